"""Which message goes out how often on one channel of a simulated vehicle."""

from __future__ import annotations

import math
from heapq import heappop, heappush, heapreplace

__all__ = ["Streams"]


class Streams:
    """Intervals per message id, and what is due. A stream that fell behind skips; it never bursts."""

    __slots__ = ("_heap", "_intervals", "_token", "next_due")

    def __init__(self) -> None:
        self.next_due: float = math.inf
        """When something is due; infinity when nothing is streamed."""
        self._intervals: dict[int, tuple[float, int]] = {}
        self._heap: list[tuple[float, int, int]] = []
        self._token = 0

    def set_interval(self, message_id: int, interval_s: float, now: float) -> None:
        """Send a message every ``interval_s`` seconds, for the first time now; 0 stops it."""
        self._token += 1
        if interval_s <= 0.0:
            self._intervals.pop(message_id, None)
        else:
            self._intervals[message_id] = (interval_s, self._token)
            heappush(self._heap, (now, self._token, message_id))
        self._look()

    def interval(self, message_id: int) -> float:
        """Seconds between two of these messages; 0 when it is not streamed."""
        return self._intervals.get(message_id, (0.0, 0))[0]

    def ids(self) -> frozenset[int]:
        """What is streamed at present."""
        return frozenset(self._intervals)

    def postpone(self, seconds: float) -> None:
        """Make everything this much later."""
        self._heap = [(due + seconds, token, message_id) for due, token, message_id in self._heap]
        self._look()

    def take_due(self, now: float) -> list[int]:
        """The message ids that are due, each scheduled anew."""
        ids: list[int] = []
        heap, intervals = self._heap, self._intervals
        while self.next_due <= now:
            due, token, message_id = heap[0]
            interval = intervals[message_id][0]
            following = due + interval
            heapreplace(heap, (following if following > now else now + interval, token, message_id))
            ids.append(message_id)
            self._look()
        return ids

    def _look(self) -> None:
        """Find out what is due next; what was stopped or replaced is dropped on the way."""
        heap, intervals = self._heap, self._intervals
        while heap:
            due, token, message_id = heap[0]
            current = intervals.get(message_id)
            if current is not None and current[1] == token:
                self.next_due = due
                return
            heappop(heap)
        self.next_due = math.inf
