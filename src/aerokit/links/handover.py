"""``Handover``: from threads of others to the event loop, bounded and in order."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["MOST_WAITING", "Handover", "opened_in_a_thread"]

ItemT = TypeVar("ItemT")

MOST_WAITING = 2048
"""So much waits for a loop that does not come round; then the oldest goes."""

_AT_ONCE = 256  # in one turn of the loop, before everybody else gets one


class Handover(Generic[ItemT]):
    """``post(item)`` from any thread calls ``take(item)`` on the loop; nothing is called after :meth:`close`.

    At most ``most`` items wait; the oldest are dropped then, and counted. The loop is woken once for all that wait.
    """

    dropped: int

    def __init__(self, take: Callable[[ItemT], object], most: int = MOST_WAITING) -> None:
        self.dropped = 0
        """Items that the loop was too slow for."""
        self._loop = asyncio.get_running_loop()
        self._take: Callable[[ItemT], object] | None = take
        self._most = most
        self._waiting: deque[ItemT] = deque()
        self._is_called = False
        self._lock = threading.Lock()

    def post(self, item: ItemT) -> None:
        """Hand over; never blocks, never raises."""
        with self._lock:
            if self._take is None:
                return
            if len(self._waiting) >= self._most:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(item)
            if self._is_called:
                return
            self._is_called = True
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        """What waits is forgotten."""
        with self._lock:
            self._take = None
            self._waiting.clear()

    def _drain(self) -> None:
        """A burst of what waits."""
        for _ in range(_AT_ONCE):
            with self._lock:
                take = self._take
                if take is None or not self._waiting:
                    self._is_called = False
                    return
                item = self._waiting.popleft()
            try:
                take(item)
            except BaseException:
                self._loop.call_soon(self._drain)  # the others are handed over all the same
                raise
        self._loop.call_soon(self._drain)


async def opened_in_a_thread(work: Callable[[], ItemT], close: Callable[[ItemT], object]) -> ItemT:
    """What ``work()`` opens, in a thread of the loop's; ``close`` it when nobody waits for it any more.

    A thread cannot be stopped: when this is cancelled, what it opens is closed as soon as it is there.
    """
    opening = asyncio.get_running_loop().run_in_executor(None, work)

    def close_later(opened: asyncio.Future[ItemT]) -> None:
        if not opened.cancelled() and opened.exception() is None:
            close(opened.result())

    try:
        return await asyncio.shield(opening)
    except asyncio.CancelledError:
        opening.add_done_callback(close_later)
        raise
