"""Take-off, landing, return to launch, mode changes and hold."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import CommandRejected, NotSupported, OperationRejected
from aerokit.mavlink.enums import MavLandedState
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.ground import GroundCheck
from aerokit.vehicle.commanding.progress import (
    MAX_SILENCE_S,
    POSITION_MAX_AGE_S,
    CircleDetector,
    StallDetector,
    await_progress,
)
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Mode, TakeOff
    from aerokit.vehicle.commanding.order import Order

# Maps each MAV_LANDED_STATE of a flying vehicle to its name in error texts.
IN_THE_AIR: dict[int | None, str] = {
    MavLandedState.IN_AIR: "in the air",
    MavLandedState.TAKEOFF: "taking off",
    MavLandedState.LANDING: "landing",
}

# Height above home from which a vehicle that sends no landed state is considered flying.
MIN_FLYING_HEIGHT_M = 2.0

# Metres of climb that show that the vehicle executes a take-off command.
CLIMB_DETECTED_M = 0.5

# Time-out in seconds of a mode change, the same as the default of `set_mode`.
MODE_TIMEOUT_S = 6.0

# A submarine that leaves the surfacing mode below this depth has not surfaced. Home is at the surface.
MAX_SURFACE_DEPTH_M = 1.5


@checks_arguments
class FlightActions(VehicleBase):
    """Take-off, landing and return to launch."""

    async def take_off(
        self,
        altitude_m: float,
        *,
        timeout: float = 60.0,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Take off and climb to ``altitude_m`` above home. Returns when the vehicle is at that altitude.

        The vehicle must be armed. If the autopilot requires another mode for a take-off, aerokit changes the mode.
        After a cancellation or a time-out, aerokit orders the vehicle to hold where it is. A QuadPlane, and an
        ArduPlane that already moves, complete the take-off instead, because a hold could make them hit the ground.

        Args:
            altitude_m: metres above home, above 0, at most 10,000.
            timeout: seconds until the vehicle is at that altitude.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no such limit.

        Raises:
            InvalidArgument: the altitude is out of range. Nothing was sent.
            NotSupported: this type of vehicle cannot take off.
            OperationRejected: the vehicle is not armed, or is already flying (nothing was sent). Or during the
                take-off, its mode changed, or it disarmed or hit the ground.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            CommandTimeout: there was no acknowledgement.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle did not reach the altitude in time, or does not move.
            ValueUnknownError: the altitude of home is unknown, which PX4 needs.
        """
        check_range("altitude_m", altitude_m, 0, 10_000, above=True)
        plan = self._take_off_plan(altitude_m)
        if not self.telemetry.is_armed:
            raise OperationRejected("take_off: the vehicle is not armed: call arm() first; nothing was sent")
        landed = self.telemetry.landed_state
        # TAKEOFF is missing below: during a take-off, PX4 accepts another altitude, and ArduPilot rejects the command.
        is_flying = landed.latest in (MavLandedState.IN_AIR, MavLandedState.LANDING)
        if is_flying and landed.age <= POSITION_MAX_AGE_S:  # A mode change would abort a landing.
            raise OperationRejected(
                f"take_off: the vehicle is already {IN_THE_AIR[landed.latest]}: use go_to() to climb; nothing was sent"
            )
        # The modes that the vehicle may report during the take-off.
        take_off_mode = self.autopilot.mode_for("take_off", is_vtol=self.telemetry.is_vtol)
        modes = (plan.mode, plan.mode_after, take_off_mode)
        order = self._arbiter.order(*(mode for mode in modes if mode is not None))
        order.must_complete = self.autopilot.must_complete_take_off
        try:
            with self._flight_cleanup.holding_if_abandoned(order):
                await self._begin_take_off(plan, order)
                await self._await_altitude(altitude_m, plan, timeout, max_silence_s, order)
        except CommandRejected as error:
            explained = self._with_landed_state(error)
            if explained is None:
                raise
            raise explained from error

    def _with_landed_state(self, error: CommandRejected) -> CommandRejected | None:
        """Return the error of a refused take-off with the landed state added to it.

        Returns None if the vehicle is not known to be in the air.
        """
        # The vehicle does not say why it refuses a take-off in the air.
        state = IN_THE_AIR.get(self.telemetry.landed_state.latest)
        altitude_m = self._position.altitude_relative()
        is_high = altitude_m > MIN_FLYING_HEIGHT_M
        if state is None and not is_high:
            return None
        is_altitude_known = altitude_m > -math.inf
        height = f", {altitude_m:.1f} m above home" if is_altitude_known else ""
        reason = (
            f"the vehicle is {state or 'probably in the air'}{height} and can only take off from the ground;"
            " go_to() climbs"
        )
        # The text of `error` already lists its own reasons, so the constructor gets only the new reason. The attribute
        # has all of them.
        explained = CommandRejected(f"{error}", command=error.command, result=error.result, reasons=(reason,))
        explained.reasons = (*error.reasons, reason)
        return explained

    def _take_off_plan(self, altitude_m: float) -> TakeOff:
        home = self._position.home_altitude() if self.autopilot.take_off_needs_home() else None
        plan = self.autopilot.take_off(altitude_m, home, is_vtol=self.telemetry.is_vtol)
        if plan is None:
            raise NotSupported(f"take_off: {self.autopilot.firmware} cannot take off")
        return plan

    async def _begin_take_off(self, plan: TakeOff, order: Order) -> None:
        if plan.mode is not None:
            await self._sender.ensure_mode(plan.mode, order)
        if plan.command is not None:
            is_rising = self._climb_detector()  # A reported climb acknowledges the command.
            with self._session.streaming("position", "landed_state"):
                await self._sender.send_long(order, plan.command, *plan.params, modes=order.modes, is_done=is_rising)

    def _climb_detector(self) -> Callable[[], bool]:
        """Return a function that returns True once new messages report a climb."""
        started, landed = self.connection.now(), self.telemetry.landed_state
        if landed.latest == MavLandedState.TAKEOFF and landed.age <= POSITION_MAX_AGE_S:
            return lambda: False  # The climb may be the effect of an earlier command.
        # Without a recent altitude, the climb is measured from the first one that is received.
        is_start_known = self._position.was_received_since(started - POSITION_MAX_AGE_S)
        start_m = self._position.altitude_amsl() if is_start_known else -math.inf  # −inf: unknown
        state_before = landed.latest

        def is_rising() -> bool:
            nonlocal start_m
            if start_m == -math.inf and self._position.was_received_since(started):
                start_m = self._position.altitude_amsl()
            has_taken_off = landed.latest in (MavLandedState.IN_AIR, MavLandedState.TAKEOFF)
            is_reported = has_taken_off and landed.latest != state_before
            has_climbed = start_m > -math.inf and self._position.altitude_amsl() > start_m + CLIMB_DETECTED_M
            return is_reported or has_climbed

        return is_rising

    async def _await_altitude(
        self, altitude_m: float, plan: TakeOff, timeout: float, max_silence_s: float | None, order: Order
    ) -> None:
        # A hovering vehicle may be slightly too low. A vehicle on the ground must not be within the tolerance.
        tolerance_m = min(max(0.5, 0.05 * altitude_m), 0.5 * altitude_m)
        started = self.connection.now()
        # If home moves during the climb, the vehicle keeps its target altitude: PX4 corrects the altitude of home in
        # flight, and `set_home` may be called. The target is therefore an altitude above mean sea level: param7 of
        # PX4's command, or else computed from the first known position.
        target_amsl_m: float | None = plan.params[6] if self.autopilot.take_off_needs_home() else None

        def missing_m() -> float:
            nonlocal target_amsl_m
            here_amsl_m = self._position.altitude_amsl()
            missing_above_home_m = altitude_m - self._position.altitude_relative()
            target_m = here_amsl_m + missing_above_home_m
            is_target_known = self._position.was_received_since(started) and math.isfinite(target_m)
            if target_amsl_m is None and is_target_known:
                target_amsl_m = target_m
            return missing_above_home_m if target_amsl_m is None else target_amsl_m - here_amsl_m

        def is_up() -> bool:
            return self._position.was_received_since(started) and missing_m() <= tolerance_m and not order.end

        with self._session.streaming("position"):
            await await_progress(
                self._session,
                f"take_off({altitude_m:g} m)",
                is_done=is_up,
                failure_reason=self._sender.mode_failure(order, *order.modes),
                describe=self._describe_altitude,
                timeout=timeout,
                max_silence_s=max_silence_s,
                stall_reason=StallDetector(self._session),
            )

    def _describe_altitude(self) -> str:
        altitude_m = self._position.altitude_relative()
        is_known = altitude_m > -math.inf
        return f"the vehicle is at {altitude_m:.1f} m" if is_known else "the vehicle's altitude is unknown"

    async def land(self, *, timeout: float | None = 300.0, max_silence_s: float | None = MAX_SILENCE_S) -> None:
        """Land at the present position. Returns when the vehicle is on the ground.

        The motors may still be turning then; ``vehicle.armed`` reports when they have stopped. After a cancellation,
        the vehicle continues to land.

        Args:
            timeout: seconds until the vehicle is on the ground; None: no limit.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.

        Raises:
            NotSupported: this type of vehicle has no landing mode. Nothing was sent.
            CommandRejected: the vehicle refused the mode.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: the mode changed meanwhile, or the vehicle fell.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle was not on the ground in time.
        """
        mode = self._sender.mode_for("land", "land")
        if self.autopilot.mode_when_landed is None:
            order = self._arbiter.order(mode)
            await self._enter_landing_mode(mode, order)
        else:
            order = self._arbiter.order(mode, self.autopilot.modes.find(self.autopilot.mode_when_landed))
            with self._arbiter.changing_mode():
                # A submarine at the surface may leave the mode before any HEARTBEAT reports the mode, so a wait for
                # that report could fail.
                await self._sender.request_mode(mode, order, attempt_timeout=min(1.0, MODE_TIMEOUT_S / 4))
        await self._await_ground("land", order, timeout, max_silence_s)

    async def return_to_launch(
        self, *, timeout: float | None = 600.0, max_silence_s: float | None = MAX_SILENCE_S
    ) -> None:
        """Return to launch. Wait until the vehicle has landed, or is above home if it does not land by itself.

        Raises the same errors as :meth:`land`.
        """
        mode = self._sender.mode_for("return_to_launch", "return")
        order = self._arbiter.order(mode)
        await self._enter_landing_mode(mode, order)
        if self.autopilot.lands_at_home(mode):
            await self._await_ground("return_to_launch", order, timeout, max_silence_s)
        else:
            await self._await_home(order, timeout, max_silence_s)

    async def _enter_landing_mode(self, mode: Mode, order: Order) -> None:
        try:
            await self._sender.change_mode(mode, order, reported_since=order.given_at)
        except OperationRejected:
            # After a landing, PX4 disarms and changes to LOITER, which ends the order. The vehicle is then on the
            # ground, as ordered. If the vehicle has refused the mode, the order has not ended, and the error is raised.
            is_down = self.telemetry.is_confirmed_disarmed or is_reported_on_ground(self.telemetry)
            has_ended_by_landing = order.end and is_down and order.is_newest
            if not has_ended_by_landing:
                raise

    async def _await_ground(
        self, operation: str, order: Order, timeout: float | None, max_silence_s: float | None
    ) -> None:
        armed, landed, mode = self.telemetry.armed, self.telemetry.landed_state, self.telemetry.mode
        accepted_at = self.connection.now()
        landing_failure = self._sender.landing_failure(order)
        ground = GroundCheck(self._session)

        def has_left_surfacing_mode() -> bool:
            return self.telemetry.mode_name == self.autopilot.mode_when_landed and mode.updated_at > accepted_at

        def is_deep() -> bool:
            return (
                self._position.was_received_since(order.given_at)
                and self._position.altitude_relative() < -MAX_SURFACE_DEPTH_M
            )

        def is_down() -> bool:
            # Messages from before the order may be outdated.
            is_disarmed = self.telemetry.is_confirmed_disarmed and armed.updated_at > order.given_at
            is_landed = is_reported_on_ground(self.telemetry) and landed.updated_at > order.given_at
            # A submarine "lands" by going to the surface. Most submarines do not report a global position. Without a
            # position, the mode change alone counts.
            has_surfaced = has_left_surfacing_mode() and not is_deep()
            return ground.confirms(is_disarmed or is_landed or has_surfaced)

        def failure_reason() -> str | None:
            has_stopped_surfacing = has_left_surfacing_mode() and is_deep()
            if has_stopped_surfacing and self.connection.now() > accepted_at + MODE_GRACE_S:
                return f"the mode changed to {self.telemetry.mode_name} at {self._position.altitude_relative():.1f} m"
            return ground.failure_reason(landing_failure)

        with self._session.streaming("landed_state", "position"):
            await await_progress(
                self._session,
                operation,
                is_done=is_down,
                failure_reason=failure_reason,
                describe=self._describe_altitude,
                timeout=timeout,
                max_silence_s=max_silence_s,
            )

    async def _await_home(self, order: Order, timeout: float | None, max_silence_s: float | None) -> None:
        home = self.telemetry.home
        circle = CircleDetector(self._session)
        started = self.connection.now()

        def distance_m() -> float:
            return math.inf if home.latest is None else self._position.distance_to(home.latest.position)

        def is_back() -> bool:
            if home.latest is None or order.end or not self._position.was_received_since(started):
                return False
            return self._position.is_at(home.latest.position, circle)

        def describe() -> str:
            is_known = math.isfinite(distance_m())
            return f"the vehicle is {distance_m():.1f} m from home" if is_known else "the distance from home is unknown"

        with self._session.streaming("position"):
            await await_progress(
                self._session,
                "return_to_launch",
                is_done=is_back,
                failure_reason=self._sender.mode_failure(order, *order.modes),
                describe=describe,
                timeout=timeout,
                max_silence_s=max_silence_s,
            )


