"""Flying, driving or diving to a place; speed, heading, home, regions of interest."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import (
    MavCmd,
    MavDoRepositionFlags,
    MavFrame,
    MavProtocolCapability,
    MavResult,
    MavRoi,
    SpeedType,
)
from aerokit.mavlink.messages import HomePosition, SetPositionTargetGlobalInt
from aerokit.position import Home, Position, position_with_altitude, travel_target
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.order import HOME, ROI, SUPERSEDED
from aerokit.vehicle.commanding.progress import (
    MAX_DISTANCE_M,
    MAX_SILENCE_S,
    POSITION_MAX_AGE_S,
    CircleDetector,
    StallDetector,
    await_progress,
)

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Order

# Bits of POSITION_TARGET_TYPEMASK that make the vehicle ignore all fields but the position.
POSITION_ONLY = 0x0DF8

KEEP_THROTTLE = -1
"""param3 of DO_CHANGE_SPEED that leaves the throttle unchanged."""

USE_PRESENT_POSITION, USE_PLACE = 1, 0  # param1 of DO_SET_HOME

HOME_TOLERANCE_M = 5.0
"""Home counts as moved to a place within this distance; a COMMAND_LONG has a resolution of about two metres."""

# A target that is sent without an acknowledgement is repeated at this interval in seconds.
RESEND_INTERVAL_S = 1.0

# The vehicle has arrived once it has been within the arrival radius for this many seconds.
ARRIVED_FOR_S = 0.5

# A direction is sent only with turns between these angles, because the shorter way might then be the wrong one. With
# other turns, a direction might cause almost a full circle, because ArduPilot measures the turn from its own target
# heading, not from the reported heading (ArduCopter/autoyaw.cpp, set_fixed_yaw_rad).
MIN_DIRECTED_TURN_DEG, MAX_DIRECTED_TURN_DEG = 170, 350

# The command for a turn with a direction is sent only once, with this many seconds for its acknowledgement.
DIRECTED_TURN_ACK_TIMEOUT_S = 4.0


@checks_arguments
class TravelActions(VehicleBase):
    """Going to a place, turning, speed and home."""

    async def go_to(
        self,
        target: Position | Home,
        *,
        speed_m_s: float | None = None,
        heading_deg: float | None = None,
        tolerance_m: float | None = None,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Fly to a place and return on arrival.

        After a cancellation, a time-out or a silence, aerokit orders the vehicle to hold where it is; a silent vehicle
        gets the hold after its next heartbeat. aerokit does not order the hold if another order was given meanwhile, or
        another party changed the mode.

        Sends MAV_CMD_DO_REPOSITION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_REPOSITION), or
        SET_POSITION_TARGET_GLOBAL_INT to a vehicle that does not support this command.

        Args:
            target: latitude and longitude, and an altitude above the home of this vehicle or above mean sea level. If
                it has both, the altitude above home is used. Caution: the position of another vehicle has an altitude
                above the home of that vehicle. Without an altitude, or if the target is ``vehicle.home.value``, the
                vehicle keeps its present altitude.
            speed_m_s: ground speed from now on, above 0; None keeps the present speed.
            heading_deg: heading on arrival, 0–360 clockwise from north; None leaves it to the autopilot.
            tolerance_m: arrival radius in metres; None: the default of the type of vehicle. A plane then also counts as
                arrived once it has flown half a circle around the target.
            max_distance_m: a place farther away than this many metres is refused.
            timeout: seconds. None: no limit, as long as heartbeats arrive, the mode stays and the vehicle moves.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.

        Raises:
            InvalidArgument: the target is not on earth or too far away, or another argument is out of range. Nothing
                was sent.
            ValueUnknownError: the vehicle's position or home is needed but unknown.
            CommandRejected: the vehicle refused (outside its fence, no position, …).
            OperationRejected: the mode changed (a pilot, a failsafe), or the vehicle disarmed or hit the ground.
            CommandTimeout: there was no acknowledgement.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle did not arrive in time, or does not move.
        """
        target = travel_target(target)
        place = self._position.command_int_place(target)
        target = self._position.with_sent_altitude(target)
        _check_travel(speed_m_s, heading_deg, tolerance_m)
        self._position.check_reach("target", [target], max_distance_m)
        arrival_radius_m = self._position.arrival_radius_m if tolerance_m is None else tolerance_m
        self._check_can_turn(heading_deg)
        self._position.check_flying("go_to")
        mode = self._sender.mode_for("go_to", self.autopilot.reposition_purpose)
        # The second mode is for firmware that does not support MAV_CMD_DO_REPOSITION; see `_send_target`.
        order = self._arbiter.order(mode, self._sender.mode_for("go_to", "setpoint"))
        yaw = self._reposition_yaw(heading_deg)
        is_incomplete = False  # True once the vehicle has accepted the target, until the speed and the heading are set.
        try:
            with self._flight_cleanup.holding_if_abandoned(order):
                unacknowledged_target = await self._send_target(order, place, yaw, speed_m_s)
                if unacknowledged_target is None:  # After DO_REPOSITION, the altitude AMSL stays if home moves.
                    target = self._position.with_amsl_altitude(target)
                is_incomplete = True
                if speed_m_s is not None and not self._speeds_by_reposition:
                    # ArduPilot applies the speed only once the vehicle is on its way.
                    change = (SpeedType.GROUNDSPEED, speed_m_s, KEEP_THROTTLE)
                    await self._sender.send_long(order, MavCmd.DO_CHANGE_SPEED, *change)
                # On this autopilot, MAV_CMD_DO_REPOSITION does not set the heading.
                if heading_deg is not None and math.isnan(yaw):
                    await self._sender.send_long(order, MavCmd.CONDITION_YAW, heading_deg % 360)
                is_incomplete = False
                await self._await_arrival(
                    target,
                    arrival_radius_m,
                    circle=CircleDetector(self._session) if tolerance_m is None else None,
                    order=order,
                    mode=mode,
                    unacknowledged_target=unacknowledged_target,
                    timeout=timeout,
                    max_silence_s=max_silence_s,
                )
        except OperationRejected:
            # The vehicle is on its way, but the speed or the heading was refused or not sent. After a takeover,
            # `hold_in_background` sends nothing.
            if is_incomplete:
                self._flight_cleanup.hold_in_background(order)
            raise

    async def _send_target(
        self, order: Order, place: dict[str, Any], yaw: float, speed_m_s: float | None
    ) -> SetPositionTargetGlobalInt | None:
        """Send MAV_CMD_DO_REPOSITION. Returns None if the vehicle acknowledged it.

        If the vehicle does not support the command, sends and returns a SET_POSITION_TARGET_GLOBAL_INT. The caller must
        repeat this message on the way, because the vehicle does not acknowledge it.
        """
        # -1 leaves the speed to the vehicle.
        speed = speed_m_s if speed_m_s is not None and self._speeds_by_reposition else -1
        params = (speed, MavDoRepositionFlags.CHANGE_MODE, 0, yaw)
        modes = (self._sender.mode_for("go_to", self.autopilot.reposition_purpose),)
        send = self._session.commands.send_int
        try:
            with self._arbiter.changing_mode():
                await self._sender.run_command(order, send, MavCmd.DO_REPOSITION, *params, modes=modes, **place)
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            await self._sender.ensure_mode(self._sender.mode_for("go_to", "setpoint"), order)
            self._sender.raise_if_ended(order)  # `await_recent_state` does this only if it waits.
            await self._sender.await_recent_state(order)
            ignored = dict.fromkeys(("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate"), 0.0)
            message = SetPositionTargetGlobalInt(
                time_boot_ms=0,
                target_system=self.system_id,
                target_component=self.component_id,
                coordinate_frame=place["frame"],
                type_mask=POSITION_ONLY,
                lat_int=place["x"],
                lon_int=place["y"],
                alt=place["z"],
                **ignored,
            )
            self.connection.send(message)
            order.was_refused = False
            return message
        return None

    async def _await_arrival(
        self,
        target: Position,
        arrival_radius_m: float,
        *,
        circle: CircleDetector | None,
        order: Order,
        mode: Mode,
        unacknowledged_target: SetPositionTargetGlobalInt | None,
        timeout: float | None,
        max_silence_s: float | None,
    ) -> None:
        started = self.connection.now()
        sent_at = started  # when `unacknowledged_target` was last sent

        def resend_if_due() -> None:
            nonlocal sent_at
            now = self.connection.now()
            if unacknowledged_target is None or now - sent_at < RESEND_INTERVAL_S:
                return
            # Once the computer has slept, the target is never sent again, because it would be too late.
            has_computer_slept = self._arbiter.slept_since(sent_at) > 0
            if self._arbiter.is_state_recent and not order.end and not has_computer_slept:
                sent_at = now
                self.connection.send(unacknowledged_target)

        def resend_and_check_arrival() -> bool:
            resend_if_due()
            if not self._position.was_received_since(started) or order.end:
                return False
            if circle is not None and circle.circles(target):
                return True
            return self._position.remaining_distance(target) <= arrival_radius_m

        with self._session.streaming("position"):
            await await_progress(
                self._session,
                f"go_to({target.latitude_deg:.7f}, {target.longitude_deg:.7f})",
                is_done=resend_and_check_arrival,
                failure_reason=self._sender.mode_failure(order, mode),
                describe=lambda: f"the vehicle is {self._position.remaining_distance(target):.1f} m away",
                timeout=timeout,
                max_silence_s=max_silence_s,
                held_for=ARRIVED_FOR_S,
                stall_reason=StallDetector(self._session),
            )

    async def set_speed(self, speed_m_s: float) -> None:
        """Change the ground speed in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED).

        Returns at the acknowledgement, because no message reports the setting. ArduPilot applies the speed only while
        the vehicle is on its way in GUIDED or AUTO. ``go_to(speed_m_s=...)`` sets the speed when the vehicle is on its
        way.

        Raises:
            InvalidArgument: the speed is out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
        """
        check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        change = (SpeedType.GROUNDSPEED, speed_m_s, KEEP_THROTTLE)
        await self._sender.auxiliary_command(MavCmd.DO_CHANGE_SPEED, *change)

    async def set_heading(
        self,
        heading_deg: float,
        *,
        relative: bool = False,
        rate_deg_s: float = 0.0,
        tolerance_deg: float = 5.0,
        timeout: float = 60.0,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Turn on the spot and return when the vehicle has this heading.

        An ArduPilot vehicle changes to GUIDED and gets MAV_CMD_CONDITION_YAW. PX4 does not support this command, so the
        vehicle stops and turns by MAV_CMD_DO_REPOSITION. After a cancellation, the vehicle continues to turn.

        Args:
            heading_deg: −360 to 360, clockwise from north. With ``relative``, an angle to turn by, negative to the
                left. The vehicle turns the shorter way, but ArduPilot turns relative angles of ±170 to ±350 degrees in
                the direction of their sign.
            relative: True to turn by an angle from the present heading; 360 and −360 cause no turn.
            rate_deg_s: turn rate in degrees per second; 0 leaves it to the autopilot. PX4 ignores it.
            tolerance_deg: accepted deviation in degrees.
            timeout: seconds until the vehicle has the heading.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no such limit.

        Raises:
            InvalidArgument: an argument is out of range. Nothing was sent.
            ValueUnknownError: ``relative`` is True, but the heading is unknown or older than 2 s. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement; the vehicle may still turn. ArduPilot gets a relative angle of
                170 to 350 degrees only once.
            OperationRejected: the mode changed, or the vehicle disarmed or hit the ground, during the turn.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle did not reach the heading in time.
        """
        check_range("heading_deg", heading_deg, -360, 360)
        check_range("rate_deg_s", rate_deg_s, 0, 360)
        check_range("tolerance_deg", tolerance_deg, 0, 180, above=True)
        self._check_can_turn(heading_deg)
        mode = self._sender.mode_for("set_heading", self.autopilot.reposition_purpose)
        present_deg = self.telemetry.heading_deg.fresh(POSITION_MAX_AGE_S) if relative else 0
        goal_deg = (present_deg + heading_deg) % 360
        order = self._arbiter.order(mode)
        if self._turns_by_reposition:
            yaw = math.remainder(math.radians(goal_deg), 2 * math.pi)
            no_place = (math.nan,) * 3
            params = (-1, MavDoRepositionFlags.CHANGE_MODE, 0, yaw, *no_place)
            await self._sender.send_long(order, MavCmd.DO_REPOSITION, *params, modes=(mode,))
        else:
            await self._sender.ensure_mode(mode, order)
            # An absolute heading is sent instead of an angle, so that a repetition does not turn the vehicle further.
            direction = 0  # the shorter way
            if relative and MIN_DIRECTED_TURN_DEG <= abs(heading_deg) <= MAX_DIRECTED_TURN_DEG:
                direction = 1 if heading_deg > 0 else -1
            # With a direction, a repetition near the goal might begin another circle.
            options = {"attempts": 1, "attempt_timeout": DIRECTED_TURN_ACK_TIMEOUT_S} if direction else {}
            turn = (goal_deg, rate_deg_s, direction, 0)  # 0: an absolute heading
            await self._sender.send_long(order, MavCmd.CONDITION_YAW, *turn, **options)
        await self._await_heading(goal_deg, tolerance_deg, timeout, max_silence_s, order, mode)

    async def _await_heading(
        self,
        goal_deg: float,
        tolerance_deg: float,
        timeout: float,
        max_silence_s: float | None,
        order: Order,
        mode: Mode,
    ) -> None:
        started = self.connection.now()
        heading = self.telemetry.heading_deg

        def deviation_deg() -> float:
            return abs(math.remainder(heading.value - goal_deg, 360)) if heading.is_known else math.inf

        def is_done() -> bool:
            return heading.updated_at >= started and deviation_deg() <= tolerance_deg and not order.end

        with self._session.streaming("heading_deg"):
            await await_progress(
                self._session,
                f"set_heading({goal_deg:g}°)",
                is_done=is_done,
                failure_reason=self._sender.mode_failure(order, mode),
                describe=lambda: f"the heading is {deviation_deg():.0f}° off",
                timeout=timeout,
                max_silence_s=max_silence_s,
            )

    async def set_home(self, place: Position | Home | None = None, *, timeout: float = 5.0) -> None:
        """Move the home position, and wait until HOME_POSITION reports it after the acknowledgement.

        Then waits for the next position, so that ``vehicle.position`` has its altitude above the new home.

        While PX4 is disarmed in the first two minutes after a take-off, it may replace a place by its own position.

        Sends MAV_CMD_DO_SET_HOME (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_HOME). A place is sent as
        COMMAND_INT. Firmware that refuses this as unsupported gets a COMMAND_LONG, which has a resolution of about two
        metres.

        Args:
            place: latitude, longitude and an altitude above mean sea level; None: the vehicle's present position.
            timeout: seconds to wait for HOME_POSITION after the acknowledgement.

        Raises:
            InvalidArgument: the place has no altitude above mean sea level. Nothing was sent.
            CommandRejected: the vehicle refused: it has no position, or the place is invalid.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: a newer call of `set_home` replaced this one, or a pilot or a failsafe took over before
                the acknowledgement.
            OperationTimeout: the vehicle accepted the command, but HOME_POSITION did not report the new home.
        """
        if place is not None and place.altitude_amsl_m is None:
            raise InvalidArgument(
                "place.altitude_amsl_m = None is not allowed: home needs an altitude above mean sea level"
            )
        home = self.telemetry.home
        with self._arbiter.withdrawable_order(HOME) as home_order:
            await self._send_home(home_order, place)
        acknowledged_at = self.connection.now()

        def is_set(reported: Home) -> bool:
            # A message with the old home may arrive after the acknowledgement.
            is_there = place is None or reported.position.distance_to(place) <= HOME_TOLERANCE_M
            return is_there and home.updated_at >= acknowledged_at

        # Most vehicles send HOME_POSITION once when their home has moved, and this message may be lost.
        task = self._session.background.start(self._request_home, "aerokit request of the home position")
        try:
            reported = await home.wait_until(
                lambda reported: is_set(reported) or not home_order.is_newest, timeout=timeout, description="set_home"
            )
        finally:
            if task is not None:
                task.cancel()
        if not is_set(reported):
            raise OperationRejected(f"set_home: {SUPERSEDED}")
        here, set_at = self.telemetry.position, home.updated_at
        if here.age <= POSITION_MAX_AGE_S:
            # The altitude of an older position is relative to the old home. `go_to` would order it above the new home.
            with suppress(OperationTimeout):
                await here.wait_until(lambda _: here.updated_at > set_at, timeout=POSITION_MAX_AGE_S)

    async def _send_home(self, home_order: Order, place: Position | Home | None) -> None:
        with self._arbiter.auxiliary_order(home_order) as order:
            if place is None:
                await self._sender.send_long(order, MavCmd.DO_SET_HOME, USE_PRESENT_POSITION)
                return
            # The command takes altitudes above mean sea level only.
            amsl_place = position_with_altitude(place).replace(altitude_relative_m=None)
            latitude, longitude, altitude, _ = self._position.global_target(amsl_place)
            position: dict[str, Any] = {"x": latitude, "y": longitude, "z": altitude}
            send = self._session.commands.send_place
            await self._sender.run_command(order, send, MavCmd.DO_SET_HOME, USE_PLACE, **position)

    async def _request_home(self) -> None:
        with suppress(AerokitError):
            while True:
                await self._session.commands.send_long(MavCmd.REQUEST_MESSAGE, HomePosition.ID)
                await anyio.sleep(RESEND_INTERVAL_S)

    def distance_to(self, target: Position | Home) -> float:
        """Return the distance to ``target`` in metres; infinite while the position is unknown.

        The distance is three-dimensional if the vehicle's position and the target have an altitude of the same kind.
        Otherwise it is measured along the ground.
        """
        return self._position.distance_to(position_with_altitude(target))

    def _check_can_turn(self, heading_deg: float | None) -> None:
        can_turn = self._turns_by_reposition or self.autopilot.condition_yaw
        if heading_deg is not None and not can_turn:
            raise NotSupported(f"{self.autopilot.firmware} has no command to turn to a heading; nothing was sent")

    @property
    def _speeds_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.speed

    @property
    def _turns_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.yaw

    def _reposition_yaw(self, heading_deg: float | None) -> float:
        """Return the yaw in radians. NaN leaves the yaw to the autopilot."""
        if heading_deg is None or not self._turns_by_reposition:
            return math.nan
        return math.remainder(math.radians(heading_deg), 2 * math.pi)


def _check_travel(speed_m_s: float | None, heading_deg: float | None, tolerance_m: float | None) -> None:
    if speed_m_s is not None:
        check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
    if heading_deg is not None:
        check_range("heading_deg", heading_deg, 0, 360)
    if tolerance_m is not None:
        check_range("tolerance_m", tolerance_m, 0, 100_000, above=True)


ROI_LOCATION = MavCmd.DO_SET_ROI_LOCATION


@checks_arguments
class LookActions(VehicleBase):
    """Pointing the nose or the gimbal at a place. A new order replaces the previous one."""

    async def look_at(self, target: Position | Home) -> None:
        """Point the nose or the gimbal at a place until :meth:`stop_looking`.

        A place without an altitude is taken to be at the vehicle's altitude.

        Sends MAV_CMD_DO_SET_ROI_LOCATION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_LOCATION), or
        MAV_CMD_DO_SET_ROI to old firmware.

        Raises:
            ValueUnknownError: home is needed to convert the altitude, but unknown.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: the mode changed, or a newer order was given, before the acknowledgement.
        """
        place = self._position.command_int_place(position_with_altitude(target))
        is_unsupported = self._session.commands.is_unsupported(ROI_LOCATION)
        was_set = not is_unsupported and await self._set_roi_location(place)
        if was_set:
            return
        is_relative = place["frame"] == MavFrame.GLOBAL_RELATIVE_ALT_INT
        above_home_m = place["z"] if is_relative else place["z"] - self._position.home_altitude()
        params_1_to_4 = (MavRoi.LOCATION, 0, 0, 0)
        await self._send_roi(MavCmd.DO_SET_ROI, *params_1_to_4, place["x"] * 1e-7, place["y"] * 1e-7, above_home_m)

    async def _set_roi_location(self, place: dict[str, Any]) -> bool:
        """Return False if the firmware does not support the command as COMMAND_INT."""
        with self._new_roi_order() as order:
            try:
                await self._sender.run_command(order, self._session.commands.send_int, ROI_LOCATION, **place)
            except CommandTimeout:
                # Firmware that does not support COMMAND_INT does not answer it.
                supports_int = (self.telemetry.capabilities.latest or 0) & MavProtocolCapability.COMMAND_INT
                if supports_int or not self._arbiter.is_state_recent:
                    raise
                self._raise_if_superseded(order)
                return False
            except CommandRejected:
                if not self._session.commands.is_unsupported(ROI_LOCATION):
                    raise
                self._raise_if_superseded(order)
                return False
        return True

    async def _send_roi(self, command: int, *params: float) -> None:
        with self._new_roi_order() as order:
            await self._sender.send_long(order, command, *params)

    def _new_roi_order(self) -> AbstractContextManager[Order]:
        return self._arbiter.auxiliary_order(self._arbiter.device_order(ROI))

    @staticmethod
    def _raise_if_superseded(order: Order) -> None:
        # A takeover does not prevent the rest of the order, because a ROI applies in any mode.
        if order.end and not order.takeover_reason:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE; MAV_CMD_DO_SET_ROI to old firmware).

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: the mode changed, or a newer order was given, before the acknowledgement.
        """
        with self._new_roi_order() as order:
            try:
                await self._sender.send_long(order, MavCmd.DO_SET_ROI_NONE)
                return
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
                self._raise_if_superseded(order)
        # The firmware supports only the older command.
        await self._send_roi(MavCmd.DO_SET_ROI)
