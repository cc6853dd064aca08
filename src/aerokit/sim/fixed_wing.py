"""How a simulated aeroplane moves: a point mass that flies where its nose points, through air that moves.

What it does: limits of airspeed, climb, sink, bank and load; turns whose radius follows from bank and speed; wind, for
which it crabs; rolling on the ground before the take-off and after the landing. What it does not: lift and drag,
stalls, sideslip, a propeller, ground that is not level.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from aerokit.sim.motion import GRAVITY_M_S2, Motion, Wind, wrap_pi

_BANK_TIME_CONSTANT_S = 0.4
_CLIMB_TIME_CONSTANT_S = 0.7
_PITCH_TIME_CONSTANT_S = 0.3
_TURN_GAIN_PER_S = 0.8
_HEIGHT_GAIN_PER_S = 0.4
_ANGLE_OF_ATTACK_RAD = math.radians(2.0)
_STOPPED_M_S = 0.3


@dataclass
class WingLimits:
    """What airframe and controller settings allow."""

    airspeed_min_m_s: float = 10.0
    airspeed_max_m_s: float = 30.0
    acceleration_m_s2: float = 3.0
    roll_out_m_s2: float = 2.0
    """Deceleration on the ground."""
    climb_m_s: float = 5.0
    sink_m_s: float = 5.0
    glide_sink_m_s: float = 2.0
    """How fast it comes down without power."""
    vertical_acceleration_m_s2: float = 3.0
    bank_rad: float = math.radians(45.0)


class FixedWing(Motion):
    """Say what to do with `bank_and_climb`, `head`, `fly_to`, `circle` or `roll_out`; ``step`` does it.

    It begins at rest on the ground, where it rolls straight on until it is fast enough and a climb is wanted. The
    names of `Motion` for position, velocity and attitude are kept.
    """

    north: float
    east: float
    down: float

    roll: float
    pitch: float

    def __init__(self, rng: random.Random, wing: WingLimits | None = None, wind: Wind | None = None) -> None:
        super().__init__(rng, wind=wind)
        self.wing: WingLimits = wing if wing is not None else WingLimits()
        self.throttle: float = 0.0
        """0 to 1: what the engine gives."""
        self._speed = 0.0
        self._wanted_airspeed = 0.0
        self._wanted_bank = 0.0
        self._wanted_climb = 0.0

    def bank_and_climb(self, airspeed: float, bank: float, climb: float) -> None:
        """Keep an airspeed (m/s), a bank angle (rad, right is positive) and a climb (m/s)."""
        limit = self.wing.bank_rad
        self._wanted_airspeed = airspeed
        self._wanted_bank = max(-limit, min(limit, bank))
        self._wanted_climb = max(-self.wing.sink_m_s, min(self.wing.climb_m_s, climb))

    def head(self, course: float, airspeed: float, climb: float, *, turn_rate: float = 0.0) -> None:
        """Fly a course over the ground (rad from north) against the wind; ``turn_rate`` is how fast that changes."""
        speed = max(self._speed, self.wing.airspeed_min_m_s)
        north, east = self._air_movement()
        across = -north * math.sin(course) + east * math.cos(course)
        heading = course - math.asin(max(-0.9, min(0.9, across / speed)))
        rate = turn_rate + _TURN_GAIN_PER_S * wrap_pi(heading - self.yaw)
        self.bank_and_climb(airspeed, math.atan(speed * rate / GRAVITY_M_S2), climb)

    def fly_to(self, north: float, east: float, down: float, *, airspeed: float) -> None:
        """Fly towards a point, and over it: an aeroplane does not stop there."""
        course = math.atan2(east - self.east, north - self.north)
        self.head(course, airspeed, self.climb_to(down))

    def circle(self, north: float, east: float, down: float, *, radius: float, airspeed: float) -> None:
        """Fly around a point, ``radius`` metres away; a negative one is anticlockwise."""
        size, way = max(1.0, abs(radius)), math.copysign(1.0, radius)
        distance = math.hypot(north - self.north, east - self.east)
        inward = math.atan2(east - self.east, north - self.north)
        # Far away straight towards the circle's edge, on it along the tangent.
        share = max(-1.0, min(1.0, (distance - size) / size))
        course = inward - way * (math.pi / 2) * (1.0 - share)
        rate = way * self.ground_speed_m_s / size if distance < 1.5 * size else 0.0
        self.head(course, airspeed, self.climb_to(down), turn_rate=rate)

    def roll_out(self) -> None:
        """Come to a stop on the ground."""
        self.bank_and_climb(0.0, 0.0, 0.0)

    def climb_to(self, down: float) -> float:
        """The climb in m/s that leads to a height."""
        return _HEIGHT_GAIN_PER_S * (self.down - down)

    @property
    def is_at_rest(self) -> bool:
        return self.is_on_ground and self._speed < _STOPPED_M_S

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Move on by ``dt`` seconds; without power it glides down."""
        if self.wind.gusts_m_s > 0.0:
            self._blow(dt)
        was_on_ground = self.is_on_ground
        before = (self.velocity_north, self.velocity_east, self.velocity_down)
        if was_on_ground and not self._lifts_off(powered=powered):
            self._roll_on_ground(dt, powered=powered)
        else:
            self._fly(dt, powered=powered)
            if self.is_on_ground and self.velocity_down >= 0.0 and not was_on_ground:
                self._touch_down()
        self._differentiate(before, dt)

    def settle(self) -> None:
        super().settle()
        self._speed = self.throttle = 0.0
        self.roll_out()

    def _lifts_off(self, *, powered: bool) -> bool:
        return powered and self._wanted_climb > 0.0 and self._speed >= self.wing.airspeed_min_m_s

    def _roll_on_ground(self, dt: float, *, powered: bool) -> None:
        wanted = self._wanted_airspeed if powered else 0.0
        self._approach_speed(wanted, dt)
        self.throttle = 1.0 if powered and wanted > self._speed else 0.0
        self.roll = self.pitch = 0.0
        self.roll_rate = self.pitch_rate = self.yaw_rate = 0.0
        self.velocity_north, self.velocity_east = self._along_nose(self._speed)
        self.velocity_down, self.down = 0.0, self.ground_down
        self._advance(dt)

    def _fly(self, dt: float, *, powered: bool) -> None:
        wing = self.wing
        wanted_climb = self._wanted_climb if powered else -wing.glide_sink_m_s
        wanted = max(wing.airspeed_min_m_s, min(wing.airspeed_max_m_s, self._wanted_airspeed))
        self._approach_speed(wanted if powered else 1.3 * wing.airspeed_min_m_s, dt)
        self._bank(self._wanted_bank if powered else 0.0, dt)
        rate = (-wanted_climb - self.velocity_down) / _CLIMB_TIME_CONSTANT_S
        limit = wing.vertical_acceleration_m_s2
        self.velocity_down += max(-limit, min(limit, rate)) * dt
        self._tilt(dt)
        level = math.sqrt(max(0.0, self._speed * self._speed - self.velocity_down * self.velocity_down))
        air_north, air_east = self._air_movement()
        north, east = self._along_nose(level)
        self.velocity_north: float = north + air_north
        self.velocity_east: float = east + air_east
        self._advance(dt)
        climb_share = -self.velocity_down / wing.climb_m_s
        self.throttle = max(0.0, min(1.0, 0.45 + 0.5 * climb_share)) if powered else 0.0

    def _touch_down(self) -> None:
        self.impact_speed_m_s: float = self.velocity_down
        self._speed = self.ground_speed_m_s
        self.down = self.ground_down
        self.velocity_down: float = 0.0
        self.roll = self.pitch = 0.0

    def _approach_speed(self, wanted: float, dt: float) -> None:
        down = self.wing.roll_out_m_s2 if self.is_on_ground else self.wing.acceleration_m_s2
        self._speed += max(-down * dt, min(self.wing.acceleration_m_s2 * dt, wanted - self._speed))

    def _bank(self, wanted: float, dt: float) -> None:
        step = (wanted - self.roll) * min(1.0, dt / _BANK_TIME_CONSTANT_S)
        self.roll += step
        self.roll_rate: float = step / dt
        self.yaw_rate: float = GRAVITY_M_S2 * math.tan(self.roll) / max(self._speed, 1.0)
        self.yaw: float = wrap_pi(self.yaw + self.yaw_rate * dt)

    def _tilt(self, dt: float) -> None:
        slope = math.asin(max(-0.7, min(0.7, -self.velocity_down / max(self._speed, 1.0))))
        step = (slope + _ANGLE_OF_ATTACK_RAD - self.pitch) * min(1.0, dt / _PITCH_TIME_CONSTANT_S)
        self.pitch += step
        self.pitch_rate: float = step / dt

    def _along_nose(self, speed: float) -> tuple[float, float]:
        return speed * math.cos(self.yaw), speed * math.sin(self.yaw)

    def _air_movement(self) -> tuple[float, float]:
        return self.wind.north_m_s + self._gust_north, self.wind.east_m_s + self._gust_east

    def _advance(self, dt: float) -> None:
        self.north += self.velocity_north * dt
        self.east += self.velocity_east * dt
        self.down += self.velocity_down * dt

    def _differentiate(self, before: tuple[float, float, float], dt: float) -> None:
        self.acceleration_north: float = (self.velocity_north - before[0]) / dt
        self.acceleration_east: float = (self.velocity_east - before[1]) / dt
        self.acceleration_down: float = (self.velocity_down - before[2]) / dt
