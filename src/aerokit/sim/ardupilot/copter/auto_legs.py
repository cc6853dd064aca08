"""What an ArduCopter does at one time in a mission: go somewhere, fly circles, come down, stay."""

from __future__ import annotations

import math
from typing import Protocol

from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import TakeOff
from aerokit.sim.ardupilot.copter.returning import Rtl, sink
from aerokit.sim.local_frame import Ned

_STOPPED_M = 0.3
_TO_EDGE_M = 3.0
_TAKE_OFF_WITHOUT_THROTTLE = 2
_THROTTLE_RAISED = 1100


class Limits(Protocol):
    """Speeds in m/s that may change on the way."""

    speed: float
    climb: float
    descent: float
    may_lift_off: bool
    """Whether a take-off may begin."""


class Leg(Protocol):
    """``update`` tells the motion what to do for the next ``dt`` seconds."""

    def update(self, dt: float) -> None: ...

    @property
    def is_complete(self) -> bool:
        """Whether the aim is reached."""
        ...


class Stay:
    """Keep still; on the ground the motors idle."""

    is_complete = False

    def __init__(self, copter: CopterHost) -> None:
        self._copter = copter

    def update(self, dt: float) -> None:
        self._copter.motors.wanted = not self._copter.is_landed
        self._copter.motion.seek_velocity(0.0, 0.0, 0.0)


class Way:
    """Straight to a place. With ``stops`` the place itself counts, else WPNAV_RADIUS around it."""

    def __init__(self, copter: CopterHost, limits: Limits, destination: Ned, *, stops: bool) -> None:
        self._copter, self._limits = copter, limits
        self.destination = destination
        self._radius = _STOPPED_M if stops else copter.parameters["WPNAV_RADIUS"] / 100.0
        self.is_complete: bool = False

    def update(self, dt: float) -> None:
        """Fly on, and stay when it is reached."""
        copter, limits, motion = self._copter, self._limits, self._copter.motion
        copter.motors.wanted = not copter.is_landed
        if copter.is_landed:
            return
        motion.seek_position(
            *self.destination, speed=limits.speed, climb=limits.climb, descent=limits.descent
        )
        away = math.dist(self.destination, motion.place)
        self.is_complete = self.is_complete or away <= self._radius


class Circle:
    """To the edge of a circle, and around as often as wanted; a negative radius turns to the left."""

    def __init__(
        self, copter: CopterHost, limits: Limits, centre: Ned, *, turns: float, radius: float
    ) -> None:
        self._copter, self._turns = copter, turns
        self._centre = centre
        self._radius = abs(radius) or copter.parameters["CIRCLE_RADIUS"] / 100.0
        self._rate = math.copysign(math.radians(copter.parameters["CIRCLE_RATE"]), radius)
        motion = copter.motion
        north, east = motion.north - centre[0], motion.east - centre[1]
        self._angle = math.atan2(east, north)
        self._done = 0.0
        self._said = -1
        self._way: Way | None = None
        if (
            abs(math.hypot(north, east) - self._radius) > _TO_EDGE_M
            or abs(motion.down - centre[2]) > _TO_EDGE_M
        ):
            self._way = Way(copter, limits, self._point(), stops=True)

    @property
    def is_complete(self) -> bool:
        return self._way is None and self._done / math.tau >= self._turns

    def update(self, dt: float) -> None:
        if self._way is not None:
            self._way.update(dt)
            if self._way.is_complete:
                self._way = None
            return
        motion, rate = self._copter.motion, self._limited_rate()
        self._say()
        self._angle += rate * dt
        self._done += abs(rate) * dt
        self._say()
        point, speed = self._point(), rate * self._radius
        motion.seek_velocity(
            point[0] - motion.north - speed * math.sin(self._angle),
            point[1] - motion.east + speed * math.cos(self._angle),
            point[2] - motion.down,
        )

    def _limited_rate(self) -> float:
        fastest = math.sqrt(0.7 * self._copter.motion.limits.acceleration_m_s2 / max(0.5, self._radius))
        return math.copysign(min(abs(self._rate), fastest), self._rate)

    def _point(self) -> Ned:
        north = self._centre[0] + self._radius * math.cos(self._angle)
        return (north, self._centre[1] + self._radius * math.sin(self._angle), self._centre[2])

    def _say(self) -> None:
        number = int(self._done / math.tau)
        if number > self._said:
            self._said = number
            self._copter.info(f"Mission: starting circle {number + 1}/{int(self._turns)}")


class Climb:
    """A take-off; on the ground it waits for MISSION_START, a raised throttle or AUTO_OPTIONS."""

    def __init__(self, copter: CopterHost, limits: Limits, altitude_m: float) -> None:
        self._copter, self._limits = copter, limits
        self._take_off = TakeOff(copter, altitude_m)

    @property
    def is_complete(self) -> bool:
        return self._take_off.is_complete

    def update(self, dt: float) -> None:
        """Wait, lift off, climb."""
        copter, limits = self._copter, self._limits
        options = int(copter.parameters["AUTO_OPTIONS"])
        if copter.rc[2] > _THROTTLE_RAISED or options & _TAKE_OFF_WITHOUT_THROTTLE:
            limits.may_lift_off = True
        if not copter.is_landed or limits.may_lift_off:
            self._take_off.update(limits.climb)


class Return(Rtl):
    """RTL as a part of a mission."""

    @property
    def is_complete(self) -> bool:
        """Down, and the motors idle."""
        return self.copter.is_landed and self.copter.motors.is_idle


class Descent:
    """Straight down, with the speeds of LAND; complete when it is down and the motors idle."""

    def __init__(self, copter: CopterHost) -> None:
        self._copter = copter

    @property
    def is_complete(self) -> bool:
        return self._copter.is_landed and self._copter.motors.is_idle

    def update(self, dt: float) -> None:
        """Come down, or let the motors idle."""
        if self._copter.is_landed:
            self._copter.motors.wanted = False
        else:
            sink(self._copter)
