"""Runs a sans-IO exchange on the event loop: one future, one timer, and nothing left of either afterwards."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import Exchange
    from aerokit.runtime.connection import Connection

__all__ = ["run_exchange"]

ResultT = TypeVar("ResultT")


async def run_exchange(connection: Connection, system_id: int, exchange: Exchange[ResultT]) -> ResultT:
    """Run ``exchange`` with the vehicle ``system_id`` to its end and return its result.

    Cancellation ends it at once. When the connection ends, the exchange ends with the connection's error.
    """
    runner = _Runner(connection, exchange)
    detachments = [
        connection.bus.attach(message_type, runner.receive, system_id=system_id)
        for message_type in exchange.expects
    ]
    detachments.append(connection.on_end(runner.abort))
    try:
        runner.start()
        await runner.future
    finally:
        runner.stop()
        for detach in detachments:
            detach()
    return exchange.result()


class _Runner:
    """Feeds one exchange with messages and time, and sends what it wants sent."""

    def __init__(self, connection: Connection, exchange: Exchange[Any]) -> None:
        self._connection, self._exchange = connection, exchange
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self.future: asyncio.Future[None] = self._loop.create_future()

    def start(self) -> None:
        self._exchange.start(self._loop.time())
        self._after_step()

    def receive(self, message: Message) -> None:
        self._exchange.receive(message, self._loop.time())
        self._after_step()

    def abort(self, error: Exception) -> None:
        self._exchange.abort(error)
        self._after_step()

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _expire(self) -> None:
        self._timer = None
        self._exchange.expire(self._loop.time())
        self._after_step()

    def _after_step(self) -> None:
        for message in self._exchange.take_outbox():
            self._connection.send(message)
        deadline = self._exchange.deadline
        if self._exchange.done:
            self.stop()
            if not self.future.done():
                self.future.set_result(None)
        elif deadline is not None and (self._timer is None or self._timer.when() != deadline):
            self.stop()
            self._timer = self._loop.call_at(deadline, self._expire)
