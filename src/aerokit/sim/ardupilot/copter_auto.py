"""AUTO of a simulated ArduCopter.

Simulated: take-off, waypoints (splines as straight lines), loitering, circles, delays, landing, return to launch,
conditions, speed, home, region of interest, jumps; servo, relay and camera commands. Skipped: NAV_PAYLOAD_PLACE,
NAV_SCRIPT_TIME, NAV_ATTITUDE_TIME, DO_GUIDED_LIMITS.
"""

from __future__ import annotations

import math
from itertools import islice

from aerokit.mavlink.enums import CopterMode, MavFrame, MavSeverity, SpeedType
from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.messages import MissionItemReached
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.copter_modes import CopterHost, CopterRtl, CopterTakeOff
from aerokit.sim.ardupilot.host import RC_THROTTLE
from aerokit.sim.ardupilot.mission_run import TAKE_OFFS, MissionCommand, MissionMode, SupportedCommand, never, place_of
from aerokit.sim.motion import Ned, wrap_pi

_STOPPED_M, _ON_CIRCLE_M = 0.3, 3.0
_TAKE_OFF_WITHOUT_THROTTLE = 2  # bit of AUTO_OPTIONS
_RAISED_THROTTLE_PWM = 1100
# A turn on a circle uses at most this share of the acceleration limit. The rest corrects the distance from the circle.
_TURN_SHARE_OF_ACCELERATION = 0.7


# A leg is the manoeuvre of a navigation command. Its `update` sets the motion targets for the next `dt` seconds.


class _FlyLeg:
    """Straight flight to a place. With ``stops``, it ends at the place, otherwise within WPNAV_RADIUS of the place."""

    def __init__(self, auto: CopterAuto, destination: Ned, *, stops: bool) -> None:
        self._copter, self._auto = auto.vehicle, auto
        self.destination = destination
        self._radius = _STOPPED_M if stops else self._copter.parameters["WPNAV_RADIUS"] / 100.0
        self.is_complete: bool = False

    def update(self, dt: float) -> None:
        copter, limits, motion = self._copter, self._auto, self._copter.motion
        copter.motors.spool_up_requested = not copter.is_landed
        if copter.is_landed:
            return
        motion.seek_position(*self.destination, speed=limits.speed, climb=limits.climb, descent=limits.descent)
        self.is_complete = self.is_complete or math.dist(self.destination, motion.place) <= self._radius


class _CircleLeg:
    """Flight to the nearest point of a circle, and then around the circle. A negative radius is anticlockwise."""

    def __init__(self, auto: CopterAuto, center: Ned, *, turns: float, radius: float) -> None:
        self._copter = auto.vehicle
        self._turns = turns
        self._center_north, self._center_east, self._center_down = center
        parameters, motion = self._copter.parameters, self._copter.motion
        self._radius = abs(radius) or parameters["CIRCLE_RADIUS"] / 100.0  # 0 selects the parameter.
        self._turn_rate = math.copysign(math.radians(parameters["CIRCLE_RATE"]), radius)
        north, east = motion.north - self._center_north, motion.east - self._center_east
        self._angle = math.atan2(east, north)  # bearing of the point to follow, seen from the center
        self._turned_rad = 0.0  # angle flown so far; positive in both directions
        self._reported_turns = -1  # number of the turn that was reported last, from 0; -1 if there is none
        self._approach: _FlyLeg | None = None  # None once the copter is on the circle
        distance_to_circle = abs(math.hypot(north, east) - self._radius)
        if distance_to_circle > _ON_CIRCLE_M or abs(motion.down - self._center_down) > _ON_CIRCLE_M:
            self._approach = _FlyLeg(auto, self._point_to_follow(), stops=True)

    @property
    def is_complete(self) -> bool:
        return self._approach is None and self._turned_rad / math.tau >= self._turns

    def update(self, dt: float) -> None:
        if self._approach is not None:
            self._approach.update(dt)
            if self._approach.is_complete:
                self._approach = None
            return
        motion = self._copter.motion
        max_rate = math.sqrt(_TURN_SHARE_OF_ACCELERATION * motion.limits.acceleration_m_s2 / max(0.5, self._radius))
        rate = math.copysign(min(abs(self._turn_rate), max_rate), self._turn_rate)  # `max_rate` limits the acceleration
        self._report_new_turn()  # The first turn is reported before the copter moves.
        self._angle += rate * dt
        self._turned_rad += abs(rate) * dt
        self._report_new_turn()
        # Follow a point on the circle with the velocity of the point, plus 1 m/s for each metre of distance to it.
        north, east, down = self._point_to_follow()
        speed = rate * self._radius
        velocity_north = -speed * math.sin(self._angle)
        velocity_east = speed * math.cos(self._angle)
        motion.seek_velocity(
            north - motion.north + velocity_north, east - motion.east + velocity_east, down - motion.down
        )

    def _point_to_follow(self) -> Ned:
        north = self._center_north + self._radius * math.cos(self._angle)
        east = self._center_east + self._radius * math.sin(self._angle)
        return (north, east, self._center_down)

    def _report_new_turn(self) -> None:
        number = int(self._turned_rad / math.tau)
        if number > self._reported_turns:
            self._reported_turns = number
            self._copter.info(f"Mission: starting circle {number + 1}/{int(self._turns)}")


