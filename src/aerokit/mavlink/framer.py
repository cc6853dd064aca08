"""`Framer`: extracts frames from bytes.

The input may be datagrams or a stream cut anywhere, with noise and text between frames. The framer never raises. At
each byte that could start a frame, it applies these rules in order:

- A frame with a valid checksum is returned.
- After a plausible header, the framer waits for the rest of the frame.
- Anything else is skipped one byte at a time, so that a valid frame after noise is found.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from itertools import chain
from struct import Struct
from struct import error as StructError  # noqa: N812
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.wire import wire
from aerokit.mavlink.dialect import STANDARD, Dialect
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED, Frame, x25
from aerokit.mavlink.statistics import OTHER_SENDER, FramerStatistics, SourceLimit, SourceStatistics

MAX_SOURCES = 1024
"""Number of senders with separate counters, for a framer without a shared `SourceLimit`."""

# The message id has three bytes, for which ``struct`` has no format. The last field therefore also contains the first
# byte of the payload.
_HEADER_V2 = Struct("<BBBxBHI").unpack_from  # magic, length, flags, sequence, source, id
_HEADER_V1 = Struct("<xBBHB").unpack_from  # length, sequence, source, id
_CHECKSUM = Struct("<H").unpack_from
_MIN_LENGTH_V2 = 12
_MIN_LENGTH_V1 = 8
_MAGICS = (MAGIC_V1, MAGIC_V2)
# Finds possible starts of frames. A MAVLink 2 frame must have known flags, unless the data ends before the flags.
_find_magics = re.compile(rb"\xfe|\xfd(?=\Z|.\Z|.[\x00\x01])", re.DOTALL).finditer

# Verdicts about a position in the data.
_VALID = 0  # a whole frame with a valid checksum
_INCOMPLETE = 1  # the beginning of a plausible frame: wait for its rest
_UNLIKELY = 2  # like _INCOMPLETE, but an unknown message or too long: also look for frames that begin inside it
_UNKNOWN_MESSAGE = 3  # looks like a whole frame of an unknown message
_BAD_CRC = 4
_NOISE = 5


class _ValidFrame(NamedTuple):
    """Position of a valid frame, and parts of its header."""

    begin: int
    end: int
    message_id: int
    sequence: int
    source: int  # system id + 256 · component id


class _OutOfOrder(NamedTuple):
    """A frame whose sequence number was not the expected one."""

    position: int  # index in the list of returned frames, if the message is wanted
    ordering: int  # LATE or OTHER_SENDER
    identity: int  # sequence number << 16 | component id << 8 | system id


# Where a frame may begin, the verdict about it, and the size that the data must have for the next examination.
_Candidate = tuple[int, int, int]


class _ScanState(NamedTuple):
    """State of `_search`, from which its next call continues."""

    examined_to: int = 0
    candidates: Sequence[_Candidate] = ()
    bad_crcs: Sequence[int] = ()  # positions of frames with a wrong checksum


_NEW_SCAN = _ScanState()


class PythonFramer:
    """Extracts frames from the data of one peer on one link. Keeps at most two unfinished frames, about 600 bytes."""

    def __init__(self, dialect: Dialect = STANDARD, limit: SourceLimit | None = None) -> None:
        self.dialect = dialect
        """The known messages. Frames with other ids cannot be verified and are only counted."""
        self.wanted: Container[int] | None = None
        """Ids of the messages to return, or None for all. Other frames are only verified and counted."""
        self.keep_unknown = False
        """True to return frames of unknown messages as well, for recordings. Their checksums are not verified."""
        self.statistics: FramerStatistics = FramerStatistics()
        """Counters since the beginning."""
        self.late: list[Frame] = []
        """Frames of the last `receive` call that arrived after newer frames of their sender, and repeated frames."""
        self.foreign: list[Frame] = []
        """Frames of the last `receive` call that came from a second sender with the same ids."""
        self._rest = b""  # data kept for the next call, because a frame may begin in it
        self._scan = _NEW_SCAN  # findings of `_search` about `_rest`
        self._unknown: list[bytes] = []  # frames of unknown messages, until `receive` returns them
        self._rows = dialect.rows
        self._extras = dialect.extras
        self._limit = SourceLimit(MAX_SOURCES) if limit is None else limit  # bounds the number of senders with counters
        self._limit.join(self.statistics)
        self._sources = self.statistics.by_key

    def receive(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """Return the frames of wanted messages that ``data`` completes, in order. Their ``received_at`` is ``now``."""
        # This loop is long and duplicates `_examine` deliberately, because it runs for every frame. Anything but a
        # valid MAVLink 2 frame of a known message takes the slow path.
        if type(data) is not bytes:
            data = bytes(data)
        size = len(data)
        self.statistics.bytes += size
        if self.late or self.foreign:
            self.late, self.foreign = [], []
        elif size >= _MIN_LENGTH_V2 and not self._rest:
            # Most datagrams are a single valid frame in sequence. For these, this path is a sixth faster than the loop
            # below.
            magic, length, flags, sequence, key, message_id = _HEADER_V2(data)
            payload_end = 10 + length
            end = payload_end + (2 + SIGNATURE_LENGTH if flags else 2)
            if magic == MAGIC_V2 and flags <= SIGNED and end == size:
                message_id &= 0xFFFFFF
                try:
                    source = self._sources[key]
                    body = data[1:payload_end]
                    (checksum,) = _CHECKSUM(data, payload_end)
                    if source.expected & 0xFF == sequence and x25(body + self._extras[message_id]) == checksum:
                        source.expected += 1
                        if self.wanted is not None and message_id not in self.wanted:
                            return []
                        frame = Frame()
                        frame._body = body
                        frame.checksum = checksum
                        frame.message_id = message_id
                        frame.system_id = source.system_id
                        frame.component_id = source.component_id
                        frame.received_at = now
                        if flags:
                            frame._raw = data
                        return [frame]
                except KeyError:  # The sender or the message is unknown.
                    pass
        scan = _NEW_SCAN
        if self._rest:
            scan, data, self._rest = self._scan, self._rest + data, b""
            size = len(data)
        extras, sources, wanted = self._extras, self._sources, self.wanted
        frames: list[Frame] = []
        out_of_order: list[_OutOfOrder] | None = None
        begin = end = flags = checksum = 0
        body = b""
        while begin < size:
            try:
                magic, length, flags, sequence, key, message_id = _HEADER_V2(data, begin)
                is_valid = magic == MAGIC_V2 and flags <= SIGNED
                if is_valid:
                    message_id &= 0xFFFFFF
                    payload_end = begin + 10 + length
                    end = payload_end + 2
                    body = data[begin + 1 : payload_end]
                    (checksum,) = _CHECKSUM(data, payload_end)
                    is_valid = x25(body + extras[message_id]) == checksum
                    if flags:
                        end += SIGNATURE_LENGTH
                        is_valid = is_valid and end <= size
            except (StructError, KeyError):
                is_valid = False
                body = b""
                end = sequence = key = message_id = checksum = 0
            if not is_valid:
                # Kept data is not examined twice: `scan` has the results of the earlier call, which `_search` uses.
                next_frame = None
                if data[begin] in _MAGICS and (begin or scan is _NEW_SCAN):
                    _, _, next_frame = self._examine(data, begin)
                if next_frame is None:
                    next_frame = self._search(data, begin, _NEW_SCAN if begin else scan)
                if self._unknown:
                    frames += self._take_unknown(now)
                if next_frame is None:
                    break
                begin, end, message_id, sequence, key = next_frame
            try:
                source = sources[key]
            except KeyError:
                source = self.statistics.add_source(key, sequence, has_room=self._limit.make_room(now))
            if source.expected & 0xFF == sequence:
                source.expected += 1
            else:
                out_of_order = out_of_order or []
                if ordering := source.out_of_order(sequence, now):
                    out_of_order.append(_OutOfOrder(len(frames), ordering, sequence << 16 | key))
            if wanted is None or message_id in wanted:
                if is_valid:
                    frame = Frame()
                    frame._body = body
                    frame.checksum = checksum
                    frame.message_id = message_id
                    frame.system_id = source.system_id
                    frame.component_id = source.component_id
                    frame.received_at = now
                    if flags:
                        frame._raw = data[begin:end]
                else:
                    frame = Frame.parse(data[begin:end], now)
                frames.append(frame)
            begin = end
        if out_of_order:
            self._fill_late_and_foreign(frames, out_of_order)
        return frames

    def reset(self) -> None:
        """Drop incomplete data, because the next bytes belong to another stream."""
        self._rest = b""

    def close(self) -> None:
        """Free the places of this framer's senders in a shared `SourceLimit`. Do not use the framer afterwards."""
        self._limit.leave(self.statistics)

    def counters_of(self, frame: Frame) -> SourceStatistics | None:
        """Return the counters of a frame's sender, or None if the sender has no counters of its own."""
        return self._sources.get(frame.component_id << 8 | frame.system_id)

    @property
    def waiting(self) -> int:
        """Number of bytes kept because they may become a frame; at most a few hundred."""
        return len(self._rest)

    def _fill_late_and_foreign(self, frames: list[Frame], out_of_order: list[_OutOfOrder]) -> None:
        """Add the frames that were out of order to :attr:`late` or :attr:`foreign`."""
        for position, ordering, identity in out_of_order:
            if position < len(frames):
                frame = frames[position]
                # `frames` lacks unwanted messages, so the frame at `position` may be a different one.
                if frame.sequence << 16 | frame.component_id << 8 | frame.system_id != identity:
                    continue
                if ordering == OTHER_SENDER:
                    self.foreign.append(frame)
                else:
                    self.late.append(frame)

    # -------------------------------------------------------------------------------- slow path

    def _search(self, data: bytes, begin: int, scan: _ScanState) -> _ValidFrame | None:
        """Return the next valid frame from ``begin`` on, or None. Store data of an incomplete frame in ``_rest``.

        ``scan`` has the candidates (positions at which a frame may begin) that the previous call left undecided.
        """
        size = len(data)
        keep_from = -1  # position from which data is kept; -1 if nothing is kept
        unknown_begin = unknown_end = -1  # a possible frame of an unknown message; -1 if there is none
        examined_to = scan.examined_to
        pending: list[_Candidate] = []
        bad_crcs = list(scan.bad_crcs)
        # `_NOISE` is a placeholder. The end 0 makes the loop examine every candidate, which replaces both values.
        new_candidates = ((match.start(), _NOISE, 0) for match in _find_magics(data, max(begin, examined_to)))
        examined_to = size
        end_of_data = (size, _NOISE, size)  # makes the loop decide about an unknown frame at the end of the data
        for position, verdict, end in chain(scan.candidates, new_candidates, (end_of_data,)):
            if unknown_begin >= 0 and position >= unknown_end:
                # No valid frame begins inside the unknown frame. Skip it whole if a frame or nothing follows.
                if unknown_end == size or data[unknown_end] in _MAGICS:
                    self._count_skipped(begin, unknown_begin, bad_crcs)
                    self._skip_unknown(data, unknown_begin, unknown_end)
                    begin = unknown_end
                    keep_from = -1
                    pending = []
                    bad_crcs = [bad_crc for bad_crc in bad_crcs if bad_crc >= begin]
                unknown_begin = -1
            if position >= size:
                break
            # Examine the candidate if enough data has arrived. A verdict of `_UNKNOWN_MESSAGE` is final.
            if end <= size and verdict != _UNKNOWN_MESSAGE:
                verdict, end, frame = self._examine(data, position)
                if verdict == _VALID:
                    self._count_skipped(begin, position, bad_crcs)
                    return frame
            if verdict == _BAD_CRC:
                bad_crcs.append(position)
            elif verdict != _NOISE:
                pending.append((position, verdict, end))
            if verdict == _INCOMPLETE:
                keep_from = _earliest(keep_from, unknown_begin, position)
                examined_to = position + 1
                break  # The following bytes probably belong to this frame, so they are examined later.
            if verdict == _UNLIKELY and keep_from < 0:
                keep_from = position  # Later candidates, which may be inside this frame, are still examined.
            elif verdict == _UNKNOWN_MESSAGE and keep_from < 0 and unknown_begin < 0:
                unknown_begin, unknown_end = position, end
        keep = size if keep_from < 0 else keep_from
        self._count_skipped(begin, keep, bad_crcs)
        self._rest = data[keep:]
        self._scan = _ScanState(
            examined_to - keep,
            [(position - keep, verdict, end - keep) for position, verdict, end in pending if position >= keep],
            [bad_crc - keep for bad_crc in bad_crcs if bad_crc >= keep],
        )
        return None

    def _take_unknown(self, now: float) -> list[Frame]:
        frames = [Frame.parse(raw, now) for raw in self._unknown]
        self._unknown.clear()
        return frames

    def _skip_unknown(self, data: bytes, begin: int, end: int) -> None:
        if self.keep_unknown:
            self._unknown.append(data[begin:end])
        if data[begin] == MAGIC_V2:
            _, _, _, sequence, key, message_id = _HEADER_V2(data, begin)
        else:
            _, sequence, key, message_id = _HEADER_V1(data, begin)
        self.statistics.count_unknown(message_id & 0xFFFFFF)
        source = self._sources.get(key)
        if source is not None and source.expected & 0xFF == sequence:
            source.skip(1)  # The frame was received, so its sequence number must not count as lost.

    def _count_skipped(self, begin: int, end: int, bad_crcs: list[int]) -> None:
        """Count the bytes from ``begin`` to ``end`` as bad. They are outside frames, and are not kept in ``_rest``."""
        self.statistics.bad_bytes += end - begin
        if bad_crcs:
            self.statistics.bad_crcs += sum(position < end for position in bad_crcs)

    def _examine(self, data: bytes, begin: int) -> tuple[int, int, _ValidFrame | None]:
        """Examine a possible frame at ``begin``. Return (verdict, end, valid frame or None).

        The end is that of the frame or, if the header is incomplete, of the header.
        """
        size = len(data)
        if data[begin] == MAGIC_V2:
            if size - begin < 3:  # The flags have not arrived yet.
                return _INCOMPLETE, begin + 3, None
            if size - begin < _MIN_LENGTH_V2:
                has_valid_flags = data[begin + 2] <= SIGNED
                return (_INCOMPLETE if has_valid_flags else _NOISE), begin + _MIN_LENGTH_V2, None
            _, length, flags, sequence, key, message_id = _HEADER_V2(data, begin)
            if flags & ~SIGNED:
                return _NOISE, size, None
            message_id &= 0xFFFFFF
            payload = begin + 10
            end = payload + length + 2 + (SIGNATURE_LENGTH if flags else 0)
        else:
            if size - begin < _MIN_LENGTH_V1:
                return _INCOMPLETE, begin + _MIN_LENGTH_V1, None
            length, sequence, key, message_id = _HEADER_V1(data, begin)
            payload = begin + 6
            end = payload + length + 2
        row = self._rows.get(message_id)
        if row is None:
            return (_UNKNOWN_MESSAGE if end <= size else _UNLIKELY), end, None
        extra, base_length, full_length = row
        is_v1 = data[begin] == MAGIC_V1
        if is_v1 and not base_length <= length <= full_length:
            return _NOISE, size, None  # A MAVLink 1 payload is neither truncated nor longer than its definition.
        if end > size:
            return (_INCOMPLETE if length <= full_length else _UNLIKELY), end, None
        payload_end = payload + length
        (checksum,) = _CHECKSUM(data, payload_end)
        if x25(data[begin + 1 : payload_end] + bytes((extra,))) != checksum:
            return _BAD_CRC, end, None
        return _VALID, end, _ValidFrame(begin, end, message_id, sequence, source=key)


