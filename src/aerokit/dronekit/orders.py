"""Orders that a program gives without waiting: sent in the order of the calls, repeated until they are answered."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import logging
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
        self._newest: dict[str, tuple[concurrent.futures.Future[None], asyncio.Task[None]]] = {}
        self._pending: set[concurrent.futures.Future[None]] = set()
        self.describe: Callable[[], str] | None = None
        """What to say of the vehicle when it has refused an order."""

    def give(self, kind: str, function: Work, *args: Any, **kwargs: Any) -> concurrent.futures.Future[None]:
        """Start it; what it sends first goes out in the order of these calls. Never blocks; from any thread.

        Raises:
            ConnectionClosed: the connection was closed.
        """
        future: concurrent.futures.Future[None] = concurrent.futures.Future()
        self._pending.add(future)
        future.add_done_callback(self._pending.discard)
        work = functools.partial(function, *args, **kwargs)
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
            self._loop.call_soon(_call_next, function, *args)

    def wait(self, timeout: float) -> None:
        """Wait until all that were given have ended, at most so many seconds."""
        pending = self._pending.copy()
        if pending and not self._loop.is_current:
            concurrent.futures.wait(pending, timeout)

    # ------------------------------------------------------------------------------- inside

    def _begin(
        self, kind: str, work: Callable[[], Awaitable[object]], future: concurrent.futures.Future[None]
    ) -> None:
        place = REPLACES.get(kind, kind)
        if place in self._newest:
            self._newest[place][1].cancel()
        if not future.set_running_or_notify_cancel():
            return
        task = asyncio.get_running_loop().create_task(self._run(work, future, kind), name=f"dronekit {kind}")
        self._newest[place] = future, task
        task.add_done_callback(lambda _: self._end(place, future))

    def _withdraw(self, order: concurrent.futures.Future[None]) -> None:
        for future, task in self._newest.values():
            if future is order:
                task.cancel()

    def _end(self, kind: str, future: concurrent.futures.Future[None]) -> None:
        if kind in self._newest and self._newest[kind][0] is future:
            del self._newest[kind]
        if not future.done():  # it was cancelled before its first step, or while it waited
            future.set_exception(
                ConnectionClosed(
                    f"{kind}: a newer order replaced it, it was withdrawn, or the connection was closed"
                )
            )

    async def _run(
        self, work: Callable[[], Awaitable[object]], future: concurrent.futures.Future[None], kind: str
    ) -> None:
        try:
            await work()
        except Exception as error:
            if not isinstance(error, ConnectionClosed):
                text = str(error)  # who keeps log records keeps no frames, and so no vehicle
                if isinstance(error, CommandRejected) and self.describe is not None:
                    text += f" ({self.describe()})"  # most refusals are for what the vehicle does not say
                logger.warning("%s: %s", kind, text)
            future.set_exception(error)
        else:
            future.set_result(None)


def _call_next(function: Callable[..., object], *args: Any) -> None:
    """In the turn in which tasks begun before take their first step."""
    asyncio.get_running_loop().call_soon(function, *args)
