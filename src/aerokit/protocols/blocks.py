"""``BlockRequests``: which blocks of a file are asked for or sent next, how many at a time, and which of them again."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.protocols.exchange import RoundTrip

OVERTAKEN = 3
"""Answers come in the order of their requests. One that so many later ones have overtaken was lost."""

AT_ONCE = 4
"""ArduPilot keeps five requests waiting, drops what comes beside, and looks at them every 2 ms."""

SPACING_S = 0.002
"""Between further ones."""

SOON = 0.5
"""An answer that comes within this part of the fastest round trip was to an earlier sending."""

STEADY = 3
"""So often in a row an answer may be overdue before requests come more rarely: radios lose single frames."""


class AdaptiveWindow:
    """How many requests may be under way: as many as the link carries without their answers taking longer.

    It grows while answers come as fast as the fastest ones, and shrinks when they take much longer: they wait in a
    queue then. Loss says nothing, radios lose frames; only when most is lost, something is too full.
    """

    def __init__(self, *, start: int = 4, lowest: int = 2, highest: int = 64) -> None:
        self._size = float(start)
        self._lowest, self._highest = lowest, highest
        self._fastest_s: float | None = None
        self._loss = 0.0

    @property
    def size(self) -> int:
        """Requests that may be under way."""
        return int(self._size)

    def widen(self, size: float) -> None:
        """So many answers fit into a round trip, as is known from elsewhere: begin with as many requests."""
        self._size = max(self._size, min(size, self._highest / 2))

    def answered(self, seconds: float | None) -> None:
        """An answer came so long after its request; None when that is not known for sure."""
        self._loss -= self._loss / 16
        if seconds is None:
            return
        if self._fastest_s is None or seconds < self._fastest_s:
            self._fastest_s = seconds
        if seconds <= 1.25 * self._fastest_s + 0.01:
            self._size = min(self._highest, self._size + 0.5)
        elif seconds > 2.0 * self._fastest_s + 0.05:
            self._size = max(self._lowest, self._size - 0.25)

    def lost(self) -> None:
        """No answer came in time."""
        self._loss += (1.0 - self._loss) / 16
        if self._loss > 0.75:
            self._size = max(self._lowest, self._size / 2)
            self._loss = 0.5


class _Block:
    __slots__ = ("attempts", "before_at", "order", "sent_at")

    def __init__(self) -> None:
        self.attempts = self.order = 0
        self.before_at = self.sent_at = 0.0


class BlockRequests:
    """Requests for blocks by their offsets, a window of them under way; beyond ``at_once`` they are sent ``spacing_s``
    seconds apart.

    One is sent again when its answer is overdue (:class:`RoundTrip`), or when later ones were answered before it.
    """

    def __init__(
        self, round_trip: RoundTrip, *, at_once: int = AT_ONCE, spacing_s: float = SPACING_S
    ) -> None:
        self.window: AdaptiveWindow = AdaptiveWindow()
        self._round_trip, self._at_once, self._spacing_s = round_trip, at_once, spacing_s
        self._waiting: dict[int, None] = {}
        self._under_way: dict[int, _Block] = {}  # in the order of sending
        self._blocks: dict[int, _Block] = {}
        self._orders = 0
        self._silent = 0
        self._busy_at = self._free_at = float("-inf")
        self._is_held_back = False

    def __len__(self) -> int:
        return len(self._waiting) + len(self._under_way)

    @property
    def under_way(self) -> int:
        """How many wait for their answers."""
        return len(self._under_way)

    @property
    def deadline(self) -> float | None:
        """When an answer is overdue or another request may be sent; None while none is waited for."""
        overdue_at = min((self._due_at(block) for block in self._under_way.values()), default=None)
        if self._is_held_back and overdue_at is not None:
            return min(overdue_at, self._free_at)
        return overdue_at

    def ask(self, offset: int) -> None:
        """Have it sent as soon as there is room; nothing happens when it waits or is under way."""
        if offset not in self._under_way:
            self._waiting[offset] = None

    def forget(self, offset: int) -> None:
        """Send it no more: the block came another way."""
        self._waiting.pop(offset, None)
        self._under_way.pop(offset, None)
        self._blocks.pop(offset, None)

    def forget_from(self, end: int) -> None:
        """There are no blocks from there on."""
        for offset in [each for each in (*self._waiting, *self._under_way) if each >= end]:
            self.forget(offset)

    def busy(self, until: float) -> None:
        """The server has something else to do: nothing is overdue, and no answer measures."""
        self._busy_at = until

    def answered(self, offset: int, now: float, *, sent_at: float | None = None) -> None:
        """Its answer has come; ``sent_at``: to the request that was sent then, None when that is not known."""
        block = self._blocks.get(offset)
        self.forget(offset)
        if block is None:
            return
        if sent_at is None:
            sent_at = self._answered_sending(block, now)
        self._silent = 0
        if sent_at is None or sent_at <= self._busy_at:
            self.window.answered(None)
            return
        self._round_trip.measured(now - sent_at)
        self.window.answered(now - sent_at)
        if block.attempts == 1:
            self._give_up_overtaken(block.order)

    def _answered_sending(self, block: _Block, now: float) -> float | None:
        """When that was sent which was answered, as far as it can be told."""
        if block.attempts == 1:
            return block.sent_at
        fastest_s = self._round_trip.fastest_s or 0.0
        return block.before_at if now - block.sent_at < SOON * fastest_s else None  # not long enough

    def take_due(self, now: float, *, limit: int | None = None) -> list[int]:
        """The offsets to be sent now, first those to be sent again; they count as sent. ``limit``: of the window."""
        overdue = [offset for offset, block in self._under_way.items() if self._due_at(block) <= now]
        self._put_first(overdue)
        self._silent += bool(overdue)
        size = self.window.size if limit is None else min(limit, self.window.size)
        due: list[int] = []
        self._is_held_back = False
        while self._waiting and len(self._under_way) < size:
            if len(self._under_way) >= self._at_once:
                if now < self._free_at:
                    self._is_held_back = True
                    break
                self._free_at = now + self._spacing_s
            offset = next(iter(self._waiting))
            del self._waiting[offset]
            self._send(offset, now)
            due.append(offset)
        return due

    def _due_at(self, block: _Block) -> float:
        return max(block.sent_at, self._busy_at) + self._round_trip.timeout_s(max(1, self._silent - STEADY))

    def _send(self, offset: int, now: float) -> None:
        self._orders += 1
        block = self._blocks.setdefault(offset, _Block())
        block.attempts += 1
        block.order, block.before_at, block.sent_at = self._orders, block.sent_at, now
        self._under_way[offset] = block

    def _give_up_overtaken(self, order: int) -> None:
        overtaken = []
        for offset, block in self._under_way.items():
            if block.order > order - OVERTAKEN:
                break
            overtaken.append(offset)
        self._put_first(overtaken)

    def _put_first(self, offsets: list[int]) -> None:
        if offsets:
            for offset in offsets:
                del self._under_way[offset]
                self.window.lost()
            self._waiting = {**dict.fromkeys(offsets), **self._waiting}


WriteBytes = Callable[[bytes], object]
"""Takes the next bytes of a file."""


class Reassembly:
    """Puts the blocks of one file into their order; ``write`` gets them one after the other.

    So what was written is always the beginning of the file, whatever happens next. Blocks begin ``start`` plus a
    multiple of ``block_size`` bytes into the file; only the last one is shorter.
    """

    position: int

    def __init__(self, write: WriteBytes, *, block_size: int, start: int = 0) -> None:
        self.start: int = start
        self.block_size: int = block_size
        self.position = start
        """Everything before this was written."""
        self.tail: int = start
        """The end of the last block that has come."""
        self.end: int | None = None
        """Where the file ends; None while that is not known."""
        self.gaps: dict[int, None] = {}
        """The blocks before ``tail`` that are missing, by their offsets, in order."""
        self._write = write
        self._ahead: dict[int, bytes] = {}
        self._bytes_ahead = 0

    @property
    def done(self) -> int:
        """Bytes that are there, those of the beginning that were there before included."""
        return self.position + self._bytes_ahead

    @property
    def is_complete(self) -> bool:
        """Whether all of the file has come."""
        return self.end is not None and self.position >= self.end

    def add(self, offset: int, data: bytes) -> bool:
        """Take one block; whether it was missing. One that is shorter than the others is the last."""
        if not data or (offset - self.start) % self.block_size or not self._is_missing(offset):
            return False
        if offset >= self.tail:
            self.gaps.update(dict.fromkeys(range(self.tail, offset, self.block_size)))
            self.tail = offset + len(data)
        else:
            del self.gaps[offset]
        if offset == self.position:
            self._advance(data)
        else:
            self._ahead[offset] = data
            self._bytes_ahead += len(data)
        if len(data) < self.block_size:
            self.end_at(offset + len(data))
        return True

    def end_at(self, end: int) -> None:
        """The file is known to end there; of several ends the first one counts."""
        if self.end is not None and self.end <= end:
            return
        self.end = end
        for offset in [each for each in self.gaps if each >= end]:
            del self.gaps[offset]
        for offset in [each for each in self._ahead if each >= end]:
            self._bytes_ahead -= len(self._ahead.pop(offset))
        if self.tail < end:
            self.gaps.update(dict.fromkeys(range(self.tail, end, self.block_size)))
        self.tail = max(end, self.position)

    def missing(self, size: int | None = None) -> tuple[tuple[int, int], ...]:
        """What has not come, as (offset, size); ``size`` is that of the file, as far as it is known.

        A size of 0 means from there to an end that nobody knows.
        """
        ranges: list[tuple[int, int]] = []
        for offset in self.gaps:
            length = self.block_size if self.end is None else min(self.block_size, self.end - offset)
            if ranges and sum(ranges[-1]) == offset:
                ranges[-1] = (ranges[-1][0], ranges[-1][1] + length)
            else:
                ranges.append((offset, length))
        if self.end is None:
            rest = 0 if size is None else max(0, size - self.tail)
            ranges.append((self.tail, rest))
        return tuple(ranges)

    def _is_missing(self, offset: int) -> bool:
        if self.end is not None and offset >= self.end:
            return False
        return offset >= self.tail or offset in self.gaps

    def _advance(self, data: bytes) -> None:
        self._write(data)
        self.position += len(data)
        while (ahead := self._ahead.pop(self.position, None)) is not None:
            self._bytes_ahead -= len(ahead)
            self._write(ahead)
            self.position += len(ahead)