@checks_arguments
class ModeActions(VehicleBase):
    """Changing the flight mode, and holding."""

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT reports it.

        Sends MAV_CMD_DO_SET_MODE, or SET_MODE to a vehicle that does not support the command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Args:
            mode: a name as spelled in the autopilot's documentation (``"GUIDED"``, ``"POSCTL"``; case is ignored), or
                the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole call.

        Raises:
            InvalidArgument: this vehicle has no such mode; the text lists its modes. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: the vehicle did not acknowledge, or accepted the mode but stayed in another mode.
        """
        target_mode = self.autopilot.find_mode(mode, self.telemetry.mode_names)
        await self._sender.change_mode(target_mode, self._arbiter.order(target_mode), timeout)

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles). Returns when HEARTBEAT reports the autopilot's hold mode.

        The mode is BRAKE on Copter, LOITER on Plane and boats, HOLD on Rover, POSHOLD on Sub and LOITER on PX4.

        Raises:
            NotSupported: this vehicle has no hold mode. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: the vehicle did not acknowledge, or accepted the mode but stayed in another mode.
        """
        await self._flight_cleanup.hold()

    @property
    def is_hold_pending(self) -> bool:
        """True while the hold that followed an abandoned flight is not confirmed."""
        return self._flight_cleanup.is_hold_pending

    @property
    def is_flown_by_program(self) -> bool:
        """True while the vehicle is armed and executes orders of this program.

        The program must have armed the vehicle, or have given a steering order since another party armed it. No pilot,
        failsafe or other program may have taken over since. False for a vehicle that the program only observes.
        """
        return self.telemetry.is_armed and self._arbiter.is_flown_by_program

    @property
    def taken_over(self) -> str:
        """Text about the takeover that ended the program's last action; empty if there was none.

        A change of the mode (``"the mode changed to LOITER"``) may come from a pilot, a failsafe or another program:
        HEARTBEAT does not distinguish them. A failsafe (``"a failsafe became active (MAV_STATE_CRITICAL)"``) may be
        reported seconds before the mode changes. Disarming alone, as after a landing, is not a takeover. The program's
        next action clears this text.
        """
        order = self._arbiter.current or self._arbiter.newest
        if order is None:
            return ""
        if not order.has_lost_mode:  # The mode has not changed, so only a failsafe can be a takeover.
            return order.failsafe
        may_have_landed = self.telemetry.landed_state.latest != MavLandedState.IN_AIR  # True if unknown
        awaits_heartbeat = self.telemetry.armed.updated_at < order.mode_lost_at
        if may_have_landed and awaits_heartbeat:
            # PX4 leaves LAND when it disarms. CURRENT_MODE may report the new mode before HEARTBEAT reports that the
            # vehicle is disarmed, so the next HEARTBEAT decides.
            return ""
        return order.takeover_reason
