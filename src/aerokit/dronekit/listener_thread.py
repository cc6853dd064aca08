"""The thread that runs a program's callbacks in order, separate from reception and heartbeat."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from aerokit.sync.thread_future import ThreadFuture

logger: logging.Logger = logging.getLogger("dronekit")

MAX_QUEUED_CALLS = 10_000  # `post_or_drop` drops calls while this many are queued
JOIN_TIMEOUT_S = CALL_TIMEOUT_S = 2.0


class ListenerThread:
    """Calls functions in the order in which they were posted, on a daemon thread that starts with the first call.

    Exceptions of the functions are logged.
    """

    dropped: int

    def __init__(self, name: str = "dronekit listeners") -> None:
        self._name = name
        self._calls: queue.SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None  # None before the first call
        self._lock = threading.Lock()  # held while the thread is started or stopped
        self.is_stopped: bool = False
        self.on_called: Callable[[], object] = _nothing
        """Called after each callback."""
        self.dropped = 0
        """Number of calls that were dropped because a callback blocked."""
        self._kept_alive: dict[int, object] = {}  # objects with listeners, by id()

    def post(self, function: Callable[..., object], *args: Any) -> None:
        """Queue a call without blocking, from any thread. Ignored after :meth:`stop`."""
        if self._thread is None:
            self._start()
        if not self.is_stopped:
            self._calls.put((function, args))

    def post_or_drop(self, function: Callable[..., object], *args: Any) -> None:
        """Like :meth:`post`, but drop the call while the queue is full. For values that are soon replaced."""
        if self._calls.qsize() < MAX_QUEUED_CALLS:
            self.post(function, *args)
            return
        if not self.dropped:
            logger.warning("a listener blocks the callback thread; further values are dropped while the queue is full")
        self.dropped += 1

    def call(self, function: Callable[..., object], *args: Any) -> None:
        """Queue a call and wait until it has run, at most two seconds.

        On the listener thread, or after :meth:`stop`, this method runs the function directly. On an event loop or on
        another listener thread, it only queues the call, because a wait could cause a deadlock.
        """
        if self.is_current or self.is_stopped:
            function(*args)
            return
        if _must_not_wait():
            self.post(function, *args)
            return
        called: ThreadFuture[None] = ThreadFuture()

        def call_and_finish() -> None:
            try:
                function(*args)
            finally:
                called.finish()

        self.post(call_and_finish)
        # The wait is limited, because the caller may hold a lock for which a callback waits.
        deadline = time.monotonic() + CALL_TIMEOUT_S
        # Wait in short steps, because on some systems Ctrl-C does not interrupt a long wait.
        while not called.wait(0.2) and not self.is_stopped and time.monotonic() <= deadline:
            pass

    def keep_alive(self, owner: object, *, has_listeners: bool) -> None:
        """Keep an object alive while it has listeners, even if the program drops the vehicle."""
        if has_listeners and not self.is_stopped:
            self._kept_alive[id(owner)] = owner
        else:
            self._kept_alive.pop(id(owner), None)

    @property
    def is_current(self) -> bool:
        return threading.current_thread() is self._thread

    def stop(self) -> None:
        """End the thread after its current call, and drop queued calls. Does not block."""
        with self._lock:
            self.is_stopped = True
        self._kept_alive.clear()
        self._calls.put((_nothing, ()))  # This wakes the thread, which then notices `is_stopped`.

    def join(self) -> None:
        """Wait until the thread has ended, at most two seconds."""
        if self._thread is not None and not self.is_current:
            # A callback may block the thread forever.
            self._thread.join(JOIN_TIMEOUT_S)

    def _start(self) -> None:
        with self._lock:
            if self._thread is None and not self.is_stopped:
                thread = _Thread(target=self._run, name=self._name, daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # The interpreter is shutting down.
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
            except BaseException:  # SystemExit would end only this thread, not the program.
                logger.exception("Exception in a callback")
            self.on_called()
            del function, args  # Without this, the thread would keep them alive until the next call.


class _Thread(threading.Thread):
    """The thread of a :class:`ListenerThread`. `_must_not_wait` recognises such threads by this class."""


def _must_not_wait() -> bool:
    if isinstance(threading.current_thread(), _Thread):
        return True
    with contextlib.suppress(RuntimeError):
        asyncio.get_running_loop()
        return True
    return False


def _nothing() -> None:
    pass
