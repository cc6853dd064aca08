"""Atomic writing of text files, and reading of files with a size limit."""

from __future__ import annotations

import errno
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, ClassVar

from aerokit.errors import FileFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self

MAX_FILE_SIZE = 16 << 20
"""Size limit in bytes for files of parameters, metadata, plans and definitions; real files have at most 5 MB."""

_XZ_MAGIC = b"\xfd7zXZ\x00"
_XZ_MEMORY_LIMIT = 128 << 20  # Files compressed by xz -9 need 65 MB.


def write_atomically(path: str | os.PathLike[str], text: str) -> None:
    """Write a UTF-8 file with Unix line ends.

    If writing fails (OSError), the previous content is kept.
    """
    target = Path(path)
    part_file = target.with_name(target.name + ".part")
    # An earlier attempt may have left this file, and a symbolic link of this name would redirect the writing.
    part_file.unlink(missing_ok=True)
    try:
        with part_file.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())  # Without this, a power failure could leave an empty file under the new name.
        part_file.replace(target)
    finally:
        part_file.unlink(missing_ok=True)


def read_bounded(path: str | os.PathLike[str]) -> bytes:
    """Read a file.

    Raises FileFormatError if it is larger than :data:`MAX_FILE_SIZE`, and OSError if it cannot be read.
    """
    with open(path, "rb") as file:
        data = file.read(MAX_FILE_SIZE + 1)
    if len(data) > MAX_FILE_SIZE:
        raise file_too_large(os.fspath(path))
    return data


def file_too_large(name: str) -> FileFormatError:
    return FileFormatError(f"{name} is too large: more than {MAX_FILE_SIZE >> 20} MB")


def decompress(data: bytes, name: str) -> bytes:
    """Decompress ``.xz`` data. Other data is returned unchanged.

    Raises FileFormatError if the data is damaged, needs too much memory, or decompresses to more than
    :data:`MAX_FILE_SIZE`. The error text begins with ``name``.
    """
    if not data.startswith(_XZ_MAGIC):
        return data
    import lzma  # Some builds of Python do not have lzma.

    decompressor = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY_LIMIT)
    try:
        content = decompressor.decompress(data, MAX_FILE_SIZE + 1)
    except lzma.LZMAError as error:
        raise FileFormatError(f"{name} cannot be decompressed: {error}") from None
    if len(content) > MAX_FILE_SIZE:
        raise file_too_large(name)
    if not decompressor.eof:
        raise FileFormatError(f"{name} is damaged: the file is truncated")
    return content


def read_text(path: str | os.PathLike[str]) -> str:
    """Read a text file. Line ends are converted to those of Unix.

    Raises FileFormatError if it is too large or not UTF-8, and OSError if it cannot be read.
    """
    try:
        text = read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        name = Path(path).name
        raise FileFormatError(f"{name}: byte {error.start} is not valid UTF-8 text") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


class PartFile:
    """A download in progress: until :meth:`finish`, ``<destination><mark>.part`` holds the beginning of the file.

    ``mark`` identifies the file that is downloaded, so that the partial download of another file is not continued. Use
    the object in a `with` statement, which raises OSError while another download of this program writes the file.
    """

    _claimed: ClassVar[dict[str, PartFile]] = {}  # maps absolute paths to the downloads that write these files

    def __init__(self, destination: str | os.PathLike[str], mark: str = "") -> None:
        self._destination = os.fspath(destination)
        self.path: Path = Path(f"{self._destination}{mark}.part")
        """Path of the partial file."""

    def __enter__(self) -> Self:
        self._claim = os.path.abspath(self.path)
        # One dict operation, because downloads of several vehicles may run on several threads.
        if self._claimed.setdefault(self._claim, self) is not self:
            raise OSError(errno.EBUSY, "another download is writing this file", self._claim)
        return self

    def __exit__(self, *_: object) -> None:
        del self._claimed[self._claim]

    @property
    def size(self) -> int:
        """Size in bytes of the partial file; 0 if there is none."""
        return self.path.stat().st_size if self.path.exists() else 0

    @contextmanager
    def writing(self, start: int) -> Iterator[BinaryIO]:
        """Open the file for writing at offset ``start``, and truncate it there.

        If an error ends the `with` block, an empty file is removed. Raises OSError if the file cannot be written.
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
        """Rename the partial file to its final name. An existing file is replaced."""
        os.replace(self.path, self._destination)
