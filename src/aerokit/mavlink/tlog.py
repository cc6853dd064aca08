"""Telemetry logs (``.tlog``): each frame is preceded by eight bytes, big-endian, with microseconds since 1970.

QGroundControl, Mission Planner, MAVProxy and pymavlink use this format. Times are arguments, because this module has no
clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from struct import Struct
from typing import Any, BinaryIO

from aerokit._internal.wire import wire
from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED

_TIME = Struct(">Q")
_MAGICS = (MAGIC_V1, MAGIC_V2)
_BLOCK = 1 << 16
_MAX_RECORD = 8 + 280  # the time and the longest frame
# After garbage, a time before the year 2000 does not begin a record, because zeros in a frame's header look like one.
# Directly after another record, such a time is accepted, because the computer's clock may be wrong.
_FIRST_TIME = 946_684_800_000_000  # the year 2000
_LAST_TIME = 4_102_444_800_000_000  # the year 2100; a larger number is not a timestamp
# A time whose first two bytes are at most these is before _LAST_TIME. The check of two bytes is quick.
_MAX_TIME_PREFIX = (_LAST_TIME - (1 << 48)).to_bytes(8, "big")[:2]


def read_tlog(source: str | PathLike[str] | BinaryIO) -> Iterator[tuple[float, bytes]]:
    """Yield the records of a log as (seconds since 1970, whole frame). Checksums are not verified.

    Bytes that are not a record, and a truncated record at the end, are skipped. A file opened by path is closed when
    the iterator ends or is closed. OSError if the file cannot be read.
    """
    if isinstance(source, (str, PathLike)):
        with open(source, "rb") as file:
            yield from _records(file)
    else:
        yield from _records(source)


_compiled: Any = None if wire is None else wire.tlog_records


def _records(file: BinaryIO) -> Iterator[tuple[float, bytes]]:
    """Yield the time, in seconds since 1970, and the frame of each record."""
    data = b""  # a part of the file
    begin: int = 0  # position of the next record in `data`
    end: int | None
    is_at_end = False  # True if the whole file has been read
    min_time = 0  # minimum time of the next record: 0 or _FIRST_TIME
    while True:
        # `data` must contain a whole record and the header of the next one, so that the record can be verified.
        if not is_at_end and len(data) - begin < 2 * _MAX_RECORD:
            block = file.read(_BLOCK)
            is_at_end = not block
            data, begin = data[begin:] + block, 0
            continue
        if _compiled is not None and not min_time:
            records, begin = _compiled(data, begin)
            if records:
                yield from records
                continue
        # Fast path for two consecutive records with unsigned MAVLink 2 frames. A record has 20 bytes in addition to the
        # payload: 8 for the time and 12 for the frame.
        try:
            end = begin + 20 + data[begin + 9]
            if (
                min_time
                or data[begin + 8] != MAGIC_V2
                or data[end + 8] != MAGIC_V2
                or data[begin + 10]
                or data[end + 10]
                or data[begin : begin + 2] > _MAX_TIME_PREFIX
                or data[end : end + 2] > _MAX_TIME_PREFIX
            ):
                end = _record_end(data, begin, min_time)
        except IndexError:  # The data ends here, so this is the last record, or garbage.
            end = _record_end(data, begin, min_time)
        if end is None:
            if len(data) - begin <= 8:  # The rest of the file is too short for a record.
                return
            begin, min_time = begin + 1, _FIRST_TIME  # No record begins here: search from the next byte on.
            continue
        yield _TIME.unpack_from(data, begin)[0] / 1e6, data[begin + 8 : end]
        begin, min_time = end, 0


def _record_end(data: bytes, begin: int, min_time: int) -> int | None:
    """Return the end of the record at ``begin``; None if it is incomplete, before ``min_time``, or not a record."""
    end = _frame_end(data, begin)
    if end is None or end > len(data) or _TIME.unpack_from(data, begin)[0] < min_time:
        return None
    if len(data) - end <= 8 or _frame_end(data, end) is not None:  # The log ends here, or another record follows.
        return end
    return None if _looks_shifted(data, begin, end) else end


def _looks_shifted(data: bytes, begin: int, end: int) -> bool:
    """Return True if a record probably begins between ``begin`` and ``end``, instead of at ``begin``."""
    for inside in range(begin + 1, end):
        inside_end = _frame_end(data, inside)
        # True if a possible record begins at `inside`, ends after `end`, and is followed by another record.
        if inside_end is not None and inside_end > end and _frame_end(data, inside_end) is not None:
            return True
    return False


def _frame_end(data: bytes, begin: int) -> int | None:
    """Return the end of a frame according to its header; None if there is no header."""
    start = begin + 8  # The frame follows the time, which has 8 bytes.
    if len(data) - start < 3 or data[start] not in _MAGICS or _TIME.unpack_from(data, begin)[0] > _LAST_TIME:
        return None
    magic, payload_length, flags = data[start : start + 3]
    if magic == MAGIC_V1:
        return start + 8 + payload_length
    if flags > SIGNED:
        return None
    return start + 12 + payload_length + (SIGNATURE_LENGTH if flags else 0)


class TlogWriter:
    """Writes a log; also a context manager. Each record is written in one piece."""

    def __init__(self, target: str | PathLike[str] | BinaryIO) -> None:
        """Create a new file at a path, or append to a binary file, which the caller closes."""
        self._owned = isinstance(target, (str, PathLike))
        self._file: BinaryIO = open(target, "wb") if isinstance(target, (str, PathLike)) else target  # noqa: SIM115
        self._closed = False

    def write(self, raw: bytes, timestamp_s: float) -> None:
        """Write one frame. ``timestamp_s`` is in seconds since 1970; it is rounded to microseconds."""
        microseconds = timestamp_s * 1e6
        if not 0 <= microseconds < 1 << 64:  # NaN is refused, too
            raise InvalidArgument(f"timestamp_s = {timestamp_s!r} must be seconds since 1970")
        self._file.write(_TIME.pack(round(microseconds)) + raw)

    def flush(self) -> None:
        """Pass all data to the operating system, so that it survives a crash of the program."""
        self._file.flush()

    def close(self) -> None:
        """Flush, and close the file if it was opened here. Idempotent."""
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
