"""LAND, RTL and SMART_RTL: the ways down and home."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CopterMode
from aerokit.sim.ardupilot.modes import Mode

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter import SimulatedCopter
    from aerokit.sim.ardupilot.navigation import Ned

__all__ = ["Land", "Rtl", "SmartRtl", "sink"]

_RTL_LOWEST_M = 2.0
_ARRIVED_M = 0.5


class Land(Mode):
    """Comes straight down: WPNAV_SPEED_DN to LAND_ALT_LOW, then LAND_SPEED; disarms when it is down."""

    number = CopterMode.LAND
    name = "LAND"
    needs_position = False
    can_arm = False
    is_landing = True

    def enter(self, *, force: bool) -> bool:
        """Keep the heading."""
        self.copter.yaw.hold()
        return True

    def update(self, dt: float) -> None:
        """Descend, then stop the motors."""
        descend(self.copter)


def descend(copter: SimulatedCopter) -> None:
    """One step of a landing."""
    if not copter.is_landed:
        sink(copter)
        return
    copter.motors.wanted = False
    if copter.motors.is_armed and copter.motors.is_idle:
        copter.arming.disarm()


def sink(copter: SimulatedCopter) -> None:
    """Straight down, slowly at last."""
    parameters = copter.parameters
    copter.motors.wanted = True
    speed = parameters["LAND_SPEED"] / 100.0
    if copter.navigation.altitude_above_home > parameters["LAND_ALT_LOW"] / 100.0:
        speed = (parameters["LAND_SPEED_HIGH"] or parameters["WPNAV_SPEED_DN"]) / 100.0
    copter.motion.seek_velocity(0.0, 0.0, speed)


class Rtl(Mode):
    """Climbs to RTL_ALT (less when it is close to home), flies home, waits RTL_LOIT_TIME and lands."""

    number = CopterMode.RTL
    name = "RTL"
    can_arm = False
    can_change_speed = True

    def __init__(self, copter: SimulatedCopter) -> None:
        super().__init__(copter)
        self._phase = "climb"
        self._altitude_down = 0.0
        self._waiting_since = 0.0
        self.speed = 0.0

    def enter(self, *, force: bool) -> bool:
        """Plan the way home."""
        self._phase, self.is_landing = "climb", False
        parameters = self.copter.parameters
        self.speed = (parameters["RTL_SPEED"] or parameters["WPNAV_SPEED"]) / 100.0
        north, east, down = self._home()
        self._altitude_down = down - self.return_altitude(
            math.hypot(north - self.copter.motion.north, east - self.copter.motion.east)
        )
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
        """Home, at the height of the present phase."""
        north, east, down = self._home()
        if self._phase == "climb":
            return (self.copter.motion.north, self.copter.motion.east, self._altitude_down)
        return (north, east, down if self._phase == "land" else self._altitude_down)

    def update(self, dt: float) -> None:
        """One step of the present phase."""
        copter = self.copter
        if copter.is_landed or self._phase == "land":
            descend(copter)
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
        self._go_on(math.dist(target, (copter.motion.north, copter.motion.east, copter.motion.down)))

    def _go_on(self, distance: float) -> None:
        if self._phase == "climb" and distance < _ARRIVED_M:
            self._phase = "return"
        elif self._phase == "return" and distance < _ARRIVED_M:
            self._phase, self._waiting_since = "wait", self.copter.now
        elif self._phase == "wait":
            waited = self.copter.now - self._waiting_since
            if waited >= self.copter.parameters["RTL_LOIT_TIME"] / 1000.0:
                self._phase, self.is_landing = "land", True

    def _home(self) -> Ned:
        home = self.copter.navigation.home
        return (0.0, 0.0, self.copter.motion.ground_down) if home is None else home


class SmartRtl(Rtl):
    """Straight home at the present height; the recorded path of the real mode is not simulated."""

    number = CopterMode.SMART_RTL
    name = "SMARTRTL"
    can_change_speed = False

    def return_altitude(self, distance: float) -> float:
        """As high as it is."""
        return max(self.copter.navigation.altitude_above_home, _RTL_LOWEST_M)
