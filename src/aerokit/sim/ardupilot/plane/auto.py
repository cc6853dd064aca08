"""AUTO: an ArduPlane flies its mission.

Simulated: take-off, waypoints, loitering for ever, for a time, for turns and to a height, landing, return to launch,
delays, speed, home, jumps; commands to servos, cameras and the like in passing. The others are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import MavCmd, MavSeverity, PlaneMode
from aerokit.mavlink.messages import MissionItemReached
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.plane.host import Landing, PlaneHost
from aerokit.sim.ardupilot.plane.modes import NavigatingMode, climb_out
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import wrap_pi

_C = MavCmd
_WAY, _LOITER, _CLIMB, _LAND = range(4)
_REACHED_HEIGHT_M = 5.0
_ON_CIRCLE = 1.3


class Auto(NavigatingMode):
    """The mission run says which command comes when; past the end it returns to launch."""

    number: int = PlaneMode.AUTO
    name = "AUTO"
    needs_mission = True
    can_change_speed = True

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self.may_lift_off = True
        self.is_paused = False
        self._does = _LOITER
        self._landing: Landing | None = None
        self._since = math.nan
        self._turned = 0.0
        self._last_bearing = 0.0
        self._condition_from = 0.0
        self._start: Ned = (0.0, 0.0, 0.0)
        self._handlers: dict[int, Callable[[MissionItem], None]] = {
            _C.NAV_TAKEOFF: self._take_off,
            _C.NAV_WAYPOINT: self._fly,
            _C.NAV_SPLINE_WAYPOINT: self._fly,
            _C.NAV_LOITER_UNLIM: self._loiter,
            _C.NAV_LOITER_TIME: self._loiter,
            _C.NAV_LOITER_TURNS: self._loiter,
            _C.NAV_LOITER_TO_ALT: self._loiter,
            _C.NAV_LAND: self._land,
            _C.NAV_RETURN_TO_LAUNCH: self._return,
            _C.CONDITION_DELAY: self._wait,
            _C.DO_CHANGE_SPEED: self._change_speed,
            _C.DO_SET_HOME: self._set_home,
            **dict.fromkeys((_C.DO_LAND_START, _C.DO_RETURN_PATH_START, _C.DO_FENCE_ENABLE), self._ignore),
        }

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        """Climbing by a take-off command."""
        return self._does == _CLIMB

    @property
    def is_landing(self) -> bool:  # type: ignore[override]
        """Coming down by a landing command."""
        return self._does == _LAND

    def enter(self, *, force: bool) -> bool:
        """Goes on with the mission; without one it returns at once."""
        plane = self.plane
        if plane.mode is self and plane.is_armed and plane.mission.is_running:
            return True
        super().enter(force=force)
        self._does = _LOITER
        plane.call_later(0.0, self._begin if plane.mission.is_present else self._return_at_once)
        return True

    def _begin(self) -> None:
        if self.plane.mode is self and not self.plane.mission.is_running:
            self.plane.mission.start_or_resume()

    def disarmed(self) -> None:
        """The place in the mission is forgotten."""

    def leave(self) -> None:
        """The mission stops where it is."""
        self.plane.mission.stop()

    def update(self, dt: float) -> None:
        plane = self.plane
        plane.mission.update()
        if plane.mode is not self:
            return
        if self._does == _CLIMB:
            climb_out(plane)
        elif self._does == _LAND:
            assert self._landing is not None
            self._landing.update(dt)
        elif self._does == _WAY and not plane.is_landed and self._place is not None:
            plane.wing.fly_to(*self._place, airspeed=self.airspeed)
        else:
            super().update(dt)
            self._count_turns()

    def _count_turns(self) -> None:
        wing = self.plane.wing
        if self._place is None:
            return
        bearing = math.atan2(wing.east - self._place[1], wing.north - self._place[0])
        if not math.isnan(self._since):
            self._turned += abs(wrap_pi(bearing - self._last_bearing))
        elif self._is_on_circle:
            self._since = self.plane.now
        self._last_bearing = bearing

    @property
    def _is_on_circle(self) -> bool:
        radius = abs(self.radius or self.plane.parameters["WP_LOITER_RAD"])
        return self._distance() < _ON_CIRCLE * radius

    def _distance(self) -> float:
        wing, place = self.plane.wing, self._place
        return 0.0 if place is None else math.hypot(place[0] - wing.north, place[1] - wing.east)

    def start_command(self, index: int, item: MissionItem) -> bool:
        handler = self._handlers.get(item.command)
        if handler is None:
            return False
        handler(item)
        return True

    def is_complete(self, index: int, item: MissionItem) -> bool:
        if self.plane.mode is not self or not self.plane.is_armed or not self._is_done(index, item):
            return False
        if item.command <= _C.NAV_LAST:
            self.plane.send(MissionItemReached(index))
        return True

    def end_mission(self) -> None:
        """Home; on the ground nothing."""
        if not self.plane.is_landed:
            self._return_at_once()

    def _return_at_once(self) -> None:
        if self.plane.mode is self:
            self.plane.info("Mission complete, changing mode to RTL")
            self.plane.set_mode(PlaneMode.RTL)

    def _is_done(self, index: int, item: MissionItem) -> bool:
        plane, command = self.plane, item.command
        if command == _C.NAV_TAKEOFF:
            return self._has_climbed()
        if command in (_C.NAV_WAYPOINT, _C.NAV_SPLINE_WAYPOINT):
            return self._has_passed(index)
        if command == _C.NAV_LOITER_TIME:
            return plane.now - self._since >= item.param1 and self._say("Loiter time complete")
        if command == _C.NAV_LOITER_TURNS:
            return self._turned >= 2 * math.pi * item.param1 and self._say("Loiter orbits complete")
        if command == _C.NAV_LOITER_TO_ALT:
            assert self._place is not None
            at_height = abs(plane.wing.down - self._place[2]) < _REACHED_HEIGHT_M
            return at_height and self._is_on_circle and self._say("Loiter to alt complete")
        if command == _C.CONDITION_DELAY:
            return plane.now - self._condition_from > max(0.0, item.param1)
        if command in (_C.NAV_LOITER_UNLIM, _C.NAV_LAND, _C.NAV_RETURN_TO_LAUNCH):
            return False
        if command not in self._handlers:
            plane.send_text(MavSeverity.WARNING, f"Skipping invalid cmd #{command}")
        return True

    def _say(self, text: str) -> bool:
        self.plane.info(text)
        return True

    def _has_climbed(self) -> bool:
        assert self._place is not None
        plane = self.plane
        if plane.wing.down > self._place[2]:
            return False
        return self._say(f"Takeoff complete at {plane.altitude_m:.2f}m")

    def _has_passed(self, index: int) -> bool:
        """Within WP_RADIUS, or beside the waypoint and beyond it."""
        assert self._place is not None
        wing, (north, east, _), start = self.plane.wing, self._place, self._start
        distance = self._distance()
        if distance <= self.plane.parameters["WP_RADIUS"]:
            return self._say(f"Reached waypoint #{index} dist {int(distance)}m")
        along = (north - start[0]) * (wing.north - north) + (east - start[1]) * (wing.east - east)
        return along > 0 and self._say(f"Passed waypoint #{index} dist {int(distance)}m")

    def _go(self, item: MissionItem, does: int) -> None:
        wing, before = self.plane.wing, self._place
        self._start = wing.place
        point = self.plane.point(int(item.x), int(item.y), item.z, item.frame) or self._start
        north, east = self._start[:2] if (item.x, item.y) == (0, 0) else point[:2]
        down = point[2] if item.z != 0 else (wing.down if before is None else before[2])
        self._place, self._does = (north, east, down), does
        self._since, self._turned, self.radius = math.nan, 0.0, 0.0

    def _fly(self, item: MissionItem) -> None:
        self._go(item, _WAY)

    def _take_off(self, item: MissionItem) -> None:
        self._go(item, _CLIMB)

    def _loiter(self, item: MissionItem) -> None:
        self._go(item, _LOITER)
        self.radius: float = item.param2 if item.command == _C.NAV_LOITER_TO_ALT else item.param3

    def _land(self, item: MissionItem) -> None:
        self._go(item, _LAND)
        wing, plane = self.plane.wing, self.plane
        point = plane.point(int(item.x), int(item.y), item.z, item.frame)
        north, east = self._start[:2] if point is None or (item.x, item.y) == (0, 0) else point[:2]
        self._landing = Landing(plane, (north, east, wing.ground_down if point is None else point[2]))
        plane.info(f"Landing approach start at {plane.altitude_m:.1f}m")

    def _return(self, _: MissionItem) -> None:
        """In the other mode (``start_command`` of ArduPlane's commands_logic.cpp); the mission stops at this item."""
        self.plane.set_mode(PlaneMode.RTL)

    def _wait(self, _: MissionItem) -> None:
        self._condition_from = self.plane.now

    def _ignore(self, _: MissionItem) -> None:
        pass

    def _change_speed(self, item: MissionItem) -> None:
        if self.plane.can_fly_at(item.param2):
            self.speed: float = item.param2
            self.plane.info(f"Set airspeed {item.param2:.0f} m/s")

    def _set_home(self, item: MissionItem) -> None:
        wing, plane = self.plane.wing, self.plane
        point: Ned | None = wing.place
        if item.param1 != 1:
            point = plane.point(int(item.x), int(item.y), item.z, item.frame)
        if point is not None:
            plane.navigation.set_home(point, lock=False)