class _ClimbLeg:
    """Take-off in a mission."""

    def __init__(self, auto: CopterAuto, altitude_m: float) -> None:
        self._copter, self._auto = auto.vehicle, auto
        self._take_off = CopterTakeOff(auto.vehicle, altitude_m)

    @property
    def is_complete(self) -> bool:
        return self._take_off.is_complete

    def update(self, dt: float) -> None:
        copter, auto = self._copter, self._auto
        options = int(copter.parameters["AUTO_OPTIONS"])
        # On the ground, the copter waits for MISSION_START or a raised throttle.
        if copter.rc[RC_THROTTLE] > _RAISED_THROTTLE_PWM or options & _TAKE_OFF_WITHOUT_THROTTLE:
            auto.may_lift_off = True
        if not copter.is_landed or auto.may_lift_off:
            self._take_off.update(auto.climb)


class _ReturnLeg(CopterRtl):
    """Flight back and landing, as in the mode RTL. The leg is complete when the motors idle on the ground."""

    @property
    def is_complete(self) -> bool:
        return self.vehicle.is_landed and self.vehicle.motors.is_idle


class _DescendLeg:
    """Landing at the place where the leg begins. The leg is complete when the motors idle on the ground."""

    def __init__(self, copter: CopterHost) -> None:
        self._copter = copter

    @property
    def is_complete(self) -> bool:
        return self._copter.is_landed and self._copter.motors.is_idle

    def update(self, dt: float) -> None:
        self._copter.descend()


_ALLOW_ARMING, _CONTINUE_AFTER_LAND = 1, 4  # bits of AUTO_OPTIONS and of MIS_OPTIONS
_HEADING_REACHED_RAD, _MIN_TAKE_OFF_M = math.radians(2.0), 1.0
# An upload that changes the current command or one of the next two restarts the current command.
_CHECKED_COMMANDS = 3
# The copter passes a waypoint without a stop if one of these commands follows and the waypoint has no delay.
_NO_STOP_IF_FOLLOWED_BY = frozenset(
    {Cmd.NAV_WAYPOINT, Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME, Cmd.NAV_SPLINE_WAYPOINT, Cmd.NAV_PAYLOAD_PLACE}
)
_WAYPOINTS = frozenset({Cmd.NAV_WAYPOINT, Cmd.NAV_SPLINE_WAYPOINT, Cmd.NAV_LOITER_TIME})
_LANDINGS = frozenset({Cmd.NAV_LAND, Cmd.NAV_VTOL_LAND})
_ROI_COMMANDS = (Cmd.DO_SET_ROI, Cmd.DO_SET_ROI_LOCATION, Cmd.DO_SET_ROI_NONE)
_WITHOUT_EFFECT = (
    Cmd.DO_WINCH, Cmd.DO_RETURN_PATH_START, Cmd.DO_LAND_START, Cmd.DO_MOUNT_CONTROL, Cmd.DO_GUIDED_LIMITS,
)  # fmt: skip


