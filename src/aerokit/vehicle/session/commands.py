"""Sends any MAV_CMD to one vehicle and awaits its result. Equal commands are sent one at a time."""

from __future__ import annotations

import asyncio
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from aerokit.connection.exchanges import ExchangeRun
from aerokit.errors import CommandRejected, CommandTimeout, ConnectionClosed
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.messages import CommandAck
from aerokit.protocols.command import CommandExchange, command_int, command_long, command_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.messages import CommandInt, CommandLong
    from aerokit.protocols.command import OrderStatus

UNKNOWN = (MavResult.UNSUPPORTED, MavResult.COMMAND_LONG_ONLY, MavResult.COMMAND_UNSUPPORTED_MAV_FRAME)
"""MAV_RESULTs that mean that the firmware does not support a command, or not as this message."""
# Nothing is repeated until this many measured round trips have passed, because the answer may still arrive.
ROUND_TRIPS = 2
MAX_ATTEMPT_TIMEOUT_S = 5.0
PENDING_ACK_TIMEOUT_S = 2.0
"""Seconds after which an expected COMMAND_ACK is considered lost."""

_Key = tuple[int, int]


class CommandSender:
    """The command protocol with one vehicle (https://mavlink.io/en/services/command.html).

    COMMAND_ACK has no request id, so equal commands to one component are serialized; different commands never wait for
    each other. If an order ends, its running command is aborted, and its waiting command is not sent. Late acks of
    cancelled or unconfirmed commands are not taken for the ack of the next command.
    """

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        describe: Callable[[], str],
        round_trip_s: Callable[[], float | None] = lambda: None,
        acks_per_command: Mapping[int, int] = {},
    ) -> None:
        self._connection = connection
        self._system_id, self._component_id = system_id, component_id
        self._describe, self._round_trip_s = describe, round_trip_s
        self._acks_per_command = acks_per_command
        self._locks: defaultdict[_Key, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._runs: dict[_Key, ExchangeRun[CommandAck]] = {}
        # Maps a running command to the status of its order.
        self._standings: dict[_Key, OrderStatus | None] = {}
        self._under_way: dict[_Key, list[float]] = {}
        self._results: dict[_Key, int] = {}
        self._accepted_at: dict[_Key, float] = {}
        self._is_closed = False
        self._detach = (
            connection.bus.attach(CommandAck, self._on_ack, system_id=system_id),
            connection.on_end(self._abort),
        )

    def close(self) -> None:
        """Stop receiving acks; calls that wait for one, and later calls, raise ConnectionClosed."""
        for detach in self._detach:
            detach()
        self._is_closed = True
        self._abort(ConnectionClosed("the block of this vehicle was left"))

    async def send_long(
        self,
        command: int,
        *params: float,
        component_id: int | None = None,
        attempts: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        order_status: OrderStatus | None = None,
        is_sent: bool = False,
    ) -> CommandAck:
        """Send a COMMAND_LONG with param1 to param7 and return its ACCEPTED ack; see :meth:`Vehicle.command`."""
        target = self._component_id if component_id is None else component_id
        message = command_long(self._system_id, target, command, params)
        options = (attempts, attempt_timeout, progress_timeout, on_progress, order_status, is_sent)
        return await self._run(message, *options)

    async def send_int(
        self,
        command: int,
        *params: float,
        frame: int,
        x: int = 0,
        y: int = 0,
        z: float = 0.0,
        component_id: int | None = None,
        attempts: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        order_status: OrderStatus | None = None,
    ) -> CommandAck:
        """Send a COMMAND_INT with param1 to param4, x, y, z and return its ACCEPTED ack."""
        target = self._component_id if component_id is None else component_id
        message = command_int(self._system_id, target, command, params, frame=frame, x=x, y=y, z=z)
        return await self._run(message, attempts, attempt_timeout, progress_timeout, on_progress, order_status, False)

    async def send_place(
        self,
        command: int,
        *params: float,
        x: int,
        y: int,
        z: float,
        order_status: OrderStatus | None = None,
        **options: Any,
    ) -> CommandAck:
        """Send a command with a position above mean sea level: as COMMAND_INT, or COMMAND_LONG if that is not
        supported.
        """
        try:
            return await self.send_int(
                command, *params, frame=MavFrame.GLOBAL_INT, x=x, y=y, z=z, order_status=order_status, **options
            )
        except CommandRejected as error:
            is_known = error.result not in UNKNOWN
            if is_known or (order_status is not None and order_status.end):
                raise
        place = (x * 1e-7, y * 1e-7, z)
        fill = (0.0,) * (4 - len(params))
        return await self.send_long(command, *params, *fill, *place, order_status=order_status, **options)

    def send_unconfirmed(self, command: int, *params: float, component_id: int | None = None) -> None:
        """Send a COMMAND_LONG once without waiting, for code that must not await."""
        target = self._component_id if component_id is None else component_id
        self._connection.send(command_long(self._system_id, target, command, params))
        self._expect_answers((target, command), self._acks_of(command))

    def is_for_us(self, ack: CommandAck) -> bool:
        """Return True if the ack is addressed to us. Targets are 0 in MAVLink 1 and in old firmware."""
        return ack.target_system in (0, self._connection.source_system) and ack.target_component in (
            0,
            self._connection.source_component,
        )

    def last_result(self, command: int, component_id: int | None = None) -> int | None:
        """Return the last MAV_RESULT of this command, also if its call was cancelled."""
        return self._results.get((self._component_id if component_id is None else component_id, command))

    def is_unknown(self, command: int, component_id: int | None = None) -> bool:
        """Return True if the vehicle answered that it does not support the command, or not as this message."""
        return self.last_result(command, component_id) in UNKNOWN

    def accepted_at(self, command: int) -> float:
        """Return the time of the autopilot's last ACCEPTED ack that was addressed to us; −inf without one."""
        return self._accepted_at.get((self._component_id, command), -math.inf)

    def forget_result(self, command: int, component_id: int | None = None) -> None:
        """Discard the recorded result of this command."""
        key = (self._component_id if component_id is None else component_id, command)
        self._results.pop(key, None)
        self._accepted_at.pop(key, None)

    def forget_results(self) -> None:
        """Discard all recorded results, because a rebooted vehicle may support other commands."""
        self._results.clear()

    async def _run(
        self,
        message: CommandLong | CommandInt,
        attempts: int | None,
        attempt_timeout: float | None,
        progress_timeout: float,
        on_progress: Callable[[int | None], None] | None,
        order_status: OrderStatus | None,
        is_sent: bool,
    ) -> CommandAck:
        key = (
            message.target_component or self._component_id,
            message.command,
        )  # The autopilot answers commands to all components.
        self._make_way(key)
        end = "" if order_status is None else order_status.end
        async with self._locks[key]:
            if self._is_closed:
                raise ConnectionClosed("the block of this vehicle was left; nothing was sent")
            # The order ended while the call waited for the lock.
            if order_status is not None and order_status.end != end and not is_sent:
                raise CommandTimeout(f"{command_name(message.command)} was not sent: {order_status.end}")
            acks_per_sending = self._acks_of(message.command)
            earlier = self._take_answers_under_way(key)
            if is_sent:
                del earlier[-acks_per_sending:]
            exchange = CommandExchange(
                message,
                own_system=self._connection.source_system,
                own_component=self._connection.source_component,
                attempts=attempts,
                attempt_timeout=attempt_timeout,
                min_timeout_s=self._answers_within_s(),
                progress_timeout=progress_timeout,
                on_progress=on_progress,
                earlier_answers=len(earlier),
                acks_per_sending=acks_per_sending,
                order_status=order_status,
                is_sent=is_sent,
            )
            run = self._runs[key] = ExchangeRun(self._connection, exchange)
            self._standings[key] = order_status
            try:
                return await run.result()
            except CommandTimeout as error:
                raise CommandTimeout(f"{error}; {self._describe()}") from None
            finally:
                del self._runs[key], self._standings[key]
                self._expect_answers(key, exchange.pending_answers, earlier[exchange.answers :])

    def _make_way(self, key: _Key) -> None:
        """Abort a running command whose order has ended, so that a newer command need not wait."""
        order_status = self._standings.get(key)
        if order_status is not None and order_status.end:
            text = f"no COMMAND_ACK for {command_name(key[1])} yet; not sent again: {order_status.end}"
            self._runs[key].abort(CommandTimeout(text))

    def _answers_within_s(self) -> float:
        """Return the minimum time to wait for an ack, limited because a stalled link makes the measured round trip too
        long.
        """
        return min(ROUND_TRIPS * (self._round_trip_s() or 0.0), MAX_ATTEMPT_TIMEOUT_S)

    def _acks_of(self, command: int) -> int:
        return self._acks_per_command.get(command, 1)

    def _expect_answers(self, key: _Key, count: int, earlier: Sequence[float] = ()) -> None:
        """Record acks that may still arrive, so that the next command with this key ignores them."""
        if expected := [*earlier, *[self._connection.now()] * count]:
            self._under_way.setdefault(key, []).extend(expected)

    def _take_answers_under_way(self, key: _Key) -> list[float]:
        oldest = self._connection.now() - PENDING_ACK_TIMEOUT_S
        return [at for at in self._under_way.pop(key, ()) if at >= oldest]

    def _abort(self, error: Exception) -> None:
        for run in tuple(self._runs.values()):
            run.abort(error)

    def _on_ack(self, ack: CommandAck) -> None:
        """Deliver an ack to the running exchange, or count it as an expected late ack."""
        frame = ack.received_frame
        key = (0 if frame is None else frame.component_id, ack.command)
        run = self._runs.get(key)
        is_answer = (run is not None or key in self._under_way) and self.is_for_us(ack)
        if is_answer and ack.result != MavResult.IN_PROGRESS:
            self._results[key] = ack.result
            if ack.result == MavResult.ACCEPTED and ack.target_system == self._connection.source_system:
                self._accepted_at[key] = self._connection.now()
        if run is not None:
            run.receive(ack)
        elif key in self._under_way and ack.result != MavResult.IN_PROGRESS:
            self._under_way[key].pop(0)
            if not self._under_way[key]:
                del self._under_way[key]