def _earliest(keep_from: int, unknown_begin: int, position: int) -> int:
    """Return the lowest of these positions in the data. -1 for ``keep_from`` or ``unknown_begin`` means none."""
    if unknown_begin >= 0:  # `_search` sets `unknown_begin` only before `keep_from`, so it is lower.
        return unknown_begin
    return position if keep_from < 0 else keep_from


if TYPE_CHECKING or wire is None:
    Framer = PythonFramer
else:

    class Framer(wire.FramerFields, PythonFramer):
        """`PythonFramer` with a compiled `receive`, which calls the methods in Python for rare cases."""

        def __init__(self, dialect: Dialect = STANDARD, limit: SourceLimit | None = None) -> None:
            PythonFramer.__init__(self, dialect, limit)
            self._table = dialect.table
            self._out_of_order: list[_OutOfOrder] = []

        def _find(self, data: bytes, begin: int, kept: int, now: float, frames: list[Frame]) -> int | None:
            """Return the start of the next valid frame from ``begin`` on, or None. Add unknown frames to ``frames``."""
            # Compiled code sets `kept` to 0 if no data was kept from earlier calls, to 1 if the kept data begins with
            # one plausible frame, and to 2 if `_scan` describes the kept data.
            scan = _NEW_SCAN
            if kept == 2:
                scan = self._scan
            elif kept == 1:
                scan = _ScanState(examined_to=1, candidates=[(0, _INCOMPLETE, 0)])
            next_frame = self._search(data, begin, scan)
            if self._unknown:
                frames += self._take_unknown(now)
            return None if next_frame is None else next_frame.begin

        def _add_source(self, key: int, sequence: int, now: float) -> SourceStatistics:
            return self.statistics.add_source(key, sequence, has_room=self._limit.make_room(now))

        def _count_out_of_order(
            self, source: SourceStatistics, key: int, sequence: int, now: float, position: int
        ) -> None:
            if ordering := source.out_of_order(sequence, now):
                self._out_of_order.append(_OutOfOrder(position, ordering, sequence << 16 | key))

        def _sort_out_of_order(self, frames: list[Frame]) -> None:
            out_of_order, self._out_of_order = self._out_of_order, []
            self._fill_late_and_foreign(frames, out_of_order)

        def _clear_out_of_order(self) -> None:
            self.late, self.foreign, self._out_of_order = [], [], []
