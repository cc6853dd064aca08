"""What a framer counts: `FramerStatistics`, and per sender `SourceStatistics` with the frames that were lost."""

from __future__ import annotations

import math

_QUIET_S = 10.0

_MOST_UNKNOWN = 64
_HALF = 128  # a counter that is more than this behind is late, not lost
_WINDOW = (1 << _HALF) - 1
_NEAR = 4  # two frames of one stream are mostly no farther apart
_FAR = 16  # a frame so far ahead of the others may be of another stream
_TURNS = 10  # two streams that took turns so often are two
_FORGOTTEN_S = 5.0
_OVER_S = 1.5  # no autopilot is quiet for so long
_RETURNS = 3

IN_ORDER, LATE, OTHERS = range(3)
"""What :meth:`SourceStatistics.out_of_order` says of a frame: new, overtaken or repeated, of another stream."""


class SourceStatistics:
    """One sender, (system, component): how many of its frames came, and how many did not.

    Two senders with the same ids are noticed by their counters: a stream that goes on at its own place while the other
    goes on at its own. The one with more frames is taken for the sender, until it has been quiet for 1.5 s.
    """

    expected: int

    __slots__ = (
        "_double_at",
        "_late_at",
        "_late_run",
        "_late_sequence",
        "_missing",
        "_missing_at",
        "_moved_at",
        "_other",
        "_other_at",
        "_other_count",
        "_returns",
        "_seen",
        "_since",
        "_skipped_over",
        "_turns",
        "_without",
        "component_id",
        "expected",
        "lost",
        "system_id",
    )

    _late_run: int  # of those that came before: so many in a row, with nothing else in between
    # Once there is another stream in this one's name:
    _other_count: int  # how many frames of it came
    _other_at: float
    _skipped_over: int  # counted as lost when the present one began
    _returns: int  # frames at the other place, of the stream that was here before

    def __init__(self, system_id: int, component_id: int, sequence: int) -> None:
        self.system_id: int = system_id
        self.component_id: int = component_id
        self.lost: int = 0
        """Frames missing in the sequence; one that comes late after all is taken off again."""
        self.expected = sequence
        """The sequence number of the next frame; its low byte is what is on the wire, it counts on beyond 255."""
        # How far `expected` has come without a frame: then a frame costs one addition.
        self._without = sequence
        self._missing = 0  # bit n: the frame n + 1 before `_missing_at` has not come
        self._missing_at = sequence
        self._late_sequence = self._late_at = -1
        self._other = -1  # where another stream in this one's name goes on; -1: there is none
        self._since = 0  # value of `received` when the present stream began
        self._turns, self._double_at = 0, 0.0
        self._seen, self._moved_at = sequence, 0.0

    @property
    def received(self) -> int:
        """Frames that came, whether anyone wanted them or not."""
        return self.expected - self._without

    @property
    def loss(self) -> float:
        """Share of frames lost, 0..1."""
        total = self.received + self.lost
        return self.lost / total if total else 0.0

    def is_double(self, now: float) -> bool:
        """Whether two senders were heard under these ids in the last seconds."""
        return self._turns >= _TURNS and now - self._double_at < _FORGOTTEN_S

    def out_of_order(self, sequence: int, now: float) -> int:
        """A frame came whose number is not `expected`: a gap, a late one, a double, a reboot, or another sender.

        Returns `IN_ORDER` if it is the newest of its sender all the same, else `LATE` or `OTHERS`.
        """
        if self.expected != self._seen:
            self._seen, self._moved_at = self.expected, now
        ahead = (sequence - self.expected) & 0xFF
        if self._other >= 0 and (sequence - self._other) & 0xFF < _NEAR:
            if now - self._other_at < _FORGOTTEN_S:
                return self._of_the_other(sequence, now)
            self._other = -1
        if ahead < _HALF:
            self._gap(ahead, sequence, now)
            return IN_ORDER
        if self._was_missing(256 - ahead):
            self._without -= 1
            self.lost -= 1
            return LATE
        return self._again_or_anew(sequence, now)

    def skip(self, count: int) -> None:
        """Let ``count`` numbers pass that are neither received nor lost: of messages that cannot be checked."""
        self.expected += count
        self._without += count

    def _gap(self, ahead: int, sequence: int, now: float) -> None:
        self.lost += ahead
        if ahead > _FAR:
            self._begin_stream(now)
            self._skipped_over = ahead
        self._missing = self._shifted(ahead + 1) | ((1 << ahead) - 1) << 1 & _WINDOW
        self.skip(ahead)
        self.expected += 1
        self._missing_at = self.expected

    def _begin_stream(self, now: float) -> None:
        """What follows goes on at another place; the old place is kept for a while."""
        self._other, self._other_count = self.expected & 0xFF, self.received - self._since
        self._other_at = now
        self._since, self._returns, self._skipped_over = self.received, 0, 0

    def _shifted(self, further: int) -> int:
        distance = self.expected - self._missing_at + further
        return self._missing << distance & _WINDOW if distance < _HALF else 0

    def _was_missing(self, behind: int) -> bool:
        self._missing, self._missing_at = self._shifted(0), self.expected
        bit = 1 << behind - 1
        was_missing = bool(self._missing & bit)
        self._missing &= ~bit
        return was_missing

    def _again_or_anew(self, sequence: int, now: float) -> int:
        """It came before: a double; or several in a row did, with nothing else in between: a reboot."""
        follows = sequence == (self._late_sequence + 1) & 0xFF
        self._late_run = self._late_run + 1 if follows and self._late_at == self.received else 0
        is_near = (self.expected - sequence) & 0xFF <= _FAR
        if self._late_run >= (3 if is_near else 1):
            self._begin_stream(now)
            self._go_on_at(sequence)
            return IN_ORDER
        self._take_turns(now, 1 if follows else -self._turns)
        self._without -= 1
        self._late_sequence, self._late_at = sequence, self.received
        return OTHERS if self.is_double(now) else LATE

    def _go_on_at(self, sequence: int) -> None:
        self.skip((sequence - self.expected) & 0xFF)
        self.expected += 1
        self._missing, self._missing_at, self._skipped_over = 0, self.expected, 0

    def _of_the_other(self, sequence: int, now: float) -> int:
        """The stream at the other place goes on: it is the sender's if more came of it, or this one is over."""
        count, was_first = self.received - self._since, self._other_count > self.received - self._since
        is_over = now - self._moved_at > _OVER_S
        self._take_turns(now, 1)
        self._returns += was_first
        if is_over or self._returns >= _RETURNS:
            self._swap(sequence, now, count, self._other_count if was_first else 0)
            return IN_ORDER
        if was_first and self._was_missing((self.expected - sequence) & 0xFF or 256):
            self.lost -= 1
            self._skipped_over -= 1
        self._other, self._other_count = (sequence + 1) & 0xFF, self._other_count + 1
        self._other_at = now
        self._without -= 1
        self._since += 1
        return LATE if was_first else OTHERS

    def _swap(self, sequence: int, now: float, count: int, other_count: int) -> None:
        self.lost = max(0, self.lost - self._skipped_over)  # of those skipped some may have come late
        self._other, self._other_count, self._other_at = self.expected & 0xFF, count, now
        self._since, self._returns = self.received - other_count, 0
        self._go_on_at(sequence)

    def _take_turns(self, now: float, count: int) -> None:
        if now - self._double_at > _FORGOTTEN_S:
            self._turns = 0
        self._turns = max(0, self._turns + count)
        self._double_at = now

    def __repr__(self) -> str:
        return f"<{self.system_id}/{self.component_id}: {self.received} received, {self.lost} lost>"


