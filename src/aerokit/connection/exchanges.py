"""Runs an `Exchange`, which is a protocol's state machine without I/O, on the event loop."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.connection.bus import copy_exception
from aerokit.events import LinkSelected, VehicleRebooted

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import Exchange

ResultT = TypeVar("ResultT")


async def run_exchange(connection: Connection, system_id: int, exchange: Exchange[ResultT]) -> ResultT:
    """Run an exchange with a vehicle, and return its result.

    Cancellation ends the exchange at once. Errors of sending, and the error that ends the connection, are raised.
    """
    run = ExchangeRun(connection, exchange, is_held_back=partial(connection.is_held_back, system_id))
    with ExitStack() as attachments:
        for message_type in exchange.expects:
            attachments.callback(connection.bus.attach(message_type, run.receive, system_id=system_id))
        attachments.callback(connection.on_end(run.abort))
        attachments.callback(connection.bus.attach_event(VehicleRebooted, partial(run.on_rebooted, system_id)))
        if connection.links is not None:
            attachments.callback(connection.bus.attach_event(LinkSelected, partial(run.on_link_selected, system_id)))
        return await run.result()


class ExchangeRun(Generic[ResultT]):
    """Drives one exchange: sends its messages, and informs the exchange when a deadline has passed.

    The owner calls :meth:`receive` with each message of the target, and :meth:`abort` when the connection ends. While
    ``is_held_back()`` is true, nothing is sent: the reopened link may lead to another vehicle.
    """

    def __init__(
        self,
        connection: Connection,
        exchange: Exchange[ResultT],
        *,
        is_held_back: Callable[[], bool] = lambda: False,
    ) -> None:
        self._connection, self._exchange = connection, exchange
        self._is_held_back = is_held_back
        self._deadline: float | None = None  # loop time of the timer that is set; None if no timer is set
        # Set when the exchange is done or has failed.
        self._ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def result(self) -> ResultT:
        """Start the exchange and return its result. Call it once."""
        try:
            self._exchange.start(self._connection.now())
            self._send_and_reschedule()
            await self._ended
        finally:
            self._connection.deadlines.cancel(self._expire)
        return self._exchange.result()

    def receive(self, message: Message) -> None:
        try:
            self._exchange.receive(message, self._connection.now())
        finally:  # If a callback of the program raises here, the bus logs the exception, and the exchange continues.
            self._send_and_reschedule()

    def on_link_selected(self, system_id: int, event: LinkSelected) -> None:
        is_first_choice = event.before is None
        if event.system_id == system_id and not is_first_choice:
            self._exchange.link_changed(self._connection.now())
            self._send_and_reschedule()

    def on_rebooted(self, system_id: int, event: VehicleRebooted) -> None:
        if event.system_id == system_id:
            self._exchange.vehicle_rebooted(self._connection.now())
            self._send_and_reschedule()

    def abort(self, error: Exception) -> None:
        self._exchange.abort(copy_exception(error))
        self._send_and_reschedule()

    def _expire(self) -> None:
        now = self._connection.now()
        if self._deadline is not None:
            # A timer may fire early by the clock's resolution. `expire` would then find that nothing is due yet.
            now = max(now, self._deadline)
            self._deadline = None
        try:
            self._exchange.expire(now)
        except Exception as error:
            self._exchange.abort(error)
        self._send_and_reschedule()

    def _send_and_reschedule(self) -> None:
        """Send the messages of the exchange, and set its next deadline or end it."""
        exchange = self._exchange
        try:
            for message in exchange.take_outbox():
                if self._is_held_back() or not self._connection._try_to_send(message):
                    exchange.message_dropped()
        except Exception as error:  # The exchange ends, and result() raises this error.
            exchange.abort(error)
        if exchange.done:
            self._connection.deadlines.cancel(self._expire)
            if not self._ended.done():
                self._ended.set_result(None)
        elif exchange.deadline != self._deadline:
            self._deadline = exchange.deadline
            if self._deadline is None:
                self._connection.deadlines.cancel(self._expire)
            else:
                self._connection.deadlines.set(self._expire, self._deadline)
