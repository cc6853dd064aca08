"""How rovers, boats and submarines move."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from aerokit.sim.motion import Motion, MotionLimits, Wind, approach_speed, wrap_pi

_SPEED_TIME_CONSTANT_S = 0.3
_HEADING_GAIN_PER_S = 2.0
_SLOW_M_S = 1.0
_BESIDE_RAD = math.pi / 2


@dataclass
class GroundLimits:
    """What wheels and steering allow."""

    acceleration_m_s2: float = 1.0
    top_speed_m_s: float = 10.0
    turn_rate_rad_s: float = math.radians(120.0)
    turn_radius_m: float = 0.9
    sideways_m_s2: float = 5.9


class GroundMotion(Motion):
    """One of `drive`, `head`, `drive_to` and `stop` says what to do next; it keeps the rest of `Motion`'s names."""

    north: float
    east: float
    down: float

    speed_m_s: float

    def __init__(
        self, rng: random.Random, wheels: GroundLimits | None = None, wind: Wind | None = None
    ) -> None:
        super().__init__(rng, wind=wind)
        self.wheels: GroundLimits = wheels if wheels is not None else GroundLimits()
        self.speed_m_s = 0.0
        """Forwards; negative is backwards."""
        self._wanted_speed = 0.0
        self._rate = 0.0
        self._heading: float | None = None

    def stop(self) -> None:
        self.drive(0.0, 0.0)

    def drive(self, speed: float, turn_rate: float) -> None:
        """Speed in m/s (negative: backwards) and turn rate in rad/s."""
        self._wanted_speed, self._rate, self._heading = speed, turn_rate, None

    def head(self, speed: float, heading: float) -> None:
        """Drive at this speed towards this heading in radians."""
        self._wanted_speed, self._rate, self._heading = speed, 0.0, heading

    def drive_to(
        self, north: float, east: float, *, speed: float, stops: bool = True, backwards: bool = False
    ) -> None:
        """Towards a point with at most this speed in m/s; ``stops``: brake so that it stands there."""
        north, east = north - self.north, east - self.east
        distance = math.hypot(north, east)
        if stops:
            speed = min(speed, approach_speed(distance, 1.0, self.wheels.acceleration_m_s2))
        course = math.atan2(east, north)
        if backwards:
            self.head(-speed, course + math.pi)
            return
        off = abs(wrap_pi(course - self.yaw))
        self.head(min(speed, _SLOW_M_S) if off > _BESIDE_RAD else speed, course)

    @property
    def airspeed_m_s(self) -> float:
        """A rover has no pitot tube: always 0."""
        return 0.0

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Drive on by ``dt`` seconds; without power it rolls out."""
        rate = self._turn_rate()
        self._accelerate(self._curve_speed(rate) if powered else 0.0, dt)
        middle = self.yaw + 0.5 * rate * dt
        self.yaw: float = wrap_pi(self.yaw + rate * dt)
        self.yaw_rate: float = rate
        north, east = self.speed_m_s * math.cos(middle), self.speed_m_s * math.sin(middle)
        self.acceleration_north: float = (north - self.velocity_north) / dt
        self.acceleration_east: float = (east - self.velocity_east) / dt
        self.velocity_north: float = north
        self.velocity_east: float = east
        self.north += north * dt
        self.east += east * dt

    def settle(self) -> None:
        super().settle()
        self.speed_m_s = 0.0
        self.stop()

    def _turn_rate(self) -> float:
        wheels, rate = self.wheels, self._rate
        if self._heading is not None:
            rate = _HEADING_GAIN_PER_S * wrap_pi(self._heading - self.yaw)
        most = min(wheels.turn_rate_rad_s, abs(self.speed_m_s) / wheels.turn_radius_m)
        return max(-most, min(most, rate))

    def _curve_speed(self, rate: float) -> float:
        most = self.wheels.top_speed_m_s
        if rate:
            most = min(most, max(_SLOW_M_S, self.wheels.sideways_m_s2 / abs(rate)))
        return max(-most, min(most, self._wanted_speed))

    def _accelerate(self, wanted: float, dt: float) -> None:
        change = (wanted - self.speed_m_s) * min(1.0, dt / _SPEED_TIME_CONSTANT_S)
        most = self.wheels.acceleration_m_s2 * dt
        braking = abs(wanted) < abs(self.speed_m_s)
        if braking:
            most *= 2.0
        self.speed_m_s += max(-most, min(most, change))


_DRAG_PER_S = 1.0
_LIMITS = MotionLimits(
    acceleration_m_s2=1.0, vertical_acceleration_m_s2=1.0, turn_rate_rad_s=math.radians(60.0), lean_rad=0.0
)


class UnderwaterMotion(Motion):
    """``down`` is the depth; ``bottom_down`` is where the bottom is, ``ground_down`` is the water's surface.

    ``buoyancy_m_s2`` is what lifts it when no thruster holds it.
    """

    def __init__(self, rng: random.Random, *, bottom_down: float = 200.0, buoyancy_m_s2: float = 0.1) -> None:
        super().__init__(rng, limits=_LIMITS)
        self.bottom_down = bottom_down
        self.buoyancy_m_s2 = buoyancy_m_s2
        self._is_floating = False

    @property
    def is_on_ground(self) -> bool:
        return False

    @property
    def is_at_surface(self) -> bool:
        return self.down <= self.ground_down

    @property
    def is_still(self) -> bool:
        """Whether it floats at the surface and does not move."""
        speed = math.hypot(self.velocity_north, self.velocity_east, self.velocity_down)
        return self.is_at_surface and speed < 0.01

    @property
    def airspeed_m_s(self) -> float:
        """Speed through the water is what the telemetry says here."""
        return math.hypot(self.velocity_north, self.velocity_east)

    def seek_velocity(self, north: float, east: float, down: float) -> None:
        super().seek_velocity(north, east, down)
        self._is_floating = False

    def push(self, north: float, east: float) -> None:
        """Move at this horizontal velocity and leave the depth to the buoyancy."""
        super().seek_velocity(north, east, 0.0)
        self._is_floating = True

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Move on by ``dt`` seconds; without power it drifts upwards."""
        lift = -self.buoyancy_m_s2 - _DRAG_PER_S * self.velocity_down
        if powered:
            north, east, down = self._commanded_acceleration()
            down = lift if self._is_floating else down
        else:
            north, east, down = -_DRAG_PER_S * self.velocity_north, -_DRAG_PER_S * self.velocity_east, lift
        self._integrate(north, east, down, dt)
        self._turn(dt, powered=powered)

    def _integrate(self, north: float, east: float, down: float, dt: float) -> None:
        super()._integrate(north, east, down, dt)
        if self.down < self.ground_down:
            self.down, self.velocity_down = self.ground_down, max(0.0, self.velocity_down)
        elif self.down > self.bottom_down:
            self.down: float = self.bottom_down
            self.velocity_down: float = min(0.0, self.velocity_down)
