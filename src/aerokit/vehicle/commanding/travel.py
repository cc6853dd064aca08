"""Flying, driving or diving somewhere: places, speed, heading."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags, MavFrame, MavProtocolCapability, MavResult
from aerokit.mavlink.messages import HomePosition, SetPositionTargetGlobalInt
from aerokit.position import Position
from aerokit.vehicle.commanding.context import Part
from aerokit.vehicle.commanding.order import LOOKING
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, MAX_DISTANCE_M, Stillness, await_progress

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Order

POSITION_ONLY = 0x0DF8

RESEND_S = 1.0


@checks_arguments
class TravelActions(Part):
    """Going to a place, turning; home."""

    async def go_to(
        self,
        target: Position,
        *,
        speed_m_s: float | None = None,
        heading_deg: float | None = None,
        tolerance_m: float | None = None,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Fly to a place and return on arrival.

        Cancelled half-way, or when it does not arrive in time or falls silent, the vehicle is told to hold where it
        is; unless another order was given meanwhile or somebody else has changed the mode. A silent vehicle is told so
        when it is heard again, if it still goes there then.

        Args:
            target: latitude and longitude, and an altitude above home or above mean sea level; without an altitude
                the present one is kept.
            speed_m_s: ground speed from now on, above 0; None leaves it.
            heading_deg: where to look on arrival, 0–360 clockwise from north; None leaves it to the autopilot.
            tolerance_m: how near is there, in metres; None: what suits the type of vehicle.
            max_distance_m: metres from where it is; a place farther away is refused.
            timeout: seconds; None: as long as it takes, provided that heartbeats come, the mode stays and it moves.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on, however long.

        Sends MAV_CMD_DO_REPOSITION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_REPOSITION), and
        SET_POSITION_TARGET_GLOBAL_INT to a vehicle that does not know it.

        Raises:
            InvalidArgument: the target is no place on earth or too far away, or another argument is out of range.
                Nothing was sent.
            ValueUnknownError: position or home is not known and is needed here.
            CommandRejected: the vehicle refused (outside its fence, no position, …).
            OperationRejected: on the way the mode changed (a pilot, a failsafe) or the vehicle disarmed.
            CommandTimeout: there was no answer.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: it did not arrive in time, or does not move.
        """
        latitude, longitude, altitude, is_relative = self._where.global_target(target)
        _check_travel(speed_m_s, heading_deg, tolerance_m, timeout)
        self._where.check_reach("target", [target], max_distance_m)
        near_m = self.autopilot.arrival_radius_m if tolerance_m is None else tolerance_m
        self._check_can_turn(heading_deg)
        if not self.telemetry.is_armed:
            raise OperationRejected("go_to: the vehicle is not armed; nothing was sent")
        if self._where.stands_on_the_ground():
            raise OperationRejected("go_to: the vehicle is on the ground: take_off() first; nothing was sent")
        mode = self._sender.mode_for("go_to", self.autopilot.reposition_purpose)
        order = self._arbiter.order(mode, self._sender.mode_for("go_to", "setpoint"))
        yaw = self._reposition_yaw(heading_deg)
        under_way = False
        try:
            resend = await self._send_there(order, latitude, longitude, altitude, is_relative, yaw, speed_m_s)
            under_way = True
            if speed_m_s is not None and not self._speeds_by_reposition:
                # ArduPilot obeys it only once it is under way
                await self._sender.command_of(order, MavCmd.DO_CHANGE_SPEED, 1, speed_m_s, -1)
            if heading_deg is not None and math.isnan(yaw):
                await self._sender.command_of(order, MavCmd.CONDITION_YAW, heading_deg % 360)
            with self._holding.flying(order):
                await self._await_arrival(target, near_m, timeout, max_silence_s, order, mode, resend)
        except (anyio.get_cancelled_exc_class(), OperationTimeout):  # it may have heard the order
            self._holding.hold_soon(order)
            raise
        except CommandRejected:
            if under_way:
                self._holding.hold_soon(order)
            raise

    async def _send_there(
        self,
        order: Order,
        latitude: int,
        longitude: int,
        altitude: float,
        is_relative: bool,
        yaw: float,
        speed_m_s: float | None,
    ) -> SetPositionTargetGlobalInt | None:
        """Order it; what has to be sent again for as long as it is under way, because it has no answer."""
        frame = MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT
        speed = speed_m_s if speed_m_s is not None and self._speeds_by_reposition else -1
        params = (speed, MavDoRepositionFlags.CHANGE_MODE, 0, yaw)
        place: dict[str, Any] = {"frame": frame, "x": latitude, "y": longitude, "z": altitude}
        modes = (self._sender.mode_for("go_to", self.autopilot.reposition_purpose),)
        try:
            with self._arbiter.changing_mode():
                await self._sender.give(
                    order, self._talk.commands.send_int, MavCmd.DO_REPOSITION, *params, modes=modes, **place
                )
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            await self._sender.ensure_mode(self._sender.mode_for("go_to", "setpoint"), order)
            self._sender.raise_if_over(order)
            resend = self._position_target(latitude, longitude, altitude, frame)
            self.connection.send(resend)
            return resend
        return None

    def _position_target(
        self, latitude: int, longitude: int, altitude: float, frame: int
    ) -> SetPositionTargetGlobalInt:
        zeros = (0.0,) * 8
        return SetPositionTargetGlobalInt(
            0, self.system_id, self.component_id, frame, POSITION_ONLY, latitude, longitude, altitude, *zeros
        )

    async def _await_arrival(
        self,
        target: Position,
        near_m: float,
        timeout: float | None,
        max_silence_s: float | None,
        order: Order,
        mode: Mode,
        resend: SetPositionTargetGlobalInt | None,
    ) -> None:
        """Wait for it. The older message has no answer: it is repeated while the vehicle tells that it is meant."""
        started = sent_at = self.connection.now()

        def is_there() -> bool:
            nonlocal sent_at
            now = self.connection.now()
            if resend is not None and now - sent_at >= RESEND_S and self._arbiter.is_known and not order.end:
                sent_at = now
                self.connection.send(resend)
            is_near = self._where.is_known_since(started) and self._where.way_left(target) <= near_m
            return is_near and not order.end

        with self._talk.streaming("position"):
            await await_progress(
                self._talk,
                f"go_to({target.latitude_deg:.7f}, {target.longitude_deg:.7f})",
                is_done=is_there,
                trouble=self._sender.stays_in(order, mode),
                describe=lambda: f"it is {self._where.way_left(target):.1f} m away",
                timeout=timeout,
                max_silence_s=max_silence_s,
                held_for=0.5,
                stillness=Stillness(self._talk),
            )

    async def set_speed(self, speed_m_s: float) -> None:
        """Change the ground speed for flying somewhere, in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED).

        ArduPilot takes it only while it is under way in GUIDED or AUTO; ``go_to(speed_m_s=...)`` sees to that.

        Raises:
            InvalidArgument: out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
        """
        check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        await self._sender.command_aside(MavCmd.DO_CHANGE_SPEED, 1, speed_m_s, -1)

    async def set_heading(
        self,
        heading_deg: float,
        *,
        relative: bool = False,
        rate_deg_s: float = 0.0,
        tolerance_deg: float = 5.0,
        timeout: float = 60.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Turn on the spot and return when the nose points there.

        ArduPilot: MAV_CMD_CONDITION_YAW, in GUIDED, which it is put into. PX4 has no such command and stops where it
        is to turn: MAV_CMD_DO_REPOSITION.

        Args:
            heading_deg: −360 to 360, clockwise from north; ``relative``: by so many degrees, left is negative.
            relative: count from the present heading.
            rate_deg_s: how fast, degrees per second; 0 leaves it to the autopilot. PX4 does not look at it.
            tolerance_deg: how near is there.
            timeout: seconds until it is there.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on, however long.

        Raises:
            InvalidArgument: out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
            OperationRejected: the mode changed or it disarmed on the way.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: it did not get there in time.
        """
        check_range("heading_deg", heading_deg, -360, 360)
        check_range("rate_deg_s", rate_deg_s, 0, 360)
        check_range("tolerance_deg", tolerance_deg, 0, 180, above=True)
        self._check_can_turn(heading_deg)
        mode = self._sender.mode_for("set_heading", self.autopilot.reposition_purpose)
        goal = (heading_deg + (self.telemetry.heading_deg.value if relative else 0)) % 360
        order = self._arbiter.order(mode)
        if self._turns_by_reposition:
            yaw = math.remainder(math.radians(goal), 2 * math.pi)
            params = (-1, MavDoRepositionFlags.CHANGE_MODE, 0, yaw, *(math.nan,) * 3)
            await self._sender.give(
                order, self._talk.commands.send_long, MavCmd.DO_REPOSITION, *params, modes=(mode,)
            )
        else:
            await self._sender.ensure_mode(mode, order)
            # a goal, not an angle: sent again, it does not turn it further
            direction = (1 if heading_deg >= 0 else -1) if relative else 0
            await self._sender.command_of(order, MavCmd.CONDITION_YAW, goal, rate_deg_s, direction, 0)
        await self._await_heading(goal, tolerance_deg, timeout, max_silence_s, order, mode)

    async def _await_heading(
        self,
        goal: float,
        tolerance_deg: float,
        timeout: float,
        max_silence_s: float | None,
        order: Order,
        mode: Mode,
    ) -> None:
        started = self.connection.now()
        heading = self.telemetry.heading_deg

        def off() -> float:
            return abs(math.remainder(heading.value - goal, 360)) if heading.is_known else math.inf

        with self._talk.streaming("heading_deg"):
            await await_progress(
                self._talk,
                f"set_heading({goal:g}°)",
                is_done=lambda: heading.updated_at >= started and off() <= tolerance_deg and not order.end,
                trouble=self._sender.stays_in(order, mode),
                describe=lambda: f"it is {off():.0f}° off",
                timeout=timeout,
                max_silence_s=max_silence_s,
            )

    async def set_home(self, place: Position | None = None, *, timeout: float = 5.0) -> None:
        """Have the vehicle return to another place, or to where it is now, and wait until HOME_POSITION tells it.

        Args:
            place: latitude, longitude and an altitude above mean sea level; None: where it is now.
            timeout: seconds until HOME_POSITION tells it.

        Sends MAV_CMD_DO_SET_HOME (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_HOME), as COMMAND_LONG to
        old firmware, which does not know it as COMMAND_INT: to within a metre then.

        Raises:
            InvalidArgument: the place has no altitude above mean sea level. Nothing was sent.
            CommandRejected: the vehicle refused: it knows no position, or the place is none.
            CommandTimeout: there was no answer.
            OperationTimeout: it accepted, and HOME_POSITION did not tell it.
        """
        if place is not None and place.altitude_amsl_m is None:
            raise InvalidArgument("place has no altitude_amsl_m: home needs one above mean sea level")
        home = self.telemetry.home
        with self._arbiter.aside() as order:
            if place is None:
                await self._sender.give(order, self._talk.commands.send_long, MavCmd.DO_SET_HOME, 1)
            else:
                latitude, longitude, altitude, _ = self._where.global_target(place)
                where: dict[str, Any] = {"x": latitude, "y": longitude, "z": altitude}
                await self._sender.give(order, self._talk.commands.send_place, MavCmd.DO_SET_HOME, 0, **where)
        asked_at = self.connection.now()
        await self._talk.commands.send_long(MavCmd.REQUEST_MESSAGE, HomePosition.ID)
        await home.wait_until(lambda _: home.updated_at >= asked_at, timeout=timeout, description="set_home")

    def distance_to(self, target: Position) -> float:
        """Metres from where the vehicle is to ``target``; in three dimensions when ``target`` has an altitude.

        Infinite while the position is unknown.
        """
        return self._where.distance_to(target)

    def _check_can_turn(self, heading_deg: float | None) -> None:
        if heading_deg is not None and not self._turns_by_reposition and not self.autopilot.condition_yaw:
            raise NotSupported(f"{self.autopilot.firmware} cannot be told where to look; nothing was sent")

    @property
    def _speeds_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.speed

    @property
    def _turns_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.yaw

    def _reposition_yaw(self, heading_deg: float | None) -> float:
        if heading_deg is None or not self._turns_by_reposition:
            return math.nan
        return math.remainder(math.radians(heading_deg), 2 * math.pi)


def _check_travel(
    speed_m_s: float | None, heading_deg: float | None, tolerance_m: float | None, timeout: float | None
) -> None:
    if speed_m_s is not None:
        check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
    if heading_deg is not None:
        check_range("heading_deg", heading_deg, 0, 360)
    if tolerance_m is not None:
        check_range("tolerance_m", tolerance_m, 0, 100_000, above=True)


LOCATION = MavCmd.DO_SET_ROI_LOCATION


@checks_arguments
class LookActions(Part):
    """Nose or gimbal at a place: of two orders the newer one counts."""

    async def look_at(self, target: Position) -> None:
        """Make nose or gimbal point at a place, until :meth:`stop_looking`; without an altitude, at its own.

        Sends MAV_CMD_DO_SET_ROI_LOCATION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_LOCATION), and
        MAV_CMD_DO_SET_ROI to old firmware, which knows no other.

        Raises:
            ValueUnknownError: home is not known and is needed here.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
            OperationRejected: the mode changed, or a newer order was given, before there was an answer.
        """
        latitude, longitude, altitude, is_relative = self._where.global_target(target)
        if not self._talk.commands.is_unknown(LOCATION):
            frame = MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT
            if await self._set_roi_location({"frame": frame, "x": latitude, "y": longitude, "z": altitude}):
                return
        above_home = altitude if is_relative else altitude - self._where.home_altitude()
        place = (latitude * 1e-7, longitude * 1e-7, above_home)
        await self._give(MavCmd.DO_SET_ROI, 0, 0, 0, 0, *place)

    async def _set_roi_location(self, place: dict[str, Any]) -> bool:
        """False for firmware that does not know it, or no COMMAND_INT at all: that says nothing."""
        with self._newest() as order:
            try:
                await self._sender.give(order, self._talk.commands.send_int, LOCATION, **place)
            except CommandTimeout:
                knows_int = (self.telemetry.capabilities.latest or 0) & MavProtocolCapability.COMMAND_INT
                if knows_int or not self._arbiter.is_known:
                    raise
                self._raise_if_overruled(order)
                return False
            except CommandRejected:
                if not self._talk.commands.is_unknown(LOCATION):
                    raise
                self._raise_if_overruled(order)
                return False
        return True

    async def _give(self, command: int, *params: float) -> None:
        with self._newest() as order:
            await self._sender.give(order, self._talk.commands.send_long, command, *params)

    @contextmanager
    def _newest(self) -> Iterator[Order]:
        with self._arbiter.aside(self._arbiter.of_device(LOOKING)) as order:
            yield order

    @staticmethod
    def _raise_if_overruled(order: Order) -> None:
        """A mode of the program's own is no reason: it looks there in any."""
        if order.end and not order.taken_by:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE; MAV_CMD_DO_SET_ROI to old firmware).

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
            OperationRejected: the mode changed, or a newer order was given, before there was an answer.
        """
        with self._newest() as order:
            try:
                await self._sender.give(order, self._talk.commands.send_long, MavCmd.DO_SET_ROI_NONE)
                return
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
                self._raise_if_overruled(order)
        await self._give(MavCmd.DO_SET_ROI)
