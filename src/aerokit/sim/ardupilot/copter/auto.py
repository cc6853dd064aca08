"""AUTO: an ArduCopter flies its mission.

Simulated: take-off, waypoints (splines as straight lines), loitering, circles, delays, landing, return to launch,
conditions, speed, home, region of interest, jumps; commands to servos, relays, cameras and the like in passing. Not
simulated, and skipped: payload place, guided by script or attitude, guided limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import CopterMode, MavCmd, MavFrame, MavSeverity, SpeedType
from aerokit.mavlink.messages import MissionItemReached
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.copter.auto_legs import Circle, Climb, Descent, Leg, Return, Stay, Way
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import Mode
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import wrap_pi

_C = MavCmd
_ALLOW_ARMING = 1
_CONTINUE_AFTER_LAND = 4
_HEADING_REACHED_RAD = math.radians(2.0)
_LOWEST_TAKE_OFF_M = 1.0
_STOPS_NOT_BEFORE = frozenset(
    {_C.NAV_WAYPOINT, _C.NAV_LOITER_UNLIM, _C.NAV_LOITER_TIME, _C.NAV_SPLINE_WAYPOINT, _C.NAV_PAYLOAD_PLACE}
)
_WAYPOINTS = frozenset({_C.NAV_WAYPOINT, _C.NAV_SPLINE_WAYPOINT, _C.NAV_LOITER_TIME})
_NOTHING_TO_DO = frozenset(
    {
        _C.DO_FENCE_ENABLE,
        _C.DO_WINCH,
        _C.DO_RETURN_PATH_START,
        _C.DO_LAND_START,
        _C.DO_MOUNT_CONTROL,
        _C.DO_GUIDED_LIMITS,
    }
)


class Auto(Mode):
    """What it does now is a leg; the mission run says which command comes when."""

    number: int = CopterMode.AUTO
    name = "AUTO"
    needs_mission = True
    arms_with_raised_throttle = True
    can_change_speed = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self.speed: float = 0.0
        self.climb: float = 0.0
        self.descent: float = 0.0
        """Limits in m/s."""
        self.may_lift_off: bool = False
        """On the ground a take-off waits for MISSION_START or a raised throttle."""
        self._leg: Leg = Stay(copter)
        self._is_waiting = False
        self.is_paused: bool = False
        self._last_reached = 0
        self._reached_at = self._condition_from = self._delay_until = 0.0
        self._version = -1
        self._seen: tuple[tuple[int, MissionItem], ...] = ()
        handlers: dict[int, Callable[[MissionItem], None]] = {
            _C.NAV_TAKEOFF: self._take_off,
            _C.NAV_VTOL_TAKEOFF: self._take_off,
            _C.NAV_WAYPOINT: self._fly,
            _C.NAV_SPLINE_WAYPOINT: self._fly,
            _C.NAV_LOITER_UNLIM: self._fly,
            _C.NAV_LOITER_TIME: self._fly,
            _C.NAV_LOITER_TO_ALT: self._fly,
            _C.NAV_LOITER_TURNS: self._circle,
            _C.NAV_LAND: self._land,
            _C.NAV_VTOL_LAND: self._land,
            _C.NAV_RETURN_TO_LAUNCH: self._return,
            _C.NAV_DELAY: self._delay,
            _C.NAV_GUIDED_ENABLE: self._ignore,
            _C.CONDITION_DELAY: self._wait,
            _C.CONDITION_DISTANCE: self._ignore,
            _C.CONDITION_YAW: self._turn,
            _C.DO_CHANGE_SPEED: self._change_speed,
            _C.DO_SET_HOME: self._set_home,
            _C.DO_SET_ROI: self._look_at,
            _C.DO_SET_ROI_LOCATION: self._look_at,
            _C.DO_SET_ROI_NONE: self._look_at,
            **dict.fromkeys(_NOTHING_TO_DO, self._ignore),
        }
        self._handlers = handlers

    @property
    def can_arm(self) -> bool:  # type: ignore[override]
        """AUTO_OPTIONS says so."""
        return bool(int(self.copter.parameters["AUTO_OPTIONS"]) & _ALLOW_ARMING)

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        """Climbing by a take-off command."""
        return isinstance(self._leg, Climb) and not self._leg.is_complete

    @property
    def is_landing(self) -> bool:  # type: ignore[override]
        """Coming down to stay there."""
        return isinstance(self._leg, Descent) or (isinstance(self._leg, Return) and self._leg.is_landing)

    @property
    def destination(self) -> Ned | None:
        return self._leg.destination if isinstance(self._leg, Way | Return) else None

    def pause(self) -> bool:
        """Stop on the way to a waypoint; elsewhere there is nothing to stop."""
        if not isinstance(self._leg, Way) or self._leg.is_complete:
            return False
        self.is_paused = True
        return True

    def resume(self) -> bool:
        self.is_paused = False
        return True

    def enter(self, *, force: bool) -> bool:
        """A mission is needed in the air, and on the ground one that takes off."""
        run = self.copter.mission
        if self.copter.mode is self:
            return True  # armed in this mode
        if not run.is_present and not force:
            return False
        if self.copter.is_armed and self.copter.is_landed and not run.starts_with_take_off():
            self.copter.send_text(MavSeverity.CRITICAL, "Auto: Missing Takeoff Cmd")
            return False
        parameters = self.copter.parameters
        self.speed = parameters["WPNAV_SPEED"] / 100.0
        self.climb, self.descent = parameters["WPNAV_SPEED_UP"] / 100.0, parameters["WPNAV_SPEED_DN"] / 100.0
        self._leg, self._is_waiting, self.is_paused = Stay(self.copter), True, False
        self.may_lift_off = False
        self.copter.call_later(0.0, self._start_if_waiting)
        return True

    def disarmed(self) -> None:
        """In AUTO a mission that was not over begins once more, and waits on the ground."""
        if self.copter.mode is self:
            self.copter.mission.update()

    def leave(self) -> None:
        """The mission stops where it is."""
        self._is_waiting = False
        self.copter.mission.stop()

    def _start_if_waiting(self) -> None:
        """As soon as there is an origin; also while disarmed."""
        if self._is_waiting and self.copter.mode is self and self.copter.navigation.origin is not None:
            self._is_waiting = False
            self.copter.mission.start_or_resume()
            self._notice_changes()

    def update(self, dt: float) -> None:
        self._start_if_waiting()
        if not self._is_waiting:
            if self._notice_changes() and isinstance(self._leg, Way):
                self._restart_command()
            self.copter.mission.update()
        if self.copter.mode is not self:
            return
        if self.is_paused and isinstance(self._leg, Way):
            self.stay()
        else:
            self._leg.update(dt)
            self.copter.yaw.update()

    def _notice_changes(self) -> bool:
        """Whether somebody changed the commands that are flown next."""
        run, commands = self.copter.mission, self.copter.missions.commands
        if commands.version == self._version and self._seen and self._seen[0][0] == run.nav_index:
            return False
        had_same_place = bool(self._seen) and self._seen[0][0] == run.nav_index
        upcoming = [
            found for found, _ in zip(run.navigation_from(max(1, run.nav_index)), range(3), strict=False)
        ]
        changed = tuple(upcoming) != self._seen
        self._version, self._seen = commands.version, tuple(upcoming)
        return changed and had_same_place

    def _restart_command(self) -> None:
        run = self.copter.mission
        if not run.is_running:
            return
        done = run.set_current(run.nav_index)
        text = "restarted command" if done else "but failed to restart command"
        self.copter.send_text(MavSeverity.CRITICAL, f"Auto mission changed{',' if done else ''} {text}")

    def start_command(self, index: int, item: MissionItem) -> bool:
        handler = self._handlers.get(item.command)
        if handler is None:
            return False
        handler(item)
        return True

    def is_complete(self, index: int, item: MissionItem) -> bool:
        if self.copter.mode is not self or not self._is_done(index, item):
            return False
        if not self._last_reached:
            self.copter.call_later(0.0, self._tell_reached)
        self._last_reached = index
        return True

    def _tell_reached(self) -> None:
        """Of several at the same time only the last."""
        index, self._last_reached = self._last_reached, 0
        self.copter.send(MissionItemReached(index))

    def end_mission(self) -> None:
        """Stay in the air, or disarm on the ground."""
        if self.copter.is_landed:
            self.copter.arming.disarm()
        else:
            self._leg = Stay(self.copter)
            self.copter.yaw.hold()

    def _is_done(self, index: int, item: MissionItem) -> bool:
        command, now = item.command, self.copter.now
        if command in _WAYPOINTS:  # nearly always
            return self._has_stayed(index, item.param1)
        if command in (_C.NAV_TAKEOFF, _C.NAV_VTOL_TAKEOFF):
            return self._leg.is_complete
        if command in (_C.NAV_LAND, _C.NAV_VTOL_LAND):
            return self._has_landed(index)
        if command in (_C.NAV_LOITER_TURNS, _C.NAV_LOITER_TO_ALT, _C.NAV_RETURN_TO_LAUNCH):
            return self._leg.is_complete
        if command in (_C.NAV_LOITER_UNLIM, _C.NAV_GUIDED_ENABLE):
            return command == _C.NAV_GUIDED_ENABLE and item.param1 == 0
        if command == _C.NAV_DELAY:
            return now > self._delay_until
        if command == _C.CONDITION_DELAY:
            return now - self._condition_from > max(0.0, item.param1)
        if command == _C.CONDITION_DISTANCE:
            return self._distance() < max(0.0, item.param1)
        if command == _C.CONDITION_YAW:
            return self.copter.yaw.keep_fixed(_HEADING_REACHED_RAD)
        if command not in self._handlers:
            self.copter.send_text(MavSeverity.WARNING, f"Skipping invalid cmd #{command}")
        return True

    def _has_stayed(self, index: int, seconds: float) -> bool:
        if not self._leg.is_complete:
            return False
        now = self.copter.now
        self._reached_at = self._reached_at or now
        if math.floor(now - self._reached_at) < seconds:
            return False
        self.copter.info(f"Reached command #{index}")
        return True

    def _has_landed(self, index: int) -> bool:
        """Landing ends the mission, unless a take-off follows and MIS_OPTIONS lets it go on."""
        copter = self.copter
        if isinstance(self._leg, Way):
            if self._leg.is_complete:
                copter.yaw.hold()
                self._leg = Descent(copter)
            return False
        if not self._leg.is_complete:
            return False
        goes_on = int(copter.parameters["MIS_OPTIONS"]) & _CONTINUE_AFTER_LAND
        if goes_on and copter.mission.is_take_off(index + 1):
            return True
        copter.arming.disarm()
        return False

    def _distance(self) -> float:
        destination, motion = self.destination, self.copter.motion
        if destination is None:
            return 0.0
        return math.hypot(destination[0] - motion.north, destination[1] - motion.east)

    def _place(self, item: MissionItem) -> Ned:
        """Where an item leads; what is 0 in it stays as it is."""
        motion, leg = self.copter.motion, self._leg
        here: Ned = motion.place
        if isinstance(leg, Way) and leg.is_complete:
            here = leg.destination
        point = self.copter.point(int(item.x), int(item.y), item.z, item.frame)
        if point is None:
            return here
        north, east = here[:2] if (item.x, item.y) == (0, 0) else point[:2]
        return (north, east, here[2] if item.z == 0 else point[2])

    def _go(self, place: Ned, *, stops: bool = True) -> None:
        self._reached_at = 0.0
        self.is_paused = False
        if not self.copter.yaw.has_region_of_interest:
            self.copter.yaw.default()
        self._leg = Way(self.copter, self, place, stops=stops)

    def _fly(self, item: MissionItem) -> None:
        self._go(self._place(item), stops=self._stops_at(item))

    def _stops_at(self, item: MissionItem) -> bool:
        run = self.copter.mission
        if item.command not in (_C.NAV_WAYPOINT, _C.NAV_SPLINE_WAYPOINT) or item.param1 > 0:
            return True
        following = next(run.navigation_from(run.nav_index + 1), None)
        return following is None or following[1].command not in _STOPS_NOT_BEFORE

    def _take_off(self, item: MissionItem) -> None:
        copter = self.copter
        down = copter.motion.down
        point = copter.point(0, 0, item.z, item.frame)
        lowest = down - (_LOWEST_TAKE_OFF_M if copter.is_landed else 0.0)
        home = copter.navigation.home
        ground = copter.motion.ground_down if home is None else home[2]
        copter.yaw.hold()
        self._leg = Climb(copter, self, ground - min(lowest, down if point is None else point[2]))

    def _circle(self, item: MissionItem) -> None:
        self._leg = Circle(self.copter, self, self._place(item), turns=item.param1, radius=item.param3)

    def _land(self, item: MissionItem) -> None:
        self.copter.yaw.hold()
        if (item.x, item.y) == (0, 0):
            self._leg = Descent(self.copter)
            return
        north, east, _ = self._place(item)
        self._go((north, east, self.copter.motion.down))

    def _return(self, _: MissionItem) -> None:
        self._leg = Return(self.copter)
        self._leg.enter(force=True)

    def _delay(self, item: MissionItem) -> None:
        """Seconds; a time of the day is not simulated and counts as no delay."""
        seconds = max(0.0, item.param1)
        self._delay_until = self.copter.now + seconds
        self.copter.info(f"Delaying {int(seconds)} sec")

    def _wait(self, _: MissionItem) -> None:
        self._condition_from = self.copter.now

    def _ignore(self, _: MissionItem) -> None:
        pass

    def _turn(self, item: MissionItem) -> None:
        heading, direction = math.radians(item.param1), int(item.param3)
        if item.param4 > 0:
            heading = self.copter.motion.yaw + math.copysign(heading, direction or 1.0)
            direction = 0
        self.copter.yaw.fixed(wrap_pi(heading), math.radians(item.param2), direction)

    def _change_speed(self, item: MissionItem) -> None:
        if item.param2 <= 0:
            return
        if item.param1 == SpeedType.CLIMB_SPEED:
            self.climb = item.param2
        elif item.param1 == SpeedType.DESCENT_SPEED:
            self.descent = item.param2
        else:
            self.speed = item.param2

    def _set_home(self, item: MissionItem) -> None:
        navigation, motion = self.copter.navigation, self.copter.motion
        point: Ned | None = motion.place
        if item.param1 != 1 and (item.x, item.y, item.z) != (0, 0, 0):
            point = self.copter.point(int(item.x), int(item.y), item.z, item.frame)
        if point is not None:
            navigation.set_home(point, lock=False)

    def _look_at(self, item: MissionItem) -> None:
        nowhere = (item.x, item.y, item.z) == (0, 0, 0)
        point = None if nowhere else self.copter.point(int(item.x), int(item.y), item.z, MavFrame.GLOBAL)
        self.copter.yaw.region_of_interest(point)
