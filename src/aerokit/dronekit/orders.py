"""Orders that a program gives without waiting: sent in the order of the calls, repeated until they are answered."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import threading
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandRejected, ConnectionClosed

if TYPE_CHECKING:
    from aerokit.sync.loop_thread import LoopThread

__all__ = ["Orders"]

logger = logging.getLogger("dronekit")

REPLACES = {"disarm": "arm"}
"""Kinds that are one: the newer replaces the older."""

Work = Callable[..., Awaitable[object]]


class Orders:
    """Runs coroutine functions on the loop in the background, one of each kind at a time: a newer one replaces it.

    A failure becomes one warning, and is in the future that :meth:`give` returned.
    """

    def __init__(self, loop: LoopThread) -> None:
        self._loop = loop
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._running: dict[concurrent.futures.Future[None], asyncio.Task[None]] = {}
        self._pending: set[concurrent.futures.Future[None]] = set()
        self._lock = threading.Lock()
        self.describe: Callable[[], str] | None = None
        """What to say of the vehicle when it has refused an order."""

    def give(self, kind: str, function: Work, *args: Any, **kwargs: Any) -> concurrent.futures.Future[None]:
        """Start it; what it sends first goes out in the order of these calls. Never blocks; from any thread.

        Raises:
            ConnectionClosed: the connection was closed.
        """
        future: concurrent.futures.Future[None] = concurrent.futures.Future()
        with self._lock:
            self._pending.add(future)
        future.add_done_callback(self._forget)

        async def work() -> None:
            await function(*args, **kwargs)

        try:
            self._loop.call_soon(self._begin, kind, work, future)
        except ConnectionClosed:
            future.cancel()
            raise
        return future

    def withdraw(self, order: concurrent.futures.Future[None]) -> None:
        """What :meth:`give` returned is not wanted any more: it is not sent again. Never blocks; from any thread."""
        with contextlib.suppress(ConnectionClosed):
            self._loop.call_soon(self._withdraw, order)

    def post(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function that neither waits nor raises on the loop; in order with other calls and :meth:`give`."""
        if self._loop.is_current:
            function(*args)
        else:
            self._loop.call_soon(self._call_next, function, *args)

    def wait(self, timeout: float) -> None:
        """Wait until all that were given have ended, at most so many seconds."""
        with self._lock:
            pending = tuple(self._pending)
        if pending and not self._loop.is_current:
            concurrent.futures.wait(pending, timeout)

    # ------------------------------------------------------------------------------- inside

    def _begin(
        self, kind: str, work: Callable[[], Awaitable[None]], future: concurrent.futures.Future[None]
    ) -> None:
        place = REPLACES.get(kind, kind)
        before = self._tasks.get(place)
        if before is not None:
            before.cancel()
        if not future.set_running_or_notify_cancel():
            return
        task = asyncio.get_running_loop().create_task(self._run(work, future, kind), name=f"dronekit {kind}")
        self._tasks[place] = self._running[future] = task
        task.add_done_callback(lambda ended: self._end(place, ended, future))

    def _withdraw(self, order: concurrent.futures.Future[None]) -> None:
        task = self._running.get(order)
        if task is not None:
            task.cancel()

    def _end(self, kind: str, task: asyncio.Task[None], future: concurrent.futures.Future[None]) -> None:
        self._running.pop(future, None)
        if self._tasks.get(kind) is task:
            del self._tasks[kind]
        if not future.done():  # it was cancelled before its first step, or while it waited
            future.set_exception(
                ConnectionClosed(
                    f"{kind}: a newer order replaced it, it was withdrawn, or the connection was closed"
                )
            )

    async def _run(
        self, work: Callable[[], Awaitable[None]], future: concurrent.futures.Future[None], kind: str
    ) -> None:
        try:
            await work()
        except Exception as error:
            if not isinstance(error, ConnectionClosed):
                text = str(error)  # who keeps log records keeps no frames, and so no vehicle
                logger.warning("%s: %s%s", kind, text, self._state_at(error))
            future.set_exception(error)
        else:
            future.set_result(None)

    def _state_at(self, error: Exception) -> str:
        """Most refusals are for not being armed, or for the mode: which the vehicle does not say."""
        if self.describe is None or not isinstance(error, CommandRejected):
            return ""
        return f" ({self.describe()})"

    def _call_next(self, function: Callable[..., object], *args: Any) -> None:
        """In the turn in which tasks begun before take their first step."""
        asyncio.get_running_loop().call_soon(function, *args)

    def _forget(self, future: concurrent.futures.Future[None]) -> None:
        with self._lock:
            self._pending.discard(future)
