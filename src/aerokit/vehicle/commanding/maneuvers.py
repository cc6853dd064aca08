"""Manoeuvres: orbit, figure eight, loiter, follow, VTOL transition; airspeed and climb speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument, NotSupported
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags, MavVtolState, OrbitYawBehaviour, SpeedType
from aerokit.position import travel_target
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.follow_target import FollowTarget
from aerokit.vehicle.commanding.progress import (
    MAX_DISTANCE_M,
    MAX_SILENCE_S,
    POSITION_MAX_AGE_S,
    await_progress,
    is_on_wings,
)
from aerokit.vehicle.commanding.travel import KEEP_THROTTLE

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.position import Home, Position
    from aerokit.vehicle.commanding.follow import FollowStream

Facing = Literal["center", "ahead", "initial", "free"]
FlightState = Literal["fixed_wing", "multicopter"]

SPEED_ARGUMENTS = {SpeedType.AIRSPEED: "airspeed_m_s", SpeedType.CLIMB_SPEED: "climb_m_s"}
YAW_BEHAVIOURS: dict[str, OrbitYawBehaviour] = {
    "center": OrbitYawBehaviour.HOLD_FRONT_TO_CIRCLE_CENTER,
    "ahead": OrbitYawBehaviour.HOLD_FRONT_TANGENT_TO_CIRCLE,
    "initial": OrbitYawBehaviour.HOLD_INITIAL_HEADING,
    "free": OrbitYawBehaviour.UNCONTROLLED,
}
VTOL_STATES: dict[str, MavVtolState] = {"fixed_wing": MavVtolState.FW, "multicopter": MavVtolState.MC}
MAX_RADIUS_M, MAX_SPEED_M_S, MAX_ROUNDS = 10_000, 50, 1000
MAX_SET_SPEED_M_S = 1000


@checks_arguments
class ManeuverActions(VehicleBase):
    """Orbit, figure eight, loiter, follow, VTOL transition; airspeed and climb speed."""

    async def orbit(
        self,
        center: Position | Home,
        *,
        radius_m: float,
        speed_m_s: float = 2.0,
        turns: float | None = 1.0,
        clockwise: bool = True,
        facing: Facing = "center",
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Fly circles around a place.

        Returns when the vehicle's reported positions have gone around the place ``turns`` times. Afterwards a
        multicopter holds, and a fixed wing goes on circling. After a cancellation or a time-out, aerokit orders the
        vehicle to hold.

        PX4 flies the circle itself (MAV_CMD_DO_ORBIT). ArduPlane circles a place in GUIDED (MAV_CMD_DO_REPOSITION).
        ArduCopter has no command for a circle, and its mode CIRCLE follows the throttle stick. For ArduCopter, aerokit
        therefore streams set-points in GUIDED, and the vehicle stops if your program dies.

        Args:
            center: the middle of the circle, at the altitude of the circle. For home, or a position without altitude,
                the vehicle keeps its present altitude.
            radius_m: above 0, at most 10,000. PX4's multicopters refuse more than MC_ORBIT_RAD_MAX.
            speed_m_s: ground speed, above 0, at most 50. A fixed wing ignores it.
            turns: number of turns, above 0, at most 1000. None: circle until the call is cancelled or another order is
                given.
            clockwise: direction, as seen from above.
            facing: direction of the nose: towards the center, ahead, unchanged from the beginning, or chosen by the
                autopilot. A fixed wing ignores it.
            max_distance_m: a center farther away than this many metres is refused.
            timeout: seconds. None: no limit, as long as heartbeats arrive, the mode stays and the vehicle moves.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.
                A flight by set-points ends after 3.5 s without a heartbeat in any case.

        Raises:
            NotSupported: this type of vehicle cannot circle a place. Nothing was sent.

        Other errors are those of :meth:`go_to`.
        """
        from aerokit.vehicle.commanding.closed_paths import Circle, TurnCounter
        from aerokit.vehicle.commanding.rounds import FlightLimits, RoundFlight

        check_range("radius_m", radius_m, 0, MAX_RADIUS_M, above=True)
        check_range("speed_m_s", speed_m_s, 0, MAX_SPEED_M_S, above=True)
        if turns is not None:
            check_range("turns", turns, 0, MAX_ROUNDS, above=True)
        place = travel_target(center)
        counter = TurnCounter(radius_m, clockwise=clockwise)
        limits = FlightLimits(max_distance_m, timeout, max_silence_s)
        if self.autopilot.circles_by == "setpoints":
            flight = RoundFlight(self._context, "orbit", place, counter, turns, limits)
            path = Circle(radius_m, clockwise=clockwise, first_phase=flight.bearing_rad)
            await flight.fly_by_setpoints(path, speed_m_s, facing)
        else:
            command, params, mode = self._circle_command("orbit", radius_m, speed_m_s, facing, clockwise=clockwise)
            flight = RoundFlight(self._context, "orbit", place, counter, turns, limits)
            holds_at_end = not self._is_on_wings
            await flight.fly_by_command(command, params, mode, holds_at_end=holds_at_end, radius_m=radius_m)

    async def figure_eight(
        self,
        center: Position | Home,
        *,
        major_radius_m: float,
        minor_radius_m: float,
        axis_deg: float = 0.0,
        speed_m_s: float = 2.0,
        rounds: float | None = 1.0,
        clockwise: bool = True,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Fly a figure eight; returns when the vehicle's reported positions have passed both lobes ``rounds`` times.

        A PX4 fixed wing flies the figure itself (MAV_CMD_DO_FIGURE_EIGHT), as two circles joined by straight lines, and
        continues until another order. For ArduCopter and PX4's multicopters, aerokit streams the set-points of a
        lemniscate; at the end the vehicle holds at the center. Time-out, cancellation and errors are those of
        :meth:`orbit`.

        Args:
            center: the point where the lines cross, at the altitude of the figure. Without an altitude, the vehicle
                keeps its present altitude.
            major_radius_m: half the length of the figure, above 0, at most 10,000.
            minor_radius_m: half the width of the figure, above 0, at most half of ``major_radius_m``.
            axis_deg: direction from the center to the first lobe, 0–360 clockwise from north.
            speed_m_s: ground speed, above 0, at most 50. A fixed wing ignores it.
            rounds: number of figures, a multiple of 0.5, above 0, at most 1000. None: fly until the call is cancelled.
            clockwise: direction in the first lobe, as seen from above.
            max_distance_m: a center farther away than this many metres is refused.
            timeout: seconds. None: no limit, as long as heartbeats arrive, the mode stays and the vehicle moves.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.
                A flight by set-points ends after 3.5 s without a heartbeat in any case.
        """
        from aerokit.vehicle.commanding.closed_paths import Eight, LobeCounter
        from aerokit.vehicle.commanding.rounds import FlightLimits, RoundFlight

        check_range("major_radius_m", major_radius_m, 0, MAX_RADIUS_M, above=True)
        check_range("minor_radius_m", minor_radius_m, 0, major_radius_m / 2, above=True)
        check_range("axis_deg", axis_deg, 0, 360)
        check_range("speed_m_s", speed_m_s, 0, MAX_SPEED_M_S, above=True)
        if rounds is not None:
            check_range("rounds", rounds, 0, MAX_ROUNDS, above=True)
            if rounds * 2 != int(rounds * 2):
                raise InvalidArgument(f"rounds = {rounds!r} is not allowed: it must be a multiple of 0.5")
        can_use_command = self._is_on_wings and self.autopilot.circles_by == "orbit"  # True for fixed wings on PX4
        can_use_setpoints = not self._is_on_wings and self.autopilot.setpoints.trajectory
        if not (can_use_command or can_use_setpoints):
            raise NotSupported(f"figure_eight: {self.autopilot.firmware} has no such manoeuvre; nothing was sent")
        counter = LobeCounter(major_radius_m, axis_deg)
        limits = FlightLimits(max_distance_m, timeout, max_silence_s)
        flight = RoundFlight(self._context, "figure_eight", travel_target(center), counter, rounds, limits)
        if can_use_command:
            major_m = major_radius_m if clockwise else -major_radius_m
            axis_rad = math.radians(math.remainder(axis_deg, 360))  # The command allows -pi to pi.
            params = (major_m, minor_radius_m, math.nan, axis_rad)
            mode = self._sender.mode_for("figure_eight", "hold")
            await flight.fly_by_command(MavCmd.DO_FIGURE_EIGHT, params, mode, holds_at_end=False)
        else:
            path = Eight(major_radius_m, minor_radius_m, axis_deg, clockwise=clockwise)
            await flight.fly_by_setpoints(path, speed_m_s, "ahead")

    async def loiter(
        self,
        target: Position | Home | None = None,
        *,
        radius_m: float | None = None,
        clockwise: bool = True,
        turns: float | None = None,
        duration_s: float | None = None,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Go to a place and stay there: a fixed wing circles, a multicopter hovers.

        Returns when the vehicle has arrived, has then flown ``turns`` turns, and has then stayed for ``duration_s``
        seconds; both are optional. The vehicle stays until another order. After a cancellation or a time-out, aerokit
        orders the vehicle to hold where it is.

        Sends MAV_CMD_DO_REPOSITION (ArduPilot in GUIDED, PX4 in LOITER). For a PX4 fixed wing with ``radius_m``, sends
        MAV_CMD_DO_ORBIT.

        Args:
            target: the place, as for ``go_to``. None: the vehicle's present position.
            radius_m: radius of a fixed wing's circle, above 0, at most 10,000. None: the vehicle's parameter
                (WP_LOITER_RAD, NAV_LOITER_RAD).
            clockwise: direction of the circle, as seen from above; only with ``radius_m``.
            turns: return after this many turns, above 0, at most 1000; only with ``radius_m``.
            duration_s: return this many seconds after the arrival, or after the last turn.
            max_distance_m: a place farther away than this many metres is refused.
            timeout: seconds in total. None: no limit, as long as heartbeats arrive, the mode stays and the vehicle
                moves.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.

        Raises:
            InvalidArgument: a value is out of range, or ``turns`` was given without ``radius_m``. Nothing was sent.
            NotSupported: ``radius_m`` was given, but the vehicle hovers. Nothing was sent.

        Other errors are those of :meth:`go_to`.
        """
        from aerokit.vehicle.commanding.closed_paths import TurnCounter
        from aerokit.vehicle.commanding.rounds import FlightLimits, RoundFlight

        if turns is not None:
            check_range("turns", turns, 0, MAX_ROUNDS, above=True)
        if radius_m is not None:
            check_range("radius_m", radius_m, 0, MAX_RADIUS_M, above=True)
            if not self._is_on_wings:
                raise NotSupported(
                    f"loiter: this {self.autopilot.firmware} vehicle hovers, so radius_m is not supported: use orbit()"
                )
        elif turns is not None:
            raise InvalidArgument(f"turns = {turns!r} is not allowed without radius_m")
        center = self.telemetry.position.fresh(POSITION_MAX_AGE_S) if target is None else travel_target(target)
        if radius_m is None:
            counter = None
            command = int(MavCmd.DO_REPOSITION)
            # The speed, the radius and the yaw are left to the vehicle.
            params: tuple[float, ...] = (-1.0, float(MavDoRepositionFlags.CHANGE_MODE), 0.0, math.nan)
            mode = self._sender.mode_for("loiter", self.autopilot.reposition_purpose)
        else:
            counter = TurnCounter(radius_m, clockwise=clockwise)
            command, params, mode = self._circle_command("loiter", radius_m, clockwise=clockwise)
        limits = FlightLimits(max_distance_m, timeout, max_silence_s)
        rounds = turns or 0.0  # With 0 rounds, the flight ends after the arrival and `stay_s`.
        flight = RoundFlight(self._context, "loiter", center, counter, rounds, limits, center_name="target")
        await flight.fly_by_command(
            command, params, mode, holds_at_end=False, stay_s=duration_s or 0.0, radius_m=radius_m or 0.0
        )

    def follow(
        self,
        target: FollowTarget,
        *,
        distance_m: float = 10.0,
        bearing_deg: float | None = None,
        from_course: bool = False,
        height_m: float | None = None,
        face_target: bool = True,
        valid_for_s: float = 3.0,
        max_distance_m: float = 1000.0,
    ) -> FollowStream:
        """Follow a moving target: ``async with vehicle.follow(leader) as following: await following.fly(60)``.

        aerokit computes the vehicle's place relative to the target, and streams it with the target's velocity at 10 Hz
        (SET_POSITION_TARGET_GLOBAL_INT). It does not use ArduCopter's mode FOLLOW and PX4's FOLLOWME, which depend on
        stored parameters and behave differently.

        Args:
            target: another vehicle, of any connection; an asynchronous iterable of positions; or a function that
                returns the latest position or None. aerokit calls the function on the event loop ten times a second.
                A vehicle reports its velocity. Otherwise the velocity is computed from two different positions; a speed
                above 100 m/s counts as a jump, with velocity 0.
            distance_m: distance along the ground to keep, 0 to 1000.
            bearing_deg: direction from the target to the vehicle, 0–360 clockwise from north. None: the direction at
                the beginning.
            from_course: measure ``bearing_deg`` from the target's direction of movement instead; 180 is behind the
                target.
            height_m: height above the target, −1000 to 1000. None: the vehicle keeps its present altitude.
            face_target: turn the nose to the target.
            valid_for_s: seconds without a new position of the target after which the vehicle holds.
            max_distance_m: distance to the target in metres above which the vehicle holds.

        Raises:
            InvalidArgument: an argument is out of range, or the target is the vehicle itself.
            NotSupported: this type of vehicle has no position set-points, or the vehicle is a fixed wing or a VTOL in
                forward flight.
        """
        from aerokit.vehicle.commanding.follow import FollowPlace, FollowStream

        if self._is_on_wings:
            raise NotSupported("follow: the vehicle flies on its wings, and cannot slow down or stop with its target")
        place = FollowPlace(distance_m, bearing_deg, from_course, height_m, face_target)
        return FollowStream(self._context, target, place, valid_for_s, max_distance_m)

    def _circle_command(
        self, operation: str, radius_m: float, speed_m_s: float = math.nan, facing: Facing = "free", *, clockwise: bool
    ) -> tuple[int, tuple[float, ...], Mode]:
        """Return the command that circles a place, its first four parameters, and the mode that it leads to."""
        if self.autopilot.circles_by == "orbit":
            signed_radius_m = radius_m if clockwise else -radius_m
            params: tuple[float, ...] = (signed_radius_m, speed_m_s, float(YAW_BEHAVIOURS[facing]), 0.0)
            # PX4's multicopters have a mode for circles; its fixed wings circle in the hold mode.
            orbit_mode = self.autopilot.modes.find("ORBIT")
            mode = self._sender.mode_for(operation, "hold") if self._is_on_wings else orbit_mode
            return MavCmd.DO_ORBIT, params, mode
        if self.autopilot.circles_by == "reposition":
            # The speed is left to the vehicle. param4 is the direction of the circle (GCS_MAVLink_Plane.cpp).
            params = (-1.0, float(MavDoRepositionFlags.CHANGE_MODE), radius_m, 0.0 if clockwise else 1.0)
            return MavCmd.DO_REPOSITION, params, self._sender.mode_for(operation, "setpoint")
        raise NotSupported(f"{operation}: {self.autopilot.firmware} cannot circle a place; nothing was sent")

    @property
    def _is_on_wings(self) -> bool:
        return is_on_wings(self._session)

    async def transition_to(self, state: FlightState, *, timeout: float = 60.0) -> None:
        """Change a VTOL between hover and forward flight (MAV_CMD_DO_VTOL_TRANSITION).

        Returns when the next EXTENDED_SYS_STATE reports the state, also if the vehicle is in this state already.
        ArduPilot accepts the command only in AUTO. A cancelled call does not stop the transition.

        Args:
            state: ``"fixed_wing"`` or ``"multicopter"``.
            timeout: seconds until the vehicle reports the state.

        Raises:
            InvalidArgument: there is no such state. Nothing was sent.
            NotSupported: the vehicle is not a VTOL. Nothing was sent.
            OperationRejected: the mode changed, or the vehicle disarmed or hit the ground, during the transition.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            CommandTimeout: there was no acknowledgement.
            HeartbeatTimeout: the vehicle was silent for ten seconds.
            OperationTimeout: the vehicle did not report the state in time.
        """
        if not (self.autopilot.has_vtols and self.telemetry.is_vtol):
            raise NotSupported(f"transition_to: this {self.autopilot.firmware} vehicle is not a VTOL; nothing was sent")
        # The decorator `checks_arguments` has refused every other state.
        target_state, cell = VTOL_STATES[state], self.telemetry.vtol_state
        with self._arbiter.auxiliary_order() as order:
            started = self.connection.now()
            await self._sender.send_long(order, MavCmd.DO_VTOL_TRANSITION, float(target_state))
            describe_impact = self._sender.impact_failure(order)
            with self._session.streaming("vtol_state"):
                await await_progress(
                    self._session,
                    f"transition_to({state})",
                    is_done=lambda: cell.latest == target_state and cell.updated_at > started,
                    failure_reason=lambda: describe_impact() or order.takeover_reason,
                    describe=lambda: f"MAV_VTOL_STATE is {cell.latest}",
                    timeout=timeout,
                )

    async def set_airspeed(self, airspeed_m_s: float) -> None:
        """Change the airspeed of a fixed wing in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED, SPEED_TYPE_AIRSPEED).

        Returns at the acknowledgement, because no message reports the setting. VFR_HUD reports the measured airspeed.
        ArduPlane accepts the command in GUIDED and AUTO, for airspeeds from AIRSPEED_MIN to AIRSPEED_MAX. PX4 always
        accepts it, but applies it only in modes that navigate. ``set_speed`` changes the ground speed.

        Raises:
            InvalidArgument: the airspeed is out of range. Nothing was sent.
            NotSupported: this firmware cannot change the airspeed, or the vehicle has no wings. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
        """
        await self._set_speed("set_airspeed", SpeedType.AIRSPEED, airspeed_m_s)

    async def set_climb_speed(self, climb_m_s: float) -> None:
        """Change the climb speed in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED, SPEED_TYPE_CLIMB_SPEED).

        Returns at the acknowledgement, because no message reports the setting. ArduCopter accepts the command in
        GUIDED, AUTO and RTL, and applies it until the mode changes. PX4 is not supported, because it would change the
        cruise speed instead. Raises as :meth:`set_airspeed`.
        """
        await self._set_speed("set_climb_speed", SpeedType.CLIMB_SPEED, climb_m_s)

    async def _set_speed(self, operation: str, speed_type: SpeedType, speed_m_s: float) -> None:
        check_range(SPEED_ARGUMENTS[speed_type], speed_m_s, 0, MAX_SET_SPEED_M_S, above=True)
        if speed_type not in self.autopilot.speed_types:
            firmware = self.autopilot.firmware
            raise NotSupported(f"{operation}: {firmware} has no SPEED_TYPE_{speed_type.name}; nothing was sent")
        await self._sender.auxiliary_command(MavCmd.DO_CHANGE_SPEED, float(speed_type), speed_m_s, KEEP_THROTTLE)
