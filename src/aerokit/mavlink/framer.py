"""`Framer`: any bytes in, checked frames out.

It is fed whatever a link delivers, datagrams or a stream cut anywhere, with noise and text in between, and never
raises. What it does with each byte that could start a frame follows one order: a good checksum wins, a
plausible header is worth waiting for, anything else is passed over one byte at a time, so that a good frame behind
noise is found. https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import re
from collections.abc import Container
from itertools import chain
from struct import Struct
from struct import error as StructError  # noqa: N812

from aerokit.mavlink.dialect import STANDARD, Dialect
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED, Frame, x25
from aerokit.mavlink.statistics import OTHERS, FramerStatistics, SourceLimit, SourceStatistics

MOST_SOURCES = 1024
"""So many senders are counted apart by a framer that shares no `SourceLimit` with others."""

# The last of version 2 is the id in its lower three bytes; the byte above them belongs to what follows.
_HEADER_V2 = Struct("<BBBxBHI").unpack_from  # magic, length, flags, sequence, source, id
_HEADER_V1 = Struct("<xBBHB").unpack_from  # length, sequence, source, id
_CHECKSUM = Struct("<H").unpack_from
_SHORTEST_V2 = 12
_SHORTEST_V1 = 8
_MAGICS = (MAGIC_V1, MAGIC_V2)
# What may be the beginning of a frame; of version 2 only with flags that exist, or cut off before them.
_magics = re.compile(rb"\xfe|\xfd(?=\Z|.\Z|.[\x00\x01])", re.DOTALL).finditer

# What a place in the bytes may be.
_GOOD = 0  # a whole frame with the right checksum
_WAIT = 1  # the beginning of a likely frame
_DOUBTFUL = 2  # the beginning of an unlikely frame: wait, but look behind it meanwhile
_UNKNOWN = 3  # a whole frame of an unknown message, if it is one
_BAD_CRC = 4
_NOISE = 5

_Found = tuple[int, int, int, int, int]
"""Begin, end, message id, sequence, source."""

_Known = tuple[int, list[tuple[int, int, int]], list[int]]
"""Of bytes that are kept: how far they were looked at, what may become something (begin, verdict, until which size),
and places with bad checksums. So no byte is examined again and again while others come one by one."""
_NOTHING_KNOWN: _Known = (0, [], [])


class Framer:
    """Turns bytes of one link and one peer into frames; keeps at most two unfinished frames, about 600 bytes."""

    def __init__(self, dialect: Dialect = STANDARD, limit: SourceLimit | None = None) -> None:
        self.dialect = dialect
        """Knows the messages; ids it does not know cannot be checked and are only counted."""
        self.wanted: Container[int] | None = None
        """Ids of the messages that are returned, None for all; the others are checked and counted, nothing more."""
        self.keep_unknown = False
        """Whether frames of messages that the dialect does not know are returned too, whatever is wanted: for a
        recording. Their checksums cannot be checked."""
        self.statistics: FramerStatistics = FramerStatistics()
        """Counters since the beginning."""
        self.late: list[Frame] = []
        """Those frames of the last `receive` that newer ones of their sender have overtaken, or that came before."""
        self.foreign: list[Frame] = []
        """Those that come from another sender with the same ids."""
        self._rest = b""
        self._known = _NOTHING_KNOWN
        self._unknown: list[bytes] = []
        self._rows = dialect.rows
        self._extras = dialect.extras
        self._limit = SourceLimit(MOST_SOURCES) if limit is None else limit
        self._limit.join(self.statistics)
        self._sources = self.statistics.by_key

    def receive(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """The wanted frames that are complete with ``data``, in order; ``now`` becomes their ``received_at``.

        Never raises, whatever the bytes.
        """
        # The loop is long and repeats `_examine` on purpose: it runs for every frame on the air. What is no good frame
        # of MAVLink 2 whose message is known takes the slow path.
        if type(data) is not bytes:
            data = bytes(data)
        size = len(data)
        self.statistics.bytes += size
        if self.late or self.foreign:
            self.late, self.foreign = [], []
        elif size >= _SHORTEST_V2 and not self._rest:
            # Most datagrams are one good frame, the next one of its sender: a sixth quicker than by the loop.
            magic, length, flags, sequence, key, message_id = _HEADER_V2(data)
            upto = 10 + length
            end = upto + (2 + SIGNATURE_LENGTH if flags else 2)
            if magic == MAGIC_V2 and flags <= SIGNED and end == size:
                message_id &= 0xFFFFFF
                try:
                    source = self._sources[key]
                    body = data[1:upto]
                    (checksum,) = _CHECKSUM(data, upto)
                    if (
                        source.expected & 0xFF == sequence
                        and x25(body + self._extras[message_id]) == checksum
                    ):
                        source.expected += 1
                        if self.wanted is not None and message_id not in self.wanted:
                            return []
                        frame = Frame()
                        frame.body = body
                        frame.checksum = checksum
                        frame.message_id = message_id
                        frame.system_id = source.system_id
                        frame.component_id = source.component_id
                        frame.received_at = now
                        if flags:
                            frame._raw = data
                        return [frame]
                except KeyError:
                    pass
        known = _NOTHING_KNOWN
        if self._rest:
            known, data, self._rest = self._known, self._rest + data, b""
            size = len(data)
        extras, sources, wanted = self._extras, self._sources, self.wanted
        frames: list[Frame] = []
        out_of_order: list[tuple[int, int, int]] | None = None
        begin = end = flags = checksum = 0
        body = b""
        while begin < size:
            try:
                magic, length, flags, sequence, key, message_id = _HEADER_V2(data, begin)
                if good := magic == MAGIC_V2 and flags <= SIGNED:
                    message_id &= 0xFFFFFF
                    upto = begin + 10 + length
                    end = upto + 2
                    body = data[begin + 1 : upto]
                    (checksum,) = _CHECKSUM(data, upto)
                    good = x25(body + extras[message_id]) == checksum
                    if flags:
                        end += SIGNATURE_LENGTH
                        good = good and end <= size
            except (StructError, KeyError):
                good, body = False, b""
                end = sequence = key = message_id = checksum = 0
            if not good:
                found = None
                if data[begin] in _MAGICS and (begin or known is _NOTHING_KNOWN):
                    found = self._examine(data, begin)[2]
                if found is None:
                    found = self._search(data, begin, _NOTHING_KNOWN if begin else known)
                if self._unknown:
                    frames += [Frame.parse(raw, now) for raw in self._unknown]
                    self._unknown.clear()
                if found is None:
                    break
                begin, end, message_id, sequence, key = found
            try:
                source = sources[key]
            except KeyError:
                source = self.statistics.add_source(key, sequence, self._limit.make_room(now))
            if source.expected & 0xFF == sequence:
                source.expected += 1
            else:
                out_of_order = out_of_order or []
                if verdict := source.out_of_order(sequence, now):
                    out_of_order.append((len(frames), verdict, sequence << 16 | key))
            if wanted is None or message_id in wanted:
                if good:
                    frame = Frame()
                    frame.body = body
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
            self._sort_out(frames, out_of_order)
        return frames

    def begin_anew(self) -> None:
        """Forget the beginning of a frame: what comes next is another stream of bytes."""
        self._rest = b""

    def retire(self) -> None:
        """Give back the places of its senders in a `SourceLimit` that others share; it is not used any more."""
        self._limit.leave(self.statistics)

    def counters_of(self, frame: Frame) -> SourceStatistics | None:
        """The counters of a frame's sender; None if it is not counted apart."""
        return self._sources.get(frame.component_id << 8 | frame.system_id)

    @property
    def waiting(self) -> int:
        """Bytes kept because they may become a frame, a few hundred at most."""
        return len(self._rest)

    def _sort_out(self, frames: list[Frame], out_of_order: list[tuple[int, int, int]]) -> None:
        """Name those out of order among the frames that are returned; others were not wanted."""
        for place, verdict, which in out_of_order:
            if place < len(frames):
                frame = frames[place]
                if frame.sequence << 16 | frame.component_id << 8 | frame.system_id == which:
                    (self.foreign if verdict == OTHERS else self.late).append(frame)

    # ------------------------------------------------------------------------------ the slow path

    def _search(self, data: bytes, begin: int, known: _Known) -> _Found | None:
        """The next good frame from ``begin`` on; or None, with what may yet become one kept in ``_rest``."""
        size = len(data)
        hold = -1  # from here on the bytes are kept
        unknown = unknown_end = -1  # a whole frame of an unknown message, unless a good one is found inside
        looked_at, before, bad_crcs = known
        pending: list[tuple[int, int, int]] = []
        bad_crcs = list(bad_crcs)
        reached = size
        news = ((place.start(), _NOISE, 0) for place in _magics(data, max(begin, looked_at)))
        for here, verdict, end in chain(before, news, ((size, _NOISE, size),)):
            if unknown >= 0 and here >= unknown_end:
                if unknown_end == size or data[unknown_end] in _MAGICS:
                    self._pass(begin, unknown, bad_crcs)
                    self._unknown_passed(data, unknown, unknown_end)
                    begin = unknown_end
                    hold, pending = -1, []
                    bad_crcs = [place for place in bad_crcs if place >= begin]
                unknown = -1
            if here >= size:
                break
            if end <= size and verdict != _UNKNOWN:
                verdict, end, found = self._examine(data, here)
                if verdict == _GOOD:
                    self._pass(begin, here, bad_crcs)
                    return found
            if verdict == _BAD_CRC:
                bad_crcs.append(here)
            elif verdict != _NOISE:
                pending.append((here, verdict, end))
            if verdict == _WAIT:
                hold = _earliest(hold, unknown, here)
                reached = here + 1
                break
            if verdict == _DOUBTFUL and hold < 0:
                hold = here
            elif verdict == _UNKNOWN and hold < 0 and unknown < 0:
                unknown, unknown_end = here, end
        keep = size if hold < 0 else hold
        self._pass(begin, keep, bad_crcs)
        self._rest = data[keep:]
        self._known = (
            reached - keep,
            [(here - keep, verdict, end - keep) for here, verdict, end in pending if here >= keep],
            [here - keep for here in bad_crcs if here >= keep],
        )
        return None

    def _unknown_passed(self, data: bytes, begin: int, end: int) -> None:
        """A frame of an unknown message was here: its sender, if we know it, has not lost it."""
        if self.keep_unknown:
            self._unknown.append(data[begin:end])
        if data[begin] == MAGIC_V2:
            _, _, _, sequence, key, message_id = _HEADER_V2(data, begin)
        else:
            _, sequence, key, message_id = _HEADER_V1(data, begin)
        self.statistics.unknown(message_id & 0xFFFFFF)
        source = self._sources.get(key)
        if source is not None and source.expected & 0xFF == sequence:
            source.skip(1)

    def _pass(self, begin: int, end: int, bad_crcs: list[int]) -> None:
        """Bytes that are in no frame are behind us; those that are kept will be looked at, and counted, again."""
        self.statistics.bad_bytes += end - begin
        if bad_crcs:
            self.statistics.bad_crcs += sum(place < end for place in bad_crcs)

    def _examine(self, data: bytes, begin: int) -> tuple[int, int, _Found | None]:
        """(verdict, end, frame when good) of the place ``begin``, where a magic byte is."""
        size = len(data)
        if data[begin] == MAGIC_V2:
            if size - begin < _SHORTEST_V2:
                whole = size - begin < 3 or data[begin + 2] <= SIGNED
                return (_WAIT if whole else _NOISE), begin + (3 if size - begin < 3 else _SHORTEST_V2), None
            _, length, flags, sequence, key, message_id = _HEADER_V2(data, begin)
            if flags & ~SIGNED:
                return _NOISE, size, None
            message_id, body = message_id & 0xFFFFFF, begin + 10
            end = body + length + 2 + (SIGNATURE_LENGTH if flags else 0)
        else:
            if size - begin < _SHORTEST_V1:
                return _WAIT, begin + _SHORTEST_V1, None
            length, sequence, key, message_id = _HEADER_V1(data, begin)
            body, flags = begin + 6, 0
            end = body + length + 2
        row = self._rows.get(message_id)
        if row is None:
            return (_UNKNOWN if end <= size else _DOUBTFUL), end, None
        extra, base_length, full_length = row
        if body - begin == 6 and not base_length <= length <= full_length:
            return _NOISE, size, None  # version 1 neither trims nor knows extensions that are newer than ours
        if end > size:
            return (_WAIT if length <= full_length else _DOUBTFUL), end, None
        upto = body + length
        if x25(data[begin + 1 : upto] + bytes((extra,))) != _CHECKSUM(data, upto)[0]:
            return _BAD_CRC, end, None
        return _GOOD, end, (begin, end, message_id, sequence, key)


def _earliest(hold: int, unknown: int, here: int) -> int:
    """Where what is kept begins when something likely begins here: at what began before, if that is not settled."""
    if unknown >= 0:  # before `hold`: it is none when something is held already
        return unknown
    return here if hold < 0 else hold
