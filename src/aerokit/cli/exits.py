"""How commands end: one exit code for each kind of failure, so that scripts can tell them apart."""

from __future__ import annotations

from aerokit.errors import (
    AerokitError,
    FileFormatError,
    HeartbeatTimeout,
    InvalidArgument,
    LinkError,
    OperationRejected,
    OperationTimeout,
)

__all__ = [
    "DONE",
    "FAILED",
    "INTERRUPTED",
    "NOTHING_HEARD",
    "NOT_INSTALLED",
    "REFUSED",
    "TIMED_OUT",
    "UNREADABLE",
    "WRONG_ARGUMENTS",
    "NotInstalled",
    "describe",
    "exit_code",
]

DONE, FAILED, WRONG_ARGUMENTS, NOTHING_HEARD, TIMED_OUT, REFUSED, UNREADABLE, NOT_INSTALLED = range(8)
INTERRUPTED = 130

_MEANINGS = {
    DONE: "done",
    FAILED: "failed, or the answer is no",
    WRONG_ARGUMENTS: "wrong arguments",
    NOTHING_HEARD: "no link or no vehicle",
    TIMED_OUT: "no answer in time",
    REFUSED: "the vehicle refused",
    UNREADABLE: "a file cannot be read or written",
    NOT_INSTALLED: "an extra is not installed",
    INTERRUPTED: "interrupted",
}


class NotInstalled(AerokitError):
    """A command needs packages that come with an extra; the text names it."""


_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (KeyboardInterrupt, INTERRUPTED),
    (NotInstalled, NOT_INSTALLED),
    (FileFormatError, UNREADABLE),
    (InvalidArgument, WRONG_ARGUMENTS),
    (LinkError, NOTHING_HEARD),
    (HeartbeatTimeout, NOTHING_HEARD),
    (OperationTimeout, TIMED_OUT),
    (OperationRejected, REFUSED),
    (AerokitError, FAILED),
    (OSError, UNREADABLE),
)
"""The first that fits counts."""


def exit_code(error: BaseException) -> int:
    """The exit code of a command that ends by this error."""
    return next((code for kind, code in _CODES if isinstance(error, kind)), FAILED)


def describe() -> str:
    """All of them in one line, for ``--help``."""
    return "Exit codes: " + ", ".join(f"{code} {text}" for code, text in _MEANINGS.items()) + "."
