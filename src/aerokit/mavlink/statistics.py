"""Counters of a framer: `FramerStatistics`, and `SourceStatistics` with the frame loss of each sender."""

from __future__ import annotations

import math

from aerokit._internal.wire import CounterFields, SourceFields, wire

_SILENCE_S = 10.0

_MAX_UNKNOWN_IDS = 64
_HALF = 128  # Sequence numbers wrap at 256. A number that is this far ahead, or farther, counts as behind.
_WINDOW = (1 << _HALF) - 1  # mask of the bits in `_missing`
_MAX_STEP = 4  # Sequence numbers of consecutive frames of one sender rarely differ by more.
_MAX_GAP = 16  # A frame after a larger gap may come from a second sender with the same ids.
_MIN_ALTERNATIONS = 10  # If two series of sequence numbers alternate this often, they are from two senders.
_EXPIRY_S = 5.0  # A second sender with the same ids is forgotten after this silence.
_STREAM_TIMEOUT_S = 1.5  # Autopilots send HEARTBEAT every second, so a sender that is silent for longer has ended.
_MIN_RETURNS = 3  # After this many frames, a longer other stream replaces the current one.

# Results of :meth:`SourceStatistics.out_of_order`.
IN_ORDER, LATE, OTHER_SENDER = range(3)


