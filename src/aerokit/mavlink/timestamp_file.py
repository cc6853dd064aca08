"""``TimestampFile``: the time stamp that signing goes on from after a restart, in a file.

It is written here, and not by a program or a connection, because no frame may leave with a time stamp that is not on
the disk yet: only who makes the signature knows when that is.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from aerokit.errors import FileFormatError
from aerokit.whole_file import write_whole

__all__ = ["TimestampFile"]

_LONGEST = 64


class TimestampFile:
    """Holds one number: all time stamps that were used are below it.

    FileFormatError for other contents, OSError when it cannot be read or written. What goes wrong later does not stop a
    flight: ``error`` has it, until the file has been written again.
    """

    def __init__(self, path: str | PathLike[str], most: int) -> None:
        self._path, self._most = Path(path), most
        self.timestamp: int = self._read()
        """The number in the file; 0 when there was none."""
        self.error: OSError | None = None
        """Why it could not be written the last time."""
        self._write(self.timestamp)

    def reserve(self, timestamp: int, ahead: int) -> None:
        """See to it that the file holds more than this number, ``ahead`` more if it has to be written."""
        if timestamp < self.timestamp:
            return
        self.timestamp = min(timestamp + ahead, self._most)
        try:
            self._write(self.timestamp)
            self.error = None
        except OSError as error:
            self.error = error

    def _write(self, timestamp: int) -> None:
        write_whole(self._path, f"{timestamp}\n")

    def _read(self) -> int:
        try:
            with self._path.open("rb") as file:
                text = file.read(_LONGEST).decode("ascii", "replace")
        except FileNotFoundError:
            return 0
        if not (text.strip().isdecimal() and int(text) <= self._most):
            raise FileFormatError(f"{self._path} holds no time stamp of signing: {text[:40]!r}")
        return int(text)
