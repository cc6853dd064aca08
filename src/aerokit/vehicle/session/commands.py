"""Sends any MAV_CMD to one vehicle and awaits the result. Commands with the same MAV_CMD are sent one at a time."""

from __future__ import annotations

import asyncio
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.connection.copies import CopyFilter
from aerokit.connection.exchanges import ExchangeRun
from aerokit.errors import CommandRejected, CommandTimeout, ConnectionClosed
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.messages import CommandAck
from aerokit.protocols.command import MAX_ATTEMPTS, CommandExchange, command_int, command_long, command_name
from aerokit.protocols.exchange import is_addressed_to

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.messages import CommandInt, CommandLong
    from aerokit.protocols.command import OrderStatus

UNSUPPORTED_RESULTS = (MavResult.UNSUPPORTED, MavResult.COMMAND_LONG_ONLY, MavResult.COMMAND_UNSUPPORTED_MAV_FRAME)
"""Results of a command that the firmware does not support at all, or not in this message or frame."""
# Minimum wait for an ack before the command is repeated, in measured round-trip times.
MIN_ROUND_TRIPS = 2
MAX_ATTEMPT_TIMEOUT_S = 5.0
PENDING_ACK_TIMEOUT_S = 2.0
"""An ack is considered lost this many seconds after the end of the call that expected it."""
MAX_RECENT_ACKS = 16

_Key = tuple[int, int]
"""Component id and MAV_CMD."""


class _Options(NamedTuple):
    """How a command is sent; see :meth:`CommandSender.send_long`."""

    attempts: int | None
    attempt_timeout: float | None
    progress_timeout: float
    on_progress: Callable[[int | None], None] | None
    order_status: OrderStatus | None
    was_just_sent: bool = False


class _LateRefusal(NamedTuple):
    accepted_at: float  # time of the last ACCEPTED before the refusal
    received_at: float
    result: int