class CopterAuto(MissionMode):
    """AUTO: flies the mission. `MissionRun` selects the commands, and each navigation command is flown as a leg."""

    number: int = CopterMode.AUTO
    name = "AUTO"
    arms_with_raised_throttle = True
    vehicle: CopterHost

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self.climb: float = 0.0  # Maximum climb rate in m/s.
        self.descent: float = 0.0  # Maximum sink rate in m/s.
        # Manoeuvre of the present navigation command; None while the copter holds its position.
        self._leg: _FlyLeg | _CircleLeg | _ClimbLeg | _ReturnLeg | _DescendLeg | None = None
        self._last_reached = 0  # index of the command to report in MISSION_ITEM_REACHED; 0 if there is none
        self._reached_at: float | None = None  # None until the copter reaches the waypoint.
        self._delay_until = 0.0
        self._list_version = -1  # version of the command list from which `_upcoming` was read
        # The current and the next navigation commands. They are compared to notice an upload that changes them.
        self._upcoming: tuple[MissionCommand, ...] = ()
        self.commands.update(
            {
                **dict.fromkeys(TAKE_OFFS, SupportedCommand(self._take_off, self._has_leg_ended)),
                **dict.fromkeys(_WAYPOINTS, SupportedCommand(self._fly, self._has_stayed)),
                Cmd.NAV_LOITER_UNLIM: SupportedCommand(self._fly, never),
                Cmd.NAV_LOITER_TO_ALT: SupportedCommand(self._fly, self._has_leg_ended),
                **dict.fromkeys(_LANDINGS, SupportedCommand(self._land, self._land_or_continue)),
                Cmd.NAV_LOITER_TURNS: SupportedCommand(self._circle, self._has_leg_ended),
                Cmd.NAV_RETURN_TO_LAUNCH: SupportedCommand(self._return, self._has_leg_ended),
                Cmd.NAV_DELAY: SupportedCommand(self._delay, lambda *_: copter.now > self._delay_until),
                # Param 1 is 1 at the start of the control by a companion computer, and 0 at its end.
                Cmd.NAV_GUIDED_ENABLE: SupportedCommand(is_done=lambda _, item: item.param1 == 0),
                Cmd.CONDITION_DISTANCE: SupportedCommand(
                    is_done=lambda _, item: self.distance_to_destination < max(0.0, item.param1)
                ),
                Cmd.CONDITION_YAW: SupportedCommand(
                    self._turn, lambda *_: copter.yaw.turn_to_last_heading(_HEADING_REACHED_RAD)
                ),
                Cmd.DO_CHANGE_SPEED: SupportedCommand(self._change_speed),
                **dict.fromkeys(_ROI_COMMANDS, SupportedCommand(self._look_at)),
                **dict.fromkeys(_WITHOUT_EFFECT, SupportedCommand()),
            }
        )

    @property
    def can_arm(self) -> bool:  # type: ignore[override]
        return bool(int(self.vehicle.parameters["AUTO_OPTIONS"]) & _ALLOW_ARMING)

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        return isinstance(self._leg, _ClimbLeg) and not self._leg.is_complete

    @property
    def is_landing(self) -> bool:  # type: ignore[override]
        leg = self._leg
        return isinstance(leg, _DescendLeg) or (isinstance(leg, _ReturnLeg) and leg.is_landing)

    def _has_leg_ended(self, _index: int, _item: MissionItem) -> bool:
        return self._leg is not None and self._leg.is_complete

    @property
    def destination(self) -> Ned | None:
        return self._leg.destination if isinstance(self._leg, _FlyLeg | _ReturnLeg) else None

    def pause(self) -> bool:
        if not isinstance(self._leg, _FlyLeg) or self._leg.is_complete:
            return False
        self.is_paused = True
        return True

    def resume(self) -> bool:
        self.is_paused = False
        return True

    def enter(self, *, force: bool) -> bool:
        copter, run = self.vehicle, self.vehicle.mission
        if copter.mode is self:
            return True  # Arming enters the current mode again, which must not restart the mission.
        if not run.is_present and not force:
            return False
        must_take_off = copter.is_armed and copter.is_landed
        if must_take_off and not run.starts_with_take_off():
            copter.send_text(MavSeverity.CRITICAL, "Auto: Missing Takeoff Cmd")
            return False
        self.speed = copter.speed_limit("WPNAV_SPEED")
        self.climb, self.descent = copter.speed_limit("WPNAV_SPEED_UP"), copter.speed_limit("WPNAV_SPEED_DN")
        self._leg = None
        self.may_lift_off = self.is_paused = False
        self.wait_for_origin()
        return True

    def on_mission_started(self) -> None:
        self._update_upcoming()  # so that `update` notices a later upload

    def update(self, dt: float) -> None:
        self.start_if_origin_known()
        if not self.is_waiting_for_origin:
            has_changed = self._update_upcoming()
            if has_changed and isinstance(self._leg, _FlyLeg):  # An upload has changed the next commands.
                self._restart_command()
            self.vehicle.mission.update()
            self._update_upcoming()  # `mission.update` may have started the next command
        if self.vehicle.mode is not self:  # The mission has changed the mode.
            return
        is_stopped = self.is_paused and isinstance(self._leg, _FlyLeg)  # A take-off or landing cannot be paused.
        if self._leg is None or is_stopped:
            self.vehicle.hold_position()
        else:
            self._leg.update(dt)
        if not is_stopped:
            self.vehicle.yaw.update()

    def _update_upcoming(self) -> bool:
        """Return True if an upload has changed the current or the next commands."""
        run, commands = self.vehicle.mission, self.vehicle.missions.commands
        has_same_index = bool(self._upcoming) and self._upcoming[0].seq == run.nav_index
        if commands.version == self._list_version and has_same_index:
            return False
        upcoming = tuple(islice(run.navigation_from(max(1, run.nav_index)), _CHECKED_COMMANDS))  # Item 0 is home.
        has_changed = upcoming != self._upcoming
        self._list_version = commands.version
        self._upcoming = upcoming
        return has_changed and has_same_index

    def _restart_command(self) -> None:
        run = self.vehicle.mission
        if not run.is_running:
            return
        is_restarted = run.set_current(run.nav_index)
        result = ", restarted command" if is_restarted else " but failed to restart command"
        self.vehicle.send_text(MavSeverity.CRITICAL, f"Auto mission changed{result}")

    def is_complete(self, index: int, item: MissionItem) -> bool:
        if self.vehicle.mode is not self or not self._is_done(index, item):
            return False
        if not self._last_reached:
            self.vehicle.call_later(0.0, self._report_reached)
        self._last_reached = index
        return True

    def _report_reached(self) -> None:
        # The firmware reports only the last of several commands that complete in the same tick.
        self.vehicle.send(MissionItemReached(self._last_reached))
        self._last_reached = 0

    def end_mission(self) -> None:
        if self.vehicle.is_landed:
            self.vehicle.arming.disarm()
        else:
            self._leg = None
            self.vehicle.yaw.hold()

    def _has_stayed(self, index: int, item: MissionItem) -> bool:
        if not self._has_leg_ended(index, item):
            return False
        if self._reached_at is None:
            self._reached_at = self.vehicle.now
        # The firmware counts whole seconds (mode_auto.cpp, verify_nav_wp).
        if math.floor(self.vehicle.now - self._reached_at) < item.param1:
            return False
        self.vehicle.info(f"Reached command #{index}")
        return True

    def _land_or_continue(self, index: int, item: MissionItem) -> bool:
        """Return True if the mission continues with a take-off. Otherwise, land and disarm."""
        copter = self.vehicle
        if isinstance(self._leg, _FlyLeg):  # The copter first flies to the place of the landing.
            if self._leg.is_complete:
                copter.yaw.hold()
                self._leg = _DescendLeg(copter)
            return False
        if not self._has_leg_ended(index, item):
            return False
        may_continue = bool(int(copter.parameters["MIS_OPTIONS"]) & _CONTINUE_AFTER_LAND)
        if may_continue and copter.mission.is_take_off(index + 1):
            return True
        copter.arming.disarm()
        return False

    def _place_of(self, item: MissionItem) -> Ned:
        current: Ned = self.vehicle.motion.place
        if isinstance(self._leg, _FlyLeg) and self._leg.is_complete:
            current = self._leg.destination  # more exact than the copter's position, which differs a little
        return place_of(self.vehicle, item, current)

    def _go(self, place: Ned, *, stops: bool = True) -> None:
        self._reached_at = None
        self.is_paused: bool = False
        if not self.vehicle.yaw.has_region_of_interest:
            self.vehicle.yaw.apply_default()
        self._leg = _FlyLeg(self, place, stops=stops)

    def _fly(self, item: MissionItem) -> None:
        run = self.vehicle.mission
        stops = item.command not in (Cmd.NAV_WAYPOINT, Cmd.NAV_SPLINE_WAYPOINT) or item.param1 > 0
        if not stops:
            following = next(run.navigation_from(run.nav_index + 1), None)
            stops = following is None or following.item.command not in _NO_STOP_IF_FOLLOWED_BY
        self._go(self._place_of(item), stops=stops)

    def _take_off(self, item: MissionItem) -> None:
        copter = self.vehicle
        point = copter.world_point(0, 0, item.z, item.frame)  # Only the altitude is used.
        copter.yaw.hold()
        # A take-off never descends, and climbs at least `_MIN_TAKE_OFF_M` from the ground.
        min_climb = _MIN_TAKE_OFF_M if copter.is_landed else 0.0
        target_down = copter.motion.down - min_climb
        if point is not None:
            _, _, down = point
            target_down = min(target_down, down)
        _, _, home_down = copter.home_or_ground
        self._leg = _ClimbLeg(self, home_down - target_down)

    def _circle(self, item: MissionItem) -> None:
        self._leg = _CircleLeg(self, self._place_of(item), turns=item.param1, radius=item.param3)

    def _land(self, item: MissionItem) -> None:
        self.vehicle.yaw.hold()
        if (item.x, item.y) == (0, 0):
            self._leg = _DescendLeg(self.vehicle)
            return
        north, east, _ = self._place_of(item)
        self._go((north, east, self.vehicle.motion.down))

    def _return(self, _: MissionItem) -> None:
        leg = _ReturnLeg(self.vehicle)
        self._leg = leg
        leg.enter(force=True)

    def _delay(self, item: MissionItem) -> None:
        seconds = max(0.0, item.param1)  # A negative number (to wait for a time of day) is not simulated.
        self._delay_until = self.vehicle.now + seconds
        self.vehicle.info(f"Delaying {int(seconds)} sec")

    def _turn(self, item: MissionItem) -> None:
        heading, direction = math.radians(item.param1), int(item.param3)
        if item.param4 > 0:  # CONDITION_YAW: relative angle; param 3 is its sign.
            direction = direction or 1
            heading = self.vehicle.motion.yaw + math.copysign(heading, direction)
        self.vehicle.yaw.turn_to(wrap_pi(heading), math.radians(item.param2), direction)

    def _change_speed(self, item: MissionItem) -> None:
        if item.param2 <= 0:  # In DO_CHANGE_SPEED, -1 means no change.
            return
        if item.param1 == SpeedType.CLIMB_SPEED:
            self.climb = item.param2
        elif item.param1 == SpeedType.DESCENT_SPEED:
            self.descent = item.param2
        else:
            self.speed: float = item.param2

    def _look_at(self, item: MissionItem) -> None:
        is_none = (item.x, item.y, item.z) == (0, 0, 0)
        point = None if is_none else self.vehicle.world_point(int(item.x), int(item.y), item.z, MavFrame.GLOBAL)
        self.vehicle.yaw.set_region_of_interest(point)