class SourceStatistics(SourceFields):
    """Counters of one sender (system, component): frames received and lost.

    If two senders use the same ids, their sequence numbers form two streams. Lost frames are then counted only in the
    stream with more frames. When that stream has been silent for 1.5 s, they are counted only in the other stream.
    """

    expected: int

    __slots__ = (
        "_advanced_at",
        "_alternated_at",
        "_alternations",
        "_last_expected",
        "_missing",
        "_missing_base",
        "_other_at",
        "_other_count",
        "_other_expected",
        "_received_at_repetition",
        "_repeated_sequence",
        "_repetitions",
        "_returns",
        "_skipped_over",
        "_stream_start",
        "_unreceived",
        "component_id",
        "lost",
        "system_id",
    )

    _repetitions: int  # number of repeated frames with consecutive sequence numbers, up to the last one
    # If two senders use the same ids, their sequence numbers form two streams. `expected` is about the current stream.
    # The next four attributes are about the other stream. They are set when a second stream begins.
    _other_count: int  # number of frames of the other stream
    _other_at: float  # time of its last frame
    _skipped_over: int  # number of frames that counted as lost because of the gap to the other stream
    _returns: int  # number of frames of the other stream that arrived while it had more frames than the current one

    def __init__(self, system_id: int, component_id: int, sequence: int) -> None:
        self.system_id: int = system_id
        self.component_id: int = component_id
        self.lost: int = 0
        """Number of lost frames. A frame that arrives late no longer counts as lost."""
        self.expected = sequence
        """Sequence number of the next frame. Does not wrap at 255; the low byte is the number on the wire."""
        # `received` is computed as `expected - _unreceived`. A frame in sequence then changes only `expected`.
        self._unreceived = sequence
        # Missing frames: bit 0 is set if the frame before `_missing_base` is missing, bit 1 for the one before that, …
        self._missing = 0
        self._missing_base = sequence
        self._repeated_sequence = -1  # sequence number of the last repeated frame
        self._received_at_repetition = -1  # value of `received` when that frame arrived
        self._other_expected = -1  # next sequence number of the other stream; -1 if there is only one stream
        self._stream_start = 0  # value of `received` at the beginning of the current stream
        self._alternations = 0  # how often the two streams have alternated
        self._alternated_at = 0.0  # time of the last alternation
        self._last_expected = sequence  # value of `expected` at the last call of `out_of_order`
        self._advanced_at = 0.0  # time of the last call of `out_of_order` with a changed `expected`

    @property
    def received(self) -> int:
        """Number of frames received, including those that the framer does not pass on."""
        return self.expected - self._unreceived

    @property
    def loss(self) -> float:
        """Fraction of frames lost, 0..1."""
        total = self.received + self.lost
        return self.lost / total if total else 0.0

    def has_duplicates(self, now: float) -> bool:
        """Return True if two senders have used these ids within the last 5 seconds."""
        return self._alternations >= _MIN_ALTERNATIONS and now - self._alternated_at < _EXPIRY_S

    def out_of_order(self, sequence: int, now: float) -> int:
        """Process a frame whose sequence number is not `expected`, and return how it is to be treated.

        `IN_ORDER`: it is the newest frame, after lost frames or a reboot of the sender. `LATE`: a newer frame has
        overtaken it, or it is a repetition. `OTHER_SENDER`: a second sender with the same ids has sent it.
        """
        if self.expected != self._last_expected:
            self._last_expected, self._advanced_at = self.expected, now
        ahead = (sequence - self.expected) & 0xFF
        # Sequence numbers wrap, so the current stream reaches the number at which the other stream has stopped. A frame
        # that follows the current stream after a small gap belongs to the current stream.
        follows_current = ahead <= _MAX_GAP
        is_near_other = self._other_expected >= 0 and (sequence - self._other_expected) & 0xFF < _MAX_STEP
        if is_near_other and not follows_current:
            if now - self._other_at < _EXPIRY_S:
                return self._continue_other(sequence, now)
            self._other_expected = -1
        if ahead < _HALF:
            self._on_gap(ahead, now)
            return IN_ORDER
        if self._consume_missing(256 - ahead):  # A frame that counted as lost has arrived late.
            self._unreceived -= 1
            self.lost -= 1
            return LATE
        return self._on_repeated(sequence, now)

    def skip(self, count: int) -> None:
        """Advance `expected` by ``count`` frames, without counting them as received or as lost."""
        self.expected += count
        self._unreceived += count

    def _on_gap(self, ahead: int, now: float) -> None:
        """Process a frame after ``ahead`` missing frames."""
        # `out_of_order` subtracts each missing frame that arrives late.
        self.lost += ahead
        if ahead > _MAX_GAP:  # The frame may come from a second sender with the same ids.
            self._begin_stream(now)
            self._skipped_over = ahead
        missing_bits = ((1 << ahead) - 1) << 1  # bit 0 is this frame
        self._missing = self._missing_shifted(ahead + 1) | missing_bits & _WINDOW
        self.skip(ahead)
        self.expected += 1
        self._missing_base = self.expected

    def _begin_stream(self, now: float) -> None:
        # Remember where the previous stream stopped, because it may continue.
        self._other_expected = self.expected & 0xFF
        self._other_count = self.received - self._stream_start
        self._other_at = now
        self._stream_start = self.received
        self._returns = self._skipped_over = 0

    def _missing_shifted(self, advance: int) -> int:
        """Return `_missing` with its bits counted from `expected` + ``advance`` instead of `_missing_base`."""
        distance = self.expected - self._missing_base + advance
        return self._missing << distance & _WINDOW if distance < _HALF else 0

    def _consume_missing(self, behind: int) -> bool:
        """Mark the frame ``behind`` places before `expected` as received. Return True if it was missing."""
        self._missing, self._missing_base = self._missing_shifted(0), self.expected
        bit = 1 << behind - 1
        was_missing = bool(self._missing & bit)
        self._missing &= ~bit
        return was_missing

    def _on_repeated(self, sequence: int, now: float) -> int:
        """Process an old frame that was not missing. Return the same kind of result as :meth:`out_of_order`."""
        # A single old frame is a repetition. Several with consecutive numbers show that the sender rebooted.
        follows_last_repetition = sequence == (self._repeated_sequence + 1) & 0xFF
        is_next_frame = follows_last_repetition and self._received_at_repetition == self.received
        self._repetitions = self._repetitions + 1 if is_next_frame else 1
        is_near = (self.expected - sequence) & 0xFF <= _MAX_GAP
        # Links may repeat two or three recent frames, so only four in a row show a reboot. Links hardly ever repeat
        # older frames, so two are enough.
        min_repetitions = 4 if is_near else 2
        if self._repetitions >= min_repetitions:
            self._begin_stream(now)
            self._continue_at(sequence)
            return IN_ORDER
        # If two senders use the same ids, their frames alternate. Those of one sender look like repetitions.
        if follows_last_repetition:
            self._count_alternation(now)
        else:
            self._alternations = 0
            self._alternated_at = now
        self._unreceived -= 1  # `received` counts the frame, although `expected` does not advance
        self._repeated_sequence = sequence
        self._received_at_repetition = self.received
        return OTHER_SENDER if self.has_duplicates(now) else LATE

    def _continue_at(self, sequence: int) -> None:
        """Make this sequence number the newest."""
        # The skipped sequence numbers do not count as lost.
        self.skip((sequence - self.expected) & 0xFF)
        self.expected += 1
        self._missing_base = self.expected
        self._missing = self._skipped_over = 0

    def _continue_other(self, sequence: int, now: float) -> int:
        """Process a frame of the other stream. Return how it is to be treated, as :meth:`out_of_order` does."""
        current_count = self.received - self._stream_start
        is_other_longer = self._other_count > current_count
        has_current_ended = now - self._advanced_at > _STREAM_TIMEOUT_S
        self._count_alternation(now)
        if is_other_longer:
            self._returns += 1
        if has_current_ended or self._returns >= _MIN_RETURNS:
            # A shorter stream that becomes the current one starts with a count of 0.
            other_count = self._other_count if is_other_longer else 0
            self._swap_streams(sequence, now, current_count=current_count, other_count=other_count)
            return IN_ORDER
        behind = (self.expected - sequence) & 0xFF or 256  # 1 to 256 places before `expected`
        if is_other_longer and self._consume_missing(behind):
            # The frame was counted as lost, because it is in the gap between the sequence numbers of the streams.
            self.lost -= 1
            self._skipped_over -= 1
        self._other_expected = (sequence + 1) & 0xFF
        self._other_count += 1
        self._other_at = now
        self._unreceived -= 1  # `received` counts the frame, although `expected` does not advance
        self._stream_start += 1  # keeps the frame out of `current_count`
        # The longer stream is taken for the known sender's, the shorter one for that of a second sender.
        return LATE if is_other_longer else OTHER_SENDER

    def _swap_streams(self, sequence: int, now: float, *, current_count: int, other_count: int) -> None:
        """Make the other stream the current one. It continues with the frame that has this sequence number."""
        # The numbers between the two streams counted as lost, but were never sent. Some of them may already have been
        # subtracted, as frames that arrived late, so the difference may be negative.
        self.lost = max(0, self.lost - self._skipped_over)
        self._other_expected = self.expected & 0xFF
        self._other_count = current_count
        self._other_at = now
        self._stream_start = self.received - other_count
        self._returns = 0
        self._continue_at(sequence)

    def _count_alternation(self, now: float) -> None:
        if now - self._alternated_at > _EXPIRY_S:
            self._alternations = 0
        self._alternations += 1
        self._alternated_at = now

    def __repr__(self) -> str:
        return f"<{self.system_id}/{self.component_id}: {self.received} received, {self.lost} lost>"


