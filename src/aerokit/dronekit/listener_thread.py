"""The thread on which a program's callbacks run, one after the other, apart from reception and heartbeat."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from aerokit.sync.reply import Reply

logger: logging.Logger = logging.getLogger("dronekit")

MOST_WAITING = 10_000
"""What a listener that does not come back lets wait at most; values that come again and again are dropped then."""
JOIN_S = CALL_S = 2.0


class ListenerThread:
    """Calls functions in the order in which they were posted. The thread starts with the first of them.

    What a function raises is logged. The thread does not keep the interpreter alive.
    """

    dropped: int

    def __init__(self, name: str = "dronekit listeners") -> None:
        self._name = name
        self._calls: queue.SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self.is_stopped: bool = False
        """Whether nothing is called any more."""
        self.on_called: Callable[[], object] = _nothing
        """What is called when a callback has come back."""
        self.dropped = 0
        """How many calls were dropped because a listener did not come back."""
        self._kept: dict[int, object] = {}

    def post(self, function: Callable[..., object], *args: Any) -> None:
        """Have ``function(*args)`` called; from any thread, never blocks. Nothing happens once it is stopped."""
        if self._thread is None:
            self._start()
        if not self.is_stopped:
            self._calls.put((function, args))

    def offer(self, function: Callable[..., object], *args: Any) -> None:
        """As :meth:`post`, for what comes again anyway: dropped while 10,000 others wait."""
        if self._calls.qsize() < MOST_WAITING:
            self.post(function, *args)
            return
        if not self.dropped:
            logger.warning("a listener does not come back; values are dropped that it would be told of")
        self.dropped += 1

    def call(self, function: Callable[..., object], *args: Any) -> None:
        """Have it called, and wait until it was: at once on this thread itself and when the thread has ended.

        Not waited for on the threads of event loops and of other listeners, which callbacks may be waiting for, and for
        two seconds at most elsewhere: the caller may hold what a callback wants.
        """
        if self.is_current or self.is_stopped:
            function(*args)
            return
        if _must_not_wait():
            self.post(function, *args)
            return
        called: Reply[None] = Reply()

        def call_and_tell() -> None:
            try:
                function(*args)
            finally:
                called.end()

        self.post(call_and_tell)
        end = time.monotonic() + CALL_S  # waited for in slices, for Ctrl-C on every system
        while not called.wait(0.2) and not self.is_stopped and time.monotonic() <= end:
            pass

    def keep(self, owner: object, *, has_listeners: bool) -> None:
        """Keep an object for as long as it has listeners: a program may have nothing else of it any more."""
        if has_listeners and not self.is_stopped:
            self._kept[id(owner)] = owner
        else:
            self._kept.pop(id(owner), None)

    @property
    def is_current(self) -> bool:
        """Whether the caller is on this thread."""
        return threading.current_thread() is self._thread

    def stop(self) -> None:
        """Call nothing more. Idempotent; never blocks."""
        with self._lock:
            self.is_stopped = True
        self._kept.clear()
        self._calls.put((_nothing, ()))

    def join(self) -> None:
        """Wait until the thread has ended, at most two seconds: a callback may be stuck in the program's own code."""
        if self._thread is not None and not self.is_current:
            self._thread.join(JOIN_S)

    def _start(self) -> None:
        with self._lock:
            if self._thread is None and not self.is_stopped:
                thread = _Thread(target=self._run, name=self._name, daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # the interpreter is ending: there is nobody left to be called
                    self.is_stopped = True
                else:
                    self._thread = thread

    def _run(self) -> None:
        while True:
            function, args = self._calls.get()
            if self.is_stopped:
                return
            try:
                function(*args)
            except BaseException:  # sys.exit() in a callback would end the callbacks, and nothing else
                logger.exception("Exception in a callback")
            self.on_called()
            del function, args  # they would be kept until the next call


class _Thread(threading.Thread):
    """One on which callbacks run."""


def _must_not_wait() -> bool:
    if isinstance(threading.current_thread(), _Thread):
        return True
    with contextlib.suppress(RuntimeError):
        asyncio.get_running_loop()
        return True
    return False


def _nothing() -> None:
    pass
