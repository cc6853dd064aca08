"""``write_whole``: a text file that appears whole or not at all; ``read_bounded``, ``unpacked``: not too long a one."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from aerokit.errors import FileFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

LARGEST_FILE = 16 << 20
"""Bytes of the largest file of parameters, metadata, plans or definitions that is read; real ones have 5 MB at most."""

_XZ = b"\xfd7zXZ\x00"

_MOST_MEMORY = 128 << 20  # xz -9 takes 65 MB


def write_whole(path: str | os.PathLike[str], text: str) -> None:
    """Write a file, UTF-8 and with Unix line ends; what was there before stays when that goes wrong (OSError)."""
    target = Path(path)
    part = target.with_name(target.name + ".part")
    part.unlink(
        missing_ok=True
    )  # what was left, or a link to a file of somebody's, through which we would write
    try:
        with part.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave the new name with nothing in it
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def read_bounded(path: str | os.PathLike[str]) -> bytes:
    """All bytes of a file; FileFormatError beyond :data:`LARGEST_FILE`, OSError when it cannot be read."""
    with open(path, "rb") as file:
        data = file.read(LARGEST_FILE + 1)
    if len(data) > LARGEST_FILE:
        raise too_large(os.fspath(path))
    return data


def too_large(name: str) -> FileFormatError:
    """The complaint about a file beyond :data:`LARGEST_FILE`."""
    return FileFormatError(f"{name} has more than {LARGEST_FILE >> 20} MB: that is no such file")


def unpacked(data: bytes, name: str) -> bytes:
    """What an ``.xz`` file holds, and other bytes as they are.

    FileFormatError, which begins with ``name``, when it is damaged or holds more than :data:`LARGEST_FILE`.
    """
    if not data.startswith(_XZ):
        return data
    import lzma  # some builds of Python are without it

    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_MEMORY)
    try:
        found = unpacker.decompress(data, LARGEST_FILE + 1)
    except lzma.LZMAError as error:
        raise FileFormatError(f"{name} is damaged: {error}") from None
    if len(found) > LARGEST_FILE:
        raise too_large(name)
    if not unpacker.eof:
        raise FileFormatError(f"{name} is damaged: it is cut off")
    return found


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file; :class:`FileFormatError` when it is no UTF-8 or too long, OSError when it cannot be read."""
    try:
        text = read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        name = Path(path).name
        raise FileFormatError(f"{name}: byte {error.start}: no text (UTF-8 was expected)") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


class PartFile:
    """``<to>.part`` until ``finish``; what is in it is always the beginning of what shall be in it.

    ``mark`` goes before ``.part``, so that beginnings of different things are not taken for each other.
    """

    def __init__(self, to: str | os.PathLike[str], mark: str = "") -> None:
        self._to = os.fspath(to)
        self.path: Path = Path(f"{self._to}{mark}.part")
        """Where it is meanwhile."""

    @property
    def size(self) -> int:
        """Bytes that an earlier attempt has left; 0 when there was none."""
        return self.path.stat().st_size if self.path.exists() else 0

    @contextmanager
    def writing(self, start: int) -> Iterator[BinaryIO]:
        """Open it for writing from ``start`` on; what was behind is gone. Nothing stays of
        an attempt that has brought nothing.

        Raises:
            OSError: it cannot be written.
        """
        try:
            with self.path.open("r+b" if start else "wb") as disk:
                disk.seek(start)
                disk.truncate()
                yield disk
        except BaseException:
            if not self.size:
                self.path.unlink(missing_ok=True)
            raise

    def finish(self) -> None:
        """Give it its name, in place of the file that may have it."""
        os.replace(self.path, self._to)