class CommandSender:
    """Runs the command protocol with one vehicle (https://mavlink.io/en/services/command.html).

    COMMAND_ACK has no request id. Commands with the same MAV_CMD to one component are therefore serialized; other
    commands never wait for each other. A late ack of a command whose call has already ended is not taken for the
    ack of the next command.

    A command may belong to an order, such as a ``go_to`` call. When a newer order replaces it, the old order's
    command is not repeated or, if it waits for an earlier command, not sent.
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
        self._system_id = system_id
        self._component_id = component_id
        # Describes the link, for error texts.
        self._describe = describe
        self._round_trip_s = round_trip_s
        self._acks_per_command = acks_per_command
        self._locks: defaultdict[_Key, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._runs: dict[_Key, ExchangeRun[CommandAck]] = {}
        self._exchanges: dict[_Key, CommandExchange] = {}  # the exchanges of `_runs`
        # Maps each command to the acks of earlier calls that may still arrive, each as the time when its call ended.
        self._pending_acks: dict[_Key, list[float]] = {}
        # The last MAV_RESULT of each command, and the times at which it was last accepted and last refused.
        self._results: dict[_Key, int] = {}
        self._accepted_at: dict[_Key, float] = {}
        self._refused_at: dict[_Key, float] = {}
        # The last refusal of each command that arrived when no ack was expected.
        self._late_refusals: dict[_Key, _LateRefusal] = {}
        self._copies = CopyFilter(connection, MAX_RECENT_ACKS)
        self._is_closed = False
        self._detach_callbacks = (
            connection.bus.attach(CommandAck, self._on_ack, system_id=system_id),
            connection.on_end(self._abort),
        )

    def close(self) -> None:
        """Stop receiving acks. Waiting calls and later calls raise ConnectionClosed."""
        for detach in self._detach_callbacks:
            detach()
        self._is_closed = True
        self._abort(ConnectionClosed("the async with block of this vehicle was left"))

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
        was_just_sent: bool = False,
    ) -> CommandAck:
        """Send a COMMAND_LONG with param1 to param7 and return its ACCEPTED ack.

        Pass ``was_just_sent=True`` if `send_unconfirmed` has just sent the command. This call then sends it again only
        if no ack arrives. See also :meth:`Vehicle.command`.
        """
        target = self._component_id if component_id is None else component_id
        message = command_long(self._system_id, target, command, params)
        options = _Options(attempts, attempt_timeout, progress_timeout, on_progress, order_status, was_just_sent)
        return await self._run(message, options)

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
        options = _Options(attempts, attempt_timeout, progress_timeout, on_progress, order_status)
        return await self._run(message, options)

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
        """Send a command with a position as COMMAND_INT. If the firmware does not support that, send a COMMAND_LONG.

        ``x`` and ``y`` are latitude and longitude in 1e-7 degrees. ``z`` is in metres above mean sea level.
        COMMAND_LONG has no frame, so use this only if the command's altitude is always AMSL, as for DO_SET_HOME.
        """
        try:
            return await self.send_int(
                command, *params, frame=MavFrame.GLOBAL_INT, x=x, y=y, z=z, order_status=order_status, **options
            )
        except CommandRejected as error:
            is_supported = error.result not in UNSUPPORTED_RESULTS
            has_order_ended = order_status is not None and bool(order_status.end)
            if is_supported or has_order_ended:
                raise
        # In COMMAND_LONG, the position is in param5 to param7, with latitude and longitude in degrees.
        params_1_to_4 = (*params, *(0.0,) * (4 - len(params)))
        position = (x * 1e-7, y * 1e-7, z)
        return await self.send_long(command, *params_1_to_4, *position, order_status=order_status, **options)

    def send_unconfirmed(self, command: int, *params: float, component_id: int | None = None) -> None:
        """Send a COMMAND_LONG once without waiting for its ack. For code that cannot await."""
        target = self._component_id if component_id is None else component_id
        self._connection.send(command_long(self._system_id, target, command, params))
        self._add_pending_acks((target, command), [self._connection.now()] * self._acks_of(command))

    def is_for_us(self, ack: CommandAck) -> bool:
        # An ack without a target (0) counts too. MAVLink 1 and old firmware send no target.
        return is_addressed_to(ack, self._connection.source_system, self._connection.source_component)

    def _is_for_our_ids(self, ack: CommandAck) -> bool:
        # An ack without a target (0) may be for another ground station.
        return self.is_for_us(ack) and ack.target_system == self._connection.source_system

    def last_result(self, command: int, component_id: int | None = None) -> int | None:
        return self._results.get((self._component_id if component_id is None else component_id, command))

    def is_unsupported(self, command: int, component_id: int | None = None) -> bool:
        return self.last_result(command, component_id) in UNSUPPORTED_RESULTS

    def may_get_late_ack(self, command: int, component_id: int) -> bool:
        """Return True if an ack of an earlier call may still arrive. A call with one attempt takes it for its own."""
        earliest = self._connection.now() - PENDING_ACK_TIMEOUT_S
        return any(since >= earliest for since in self._pending_acks.get((component_id, command), ()))

    def accepted_at(self, command: int) -> float:
        """Return the time of the autopilot's last ACCEPTED ack to us, or −inf if there was none."""
        return self._accepted_at.get((self._component_id, command), -math.inf)

    def late_refusal(self, command: int, component_id: int, since: float) -> int | None:
        """Return the MAV_RESULT of a refusal that arrived after ``since``, when no ack was expected; None if none did.

        Such a refusal shows that the last call took a late or repeated ack of an earlier call for its own. If an
        ACCEPTED arrived between ``since`` and the refusal, that call is a newer one, and the result is None.
        """
        refusal = self._late_refusals.get((component_id, command))
        if refusal is None or not refusal.accepted_at <= since <= refusal.received_at:
            return None
        return refusal.result

    def forget_result(self, command: int, component_id: int | None = None) -> None:
        key = (self._component_id if component_id is None else component_id, command)
        self._results.pop(key, None)
        self._accepted_at.pop(key, None)

    def forget_results(self) -> None:
        # A rebooted vehicle may support other commands, and does not execute those from before.
        self._results.clear()
        self._accepted_at.clear()

    async def _run(self, message: CommandLong | CommandInt, options: _Options) -> CommandAck:
        """Send a command and return its ACCEPTED ack. Waits for earlier calls of the same command."""
        # Several components may answer a command to all components (0). Only the autopilot's answer ends this call.
        key = (message.target_component or self._component_id, message.command)
        order_status, was_just_sent = options.order_status, options.was_just_sent
        self._abort_run_of_ended_order(key)
        # The caller has checked the order's state, so only an end during the wait for the lock prevents the command.
        earlier_end = "" if order_status is None else order_status.end
        async with self._locks[key]:
            if self._is_closed:
                raise ConnectionClosed("the async with block of this vehicle was left; nothing was sent")
            order_end = "" if order_status is None else order_status.end
            if order_end != earlier_end and not was_just_sent:
                # The order ended while this call waited for an earlier command to complete.
                text = f"{command_name(message.command)} was not sent: {order_end}"
                raise CommandTimeout(text, was_sent=False)
            acks_per_sending = self._acks_of(message.command)
            pending_acks = self._pop_pending_acks(key)
            if was_just_sent:
                # This call waits for the acks that `send_unconfirmed` has recorded as pending. If they have arrived
                # already, the command is sent again. This is harmless: only commands that stop or release something are
                # sent this way.
                del pending_acks[-acks_per_sending:]
            exchange = CommandExchange(
                message,
                own_system=self._connection.source_system,
                own_component=self._connection.source_component,
                attempts=options.attempts,
                attempt_timeout=options.attempt_timeout,
                min_timeout_s=self._min_attempt_timeout_s(),
                progress_timeout=options.progress_timeout,
                on_progress=options.on_progress,
                earlier_acks=len(pending_acks),
                acks_per_sending=acks_per_sending,
                order_status=order_status,
                sent_by_caller=was_just_sent,
            )
            run = ExchangeRun(self._connection, exchange)
            self._runs[key] = run
            self._exchanges[key] = exchange
            try:
                return await run.result()
            except CommandTimeout as error:
                error.args = (f"{error}; {self._describe()}",)
                raise
            finally:
                del self._runs[key], self._exchanges[key]
                # Acks arrive in the order of their commands. Those received so far answer the oldest pending commands.
                still_pending = pending_acks[exchange.final_acks :]
                newly_pending = [self._connection.now()] * exchange.pending_acks
                self._add_pending_acks(key, [*still_pending, *newly_pending])

    def _abort_run_of_ended_order(self, key: _Key) -> None:
        exchange = self._exchanges.get(key)
        error = None if exchange is None else exchange.error_of_ended_order
        if error is not None:  # The command of a newer order need not wait until this run ends.
            self._runs[key].abort(error)

    def _min_attempt_timeout_s(self) -> float:
        # A round trip that was measured while the link was stalled would make the wait too long.
        return min(MIN_ROUND_TRIPS * (self._round_trip_s() or 0.0), MAX_ATTEMPT_TIMEOUT_S)

    def attempts_in_time(self, attempts: int, attempt_timeout: float) -> int:
        """Return how many attempts take as long on this link as ``attempts`` on a fast one; at least `MAX_ATTEMPTS`.

        On a slow link, each attempt takes longer than ``attempt_timeout`` seconds.
        """
        slow_timeout_s = max(attempt_timeout, self._min_attempt_timeout_s())
        return max(MAX_ATTEMPTS, int(attempts * attempt_timeout / slow_timeout_s))

    def _acks_of(self, command: int) -> int:
        # PX4 sends two acks for some commands.
        return self._acks_per_command.get(command, 1)

    def _add_pending_acks(self, key: _Key, pending_since: Sequence[float]) -> None:
        if pending_since:
            self._pending_acks.setdefault(key, []).extend(pending_since)

    def _pop_pending_acks(self, key: _Key) -> list[float]:
        """Remove the pending acks, and return the times of those that may still arrive."""
        lost_before = self._connection.now() - PENDING_ACK_TIMEOUT_S
        return [since for since in self._pending_acks.pop(key, ()) if since >= lost_before]

    def _abort(self, error: Exception) -> None:
        for run in tuple(self._runs.values()):
            run.abort(error)

    def _record_result(self, key: _Key, ack: CommandAck) -> None:
        self._results[key] = ack.result
        if ack.result != MavResult.ACCEPTED:
            self._refused_at[key] = self._connection.now()
        elif self._is_for_our_ids(ack):
            self._accepted_at[key] = self._connection.now()

    def _on_ack(self, ack: CommandAck) -> None:
        frame = ack.received_frame
        key = (0 if frame is None else frame.component_id, ack.command)
        if frame is not None and self._copies.is_copy(frame):
            return  # A copy could count as the ack of the next command with this MAV_CMD, even if that command is lost.
        run = self._runs.get(key)
        is_final = ack.result != MavResult.IN_PROGRESS
        is_refusal = is_final and ack.result != MavResult.ACCEPTED
        is_expected = (run is not None or key in self._pending_acks) and self.is_for_us(ack)
        if is_expected and is_final:
            self._record_result(key, ack)
        if run is not None:
            run.receive(ack)
        elif is_expected and is_final:
            # No call waits for this ack, so it is the ack of an earlier call.
            self._pending_acks[key].pop(0)
            if not self._pending_acks[key]:
                del self._pending_acks[key]
        elif is_refusal and key in self._results and self._is_for_our_ids(ack):
            self._on_unexpected_refusal(key, ack.result)

    def _on_unexpected_refusal(self, key: _Key, result: int) -> None:
        now = self._connection.now()
        # Soon after another refusal, this ack may be a copy of it.
        if now - self._refused_at.get(key, -math.inf) > PENDING_ACK_TIMEOUT_S:
            self._results[key] = result
            self._late_refusals[key] = _LateRefusal(self._accepted_at.get(key, -math.inf), now, result)
