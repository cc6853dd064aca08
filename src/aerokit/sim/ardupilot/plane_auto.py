"""AUTO and GUIDED of a simulated ArduPlane.

Simulated in AUTO: take-off, waypoints, all kinds of loitering, landing, return to launch, delays, speed, home, jumps;
servo and camera commands. Other commands are skipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import AttitudeTargetTypemask as Mask
from aerokit.mavlink.enums import HeadingType, MavFrame, MavResult, MavSeverity, PlaneMode, SpeedType
from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import PositionTargetTypemask as PositionMask
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.host import ABSOLUTE_FRAMES, GuidedMode
from aerokit.sim.ardupilot.mission_run import MissionMode, SupportedCommand, never
from aerokit.sim.ardupilot.plane_modes import PlaneHost, PlaneLanding, PlaneNavigatingMode
from aerokit.sim.channel import Channel
from aerokit.sim.commands import ReceivedCommand, constrained, to_int
from aerokit.sim.motion import Ned, euler_from_quaternion, wrap_pi

_FLY, _LOITER, _CLIMB, _LAND = range(4)
_REACHED_HEIGHT_M = 5.0
_ON_CIRCLE_SHARE = 1.3


class PlaneAuto(PlaneNavigatingMode, MissionMode):
    """AUTO: flies the mission. `MissionRun` selects the commands. After the last command, the mode changes to RTL."""

    number: int = PlaneMode.AUTO
    name = "AUTO"

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._manoeuvre = _LOITER
        self._landing: PlaneLanding | None = None  # set while `_manoeuvre` is `_LAND`
        self._on_circle_since = math.nan  # NaN before the plane has reached the circle
        self._turned_rad = 0.0  # angle flown around the circle
        self._last_bearing = 0.0  # bearing from the center of the circle at the last tick
        self._leg_start: Ned = (0.0, 0.0, 0.0)  # start of the straight line to the current waypoint
        self.commands.update(
            {
                Cmd.NAV_TAKEOFF: SupportedCommand(lambda item: self._go(item, _CLIMB), self._has_climbed),
                **dict.fromkeys(
                    (Cmd.NAV_WAYPOINT, Cmd.NAV_SPLINE_WAYPOINT),
                    SupportedCommand(lambda item: self._go(item, _FLY), self._has_passed),
                ),
                Cmd.NAV_LOITER_UNLIM: SupportedCommand(self._start_loiter, never),
                Cmd.NAV_LOITER_TIME: SupportedCommand(self._start_loiter, self._has_circled_for_time),
                Cmd.NAV_LOITER_TURNS: SupportedCommand(self._start_loiter, self._has_turned),
                Cmd.NAV_LOITER_TO_ALT: SupportedCommand(self._start_loiter, self._is_at_height),
                Cmd.NAV_LAND: SupportedCommand(self._start_landing, never),
                Cmd.NAV_RETURN_TO_LAUNCH: SupportedCommand(self._return, never),
                Cmd.DO_CHANGE_SPEED: SupportedCommand(self._change_speed),
                **dict.fromkeys((Cmd.DO_LAND_START, Cmd.DO_RETURN_PATH_START), SupportedCommand()),
            }
        )

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        return self._manoeuvre == _CLIMB

    @property
    def is_landing(self) -> bool:  # type: ignore[override]
        return self._manoeuvre == _LAND

    def enter(self, *, force: bool) -> bool:
        plane = self.vehicle
        if plane.mode is self and plane.is_armed and plane.mission.is_running:
            return True  # Arming enters the current mode again, which must not restart the mission.
        super().enter(force=force)
        self._manoeuvre = _LOITER
        # The mission or RTL may change the mode again. `call_later` lets the present mode change complete first.
        plane.call_later(0.0, self._begin if plane.mission.is_present else self._return_at_once)
        return True

    def _begin(self) -> None:
        if self.vehicle.mode is self and not self.vehicle.mission.is_running:
            self.vehicle.mission.start_or_resume()

    def on_disarmed(self) -> None:
        """Do nothing, because disarming has already reset the progress."""

    def update(self, dt: float) -> None:
        plane = self.vehicle
        plane.mission.update()
        if plane.mode is not self:  # The mission has changed the mode.
            return
        if self._manoeuvre == _CLIMB:
            plane.climb_out()
        elif self._manoeuvre == _LAND:
            assert self._landing is not None
            self._landing.update(dt)
        elif self._manoeuvre == _FLY and not plane.is_landed and self._place is not None:
            plane.wing.fly_to(*self._place, airspeed=self.airspeed)
        else:
            super().update(dt)
            self._count_turns()

    def _count_turns(self) -> None:
        wing = self.vehicle.wing
        if self._place is None:
            return
        north, east, _ = self._place
        bearing = math.atan2(wing.east - east, wing.north - north)
        was_on_circle = not math.isnan(self._on_circle_since)
        if was_on_circle:
            self._turned_rad += abs(wrap_pi(bearing - self._last_bearing))
        elif self._is_on_circle:
            self._on_circle_since = self.vehicle.now
        self._last_bearing = bearing

    @property
    def _is_on_circle(self) -> bool:
        radius = abs(self.radius or self.vehicle.parameters["WP_LOITER_RAD"])
        return self.distance_to_destination < _ON_CIRCLE_SHARE * radius

    def is_complete(self, index: int, item: MissionItem) -> bool:
        flies_mission = self.vehicle.mode is self and self.vehicle.is_armed
        if not flies_mission or not self._is_done(index, item):
            return False
        if item.command <= Cmd.NAV_LAST:
            self.vehicle.send(m.MissionItemReached(index))
        return True

    def end_mission(self) -> None:
        if not self.vehicle.is_landed:
            self._return_at_once()

    def _return_at_once(self) -> None:
        if self.vehicle.mode is self:
            self.vehicle.info("Mission complete, changing mode to RTL")
            self.vehicle.set_mode(PlaneMode.RTL)

    def _has_climbed(self, _index: int, _item: MissionItem) -> bool:
        plane = self.vehicle
        return self._report_if(plane.wing.down <= self._place_down, f"Takeoff complete at {plane.altitude_m:.2f}m")

    def _has_circled_for_time(self, _index: int, item: MissionItem) -> bool:
        # Before the plane has reached the circle, the time is NaN, and the comparison is false.
        time_on_circle_s = self.vehicle.now - self._on_circle_since
        return self._report_if(time_on_circle_s >= item.param1, "Loiter time complete")

    def _has_turned(self, _index: int, item: MissionItem) -> bool:
        return self._report_if(self._turned_rad >= 2 * math.pi * item.param1, "Loiter orbits complete")

    def _is_at_height(self, _index: int, _item: MissionItem) -> bool:
        is_at_height = abs(self.vehicle.wing.down - self._place_down) < _REACHED_HEIGHT_M
        return self._report_if(is_at_height and self._is_on_circle, "Loiter to alt complete")

    @property
    def _place_down(self) -> float:
        assert self._place is not None
        _, _, down = self._place
        return down

    def _report_if(self, is_complete: bool, text: str) -> bool:
        if is_complete:
            self.vehicle.info(text)
        return is_complete

    def _has_passed(self, index: int, _item: MissionItem) -> bool:
        assert self._place is not None
        wing = self.vehicle.wing
        north, east, _ = self._place
        start_north, start_east, _ = self._leg_start
        distance = self.distance_to_destination
        if distance <= self.vehicle.parameters["WP_RADIUS"]:
            self.vehicle.info(f"Reached waypoint #{index} dist {int(distance)}m")
            return True
        # The plane has passed the waypoint if its offset from the waypoint points in the direction of the leg.
        dot_product = (north - start_north) * (wing.north - north) + (east - start_east) * (wing.east - east)
        return self._report_if(dot_product > 0, f"Passed waypoint #{index} dist {int(distance)}m")

    def _go(self, item: MissionItem, manoeuvre: int) -> None:
        self._leg_start = self.vehicle.wing.place
        own_north, own_east, own_down = self._leg_start
        # `world_point` returns None for an invalid place.
        north, east, down = self.vehicle.world_point(int(item.x), int(item.y), item.z, item.frame) or self._leg_start
        has_no_place = (item.x, item.y) == (0, 0)
        if has_no_place:  # Zero coordinates mean the present position.
            north, east = own_north, own_east
        if manoeuvre == _LOITER:  # An altitude of 0 in a relative frame means the present altitude (Location.cpp).
            keeps_altitude = item.z == 0 and item.frame not in ABSOLUTE_FRAMES
        else:  # With zero coordinates, an altitude of 0 means the present altitude (commands.cpp, set_next_WP).
            keeps_altitude = item.z == 0 and has_no_place
        if keeps_altitude:
            down = own_down
        self._place = (north, east, down)
        self._manoeuvre = manoeuvre
        self._on_circle_since = math.nan
        self._turned_rad = self.radius = 0.0

    def _start_loiter(self, item: MissionItem) -> None:
        self._go(item, _LOITER)
        self.radius: float = item.param2 if item.command == Cmd.NAV_LOITER_TO_ALT else item.param3

    def _start_landing(self, item: MissionItem) -> None:
        self._go(item, _LAND)
        assert self._place is not None
        plane = self.vehicle
        north, east, _ = self._place
        # Unlike for other commands, an altitude of 0 is an ordinary altitude.
        point = plane.world_point(int(item.x), int(item.y), item.z, item.frame)
        _, _, down = point or (north, east, plane.wing.ground_down)
        self._landing = PlaneLanding(plane, (north, east, down))
        plane.info(f"Landing approach start at {plane.altitude_m:.1f}m")

    def _return(self, _: MissionItem) -> None:
        # ArduPlane changes the mode to RTL (commands_logic.cpp, start_command). The mode change stops the mission.
        self.vehicle.set_mode(PlaneMode.RTL)

    def _change_speed(self, item: MissionItem) -> None:
        if self.vehicle.is_valid_airspeed(item.param2):
            self.speed: float = item.param2
            self.vehicle.info(f"Set airspeed {item.param2:.0f} m/s")


_ATTITUDE_TIMEOUT_S = 3.0
_UNLIMITED_M_S = 1000.0
_RATES = Mask.BODY_ROLL_RATE_IGNORE | Mask.BODY_PITCH_RATE_IGNORE | Mask.BODY_YAW_RATE_IGNORE
_INVALID_ALTITUDES = (0.0, -1.0)  # The firmware refuses these.


@dataclass(frozen=True)
class _TimedValue:
    """A value of a set-point, and the time at which the set-point was received."""

    value: float
    received_at: float


class PlaneGuided(PlaneNavigatingMode, GuidedMode):
    """GUIDED: flies to the target and circles there.

    A commanded course is valid until it is cancelled or the next target arrives. Bank, pitch and throttle of
    SET_ATTITUDE_TARGET expire after three seconds each. ArduPlane uses only the altitude of position targets.
    """

    number: int = PlaneMode.GUIDED
    name = "GUIDED"
    can_change_speed = True

    def enter(self, *, force: bool) -> bool:
        self._climb_limit = _UNLIMITED_M_S
        self._course: float | None = None  # course to fly in radians from north; None to fly to the target
        self._bank = self._pitch = self._throttle = _TimedValue(0.0, -math.inf)
        return super().enter(force=force)

    def go_to(self, position: Ned) -> None:
        self._place = position
        self._course = None
        self._climb_limit = _UNLIMITED_M_S

    def change_altitude(self, down: float, climb_m_s: float = _UNLIMITED_M_S) -> None:
        if self._place is not None:
            north, east, _ = self._place
            self._place = (north, east, down)
            self._climb_limit = climb_m_s

    def on_attitude_target(self, message: m.SetAttitudeTarget, _channel: Channel) -> None:
        if not self.is_active:
            return
        mask, now = message.type_mask, self.vehicle.now
        roll, pitch, _ = euler_from_quaternion(*message.q)
        # If the message gives an attitude without rates, the firmware uses both angles. Otherwise, it uses each angle
        # that has a rate (GCS_MAVLink_Plane.cpp).
        selects_all_angles = not mask & Mask.ATTITUDE_IGNORE and mask & _RATES == _RATES
        if selects_all_angles or not mask & Mask.BODY_ROLL_RATE_IGNORE:
            self._bank = _TimedValue(roll, now)
        if selects_all_angles or not mask & Mask.BODY_PITCH_RATE_IGNORE:
            self._pitch = _TimedValue(pitch, now)
        if not mask & Mask.THROTTLE_IGNORE:
            self._throttle = _TimedValue(constrained(message.thrust, 0.0, 1.0), now)

    def update(self, dt: float) -> None:
        wing, now = self.vehicle.wing, self.vehicle.now
        has_bank, has_pitch, has_throttle = (
            now - value.received_at < _ATTITUDE_TIMEOUT_S for value in (self._bank, self._pitch, self._throttle)
        )
        has_command = has_bank or has_pitch or has_throttle or self._course is not None
        if self.vehicle.is_landed or not has_command:
            super().update(dt)  # circles the target
            return
        limits = wing.wing_limits
        # Half throttle flies at cruise speed.
        speed = 2.0 * self._throttle.value * self.vehicle.cruise_m_s if has_throttle else self.airspeed
        _, _, target_down = self._place or wing.place
        climb = max(-self._climb_limit, min(self._climb_limit, wing.climb_rate_to(target_down)))
        if has_pitch:  # A commanded pitch replaces the altitude.
            climb = max(-limits.sink_m_s, min(limits.climb_m_s, speed * math.sin(self._pitch.value)))
        if not has_bank and self._course is not None:
            wing.head(self._course, speed, climb)
            return
        bank = max(-limits.bank_rad, min(limits.bank_rad, self._bank.value)) if has_bank else 0.0
        wing.bank_and_climb(speed, bank, climb)

    def on_local_target(self, message: m.SetPositionTargetLocalNed, _: Channel) -> None:
        plane, target = self.vehicle, self.destination
        is_supported = message.coordinate_frame == MavFrame.LOCAL_OFFSET_NED
        if not self.is_active or not is_supported or target is None:
            return
        _north, _east, target_down = target
        _north, _east, home_down = plane.home_or_ground
        down = target_down + message.z
        self.change_altitude(down)
        plane.info(f"Change alt to {home_down - down:.1f}")

    def on_global_target(self, message: m.SetPositionTargetGlobalInt, _: Channel) -> None:
        plane = self.vehicle
        if not self.is_active:
            return
        point = plane.world_point(0, 0, message.alt, message.coordinate_frame)  # Only the altitude is used.
        if point is None:
            text = "Invalid coord frame in SET_POSTION_TARGET_GLOBAL_INT"  # The misspelling is the firmware's.
            plane.send_text(MavSeverity.WARNING, text)
        elif not message.type_mask & PositionMask.Z_IGNORE:
            _north, _east, down = point
            self.change_altitude(down)

    def on_guided_command(self, command: ReceivedCommand) -> int:
        """Execute a command that only GUIDED accepts."""
        handlers = {
            Cmd.GUIDED_CHANGE_SPEED: self._change_speed,
            Cmd.GUIDED_CHANGE_ALTITUDE: self._change_altitude,
            Cmd.GUIDED_CHANGE_HEADING: self._change_heading,
        }
        return handlers[Cmd(command.command)](command) if self.is_active else MavResult.FAILED

    def _change_speed(self, command: ReceivedCommand) -> int:
        if to_int(command.param1) != SpeedType.AIRSPEED:
            return MavResult.DENIED
        if not self.vehicle.is_valid_airspeed(command.param2):
            return MavResult.FAILED
        self.speed: float = command.param2
        return MavResult.ACCEPTED

    def _change_altitude(self, command: ReceivedCommand) -> int:
        point = self.vehicle.world_point(0, 0, command.z, command.altitude_frame)  # Only the altitude is used.
        if command.z in _INVALID_ALTITUDES or point is None:
            return MavResult.DENIED
        _, _, down = point
        # Param 3 is the climb rate in m/s. 0 selects the maximum.
        self.change_altitude(down, abs(command.param3) or _UNLIMITED_M_S)
        return MavResult.ACCEPTED

    def _change_heading(self, command: ReceivedCommand) -> int:
        if not 0.0 <= command.param2 < 360.0:
            return MavResult.DENIED
        if command.param1 == HeadingType.DEFAULT:
            self._course = None  # The plane circles again.
        elif command.param1 in (HeadingType.COURSE_OVER_GROUND, HeadingType.HEADING):
            self._course = math.radians(command.param2)
        else:
            return MavResult.DENIED
        return MavResult.ACCEPTED

    def change_target_altitude(self, command: ReceivedCommand) -> int:
        """Execute DO_CHANGE_ALTITUDE. All modes accept the command, but only GUIDED uses the altitude."""
        point = self.vehicle.world_point(0, 0, command.param1, to_int(command.param2))  # Only the altitude is used.
        if point is None:
            return MavResult.DENIED
        if self.is_active:
            _, _, down = point
            self.change_altitude(down)
        return MavResult.ACCEPTED
