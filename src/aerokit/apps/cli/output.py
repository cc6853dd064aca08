"""What commands print: text for people, or with ``--json`` one JSON object a line for programs."""

from __future__ import annotations

import argparse
import errno
import json
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit._internal.plain import plain, printable
from aerokit.errors import (
    AerokitError,
    FileFormatError,
    HeartbeatTimeout,
    InvalidArgument,
    LinkError,
    OperationRejected,
    OperationTimeout,
)

if TYPE_CHECKING:
    from collections.abc import Mapping


def add_json(command: argparse._ActionsContainer) -> None:
    """Add ``--json``."""
    command.add_argument(
        "--json",
        action="store_true",
        help="print JSON, one object a line, instead of text (docs/command-line.md)",
    )


def tell(options: argparse.Namespace, kind: str, record: Mapping[str, object], text: str | None) -> None:
    """Print one thing that is told.

    Args:
        options: of the command, which say whether JSON is wanted.
        kind: what it is, ``"parameter"``: the first key of the object, ``{"type": "parameter", …}``.
        record: its fields as docs/command-line.md lists them; made JSON by :func:`aerokit._internal.plain.plain`.
        text: the same for people; None: nothing.
    """
    if options.json:
        assert "type" not in record, record
        told = {"type": kind, **plain(record)}
        try:
            print(json.dumps(told, ensure_ascii=False), flush=True)
        except UnicodeEncodeError:
            print(json.dumps(told), flush=True)
    elif text is not None:
        _print(printable(text))


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except UnicodeEncodeError:  # a terminal that has no such characters
        print(text.encode("ascii", "replace").decode(), flush=True)


def tell_done(options: argparse.Namespace, action: str, text: str | None = None) -> None:
    """Tell programs that an action is done that has nothing else to tell; people only what ``text`` says."""
    tell(options, "done", {"action": action}, text)


def tell_error(error: BaseException, code: int, *, as_json: bool) -> None:
    """Say why a command failed: on stderr, and with ``--json`` as its last object, too."""
    text = _text(error)
    if as_json:
        record = {"type": "error", "error": type(error).__name__, "message": text, "exit_code": code}
        print(json.dumps(record, ensure_ascii=False), flush=True)
    print(f"aerokit: {printable(text)}", file=sys.stderr)


def _text(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__


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


def need(module: str, extra: str) -> Any:
    """Import a module of an extra.

    Raises:
        NotInstalled: it is not there; the text says what to install.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise NotInstalled(
            f"this needs {error.name}, which is not installed: pip install 'aerokit-mavlink[{extra}]'"
        ) from None


def add_force(command: argparse.ArgumentParser) -> None:
    """Add ``--force``."""
    command.add_argument("--force", action="store_true", help="replace a file that is there already")


def check_new(file: str, options: argparse.Namespace) -> None:
    """Look before anything is sent.

    Raises:
        FileExistsError: the file is there, and ``--force`` is not given.
    """
    if not options.force and Path(file).exists():
        raise FileExistsError(errno.EEXIST, "is there already; --force replaces it", file)


def make_new_recording(path: str) -> None:
    """Make the file now, so that nobody else's is replaced.

    Raises:
        FileExistsError: the file is there.
    """
    try:
        with open(path, "xb"):
            pass
    except FileExistsError as error:
        raise FileExistsError(error.errno, "is there already; nothing was recorded", path) from None


def remove_if_empty(path: str) -> None:
    """Take a recording away that was made a moment ago, when nothing came of it."""
    if not os.path.getsize(path):
        os.unlink(path)
