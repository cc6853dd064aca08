"""``opened_bin``: pymavlink's reader on a ``.bin`` of ArduPilot, whose file is closed whatever happens."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.errors import FileFormatError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["close_bin", "opened_bin"]

_MAGIC = b"\xa3\x95"


def opened_bin(path: Path, on_percent: Callable[[float], object] | None = None) -> Any:
    """A ``DFReader_binary``, to be closed by :func:`close_bin`.

    Raises:
        FileFormatError: it is no log of ArduPilot, or its formats are damaged.
    """
    with path.open("rb") as file:
        if file.read(2) != _MAGIC:
            raise FileFormatError(f"{path} is no log of ArduPilot: it does not begin like one")
    kind = import_module("pymavlink.DFReader").DFReader_binary
    reader = kind.__new__(kind)  # so that its file can be closed when it raises on damage
    try:
        with redirect_stdout(sys.stderr):  # it prints what is damaged, where our answers may go to
            reader.__init__(str(path), progress_callback=on_percent)
    except Exception as error:  # whatever it raises
        close_bin(reader)
        raise FileFormatError(f"{path} cannot be read: {error}") from None
    return reader


def close_bin(reader: Any) -> None:
    """Close its file."""
    for name in ("data_map", "filehandle"):
        with suppress(AttributeError, BufferError):  # opened never, or still looked at by a traceback
            getattr(reader, name).close()
