"""The actions of a vehicle. Each awaits what the vehicle does, not only what it answers."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import anyio

from aerokit import geo
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    LocalProtocolError,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.messages import CommandAck, SetPositionTargetGlobalInt
from aerokit.vehicle.progress import await_progress
from aerokit.vehicle.state import VehicleState
from aerokit.vehicle.values import Position

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Mode, Purpose, TakeOff

__all__ = ["FlightActions"]

logger = logging.getLogger("aerokit")

CONDITION_YAW = 115
DO_SET_MODE = 176
DO_CHANGE_SPEED = 178
DO_REPOSITION = 192
DO_SET_ROI_LOCATION = 195
DO_SET_ROI_NONE = 197
PREFLIGHT_REBOOT_SHUTDOWN = 246
COMPONENT_ARM_DISARM = 400
FORCE = 21196
CHANGE_MODE = 1
RESULT_UNSUPPORTED = 3
MAV_FRAME_GLOBAL_INT = 5
MAV_FRAME_GLOBAL_RELATIVE_ALT_INT = 6
POSITION_ONLY = 0x0FF8
LANDED_ON_GROUND, LANDED_IN_AIR = 1, 2
MODE_GRACE_S = 3.0
"""How long HEARTBEAT, at 1 Hz, may lag behind an accepted command that changes the mode."""
RESEND_S = 1.0
STOP_HERE = (DO_REPOSITION, -1, CHANGE_MODE, 0, *(math.nan,) * 4)
"""A place that is no number means: here, with the way it takes to brake."""


class FlightActions(VehicleState):
    """Arming, modes, take-off, flying somewhere, landing."""

    _hold_scope: anyio.CancelScope | None = None
    _resend: SetPositionTargetGlobalInt | None = None

    # --------------------------------------------------------------------------- readiness

    async def wait_ready(self, *, timeout: float = 90.0) -> None:
        """Wait until position and home are known, the estimator is healthy and the pre-arm checks pass.

        Raises:
            OperationTimeout: not within ``timeout`` seconds; the text says what is still missing.
        """
        with anyio.move_on_after(timeout):
            while self.missing_for_flight():
                self.connection.raise_if_ended()
                await anyio.sleep(0.2)
            return
        missing = "\n  - ".join(self.missing_for_flight() or ["nothing any more"])
        raise OperationTimeout(
            f"the vehicle was not ready within {timeout:g} s ({self.describe_link()}); still missing:\n  - {missing}"
        )

    # ------------------------------------------------------------------------------- modes

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it.

        Args:
            mode: a name as the autopilot's own documentation spells it (``"GUIDED"``, ``"POSCTL"``; case does not
                matter), or the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole of it.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Raises:
            LocalProtocolError: this vehicle has no such mode; the text lists those it has. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationTimeout: it accepted and stayed in another mode.
        """
        self._supersede_hold()
        await self._change_mode(self.autopilot.find_mode(mode, self.telemetry.mode_names), timeout)

    async def _change_mode(self, wanted: Mode, timeout: float = 6.0) -> None:
        started = self.connection.now()
        with self._refusals_of(DO_SET_MODE) as refusals:
            await self._request_mode(wanted)
            if self._is_in(wanted):
                return
            await self._await_mode(wanted, refusals, started, timeout)

    async def _request_mode(self, wanted: Mode) -> None:
        started = self.connection.now()
        try:
            await self._commands.send_long(DO_SET_MODE, *self.autopilot.mode_order(wanted).params)
        except CommandRejected as error:
            if error.result != RESULT_UNSUPPORTED:
                await self._settle()
                raise self._explained(error, started) from None
            self.connection.send(self.autopilot.mode_order(wanted).legacy(self.system_id))

    async def _await_mode(
        self, wanted: Mode, refusals: list[CommandAck], started: float, timeout: float
    ) -> None:
        """PX4 acks twice: the first ack is always ACCEPTED, the second one may take it back."""

        def trouble() -> str | None:
            return "the vehicle took its acceptance back" if refusals else None

        await await_progress(
            self,
            f"set_mode({wanted.name})",
            is_done=lambda: self._is_in(wanted),
            trouble=trouble,
            describe=lambda: f"the vehicle is in {self.mode_name}",
            timeout=max(0.1, timeout - (self.connection.now() - started)),
        )

    def _is_in(self, mode: Mode) -> bool:
        latest = self.telemetry.mode.latest
        return latest is not None and latest.custom_mode == mode.custom_mode

    async def _ensure_mode(self, mode: Mode) -> None:
        self._supersede_hold()
        if not self._is_in(mode):
            await self._change_mode(mode)

    # ------------------------------------------------------------------------------ arming

    async def arm(self, *, force: bool = False, timeout: float = 10.0) -> None:
        """Arm the motors and wait until HEARTBEAT says armed: **propellers may start to turn**.

        Args:
            force: skip the vehicle's own arming checks. Dangerous.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.

        Raises:
            CommandRejected: the vehicle refused; ``reasons`` has its pre-arm texts, failing sensors and what the
                estimator lacks. They are asked for again where the vehicle can run its checks on request.
            OperationTimeout: it accepted and did not arm.
        """
        started = self.connection.now()
        try:
            await self._commands.send_long(COMPONENT_ARM_DISARM, 1, FORCE if force else 0)
        except CommandRejected as error:
            reasons = await self._arming_reasons(started)
            raise self._explained(error, started, reasons) from None
        await self._await_armed(True, started, timeout)

    async def disarm(self, *, force: bool = False, timeout: float = 10.0) -> None:
        """Stop the motors and wait until HEARTBEAT says disarmed.

        Args:
            force: also in the air: **the vehicle falls**.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.

        Raises:
            CommandRejected: the vehicle refused, usually because it flies.
            OperationTimeout: it accepted and did not disarm.
        """
        started = self.connection.now()
        try:
            await self._commands.send_long(COMPONENT_ARM_DISARM, 0, FORCE if force else 0)
        except CommandRejected as error:
            await self._settle()
            raise self._explained(error, started) from None
        await self._await_armed(False, started, timeout)

    async def _await_armed(self, armed: bool, started: float, timeout: float) -> None:
        await await_progress(
            self,
            "arm()" if armed else "disarm()",
            is_done=lambda: self.is_armed is armed,
            trouble=lambda: None,
            describe=lambda: "; ".join(self.texts_since(started)) or "the vehicle said nothing about it",
            timeout=timeout,
        )

    # -------------------------------------------------------------------------- taking off

    async def take_off(self, altitude_m: float, *, timeout: float = 60.0) -> None:
        """Take off and climb to ``altitude_m`` above home; returns at that altitude.

        The vehicle must be armed. Where the autopilot needs its guided mode for this, it is put into it. Cancelled
        half-way, the vehicle is told to hold where it is.

        Args:
            altitude_m: metres above home, above 0, at most 10,000.
            timeout: seconds until it is there.

        Raises:
            LocalProtocolError: the altitude is out of range. Nothing was sent.
            NotSupported: this type of vehicle cannot take off.
            OperationRejected: it is not armed, or flies already; it refused; or its mode changed or it disarmed on the way.
            OperationTimeout: it did not get there in time.
        """
        if not 0 < altitude_m <= 10_000:
            raise LocalProtocolError(f"altitude_m = {altitude_m!r} is not allowed: above 0, at most 10,000")
        plan = self._take_off_plan(altitude_m)
        self._supersede_hold()
        if not self.is_armed:
            raise OperationRejected("take_off: the vehicle is not armed: await arm() first; nothing was sent")
        if self.telemetry.landed_state.latest == LANDED_IN_AIR:
            raise OperationRejected("take_off: the vehicle flies already: go_to() climbs too; nothing was sent")
        try:
            await self._begin_take_off(plan)
            await self._await_altitude(altitude_m, plan, timeout)
        except anyio.get_cancelled_exc_class():
            self._hold_soon()
            raise

    def _take_off_plan(self, altitude_m: float) -> TakeOff:
        home = self._home_altitude() if self.autopilot.take_off_needs_home() else None
        plan = self.autopilot.take_off(altitude_m, home, is_vtol=self.is_vtol)
        if plan is None:
            raise NotSupported(f"take_off: {self.autopilot.firmware} cannot take off")
        return plan

    async def _begin_take_off(self, plan: TakeOff) -> None:
        if plan.mode is not None:
            await self._ensure_mode(plan.mode)
        if plan.command is not None:
            await self._explained_command(plan.command, *plan.params)

    async def _await_altitude(self, altitude_m: float, plan: TakeOff, timeout: float) -> None:
        """The mode may become the take-off's own and the one after it; any other one is somebody else's doing."""
        tolerance = max(0.5, 0.05 * altitude_m)
        modes = [plan.mode, plan.mode_after, self.autopilot.mode_for("take_off", is_vtol=self.is_vtol)]
        await await_progress(
            self,
            f"take_off({altitude_m:g} m)",
            is_done=lambda: self._altitude_relative() >= altitude_m - tolerance,
            trouble=self._stays_in(*(mode for mode in modes if mode is not None)),
            describe=lambda: f"it is at {self._altitude_relative():.1f} m",
            timeout=timeout,
        )

    # --------------------------------------------------------------------------- going there

    async def go_to(
        self,
        target: Position,
        *,
        speed_m_s: float | None = None,
        heading_deg: float | None = None,
        tolerance_m: float | None = None,
        timeout: float | None = None,
    ) -> None:
        """Fly to a place and return on arrival. Cancelled half-way, the vehicle is told to hold where it is.

        Args:
            target: latitude and longitude, and an altitude above home or above mean sea level; without an altitude
                the present one is kept.
            speed_m_s: ground speed from now on, above 0; None leaves it.
            heading_deg: where to look on arrival, 0–360 clockwise from north; None leaves it to the autopilot.
            tolerance_m: how near is there, in metres; None: what suits the type of vehicle.
            timeout: seconds; None: as long as it takes, provided that heartbeats come and the mode stays.

        Sends MAV_CMD_DO_REPOSITION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_REPOSITION), and
        SET_POSITION_TARGET_GLOBAL_INT to a vehicle that does not know it.

        Raises:
            LocalProtocolError: the target is no place on earth. Nothing was sent.
            ValueUnknownError: position or home is not known and is needed here.
            CommandRejected: the vehicle refused (outside its fence, no position, …).
            OperationRejected: on the way the mode changed (a pilot, a failsafe) or the vehicle disarmed.
            OperationTimeout: it did not arrive in time.
        """
        latitude, longitude, altitude, is_relative = self._global_target(target)
        near_m = self.autopilot.arrival_radius_m if tolerance_m is None else tolerance_m
        self._supersede_hold()
        if not self.is_armed:
            raise OperationRejected("go_to: the vehicle is not armed; nothing was sent")
        if speed_m_s is not None:
            _check_speed(speed_m_s)
        yaw = self._reposition_yaw(heading_deg)
        await self._send_there(latitude, longitude, altitude, is_relative, yaw, speed_m_s)
        try:
            if speed_m_s is not None and not self._speeds_by_reposition:
                await self.set_speed(speed_m_s)  # ArduPilot obeys it only once it is under way
            if heading_deg is not None and math.isnan(yaw):
                await self._explained_command(CONDITION_YAW, heading_deg % 360)
            await self._await_arrival(target, near_m, timeout)
        except (anyio.get_cancelled_exc_class(), CommandRejected, CommandTimeout):
            self._hold_soon()
            raise

    async def _send_there(
        self,
        latitude: int,
        longitude: int,
        altitude: float,
        is_relative: bool,
        yaw: float,
        speed_m_s: float | None,
    ) -> None:
        started = self.connection.now()
        frame = MAV_FRAME_GLOBAL_RELATIVE_ALT_INT if is_relative else MAV_FRAME_GLOBAL_INT
        speed = speed_m_s if speed_m_s is not None and self._speeds_by_reposition else -1
        params = (speed, CHANGE_MODE, 0, yaw)
        self._resend = None
        try:
            await self._commands.send_int(
                DO_REPOSITION, *params, frame=frame, x=latitude, y=longitude, z=altitude
            )
        except CommandRejected as error:
            if error.result != RESULT_UNSUPPORTED:
                await self._settle()
                raise self._explained(error, started) from None
            await self._ensure_mode(self._mode_for("go_to", "setpoint"))
            self._resend = self._position_target(latitude, longitude, altitude, frame)
            self.connection.send(self._resend)

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
    ) -> None:
        """Wait for it. The older message has no answer, so it is repeated for as long as this call lasts."""
        sent_at, resend = self.connection.now(), self._resend

        def is_there() -> bool:
            nonlocal sent_at
            if resend is not None and self.connection.now() - sent_at >= RESEND_S:
                sent_at = self.connection.now()
                self.connection.send(resend)
            return self.distance_to(target) <= near_m

        await await_progress(
            self,
            f"go_to({target.latitude_deg:.7f}, {target.longitude_deg:.7f})",
            is_done=is_there,
            trouble=self._stays_in(self._mode_for("go_to", self.autopilot.reposition_purpose)),
            describe=lambda: f"it is {self.distance_to(target):.1f} m away",
            timeout=timeout,
            held_for=0.5,
        )

    # ------------------------------------------------------------------------- coming back

    async def land(self, *, timeout: float | None = 300.0) -> None:
        """Land where the vehicle is; returns on the ground.

        Raises:
            NotSupported: this type of vehicle has no mode for it. Nothing was sent.
            CommandRejected: the vehicle refused the mode.
            OperationRejected: the mode changed on the way.
            OperationTimeout: not on the ground in time.
        """
        mode = self._mode_for("land", "land")
        await self._ensure_mode(mode)
        await self._await_ground("land", mode, timeout)

    async def return_to_launch(self, *, timeout: float | None = 600.0) -> None:
        """Return to the launch place; returns on the ground, or above it where the vehicle does not land by itself.

        Raises as :meth:`land`.
        """
        mode = self._mode_for("return_to_launch", "return")
        await self._ensure_mode(mode)
        if self.autopilot.lands_after_return:
            await self._await_ground("return_to_launch", mode, timeout)
        else:
            await self._await_home(mode, timeout)

    async def _await_ground(self, what: str, mode: Mode, timeout: float | None) -> None:
        def is_down() -> bool:
            return not self.is_armed or self.telemetry.landed_state.latest == LANDED_ON_GROUND

        await await_progress(
            self,
            what,
            is_done=is_down,
            trouble=self._stays_in(mode),
            describe=lambda: f"it is at {self._altitude_relative():.1f} m",
            timeout=timeout,
        )

    async def _await_home(self, mode: Mode, timeout: float | None) -> None:
        home = self.telemetry.home.value
        place = Position(home.latitude_deg, home.longitude_deg)
        near_m = self.autopilot.arrival_radius_m
        await await_progress(
            self,
            "return_to_launch",
            is_done=lambda: self.distance_to(place) <= near_m,
            trouble=self._stays_in(mode),
            describe=lambda: f"it is {self.distance_to(place):.1f} m from home",
            timeout=timeout,
        )

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles); returns when HEARTBEAT tells the autopilot's mode for that.

        Copter BRAKE, Plane LOITER, Rover HOLD (a boat LOITER), Sub POSHOLD; PX4 LOITER where it comes to a stop.

        Raises as :meth:`set_mode`; NotSupported when this vehicle has no mode for it.
        """
        mode = self._mode_for("hold", "hold")
        self._supersede_hold()
        await self._stop_in(mode)

    async def _stop_in(self, mode: Mode) -> None:
        """PX4 in LOITER may be on its way somewhere: asking for the mode again would not stop it."""
        if self._holds_by_reposition:
            await self._explained_command(*STOP_HERE)
        if not self._is_in(mode):
            await self._change_mode(mode)

    def _hold_soon(self) -> None:
        """Tell the vehicle to hold without waiting: for the ends of blocks and for cancelled calls.

        One command goes out at once; a task of the vehicle's own confirms it, as long as the connection is there.
        """
        mode = self.autopilot.mode_for("hold", is_vtol=self.is_vtol)
        if mode is None or not self.connection.is_open or not self.is_armed:
            return
        if self._holds_by_reposition:
            self._commands.send_unconfirmed(*STOP_HERE)
        else:
            self._commands.send_unconfirmed(DO_SET_MODE, *self.autopilot.mode_order(mode).params)
        self._supersede_hold()
        scope = self._hold_scope = anyio.CancelScope()

        async def confirm() -> None:
            with scope:
                try:
                    await self._stop_in(mode)
                except AerokitError as error:
                    logger.warning("the vehicle was told to hold and did not confirm it: %s", error)

        self._in_background(confirm)

    def _supersede_hold(self) -> None:
        """A new order is given: what an earlier one left to be confirmed must not come after it."""
        if self._hold_scope is not None:
            self._hold_scope.cancel()
            self._hold_scope = None

    # ------------------------------------------------------------------------------ on the way

    async def set_speed(self, speed_m_s: float) -> None:
        """Change the ground speed for flying somewhere, in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED).

        ArduPilot takes it only while it is under way in GUIDED or AUTO; ``go_to(speed_m_s=...)`` sees to that.

        Raises:
            LocalProtocolError: out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
        """
        _check_speed(speed_m_s)
        await self._explained_command(DO_CHANGE_SPEED, 1, speed_m_s, -1)

    async def set_heading(
        self,
        heading_deg: float,
        *,
        relative: bool = False,
        rate_deg_s: float = 0.0,
        tolerance_deg: float = 5.0,
        timeout: float = 60.0,
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

        Raises:
            LocalProtocolError: out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
            OperationRejected: the mode changed or it disarmed on the way.
            OperationTimeout: it did not get there in time.
        """
        if not -360 <= heading_deg <= 360:
            raise LocalProtocolError(f"heading_deg = {heading_deg!r} is not allowed: −360 to 360")
        start = self.telemetry.heading_deg.value
        goal = (start + heading_deg if relative else heading_deg) % 360
        if self._turns_by_reposition:
            yaw = math.remainder(math.radians(goal), 2 * math.pi)
            await self._explained_command(DO_REPOSITION, -1, CHANGE_MODE, 0, yaw, *(math.nan,) * 3)
        else:
            await self._ensure_mode(self._mode_for("set_heading", "setpoint"))
            direction = (1 if heading_deg >= 0 else -1) if relative else 0
            angle = abs(heading_deg) if relative else goal
            await self._explained_command(CONDITION_YAW, angle, rate_deg_s, direction, 1 if relative else 0)
        await self._await_heading(goal, tolerance_deg, timeout)

    async def _await_heading(self, goal: float, tolerance_deg: float, timeout: float) -> None:
        def off() -> float:
            return abs(math.remainder(self.telemetry.heading_deg.value - goal, 360))

        await await_progress(
            self,
            f"set_heading({goal:g}°)",
            is_done=lambda: off() <= tolerance_deg,
            trouble=self._stays_in(self._mode_for("set_heading", self.autopilot.reposition_purpose)),
            describe=lambda: f"it is {off():.0f}° off",
            timeout=timeout,
        )

    async def look_at(self, target: Position) -> None:
        """Make nose or gimbal point at a place (MAV_CMD_DO_SET_ROI_LOCATION), until :meth:`stop_looking`."""
        latitude, longitude, altitude, is_relative = self._global_target(target)
        frame = MAV_FRAME_GLOBAL_RELATIVE_ALT_INT if is_relative else MAV_FRAME_GLOBAL_INT
        started = self.connection.now()
        try:
            await self._commands.send_int(
                DO_SET_ROI_LOCATION, frame=frame, x=latitude, y=longitude, z=altitude
            )
        except CommandRejected as error:
            raise self._explained(error, started) from None

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE)."""
        await self._explained_command(DO_SET_ROI_NONE)

    # --------------------------------------------------------------------------------- reboot

    async def reboot(self, *, force: bool = False, timeout: float = 60.0) -> None:
        """Reboot the autopilot and wait until it is back: its time since boot has started anew.

        Args:
            force: also while armed: **a flying vehicle falls**.
            timeout: seconds until it is back.

        Raises:
            OperationRejected: it is armed. Nothing was sent.
            CommandRejected: it refused.
            LinkLost: the link goes down with the vehicle (USB, TCP); connect again.
            OperationTimeout: it did not come back.
        """
        if self.is_armed and not force:
            raise OperationRejected("reboot: the vehicle is armed; nothing was sent")
        reboots = self._watch.reboots
        await self._explained_command(PREFLIGHT_REBOOT_SHUTDOWN, 1, *(0.0,) * 4, FORCE if force else 0)
        with anyio.move_on_after(timeout):
            while self._watch.reboots == reboots:
                self.connection.raise_if_ended()
                await anyio.sleep(0.1)
            return
        raise OperationTimeout(f"reboot: not back within {timeout:g} s; {self.describe_link()}")

    # ---------------------------------------------------------------------------------- inside

    async def _explained_command(self, command: int, *params: float) -> None:
        started = self.connection.now()
        try:
            await self._commands.send_long(command, *params)
        except CommandRejected as error:
            await self._settle()
            raise self._explained(error, started) from None

    def _mode_for(self, action: str, purpose: Purpose) -> Mode:
        mode = self.autopilot.mode_for(purpose, is_vtol=self.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self.autopilot.firmware} has no mode for it")
        return mode

    def _stays_in(self, *modes: Mode) -> Callable[[], str | None]:
        """What can go wrong on the way: it disarms, or its mode becomes another one than these."""
        grace_until = self.connection.now() + MODE_GRACE_S
        arrived = False

        def trouble() -> str | None:
            nonlocal arrived
            if not self.is_armed:
                return "the vehicle disarmed"
            mode = self.telemetry.mode.latest
            arrived = arrived or mode in modes
            if mode not in modes and (arrived or self.connection.now() > grace_until):
                return f"the mode changed to {mode}" if arrived else f"the vehicle stayed in {mode}"
            return None

        return trouble

    @property
    def _holds_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition_purpose == "hold"

    @property
    def _speeds_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.speed

    @property
    def _turns_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition.yaw

    @property
    def _takes_relative_altitude(self) -> bool:
        return self.autopilot.reposition is None or self.autopilot.reposition.relative_altitude

    def _reposition_yaw(self, heading_deg: float | None) -> float:
        if heading_deg is None or not self._turns_by_reposition:
            return math.nan
        return math.remainder(math.radians(heading_deg), 2 * math.pi)

    def distance_to(self, target: Position) -> float:
        """Metres from where the vehicle is to ``target``; in three dimensions when ``target`` has an altitude.

        Infinite while the position is unknown.
        """
        here = self.telemetry.position.latest
        if here is None:
            return math.inf
        along = geo.distance_m(
            here.latitude_deg, here.longitude_deg, target.latitude_deg, target.longitude_deg
        )
        return math.hypot(along, self._altitude_difference(here, target))

    @staticmethod
    def _altitude_difference(here: Position, target: Position) -> float:
        for mine, its in (
            (here.altitude_relative_m, target.altitude_relative_m),
            (here.altitude_amsl_m, target.altitude_amsl_m),
        ):
            if mine is not None and its is not None:
                return mine - its
        return 0.0

    def _altitude_relative(self) -> float:
        here = self.telemetry.position.latest
        altitude = None if here is None else here.altitude_relative_m
        return -math.inf if altitude is None else altitude

    def _home_altitude(self) -> float:
        return self.telemetry.home.value.altitude_amsl_m

    def _global_target(self, target: Position) -> tuple[int, int, float, bool]:
        """Latitude and longitude in 1e-7 degrees, altitude in metres, and whether it is above home.

        PX4 reads altitudes above mean sea level only, so home must be known there for one above home.
        """
        relative, amsl = target.altitude_relative_m, target.altitude_amsl_m
        if relative is None and amsl is None:
            relative = self.telemetry.position.value.altitude_relative_m
        is_relative = relative is not None
        altitude = relative if relative is not None else amsl
        if altitude is None:
            raise LocalProtocolError("the target has no altitude, and the vehicle's own is not known")
        if is_relative and not self._takes_relative_altitude:
            altitude, is_relative = altitude + self._home_altitude(), False
        return round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7), altitude, is_relative


def _check_speed(speed_m_s: float) -> None:
    if not 0 < speed_m_s <= 1000:
        raise LocalProtocolError(f"speed_m_s = {speed_m_s!r} is not allowed: above 0, at most 1000")
