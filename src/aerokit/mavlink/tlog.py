"""Telemetry logs (``.tlog``): before each frame eight bytes, big-endian, microseconds since 1970.

The format of QGroundControl, Mission Planner, MAVProxy and pymavlink. No clock here: the caller brings the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from struct import Struct
from typing import BinaryIO

from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED

_TIME = Struct(">Q")
_MAGICS = (MAGIC_V1, MAGIC_V2)
_BLOCK = 1 << 16
_LONGEST = 8 + 280
# While a record is searched for: a clock that was never set is believed only where a record must be, because the
# zeros of a frame's header look like one.
_FIRST_TIME = 946_684_800_000_000  # the year 2000
_LAST_TIME = 4_102_444_800_000_000  # the year 2100: what claims to be later is no time stamp
_LAST = (_LAST_TIME - (1 << 48)).to_bytes(8, "big")[:2]  # the beginning of times that are surely before that


def read_tlog(source: str | PathLike[str] | BinaryIO) -> Iterator[tuple[float, bytes]]:
    """The records of a log: (seconds since 1970, whole frame), as they are, nothing checked but their shape.

    A record that was cut off at the end is left out, and bytes that are no record are passed over. A file given by its
    path is closed when the iterator ends or is closed. OSError when it cannot be read.
    """
    if isinstance(source, (str, PathLike)):
        with open(source, "rb") as file:
            yield from _records(file)
    else:
        yield from _records(source)


def _records(file: BinaryIO) -> Iterator[tuple[float, bytes]]:
    data, begin, ended, earliest = b"", 0, False, 0
    end: int | None
    while True:
        if not ended and len(data) - begin < 2 * _LONGEST:  # a record and the head of the next, to tell both
            block = file.read(_BLOCK)
            ended = not block
            data, begin = data[begin:] + block, 0
            continue
        # Almost every record is MAVLink 2 and unsigned, and so is the next: `_record_end` in half the time.
        try:
            end = begin + 20 + data[begin + 9]
            if (
                earliest
                or data[begin + 8] != MAGIC_V2
                or data[end + 8] != MAGIC_V2
                or data[begin + 10]
                or data[end + 10]
                or data[begin : begin + 2] > _LAST
                or data[end : end + 2] > _LAST
            ):
                end = _record_end(data, begin, earliest)
        except IndexError:
            end = _record_end(data, begin, earliest)
        if end is None:
            if len(data) - begin <= 8:
                return
            begin, earliest = begin + 1, _FIRST_TIME
            continue
        yield _TIME.unpack_from(data, begin)[0] / 1e6, data[begin + 8 : end]
        begin, earliest = end, 0


def _record_end(data: bytes, begin: int, earliest: int) -> int | None:
    """Where the record at ``begin`` ends; None when there is none, or not all of it, or it is too early."""
    end = _frame_end(data, begin)
    if end is None or end > len(data) or _TIME.unpack_from(data, begin)[0] < earliest:
        return None
    if len(data) - end <= 8 or _frame_end(data, end) is not None:
        return end
    return None if _looks_shifted(data, begin, end) else end


def _looks_shifted(data: bytes, begin: int, end: int) -> bool:
    """Whether a record begins inside what seems to be one, and is followed by another: then that is the true one."""
    for inside in range(begin + 1, end):
        true_end = _frame_end(data, inside)
        if true_end is not None and true_end > end and _frame_end(data, true_end) is not None:
            return True
    return False


def _frame_end(data: bytes, begin: int) -> int | None:
    """The end a record's header claims, which may be behind the data's; None when it is no such header."""
    at = begin + 8
    if len(data) - at < 3 or data[at] not in _MAGICS or _TIME.unpack_from(data, begin)[0] > _LAST_TIME:
        return None
    if data[at] == MAGIC_V1:
        return at + 8 + data[at + 1]
    if data[at + 2] > SIGNED:
        return None
    return at + 12 + data[at + 1] + (SIGNATURE_LENGTH if data[at + 2] else 0)


class TlogWriter:
    """Writes a log; a context manager. Each record goes to the file in one piece."""

    def __init__(self, target: str | PathLike[str] | BinaryIO) -> None:
        """Begin a new file at a path, or go on in a binary file, which stays the caller's to close."""
        self._owned = isinstance(target, (str, PathLike))
        self._file: BinaryIO = open(target, "wb") if isinstance(target, (str, PathLike)) else target  # noqa: SIM115
        self._closed = False

    def write(self, raw: bytes, timestamp_s: float) -> None:
        """Add one frame as it was sent or received; ``timestamp_s`` is seconds since 1970, kept to the microsecond."""
        microseconds = round(timestamp_s * 1e6)
        if not 0 <= microseconds < 1 << 64:
            raise InvalidArgument(f"timestamp_s = {timestamp_s!r} must be seconds since 1970")
        self._file.write(_TIME.pack(microseconds) + raw)

    def flush(self) -> None:
        """Hand everything to the operating system, so that a crash of the program loses nothing."""
        self._file.flush()

    def close(self) -> None:
        """Flush, and close the file if it was opened here; idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._owned:
            self._file.close()
        else:
            self._file.flush()

    def __enter__(self) -> TlogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
