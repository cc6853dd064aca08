"""Cleanup after an abandoned order: hold the vehicle (`FlightCleanup`) or disarm it (`ArmCleanup`)."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.connection.tasks import Cancellation
from aerokit.errors import (
    AerokitError,
    BusyError,
    CommandRejected,
    HeartbeatTimeout,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags
from aerokit.vehicle.commanding.arbiter import ARM_HEARTBEAT_DELAY_S, MODE_GRACE_S, STEERING, was_armed_by_order
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.session.session import VehicleSession

logger: logging.Logger = logging.getLogger("aerokit")


class BackgroundTask:
    """Runs one background task for a vehicle. A new task replaces the previous one.

    ``name`` is the task's name. If the task is not done at the end of the vehicle's `async with` block, aerokit logs
    "the async with block of this vehicle was left", followed by ``warning_clause``.
    """

    def __init__(self, session: VehicleSession, name: str, warning_clause: str) -> None:
        self._session, self._name, self._warning_clause = session, name, warning_clause
        # Cancels the task; None before the first task, and once the task is done or cancelled.
        self._scope: Cancellation | None = None
        # Set when the latest task has ended, also after it was cancelled.
        self._done = asyncio.Event()

    @property
    def is_open(self) -> bool:
        return self._scope is not None

    def start(self, work: Callable[[], Awaitable[None]]) -> None:
        self.cancel()  # Two tasks might give the same order twice.
        scope, done = Cancellation(), asyncio.Event()
        self._scope, self._done = scope, done

        async def run() -> None:
            try:
                with scope:
                    await work()
            finally:
                if self._scope is scope:  # No newer task has replaced this one.
                    self._scope = None
                done.set()

        self._session.background.start(run, self._name)

    def cancel(self) -> None:
        """Cancel the task. Steps that it shields from cancellation still finish."""
        if self._scope is not None:
            self._scope.cancel()
            self._scope = None

    @contextmanager
    def protected(self) -> Iterator[None]:
        """Ignore ``cancel`` during a `with` block in which the task itself gives an order."""
        scope, self._scope = self._scope, None
        try:
            yield
        finally:
            self._scope = scope

    async def finish(self, max_wait_s: float) -> None:
        """Wait until the task is done, at most ``max_wait_s`` seconds, and log a warning if it is not."""
        if not self.is_open or not self._session.connection.is_open:
            return
        if max_wait_s > 0:
            # Shielded, because the `async with` block may be left by a cancellation.
            with anyio.CancelScope(shield=True), anyio.move_on_after(max_wait_s):
                await self._done.wait()
        if self.is_open:
            link = self._session.describe_link()
            logger.warning("the async with block of this vehicle was left %s: %s", self._warning_clause, link)


# Seconds to wait for the acknowledgement of a hold at the end of the vehicle's `async with` block.
HOLD_CLOSE_TIMEOUT_S = 1.5

# Maximum number of attempts to hold after an abandoned order. After a time-out, the next attempt waits for a HEARTBEAT.
MAX_HOLD_ATTEMPTS = 3

# A hold is repeated if it is not acknowledged within HOLD_ACK_TIMEOUT_S seconds, at most MAX_HOLD_RESENDS times. On a
# slow link, it is repeated later and less often.
HOLD_ACK_TIMEOUT_S, MAX_HOLD_RESENDS = 0.5, 10

# A vehicle that is higher or faster has begun its take-off.
MAX_GROUND_HEIGHT_M, MAX_GROUND_SPEED_M_S = 0.5, 1.0

# -1 and 0 leave the speed and the radius of a circle to the vehicle. NaN means the present position, so the vehicle
# brakes and does not fly back to a point that it has passed.
STOP_HERE = (MavCmd.DO_REPOSITION, -1, MavDoRepositionFlags.CHANGE_MODE, 0, *(math.nan,) * 4)


class FlightCleanup:
    """Makes the vehicle hold when the program orders a hold, or after an order was abandoned.

    ``stop_stream(reason)`` stops the active set-point stream. ``stop_stream`` is None while there is no such stream.
    """

    def __init__(self, session: VehicleSession, arbiter: CommandArbiter, sender: OrderSender) -> None:
        self._session, self._arbiter, self._sender = session, arbiter, sender
        self.stop_stream: Callable[[str], None] | None = None
        self._awaited_order: Order | None = None
        self._task = BackgroundTask(session, "aerokit hold", warning_clause="before a hold was confirmed")
        # After a new steering order, an earlier hold need not be confirmed any more.
        arbiter.on_steering(self._task.cancel)

    async def hold(self) -> None:
        mode = self._sender.mode_for("hold", "hold")
        order = self._arbiter.order(mode)
        with self.flying(order):
            await self.stop_in(mode, order)

    async def stop_in(self, mode: Mode, order: Order) -> None:
        """Order the vehicle to hold, even if it already is in the hold mode."""
        order.only_stops = True  # From now on, `order` is sent even if the computer slept.
        if self._holds_by_reposition:
            # PX4 also flies to places in LOITER, its hold mode, so the mode alone does not stop it. PX4 acts on the
            # loss of set-points after 1 s (COM_OF_LOSS_T), so a lost hold is repeated earlier.
            await self._sender.send_long(
                order, *STOP_HERE, attempt_timeout=HOLD_ACK_TIMEOUT_S, attempts=self._max_attempts
            )
            await self._sender.ensure_mode(mode, order)
        else:
            await self._sender.change_mode(mode, order, reported_since=order.given_at)

    def _hold_command(self, mode: Mode) -> tuple[float, ...]:
        """Return the command that makes the vehicle hold, followed by its parameters."""
        if self._holds_by_reposition:
            return STOP_HERE
        return (MavCmd.DO_SET_MODE, *self._session.autopilot.mode_order(mode).params)

    async def _confirm_hold(self, mode: Mode, order: Order) -> None:
        """Wait for the acknowledgement of a hold that was just sent. Send the hold again if there is none."""
        command, *params = self._hold_command(mode)
        await self._sender.send_long(
            order,
            int(command),
            *params,
            modes=() if self._holds_by_reposition else (mode,),
            attempt_timeout=HOLD_ACK_TIMEOUT_S,
            attempts=self._max_attempts,
            was_just_sent=True,
        )

    @property
    def _max_attempts(self) -> int:
        return self._session.commands.attempts_in_time(MAX_HOLD_RESENDS, HOLD_ACK_TIMEOUT_S)

    # ---------------------------------------------------------------------- abandoned orders

    def hold_in_background(self, order: Order) -> bool:
        """Order a hold because ``order`` was abandoned. Never waits, so that cancelled calls can use it.

        Returns True if the hold was sent, or is sent by a background task after the next HEARTBEAT. The task repeats
        the hold if it is not confirmed. Returns False if ``order`` has ended, cannot have moved the vehicle or must be
        completed, if the vehicle is disarmed or has no hold mode, or if its session has ended.
        """
        if not order.may_move:
            return False
        session = self._session
        mode = session.autopilot.mode_for("hold", is_vtol=session.telemetry.is_vtol)
        # After the end of this session, the program may fly the vehicle by another `Vehicle` object.
        if mode is None or session.end.error is not None:
            return False
        if session.telemetry.is_confirmed_disarmed or order.end:
            return False
        if order.must_complete and not order.impact and self._has_begun_take_off():
            logger.warning("a take-off was abandoned; the vehicle completes it, because a hold could make it descend")
            return False
        # If `only_stops` is True, `stop_in` has probably sent the hold already. It is then repeated after a HEARTBEAT.
        can_send_now = self._arbiter.is_state_recent and not order.only_stops
        # Each change of the mode has the same MAV_CMD, so the next COMMAND_ACK may answer the command of `order`.
        is_ack_ambiguous = not self._holds_by_reposition and session.connection.now() < order.given_at + MODE_GRACE_S
        if can_send_now:
            command, *params = self._hold_command(mode)
            self._session.commands.send_unconfirmed(int(command), *params)
            # The new order replaces the abandoned one, whose modes the vehicle may still report.
            order = self._arbiter.order(*order.modes, mode)
            self._arbiter.doubt_mode()
        self._task.start(
            partial(self._complete_hold, mode, order, is_sent=can_send_now, is_ack_ambiguous=is_ack_ambiguous)
        )
        return True

    def _has_begun_take_off(self) -> bool:
        """Return False if a plane certainly still stands on the ground."""
        telemetry = self._session.telemetry
        if telemetry.is_vtol:  # A QuadPlane with a take-off command lifts off in LOITER, too (SITL 4.7).
            return True
        velocity, position = telemetry.velocity, telemetry.position
        if velocity.latest is None or position.latest is None or max(velocity.age, position.age) > POSITION_MAX_AGE_S:
            return True
        height_m = position.latest.altitude_relative_m
        is_low = height_m is not None and height_m < MAX_GROUND_HEIGHT_M
        speed_m_s = math.hypot(velocity.latest.north_m_s, velocity.latest.east_m_s, velocity.latest.down_m_s)
        return not is_low or speed_m_s >= MAX_GROUND_SPEED_M_S

    async def _complete_hold(self, mode: Mode, order: Order, *, is_sent: bool, is_ack_ambiguous: bool) -> None:
        """Wait for the confirmation of a hold. Without one, send it again after the next HEARTBEAT.

        With ``is_ack_ambiguous``, a HEARTBEAT after the COMMAND_ACK must report the mode.
        """
        for _ in range(MAX_HOLD_ATTEMPTS):
            try:
                if is_sent:
                    await self._confirm_hold(mode, order)
                    if is_ack_ambiguous:
                        acknowledged_at = self._session.connection.now()
                        await self._sender.await_mode(mode, order, [], MODE_GRACE_S, acknowledged_at)
                    return
                await self._session.wait_for_heartbeat()
                if not order.end and not self._session.telemetry.is_confirmed_disarmed:
                    # Every new steering order cancels this task, except the one that the task gives itself.
                    with self._task.protected():
                        order = self._arbiter.order(*order.modes, mode)
                    await self.stop_in(mode, order)
                return
            except OperationTimeout as error:
                logger.warning("the hold after an abandoned flight is not confirmed yet: %s", error)
                is_sent = False  # The next attempt waits for a HEARTBEAT and sends the hold again.
            except AerokitError as error:
                if not order.end:
                    logger.warning("the vehicle does not hold after an abandoned flight: %s", error)
                return
        logger.error("the hold after an abandoned flight was not confirmed; aerokit does not send it again")

    @property
    def is_hold_pending(self) -> bool:
        return self._task.is_open

    async def finish(self) -> None:
        await self._task.finish(HOLD_CLOSE_TIMEOUT_S if self._arbiter.is_state_recent else 0)

    @contextmanager
    def flying(self, order: Order) -> Iterator[None]:
        """Register the order while a call waits for its effect, so that `end_flights` can order a hold."""
        self._awaited_order = order
        try:
            yield
        except OperationRejected:
            if order.impact:  # After an impact, the vehicle must not climb again to its target.
                self.hold_in_background(order)
            raise
        finally:
            if self._awaited_order is order:
                self._awaited_order = None

    @contextmanager
    def holding_if_abandoned(self, order: Order) -> Iterator[None]:
        """Like :meth:`flying`. If the block is cancelled or times out, order a hold: the vehicle may have the order."""
        try:
            with self.flying(order):
                yield
        except (anyio.get_cancelled_exc_class(), OperationTimeout):  # CommandTimeout and HeartbeatTimeout are included.
            self.hold_in_background(order)
            raise

    @property
    def is_stream_open(self) -> bool:
        """True while the program streams set-points, or is about to. A stream needs its own flight mode."""
        return self.stop_stream is not None

    def check_no_stream(self) -> None:
        """Raise BusyError if a set-point stream is open."""
        if self.is_stream_open:
            raise BusyError("another set-point stream is open: leave it first; nothing was sent")

    @contextmanager
    def preparing_stream(self, mode: Mode) -> Iterator[Order]:
        """Create an order to change to ``mode``, for a stream that the caller prepares in the `with` block.

        The caller sends the order after the block. If the block or its end raises, the caller must not send it, and
        aerokit orders a hold instead, because an earlier order may still move the vehicle (see `hold_in_background`).

        Raises:
            BusyError: another stream is open. No order was created.
            OperationRejected: the order has ended during the block.
            HeartbeatTimeout: the vehicle is silent at the end of the block.
        """
        self.check_no_stream()
        order = self._arbiter.order(mode)
        try:
            with self.flying(order):
                yield order
            self._sender.raise_if_ended(order)
            if not self._arbiter.is_state_recent:
                raise HeartbeatTimeout(
                    f"the vehicle is silent: {self._session.describe_link()}; the mode was not changed"
                )
        except BaseException:
            self.hold_in_background(order)
            raise

    def end_flights(self) -> None:
        if self.stop_stream is not None:
            self.stop_stream("the async with block of its vehicle was left")
        if self._awaited_order is not None:
            self.hold_in_background(self._awaited_order)

    @property
    def _holds_by_reposition(self) -> bool:
        return self._session.autopilot.reposition is not None and self._session.autopilot.reposition_purpose == "hold"


ARM_WATCH_S = 15.0
"""Seconds for which aerokit monitors the vehicle after an abandoned arm order, and disarms it if the order arms it."""

ARM_ACK_WAIT_S = 3.0
"""The COMMAND_ACK of an arm order may arrive up to this many seconds after the HEARTBEAT that reports armed."""

# Seconds to wait for the outcome of an abandoned arm order at the end of the vehicle's `async with` block.
ARM_CLOSE_TIMEOUT_S = 1.5


class ArmCleanup:
    """Monitors the vehicle after an arm order was abandoned, and disarms it if this order arms it after all.

    ``hold`` is called if the vehicle has begun a flight and therefore refuses to disarm.
    """

    def __init__(
        self,
        session: VehicleSession,
        arbiter: CommandArbiter,
        sender: OrderSender,
        hold: Callable[[], Awaitable[None]],
    ) -> None:
        self._session, self._arbiter, self._sender, self._hold = session, arbiter, sender, hold
        self._task = BackgroundTask(
            session, "aerokit late arming", warning_clause="while an arm command may still be executed"
        )
        # The arm orders whose effects calls wait for, and whether the vehicle was armed before them.
        self._awaited: list[tuple[Order, bool]] = []

    @contextmanager
    def arming(self, order: Order, was_armed: bool) -> Iterator[None]:
        """Register an arm order while a call awaits it, so that `finish` can watch it."""
        self._awaited.append((order, was_armed))
        try:
            yield
            for other in self._other_awaited(order):  # If such a call is abandoned, the vehicle must stay armed.
                other.arm_command_number = None
        finally:
            self._awaited = [awaited for awaited in self._awaited if awaited[0] is not order]

    def _other_awaited(self, order: Order) -> list[Order]:
        return [other for other, _ in self._awaited if other is not order]

    def late_arming_hint(self) -> str:
        unsent = self._session.connection.unsent_bytes
        hint = f"; {unsent} bytes are still in the send buffer" if unsent else ""
        return (
            f"it may still be executed{hint}; if it arms the vehicle within {ARM_WATCH_S:g} s, and before the end of"
            " the vehicle's `async with` block, aerokit disarms it"
        )

    def watch(self, order: Order, was_armed: bool) -> bool:
        """Watch in the background whether the abandoned arm command still arms the vehicle.

        Returns False if the program has given a newer arm or disarm command, which counts instead, or if another call
        still waits for an arm command, or has armed the vehicle meanwhile.
        """
        if not self._is_newest_arm_command(order):
            return False
        if other_orders := self._other_awaited(order):  # If that call is abandoned too, it watches the vehicle.
            other_orders[-1].arm_command_number = order.arm_command_number
            return False
        self._session.connection.discard_unsent()  # An arm command that is still unsent must not be sent later.
        mode = self._session.telemetry.mode.latest
        self._task.start(partial(self._watch_arming, order, was_armed, mode_when_abandoned=mode))
        return True

    def _is_newest_arm_command(self, order: Order) -> bool:
        return order.arm_command_number == self._arbiter.arm_commands_sent

    async def _watch_arming(self, order: Order, was_armed: bool, *, mode_when_abandoned: Mode | None) -> None:
        has_armed = False
        with anyio.move_on_after(ARM_WATCH_S):
            has_armed = await self._wait_until_armed(was_armed)
        if has_armed:
            await self._undo_late_arming(order, mode_when_abandoned)

    async def _wait_until_armed(self, was_armed: bool) -> bool:
        """Return False if the link ends before the vehicle arms."""
        armed, started = self._session.telemetry.armed, self._session.connection.now()
        try:
            if was_armed:  # An armed vehicle ignores the order until it disarms.
                await armed.wait_until(lambda is_armed: not is_armed, description="disarmed")
            await armed.wait_until(lambda is_armed: is_armed and armed.updated_at > started, description="armed")
        except AerokitError as error:
            logger.warning("the link ended while an arm command may still be executed: %s", error)
            return False
        return True

    async def _undo_late_arming(self, order: Order, mode_when_abandoned: Mode | None) -> None:
        """Disarm the vehicle if the abandoned order has armed it."""
        was_armed_by_order = await self._was_armed_by(order, mode_when_abandoned)
        if not self._is_newest_arm_command(order) or self._session.telemetry.is_confirmed_disarmed:
            return
        if not was_armed_by_order:
            logger.warning(
                "the vehicle armed after an arm command was abandoned: it stays armed, because another party may have"
                " armed it"
            )
            return
        logger.warning("an abandoned arm command has armed the vehicle: aerokit disarms it again")
        with anyio.CancelScope(shield=True):
            with self._arbiter.auxiliary_order(ends_flight=True) as disarm_order:
                try:
                    await self._sender.send_disarm(disarm_order)
                except AerokitError as error:
                    logger.error(
                        "an abandoned arm command has armed the vehicle, and it could not be disarmed: %s", error
                    )
                    was_refused = isinstance(error, CommandRejected) and self._is_newest_arm_command(disarm_order)
                    if was_refused and self._has_begun_flight(order):
                        await self._hold_after_arming()

    def _has_begun_flight(self, order: Order) -> bool:
        """Return True if the vehicle was armed in a mode that starts a flight, and no newer order steers it."""
        telemetry, newest = self._session.telemetry, self._arbiter.latest(STEERING)
        was_steered = newest is not None and newest.number > order.number
        is_in_flight_mode = telemetry.mode_name in self._session.autopilot.modes_starting_flight
        is_flying = is_in_flight_mode and telemetry.is_armed
        return is_flying and not was_steered and self._arbiter.is_state_recent

    async def _hold_after_arming(self) -> None:
        mode = self._session.telemetry.mode_name
        if self._session.autopilot.must_complete_take_off:
            logger.warning(
                "the abandoned arm command has started a flight in %s: the vehicle continues it, because a hold could"
                " make it descend",
                mode,
            )
            return
        logger.warning("the abandoned arm command has started a flight in %s: aerokit orders a hold", mode)
        try:
            await self._hold()
        except AerokitError as error:
            logger.error("the vehicle that was armed in %s does not hold: %s", mode, error)

    async def _was_armed_by(self, order: Order, mode_when_abandoned: Mode | None) -> bool:
        """Return True if this order, and no other party, has armed the vehicle."""
        armed_at = self._session.telemetry.armed.updated_at
        disarmed_at = max(order.given_at, self._arbiter.last_disarmed_report_at)
        # While the computer slept, another party had time to arm the vehicle.
        if self._arbiter.slept_since(order.given_at) > 0:
            return False
        mode_now, newest = self._session.telemetry.mode.latest, self._arbiter.newest
        was_mode_ordered = newest is not None and newest.number > order.number and newest.modes == (mode_now,)
        # A mode change that no newer order of this program explains is a takeover.
        is_mode_explained = mode_now == mode_when_abandoned or was_mode_ordered
        was_taken_over = order.takeover_reason or order.failsafe or not is_mode_explained
        if not was_taken_over and armed_at - order.given_at <= ARM_HEARTBEAT_DELAY_S:
            return True
        # After a takeover or a late HEARTBEAT, only the acknowledgement shows that this order has armed the vehicle.
        if not self._was_armed_by_accepted_command(disarmed_at):
            await anyio.sleep(ARM_ACK_WAIT_S)
        # A vehicle that was disarmed meanwhile and is armed again was armed by another party.
        has_stayed_armed = self._arbiter.last_disarmed_report_at < armed_at
        return has_stayed_armed and self._was_armed_by_accepted_command(disarmed_at)

    def _was_armed_by_accepted_command(self, disarmed_at: float) -> bool:
        accepted_at = self._session.commands.accepted_at(MavCmd.COMPONENT_ARM_DISARM)
        return was_armed_by_order(disarmed_at, accepted_at)

    def stop_watching(self) -> None:
        self._task.cancel()

    async def finish(self) -> None:
        """Wait briefly for the outcome of an abandoned arm order. Logs a warning if it stays unknown."""
        awaited, self._awaited = self._awaited, []
        if awaited:  # Tasks still wait for arm orders, which are now abandoned.
            self.watch(*awaited[-1])
        await self._task.finish(ARM_CLOSE_TIMEOUT_S)
