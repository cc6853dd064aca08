"""Text files, as people have them: with or without a byte order mark, any line ends."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.errors import FileFormatError
from aerokit.whole_file import read_bounded

if TYPE_CHECKING:
    import os

__all__ = ["read_text"]


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file; :class:`FileFormatError` when it is no UTF-8 or too long, OSError when it cannot be read."""
    try:
        text = read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        name = Path(path).name
        raise FileFormatError(f"{name}: byte {error.start}: no text (UTF-8 was expected)") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")
