"""Runs a sans-IO exchange on the event loop: one future, one timer, and nothing left of either afterwards."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.runtime.endings import raisable

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import Exchange
    from aerokit.runtime.connection import Connection

__all__ = ["run_exchange"]

ResultT = TypeVar("ResultT")


async def run_exchange(connection: Connection, system_id: int, exchange: Exchange[ResultT]) -> ResultT:
    """Run ``exchange`` with the vehicle ``system_id`` to its end and return its result.

    Cancellation ends it at once. When the connection ends, the exchange ends with the connection's error; what goes
    wrong in sending is raised here.
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
        try:
            self._exchange.receive(message, self._loop.time())
        finally:  # what a callback of the program raised is for the bus to report; the exchange goes on
            self._after_step()

    def abort(self, error: Exception) -> None:
        self._exchange.abort(raisable(error))
        self._finish()

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _expire(self) -> None:
        self._timer = None
        try:
            self._exchange.expire(self._loop.time())
        except Exception as error:
            self._exchange.abort(error)
        self._after_step()

    def _after_step(self) -> None:
        try:
            for message in self._exchange.take_outbox():
                self._connection.send(message)
        except Exception as error:  # nobody else would tell the one who waits
            self._exchange.abort(error)
        if self._exchange.done:
            self._finish()
        else:
            self._set_timer(self._exchange.deadline)

    def _set_timer(self, deadline: float | None) -> None:
        if deadline is not None and (self._timer is None or self._timer.when() != deadline):
            self.stop()
            self._timer = self._loop.call_at(deadline, self._expire)

    def _finish(self) -> None:
        self.stop()
        if not self.future.done():
            self.future.set_result(None)
