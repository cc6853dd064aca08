"""LAND, RTL and SMART_RTL: the ways down and home."""

from __future__ import annotations

import math

from aerokit.mavlink.enums import CopterMode
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import Mode
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.local_frame import Ned

_RTL_LOWEST_M = 2.0
_ARRIVED_M = 0.5
_SMART_RTL_HIGHER_M = 2.0


class Land(Mode):
    """Comes straight down: WPNAV_SPEED_DN to LAND_ALT_LOW, then LAND_SPEED; disarms when it is down."""

    number: int = CopterMode.LAND
    name = "LAND"
    needs_position = False
    can_arm = False
    is_landing = True

    def enter(self, *, force: bool) -> bool:
        self.copter.yaw.hold()
        return True

    def update(self, dt: float) -> None:
        descend(self.copter)


def descend(copter: CopterHost) -> None:
    if not copter.is_landed:
        sink(copter)
        return
    copter.motors.wanted = False
    if copter.motors.is_armed and copter.motors.is_idle:
        copter.arming.disarm()


def sink(copter: CopterHost) -> None:
    parameters = copter.parameters
    copter.motors.wanted = True
    speed = parameters["LAND_SPEED"] / 100.0
    if copter.navigation.altitude_above_home > parameters["LAND_ALT_LOW"] / 100.0:
        speed = (parameters["LAND_SPEED_HIGH"] or parameters["WPNAV_SPEED_DN"]) / 100.0
    copter.motion.seek_velocity(0.0, 0.0, speed)


class Rtl(Mode):
    """Climbs to RTL_ALT (less when it is close), flies home or to a rally point, waits RTL_LOIT_TIME and lands."""

    number: int = CopterMode.RTL
    name = "RTL"
    can_arm = False
    can_change_speed = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._phase = "climb"
        self._altitude_down = 0.0
        self._waiting_since = 0.0
        self._place: Ned = (0.0, 0.0, 0.0)
        self.speed: float = 0.0

    def enter(self, *, force: bool) -> bool:
        self._phase, self.is_landing = "climb", False
        parameters = self.copter.parameters
        self.speed = (parameters["RTL_SPEED"] or parameters["WPNAV_SPEED"]) / 100.0
        copter, home = self.copter, self._home()
        self._place = best_return_place(copter, home, is_allowed=copter.fence.contains)
        north, east, down = self._place
        distance = math.hypot(north - copter.motion.north, east - copter.motion.east)
        self._altitude_down = min(down, home[2] - self.return_altitude(distance))
        self.copter.yaw.default(returning=True)
        return True

    def return_altitude(self, distance: float) -> float:
        """Metres above home at which it flies back."""
        parameters = self.copter.parameters
        now = self.copter.navigation.altitude_above_home
        target = max(now + parameters["RTL_CLIMB_MIN"] / 100.0, parameters["RTL_ALT"] / 100.0, _RTL_LOWEST_M)
        if parameters["RTL_CONE_SLOPE"] > 0:
            target = min(target, max(distance * parameters["RTL_CONE_SLOPE"], _RTL_LOWEST_M, now))
        return max(target, now)

    @property
    def destination(self) -> Ned | None:
        """Where it returns to, at the height of the present phase."""
        north, east, down = self._place
        if self._phase == "climb":
            return (self.copter.motion.north, self.copter.motion.east, self._altitude_down)
        return (north, east, down if self._phase == "land" else self._altitude_down)

    def update(self, dt: float) -> None:
        copter = self.copter
        if self._phase == "land":
            descend(copter)
            return
        if copter.is_landed:  # it waits for DISARM_DELAY
            copter.motors.wanted = False
            return
        copter.motors.wanted = True
        target = self.destination
        assert target is not None
        limits = copter.parameters
        copter.motion.seek_position(
            *target,
            speed=self.speed,
            climb=limits["WPNAV_SPEED_UP"] / 100,
            descent=limits["WPNAV_SPEED_DN"] / 100,
        )
        copter.yaw.update()
        self._go_on(math.dist(target, copter.motion.place))

    def _go_on(self, distance: float) -> None:
        if self._phase == "climb" and distance < _ARRIVED_M:
            self._phase = "return"
        elif self._phase == "return" and distance < _ARRIVED_M:
            self._phase, self._waiting_since = "wait", self.copter.now
        elif self._phase == "wait":
            waited = self.copter.now - self._waiting_since
            if waited >= self.copter.parameters["RTL_LOIT_TIME"] / 1000.0:
                self._phase = "land"
                self.is_landing: bool = True

    def _home(self) -> Ned:
        home = self.copter.navigation.home
        return (0.0, 0.0, self.copter.motion.ground_down) if home is None else home


class SmartRtl(Mode):
    """Back on the path it has come on, without its loops; above the beginning it lands. See `SmartPath`."""

    number: int = CopterMode.SMART_RTL
    name = "SMARTRTL"
    can_arm = False
    returns_on_path = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._way: list[Ned] = []

    def enter(self, *, force: bool) -> bool:
        if not self.copter.path.is_active:
            return False
        self._way, self.is_landing = self.copter.path.take_all(), False
        if self._way:
            north, east, down = self._way[-1]
            self._way[-1] = (north, east, down - _SMART_RTL_HIGHER_M)
        self.copter.yaw.default(returning=True)
        return True

    def leave(self) -> None:
        """What it has not reached is still the way back."""
        if self._way:
            north, east, down = self._way[-1]
            self.copter.path.put_back([*self._way[:-1], (north, east, down + _SMART_RTL_HIGHER_M)])

    @property
    def destination(self) -> Ned | None:
        return self._way[0] if self._way else None

    def update(self, dt: float) -> None:
        copter = self.copter
        if copter.is_landed or not self._way:
            self.is_landing: bool = True
            descend(copter)
            return
        copter.motors.wanted = True
        target, limits = self._way[0], copter.parameters
        copter.motion.seek_position(
            *target,
            speed=limits["WPNAV_SPEED"] / 100,
            climb=limits["WPNAV_SPEED_UP"] / 100,
            descent=limits["WPNAV_SPEED_DN"] / 100,
        )
        copter.yaw.update()
        near = _ARRIVED_M if len(self._way) == 1 else limits["WPNAV_RADIUS"] / 100
        if math.dist(target, copter.motion.place) < near:
            del self._way[0]
