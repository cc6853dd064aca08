"""Windowed requests for the blocks of a file or log, and reassembly of their answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.protocols.request_window import LOSS_THRESHOLD, PendingRequest, PendingRequests

if TYPE_CHECKING:
    from aerokit.protocols.exchange import RoundTrip

# Number of requests that are sent at once. ArduPilot queues at most five, processes one every 2 ms, and drops the rest.
BATCH_SIZE = 4

# Pause between two requests while at least ``BATCH_SIZE`` are in flight.
SPACING_S = 0.002

# An answer that arrives sooner than this fraction of the fastest round trip belongs to an earlier transmission.
MIN_ROUND_TRIP_FRACTION = 0.5

# Requests back off after this many consecutive timeouts. Fewer may be caused by single frames that a radio has lost.
TIMEOUTS_BEFORE_BACKOFF = 3

# An answer is fast if it takes at most FAST_FACTOR times the fastest answer plus FAST_MARGIN_S.
FAST_FACTOR, FAST_MARGIN_S = 1.25, 0.01
# An answer has waited in a queue if it takes longer than QUEUED_FACTOR times the fastest answer plus QUEUED_MARGIN_S.
QUEUED_FACTOR, QUEUED_MARGIN_S = 2.0, 0.05
# A fast answer widens the window by WIDENING requests, a queued answer narrows it by NARROWING.
WIDENING, NARROWING = 0.5, 0.25
# Weight of each request in the average loss, and the average loss above which the window is halved.
LOSS_WEIGHT, MAX_LOSS = 1 / 16, 0.75


class CongestionWindow:
    """Limits the number of requests in flight to what the link carries without delaying the answers.

    The window grows while answers arrive as fast as the fastest answers so far. It shrinks when answers take much
    longer, because they then wait in a queue. Loss shrinks the window only if most requests are lost, because radios
    lose frames even if they carry little.
    """

    def __init__(self, *, start: int = 4, min_size: int = 2, max_size: int = 64) -> None:
        self._size = float(start)
        self._min_size, self._max_size = min_size, max_size
        self._fastest_s: float | None = None
        self._average_loss = 0.0  # average fraction of lost requests

    @property
    def size(self) -> int:
        return int(self._size)

    def widen(self, size: float) -> None:
        """Raise the window to ``size`` requests, up to half of ``max_size``."""
        self._size = max(self._size, min(size, self._max_size / 2))

    def on_answer(self, round_trip_s: float | None) -> None:
        """Record an answer. ``round_trip_s`` is the time since its request, or None if it must not be measured."""
        # An answer moves the average towards 0, a loss towards 1.
        self._average_loss -= LOSS_WEIGHT * self._average_loss
        if round_trip_s is None:
            return
        if self._fastest_s is None or round_trip_s < self._fastest_s:
            self._fastest_s = round_trip_s
        if round_trip_s <= FAST_FACTOR * self._fastest_s + FAST_MARGIN_S:
            self._size = min(self._max_size, self._size + WIDENING)
        elif round_trip_s > QUEUED_FACTOR * self._fastest_s + QUEUED_MARGIN_S:  # A queue builds up.
            self._size = max(self._min_size, self._size - NARROWING)

    def on_loss(self) -> None:
        self._average_loss += LOSS_WEIGHT * (1.0 - self._average_loss)
        if self._average_loss > MAX_LOSS:
            self._size = max(self._min_size, self._size / 2)
            self._average_loss = 0.5  # Below the limit, so that only further losses halve the size again.


class BlockRequests(PendingRequests[int]):
    """Requests for blocks, identified by their offsets. An adaptive window limits the number of requests in flight.

    Requests are sent without delay if fewer than ``batch_size`` are in flight, otherwise ``spacing_s`` seconds apart. A
    request is repeated when its answer is overdue (:class:`RoundTrip`), or when later requests were answered first.
    """

    def __init__(self, round_trip: RoundTrip, *, batch_size: int = BATCH_SIZE, spacing_s: float = SPACING_S) -> None:
        super().__init__()
        self.window: CongestionWindow = CongestionWindow()
        self._round_trip = round_trip
        self._batch_size = batch_size
        self._spacing_s = spacing_s
        self._timeouts = 0  # number of timeouts since the last answer
        self._busy_until = float("-inf")  # The server sends a burst until this time.
        self._next_send_at = float("-inf")  # earliest time to send while `batch_size` or more requests are in flight
        self._must_wait_to_send = False  # True if a request waits only for `_next_send_at`

    @property
    def deadline(self) -> float | None:
        """Time at which to call `take_due` next. None means that nothing is in flight."""
        overdue_at = min((self._due_at(block) for block in self._in_flight.values()), default=None)
        if self._must_wait_to_send and overdue_at is not None:
            return min(overdue_at, self._next_send_at)
        return overdue_at

    def discard_from(self, end: int) -> None:
        for offset in [offset for offset in (*self._waiting, *self._in_flight) if offset >= end]:
            self.discard(offset)

    def set_busy(self, until: float) -> None:
        """Suspend timeouts and round-trip measurements until this time, while the server sends a burst."""
        self._busy_until = until

    def on_answer(self, offset: int, now: float, *, sent_at: float | None = None) -> None:
        """Record an answer. ``sent_at`` is the time of the transmission that it answers, if known."""
        block = self._requests.get(offset)
        self.discard(offset)
        if block is None:  # It was not requested, or is already answered.
            return
        if sent_at is None:
            sent_at = self._sent_at_of_answer(block, now)
        self._timeouts = 0
        # No time is measured if the answered transmission is unknown (None), or was sent while the server was busy with
        # a burst.
        if sent_at is None or sent_at <= self._busy_until:
            self.window.on_answer(round_trip_s=None)
            return
        self._round_trip.add_sample(now - sent_at)
        self.window.on_answer(now - sent_at)
        if block.attempts == 1:
            self._requeue_lost(answered_transmission=block.last_number)

    def _sent_at_of_answer(self, block: PendingRequest, now: float) -> float | None:
        """Return when the answered transmission was sent, or None if it is unknown which one was answered."""
        if block.attempts == 1:
            return block.sent_at
        fastest_s = self._round_trip.fastest_s or 0.0
        is_too_early = now - block.sent_at < MIN_ROUND_TRIP_FRACTION * fastest_s
        return block.previous_sent_at if is_too_early else None

    def take_due(self, now: float, *, limit: int | None = None) -> list[int]:
        """Return the offsets to request now, and count them as sent.

        Overdue blocks come first. At most ``limit`` requests are in flight.
        """
        overdue = [offset for offset, block in self._in_flight.items() if self._due_at(block) <= now]
        self._requeue(overdue)
        if overdue:
            self._timeouts += 1
        size = self.window.size if limit is None else min(limit, self.window.size)
        due: list[int] = []
        self._must_wait_to_send = False
        while self._waiting and len(self._in_flight) < size:
            is_batch_in_flight = len(self._in_flight) >= self._batch_size
            if is_batch_in_flight:  # Further requests are sent one by one, with pauses.
                if now < self._next_send_at:
                    self._must_wait_to_send = True
                    break
                self._next_send_at = now + self._spacing_s
            due.append(self._take_waiting(now))
        return due

    def _due_at(self, block: PendingRequest) -> float:
        backoff_attempt = max(1, self._timeouts - TIMEOUTS_BEFORE_BACKOFF)
        return max(block.sent_at, self._busy_until) + self._round_trip.timeout_s(backoff_attempt)

    def _requeue_lost(self, *, answered_transmission: int) -> None:
        # Answers arrive in the order of the requests, so requests that were sent well before the answered one are lost.
        lost = []
        for offset, block in self._in_flight.items():
            if block.last_number > answered_transmission - LOSS_THRESHOLD:
                break  # All further blocks were requested later.
            lost.append(offset)
        self._requeue(lost)

    def _requeue(self, keys: list[int]) -> None:
        for _ in keys:
            self.window.on_loss()
        super()._requeue(keys)


WriteBytes = Callable[[bytes], object]
"""A function that receives the next bytes of a file."""


class Reassembly:
    """Reassembles the blocks of one file, and passes them to ``write`` in the order of their offsets.

    The written data is therefore always the beginning of the file. Blocks start at ``start`` plus a multiple of
    ``block_size`` bytes; only the last one may be shorter.
    """

    position: int

    def __init__(self, write: WriteBytes, *, block_size: int, start: int = 0) -> None:
        self.start: int = start
        self.block_size: int = block_size
        self.position = start
        """Everything before this offset was written."""
        self.tail: int = start
        """End of the received block with the largest offset, or of the file once its size is known."""
        self.end: int | None = None
        """Size of the file; None while unknown."""
        self.gaps: dict[int, None] = {}
        """Offsets of the missing blocks before ``tail``, in order."""
        self._write = write
        self._ahead: dict[int, bytes] = {}  # blocks that cannot be written yet, because an earlier block is missing
        self._bytes_ahead = 0

    @property
    def received_bytes(self) -> int:
        """Number of bytes received, including those before ``start``."""
        return self.position + self._bytes_ahead

    @property
    def is_complete(self) -> bool:
        return self.end is not None and self.position >= self.end

    def add(self, offset: int, data: bytes) -> bool:
        """Add a block. Return True if it was missing.

        A block shorter than ``block_size`` ends the file.
        """
        is_aligned = (offset - self.start) % self.block_size == 0
        if not data or not is_aligned or not self._is_missing(offset):
            return False
        if offset >= self.tail:  # All blocks between the tail and this block are missing.
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
        """Set the size of the file. A size larger than the known one is ignored."""
        if self.end is not None and self.end <= end:
            return
        self.end = end
        for offset in [offset for offset in self.gaps if offset >= end]:
            del self.gaps[offset]
        for offset in [offset for offset in self._ahead if offset >= end]:
            self._bytes_ahead -= len(self._ahead.pop(offset))
        if self.tail < end:
            self.gaps.update(dict.fromkeys(range(self.tail, end, self.block_size)))
        self.tail = max(end, self.position)  # Data beyond the end may already have been written.

    def missing(self, size: int | None = None) -> tuple[tuple[int, int], ...]:
        """Return the missing ranges as (offset, length).

        ``size`` is the expected size of the file, if known. A range of length 0 extends to the unknown end of the
        file.
        """
        ranges: list[tuple[int, int]] = []
        for offset in self.gaps:
            length = self.block_size if self.end is None else min(self.block_size, self.end - offset)
            start, size_so_far = ranges[-1] if ranges else (offset, 0)
            follows_last_range = bool(ranges) and start + size_so_far == offset
            if follows_last_range:
                ranges[-1] = (start, size_so_far + length)
            else:
                ranges.append((offset, length))
        if self.end is None:
            remaining = 0 if size is None else max(0, size - self.tail)
            ranges.append((self.tail, remaining))
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
