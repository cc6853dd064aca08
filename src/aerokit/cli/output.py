"""What commands print: text for people, or with ``--json`` one JSON object a line for programs."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from aerokit.plain import plain, printable

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["add_json", "printable", "tell", "tell_done", "tell_error"]


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
        record: its fields as docs/command-line.md lists them; made JSON by :func:`aerokit.plain.plain`.
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
