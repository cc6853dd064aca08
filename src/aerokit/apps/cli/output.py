"""Output of commands as text or JSON lines, exit codes, and checks shared by commands."""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import select
import sys
from collections import deque
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from aerokit._internal.formatting import printable, to_jsonable
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
    import logging
    from collections.abc import Iterable, Iterator, Mapping

MAX_UNPRINTED = 1000
"""Maximum number of lines that wait for a stopped terminal. Further lines replace the oldest."""


def add_json(command: argparse._ActionsContainer) -> None:
    command.add_argument(
        "--json", action="store_true", help="print JSON, one object a line, instead of text (docs/command-line.md)"
    )


def emit(options: argparse.Namespace, kind: str, record: Mapping[str, object], text: str | None) -> None:
    """Print one record: a JSON object with ``--json``, otherwise text.

    ``kind`` is the type of the record and its first field: ``{"type": "parameter", …}``. ``record`` has the other
    fields (docs/command-line.md). If ``text`` is None, nothing is printed without ``--json``.
    """
    if options.json:
        assert "type" not in record, record
        _print_json({"type": kind, **to_jsonable(record)})
    elif text is not None:
        _print(printable(text))
    if sys.stderr is not None:
        sys.stderr.flush()  # prints what waits in `nonblocking_stderr`


def _print_json(fields: Mapping[str, object]) -> None:
    try:
        print(json.dumps(fields, ensure_ascii=False), flush=True)
    except UnicodeEncodeError:
        print(json.dumps(fields), flush=True)


def can_print(stream: TextIO | None = None) -> bool:
    """Return False if printing would block, for example after Ctrl-S. The default stream is stdout.

    A blocked program sends no heartbeats and forwards no frames.
    """
    try:
        _, writable, _ = select.select([], [sys.stdout if stream is None else stream], [], 0)
    except (OSError, ValueError, TypeError):
        # The stream is closed or no file, or this is Windows, where only sockets can be checked.
        return True
    return bool(writable)


class _NonblockingStream:
    """Wraps stderr. Texts wait while writing would block, and are lost if writing fails."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._unwritten: deque[str] = deque(maxlen=MAX_UNPRINTED)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._unwritten.append(text)
        self.flush()
        return len(text)

    def flush(self, *, may_block: bool = False) -> None:
        with suppress(OSError, IndexError):  # IndexError: another thread has just written the last text.
            while self._unwritten and (may_block or can_print(self._stream)):
                self._stream.write(self._unwritten.popleft())
                self._stream.flush()


@contextmanager
def nonblocking_stderr() -> Iterator[None]:
    """Within the block, writing to stderr never blocks: a text waits until the terminal accepts it."""
    original = sys.stderr
    if original is None:
        yield
        return
    stream: Any = _NonblockingStream(original)
    sys.stderr = stream
    try:
        yield
    finally:
        sys.stderr = original
        stream.flush(may_block=True)


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except UnicodeEncodeError:  # the encoding of the terminal does not support a character
        print(text.encode("ascii", "replace").decode(), flush=True)


def emit_error(error: BaseException, code: int, *, as_json: bool) -> None:
    text = _text(error)
    if as_json:
        _print_json({"type": "error", "error": type(error).__name__, "message": text, "exit_code": code})
    print(f"aerokit: {printable(text)}", file=sys.stderr)


def _text(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return plain_text(error) or type(error).__name__


# Error texts of the library begin with the name of a call. Maps these names to the words that a command prints instead.
_PLAIN_NAMES = {
    "arm": "arming",
    "disarm": "disarming",
    "take_off": "take-off",
    "go_to": "flight to",
    "land": "landing",
    "return_to_launch": "return to launch",
    "hold": "holding",
    "mission.start": "start of the mission",
    "mission.pause": "pause of the mission",
    "mission.resume": "continuing the mission",
    "mission.wait_finished": "flying the mission",
}
# ArduPilot's texts about mission items. They only repeat what the commands print, and do not explain failures.
MISSION_TEXT: re.Pattern[str] = re.compile(r"(?:Mission: \d+ |Reached command #\d+)[^\n]*")
_MISSION_REASON = re.compile(rf"\n  - {MISSION_TEXT.pattern}")
_CALL = re.compile(rf"({'|'.join(map(re.escape, _PLAIN_NAMES))})(?:\(([^()]*)\))?(?=: )")


def plain_text(error: BaseException) -> str:
    """Return the text of an error in the words of the command line.

    ``mission.wait_finished: the mode changed to RTL`` becomes ``flying the mission: the mode changed to RTL``. Status
    texts about mission items, such as ``Mission: 3 WP``, are removed.
    """
    text = _MISSION_REASON.sub("", str(error))
    call = _CALL.match(text)
    if call is None:
        return text
    name, arguments = call.groups()
    plain_name = f"{_PLAIN_NAMES[name]} {arguments}" if arguments else _PLAIN_NAMES[name]
    return plain_name + text[call.end() :]


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Within the block, print warnings without source lines, and log messages without advice on code."""
    import logging
    import warnings

    original = warnings.showwarning
    logger = logging.getLogger("aerokit")

    def show(message: Any, category: type[Warning], *arguments: Any, **options: Any) -> None:
        if category.__module__.partition(".")[0] == "aerokit":
            print(f"aerokit: {printable(str(message))}", file=sys.stderr)
        else:
            original(message, category, *arguments, **options)

    logger.addFilter(_rewrite_for_commands)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            yield
    finally:
        logger.removeFilter(_rewrite_for_commands)