class SourceLimit:
    """How many senders are counted apart, by all the framers that share it; others are counted together.

    When it is full, those that were quiet for the last 10 s at least make room.
    """

    free: int

    __slots__ = ("_statistics", "_swept_at", "free")

    def __init__(self, most: int) -> None:
        self.free = most
        """So many more may come."""
        self._statistics: set[FramerStatistics] = set()
        self._swept_at = -math.inf

    def join(self, statistics: FramerStatistics) -> None:
        """Count the senders of these, too."""
        self._statistics.add(statistics)

    def leave(self, statistics: FramerStatistics) -> None:
        """These are not in use any more."""
        self._statistics.discard(statistics)
        self.free += len(statistics.sources)

    def make_room(self, now: float) -> bool:
        """Whether one more may be counted, and take its place."""
        if not self.free and now - self._swept_at >= _QUIET_S:
            self._swept_at = now
            for statistics in self._statistics:
                self.free += statistics.forget_quiet()
        if not self.free:
            return False
        self.free -= 1
        return True


class FramerStatistics:
    """Counters of one framer since it was made; every byte is in a frame, in an unknown one, bad, or still waiting."""

    unknown_ids: int

    __slots__ = (
        "_by_key",
        "_heard",
        "_others",
        "bad_bytes",
        "bad_crcs",
        "bytes",
        "sources",
        "unknown_ids",
        "unknown_messages",
    )

    def __init__(self) -> None:
        self.bytes: int = 0
        """Bytes taken in."""
        self.bad_bytes: int = 0
        """Bytes that belong to no frame: text, noise, damaged frames."""
        self.bad_crcs: int = 0
        """Places that looked like a frame of a known message, but for the checksum."""
        self.unknown_ids = 0
        """Frames, as far as one can tell, of messages this dialect does not know; their checksum cannot be checked."""
        self.unknown_messages: dict[int, int] = {}
        """Message id → how many of these frames; of the first 64 ids, because noise could name any number."""
        self.sources: dict[tuple[int, int], SourceStatistics] = {}
        """(system id, component id) → what came from there; of the first 1024 senders, for there could be 65,536."""
        self._by_key: dict[int, SourceStatistics] = {}
        self._heard: dict[int, int] = {}
        self._others = 0

    @property
    def frames(self) -> int:
        """Frames whose checksum was right, wanted or not."""
        return self._others + sum(source.received for source in self.sources.values())

    @property
    def by_key(self) -> dict[int, SourceStatistics]:
        """What :attr:`sources` has, by system id + 256 · component id."""
        return self._by_key

    def add_source(self, key: int, sequence: int, may_stay: bool) -> SourceStatistics:
        """Begin to count a sender; one that may not stay is counted with the others, and forgotten."""
        source = SourceStatistics(key & 0xFF, key >> 8, sequence)
        if may_stay:
            self._by_key[key] = self.sources[source.system_id, source.component_id] = source
        else:
            self._others += 1
        return source

    def forget_quiet(self) -> int:
        """Forget the senders of which nothing has come since this was last asked; how many these were."""
        quiet = [key for key, source in self._by_key.items() if self._heard.get(key) == source.received]
        for key in quiet:
            self._others += self._by_key.pop(key).received
            del self.sources[key & 0xFF, key >> 8]
        self._heard = {key: source.received for key, source in self._by_key.items()}
        return len(quiet)

    def unknown(self, message_id: int) -> None:
        """Count a frame of an unknown message."""
        self.unknown_ids += 1
        seen = self.unknown_messages
        if message_id in seen or len(seen) < _MOST_UNKNOWN:
            seen[message_id] = seen.get(message_id, 0) + 1

    def __repr__(self) -> str:
        names = ("bytes", "frames", "bad_bytes", "bad_crcs", "unknown_ids")
        return f"<FramerStatistics {', '.join(f'{name}={getattr(self, name)}' for name in names)}>"
