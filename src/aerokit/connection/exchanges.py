"""Runs a sans-IO exchange on the event loop: one future, one deadline, and nothing left of either afterwards."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.connection.bus import raisable
from aerokit.events import LinkChosen

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import Exchange

ResultT = TypeVar("ResultT")


async def run_exchange(connection: Connection, system_id: int, exchange: Exchange[ResultT]) -> ResultT:
    """Run ``exchange`` with the vehicle ``system_id`` to its end and return its result.

    Cancellation ends it at once. When the connection ends, the exchange ends with the connection's error; what goes
    wrong in sending is raised here.
    """
    run = ExchangeRun(connection, exchange)
    detachments = [
        connection.bus.attach(message_type, run.receive, system_id=system_id)
        for message_type in exchange.expects
    ]
    detachments.append(connection.on_end(run.abort))
    if connection.links is not None:
        detachments.append(connection.bus.attach_event(LinkChosen, partial(run.link_chosen, system_id)))
    try:
        return await run.result()
    finally:
        for detach in detachments:
            detach()


class ExchangeRun(Generic[ResultT]):
    """Gives one exchange its time and sends what it wants sent.

    Its owner gives it the messages of its target, and tells it the end of the connection.
    """

    def __init__(self, connection: Connection, exchange: Exchange[ResultT]) -> None:
        self._connection, self._exchange = connection, exchange
        self._deadline: float | None = None
        self._ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def result(self) -> ResultT:
        """Start it, await its end and return its result; once.

        Cancellation ends it at once. What goes wrong in sending is raised here.
        """
        try:
            self._exchange.start(self._connection.now())
            self._after_step()
            await self._ended
        finally:
            self._connection.deadlines.take_back(self._expire)
        return self._exchange.result()

    def receive(self, message: Message) -> None:
        """Take a message of the target."""
        try:
            self._exchange.receive(message, self._connection.now())
        finally:  # what a callback of the program raised is for the bus to report; the exchange goes on
            self._after_step()

    def link_chosen(self, system_id: int, event: LinkChosen) -> None:
        """Of several links another one is used."""
        if event.system_id == system_id and event.before is not None:
            self._exchange.link_changed(self._connection.now())
            self._after_step()

    def abort(self, error: Exception) -> None:
        """End it with this error."""
        self._exchange.abort(raisable(error))
        self._after_step()

    def _expire(self) -> None:
        """The deadline has come; timers ring up to the clock's resolution early, which is no reason to wait again."""
        now = self._connection.now()
        now, self._deadline = max(now, now if self._deadline is None else self._deadline), None
        try:
            self._exchange.expire(now)
        except Exception as error:
            self._exchange.abort(error)
        self._after_step()

    def _after_step(self) -> None:
        exchange = self._exchange
        try:
            for message in exchange.take_outbox():
                self._connection.send(message)
        except Exception as error:  # nobody else would tell the one who waits
            exchange.abort(error)
        if exchange.done:
            self._connection.deadlines.take_back(self._expire)
            if not self._ended.done():
                self._ended.set_result(None)
        elif exchange.deadline is not None and exchange.deadline != self._deadline:
            self._deadline = exchange.deadline
            self._connection.deadlines.set(self._expire, self._deadline)