class SourceLimit:
    """Limits the number of senders for which framers keep separate counters. Several framers can share a limit.

    When the limit is reached, senders that were silent for at least 10 s are dropped.
    """

    free: int

    __slots__ = ("_statistics", "_swept_at", "free")

    def __init__(self, maximum: int) -> None:
        self.free = maximum
        """Number of senders that can be added."""
        self._statistics: set[FramerStatistics] = set()
        self._swept_at = -math.inf

    def join(self, statistics: FramerStatistics) -> None:
        self._statistics.add(statistics)

    def leave(self, statistics: FramerStatistics) -> None:
        self._statistics.discard(statistics)
        self.free += len(statistics.sources)

    def make_room(self, now: float) -> bool:
        """Reserve a place for one more sender. Return False if none is free."""
        if not self.free and now - self._swept_at >= _SILENCE_S:
            self._swept_at = now
            for statistics in self._statistics:
                self.free += statistics.discard_silent()
        if not self.free:
            return False
        self.free -= 1
        return True


class FramerStatistics(CounterFields):
    """Counters of one framer.

    A received byte is part of a frame of a known or unknown message, counts as bad, or is still in the buffer.
    """

    unknown_ids: int

    __slots__ = (
        "_by_key",
        "_last_received",
        "_others",
        "bad_bytes",
        "bad_crcs",
        "sources",
        "unknown_ids",
        "unknown_messages",
    )

    def __init__(self) -> None:
        self.bytes: int = 0
        """Bytes received."""
        self.bad_bytes: int = 0
        """Bytes outside frames: text, noise, damaged frames."""
        self.bad_crcs: int = 0
        """Positions that look like a frame of a known message, with a wrong checksum."""
        self.unknown_ids = 0
        """Frames of messages that the dialect does not have. Such frames cannot be verified and may be noise."""
        self.unknown_messages: dict[int, int] = {}
        """Number of frames of unknown messages by message id, for the first 64 ids."""
        self.sources: dict[tuple[int, int], SourceStatistics] = {}
        """Counters by (system id, component id), for the first 1024 of 65,536 possible senders."""
        self._by_key: dict[int, SourceStatistics] = {}
        self._last_received: dict[int, int] = {}  # key → `received` at the last call of `discard_silent`
        self._others = 0  # frames of senders without counters of their own

    @property
    def frames(self) -> int:
        """Frames with a valid checksum, including those that the framer does not pass on."""
        return self._others + sum(source.received for source in self.sources.values())

    @property
    def by_key(self) -> dict[int, SourceStatistics]:
        """Like :attr:`sources`, but the key is system id + 256 · component id."""
        return self._by_key

    def add_source(self, key: int, sequence: int, has_room: bool) -> SourceStatistics:
        """Create the counters of a new sender. They are stored only if ``has_room`` is True."""
        source = SourceStatistics(key & 0xFF, key >> 8, sequence)
        if has_room:
            self._by_key[key] = source
            self.sources[source.system_id, source.component_id] = source
        else:
            self._others += 1
        return source

    def discard_silent(self) -> int:
        """Drop the senders without frames since the last call, and return their number."""
        silent = [key for key, source in self._by_key.items() if self._last_received.get(key) == source.received]
        for key in silent:
            self._others += self._by_key.pop(key).received
            del self.sources[key & 0xFF, key >> 8]
        self._last_received = {key: source.received for key, source in self._by_key.items()}
        return len(silent)

    def count_unknown(self, message_id: int) -> None:
        """Count a frame of an unknown message."""
        self.unknown_ids += 1
        counts = self.unknown_messages
        if message_id in counts or len(counts) < _MAX_UNKNOWN_IDS:
            counts[message_id] = counts.get(message_id, 0) + 1

    def __repr__(self) -> str:
        names = ("bytes", "frames", "bad_bytes", "bad_crcs", "unknown_ids")
        return f"<FramerStatistics {', '.join(f'{name}={getattr(self, name)}' for name in names)}>"


if wire is not None:
    wire.register(1, SourceStatistics)
    wire.register(2, FramerStatistics)