def _rewrite_for_commands(record: logging.LogRecord) -> bool:
    # The original messages advise to change code, but users of a command have no such code.
    if str(record.msg).startswith("the async with block of vehicle %d was left: "):
        record.msg = "disconnected from vehicle %d: %s"
    if str(record.msg).startswith("the event loop was blocked") and isinstance(record.args, tuple):
        record.msg = "this computer was busy for %.1f s: no messages or heartbeats were processed"
        record.args = record.args[:1]  # because the new text has only one placeholder
    return True


DONE, FAILED, WRONG_ARGUMENTS, NO_VEHICLE, TIMED_OUT, REFUSED, UNREADABLE, NOT_INSTALLED = range(8)
INTERRUPTED = 130
# Minimum SequenceMatcher.ratio() of similar names. It allows one wrong letter in a name of four letters.
_MIN_SIMILARITY = 0.75

_MEANINGS = {
    DONE: "done",
    FAILED: "failed, or a check was negative",
    WRONG_ARGUMENTS: "wrong arguments",
    NO_VEHICLE: "no link or no vehicle",
    TIMED_OUT: "timed out",
    REFUSED: "refused by the vehicle",
    UNREADABLE: "a file cannot be read or written",
    NOT_INSTALLED: "an optional dependency is not installed",
    INTERRUPTED: "interrupted",
}


class NotInstalled(AerokitError):
    """A command needs a package that is not installed. The text names the extra to install."""


# Maps error classes to exit codes. The first class that matches an error counts.
_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (KeyboardInterrupt, INTERRUPTED),
    (NotInstalled, NOT_INSTALLED),
    (FileFormatError, UNREADABLE),
    (InvalidArgument, WRONG_ARGUMENTS),
    (LinkError, NO_VEHICLE),
    (HeartbeatTimeout, NO_VEHICLE),
    (OperationTimeout, TIMED_OUT),
    (OperationRejected, REFUSED),
    (AerokitError, FAILED),
    (OSError, UNREADABLE),
)


def exit_code(error: BaseException) -> int:
    return next((code for error_class, code in _CODES if isinstance(error, error_class)), FAILED)


def exit_codes_help() -> str:
    return "Exit codes: " + ", ".join(f"{code} {text}" for code, text in _MEANINGS.items()) + "."


def import_extra(module: str, *, extra: str) -> Any:
    """Import a module that an optional extra of aerokit provides.

    Raises NotInstalled if a package is missing. The text has the command that installs it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise NotInstalled(
            f"{error.name} is required, but not installed: {sys.executable} -m pip install {_requirement(extra)}"
        ) from None


def _requirement(extra: str) -> str:
    """Return pip's argument that installs an extra from the same source as aerokit itself."""
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import unquote

    try:
        source = json.loads(distribution("aerokit-mavlink").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        source = {}
    url = source.get("url", "")
    if url.startswith("file://") and source.get("dir_info", {}).get("editable"):
        return f"-e '{unquote(url.removeprefix('file://'))}[{extra}]'"
    if version_control := source.get("vcs_info"):
        url = f"{version_control['vcs']}+{url}@{version_control['commit_id']}"
    return f"'aerokit-mavlink[{extra}]{f' @ {url}' if url else ''}'"


def near_names(name: str, known: Iterable[str], count: int = 1) -> list[str]:
    """Return the known names that begin with ``name`` or are similar to it, the most similar first."""
    from difflib import SequenceMatcher

    plain_name = name.strip("-").upper()
    ratios: dict[str, float] = {}
    for known_name in known:
        plain_known_name = known_name.strip("-").upper()
        is_beginning = len(plain_name) >= 3 and plain_known_name.startswith(plain_name)
        matcher = SequenceMatcher(None, plain_name, plain_known_name)
        # These ratios are upper bounds of ratio(). For most names, they make the slow ratio() unnecessary.
        may_be_near = matcher.real_quick_ratio() >= _MIN_SIMILARITY and matcher.quick_ratio() >= _MIN_SIMILARITY
        if is_beginning or may_be_near:
            ratios[known_name] = 1.0 if is_beginning else matcher.ratio()
    near = (known_name for known_name, ratio in ratios.items() if ratio >= _MIN_SIMILARITY)
    return sorted(near, key=lambda near_name: (-ratios[near_name], len(near_name), near_name))[:count]


def suggestion(name: str, known: Iterable[str], count: int = 1) -> str:
    """Return ``" (did you mean 'status'?)"``, or "" if no known name is similar."""
    names = " or ".join(map(repr, near_names(name, known, count)))
    return f" (did you mean {names}?)" if names else ""


def add_force(command: argparse.ArgumentParser) -> None:
    command.add_argument("--force", action="store_true", help="replace an existing file")


def check_not_existing(file: str | Path, options: argparse.Namespace) -> None:
    if not options.force and Path(file).exists():
        raise FileExistsError(errno.EEXIST, "file exists; use --force to replace it", str(file))


@contextmanager
def new_recording(path: str | None) -> Iterator[None]:
    """Check that a recording can be written to ``path``. After the block, remove the file if it is new and empty.

    Do nothing if ``path`` is None. Raises PermissionError if the folder is not writable.
    """
    if path is None:
        yield
        return
    if not os.access(os.path.dirname(os.path.abspath(path)), os.W_OK):
        raise PermissionError(errno.EACCES, "the folder is not writable; nothing was recorded", path)
    is_new = not os.path.exists(path)
    try:
        yield
    finally:
        if is_new and os.path.exists(path) and not os.path.getsize(path):
            os.unlink(path)
