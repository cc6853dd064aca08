"""Motion of simulated planes, rovers, boats and submarines.

A plane is a point mass that moves in the direction of its nose through moving air. Modelled: limits of airspeed, climb,
sink, bank and load; turn radius from bank and speed; wind correction; take-off and landing roll. Not modelled: lift
and drag, stalls, sideslip, propellers, uneven ground.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from aerokit.sim.motion import GRAVITY_M_S2, Motion, MotionLimits, Ned, SimulatedWind, approach_speed, wrap_pi

_BANK_TIME_CONSTANT_S = 0.4
_CLIMB_TIME_CONSTANT_S = 0.7
_PITCH_TIME_CONSTANT_S = 0.3
_TURN_GAIN_PER_S = 0.8
_HEIGHT_GAIN_PER_S = 0.4
_ANGLE_OF_ATTACK_RAD = math.radians(2.0)
_GLIDE_SPEED_FACTOR = 1.3  # The airspeed of a glide without power, divided by the minimum airspeed.
_MAX_SLOPE = 0.7  # sine of the steepest path
_STOPPED_M_S = 0.3


@dataclass
class WingLimits:
    """Limits of the airframe and its controller."""

    airspeed_min_m_s: float = 10.0
    airspeed_max_m_s: float = 30.0
    acceleration_m_s2: float = 3.0
    roll_out_m_s2: float = 2.0
    """Deceleration while the plane rolls to a stop on the ground."""
    climb_m_s: float = 5.0
    sink_m_s: float = 5.0
    glide_sink_m_s: float = 2.0
    """Sink rate without power."""
    vertical_acceleration_m_s2: float = 3.0
    bank_rad: float = math.radians(45.0)


class FixedWing(Motion):
    """Motion of a plane. Methods such as `head`, `fly_to` and `circle` set the target; ``step`` moves the plane.

    The plane starts at rest on the ground. It lifts off at its minimum airspeed, if a climb is requested.
    """

    north: float
    east: float
    down: float
    roll: float
    pitch: float

    def __init__(self, rng: random.Random, wing: WingLimits | None = None, wind: SimulatedWind | None = None) -> None:
        super().__init__(rng, wind=wind)
        self.wing_limits: WingLimits = wing if wing is not None else WingLimits()
        self.throttle: float = 0.0
        """Engine throttle, 0 to 1."""
        self._speed = 0.0  # airspeed in flight, ground speed on the ground
        self._wanted_airspeed = 0.0
        self._wanted_bank = 0.0
        self._wanted_climb = 0.0

    @property
    def stopping_place(self) -> Ned:
        """The present place. A plane cannot stop, so it circles there."""
        return self.place

    def bank_and_climb(self, airspeed: float, bank: float, climb: float) -> None:
        """Hold an airspeed in m/s, a bank angle in radians (positive to the right) and a climb rate in m/s."""
        limit = self.wing_limits.bank_rad
        self._wanted_airspeed = airspeed
        self._wanted_bank = max(-limit, min(limit, bank))
        self._wanted_climb = max(-self.wing_limits.sink_m_s, min(self.wing_limits.climb_m_s, climb))

    def head(self, course: float, airspeed: float, climb: float, *, turn_rate: float = 0.0) -> None:
        """Fly a ground course (radians from north) with wind correction. The course changes at ``turn_rate`` rad/s."""
        speed = max(self._speed, self.wing_limits.airspeed_min_m_s)
        wind_north, wind_east = self._air_movement()
        crosswind = -wind_north * math.sin(course) + wind_east * math.cos(course)
        # The crosswind may be faster than the plane, but the argument of asin must not exceed 1.
        wind_correction = math.asin(max(-0.9, min(0.9, crosswind / speed)))
        heading = course - wind_correction
        heading_rate = turn_rate + _TURN_GAIN_PER_S * wrap_pi(heading - self.yaw)
        bank = math.atan(speed * heading_rate / GRAVITY_M_S2)  # In a level turn, tan(bank) = speed * rate / gravity.
        self.bank_and_climb(airspeed, bank, climb)

    def fly_to(self, north: float, east: float, down: float, *, airspeed: float) -> None:
        """Fly towards a point, without slowing down or circling there."""
        self.head(self.bearing_to((north, east, down)), airspeed, self.climb_rate_to(down))

    def circle(self, north: float, east: float, down: float, *, radius: float, airspeed: float) -> None:
        """Circle a point. A negative radius is counter-clockwise."""
        turn_sign = math.copysign(1.0, radius)
        radius = max(1.0, abs(radius))
        center = (north, east, down)
        distance, course_to_center = self.distance_to(center), self.bearing_to(center)
        # Far away, the course points to the center. On the circle, the course is the tangent. In between, the course
        # changes gradually from the direction of the center to the tangent.
        share_to_center = max(-1.0, min(1.0, (distance - radius) / radius))
        course = course_to_center - turn_sign * (math.pi / 2) * (1.0 - share_to_center)
        is_near_circle = distance < 1.5 * radius
        turn_rate = turn_sign * self.ground_speed_m_s / radius if is_near_circle else 0.0
        self.head(course, airspeed, self.climb_rate_to(down), turn_rate=turn_rate)

    def roll_out(self) -> None:
        self.bank_and_climb(0.0, 0.0, 0.0)

    def climb_rate_to(self, down: float) -> float:
        return _HEIGHT_GAIN_PER_S * (self.down - down)

    @property
    def is_at_rest(self) -> bool:
        return self.is_on_ground and self._speed < _STOPPED_M_S

    def step(self, dt: float, *, powered: bool = True) -> None:
        if self.wind.gusts_m_s > 0.0:
            self._update_gusts(dt)
        was_on_ground = self.is_on_ground
        velocity_before = self.velocity
        lifts_off = powered and self._wanted_climb > 0.0 and self._speed >= self.wing_limits.airspeed_min_m_s
        if was_on_ground and not lifts_off:
            self._taxi(dt, powered=powered)
        else:
            self._fly(dt, powered=powered)
            if self.is_on_ground and self.velocity_down >= 0.0 and not was_on_ground:
                self._touch_down()
        self._set_acceleration(velocity_before, dt)

    def settle(self) -> None:
        super().settle()
        self._speed = self.throttle = 0.0
        self.roll_out()

    def _taxi(self, dt: float, *, powered: bool) -> None:
        wanted_speed = self._wanted_airspeed if powered else 0.0
        self._change_airspeed(wanted_speed, dt)
        self.throttle = 1.0 if powered and wanted_speed > self._speed else 0.0
        self.roll = self.pitch = 0.0
        self.roll_rate = self.pitch_rate = self.yaw_rate = 0.0
        self.velocity_north, self.velocity_east = self._along_nose(self._speed)
        self.velocity_down = 0.0
        self.down = self.ground_down
        self._advance(dt)

    def _fly(self, dt: float, *, powered: bool) -> None:
        wing = self.wing_limits
        wanted_climb = self._wanted_climb if powered else -wing.glide_sink_m_s
        wanted_speed = max(wing.airspeed_min_m_s, min(wing.airspeed_max_m_s, self._wanted_airspeed))
        self._change_airspeed(wanted_speed if powered else _GLIDE_SPEED_FACTOR * wing.airspeed_min_m_s, dt)
        self._bank(self._wanted_bank if powered else 0.0, dt)
        acceleration_down = (-wanted_climb - self.velocity_down) / _CLIMB_TIME_CONSTANT_S
        limit = wing.vertical_acceleration_m_s2
        self.velocity_down += max(-limit, min(limit, acceleration_down)) * dt
        self._pitch(dt)
        horizontal_speed = math.sqrt(max(0.0, self._speed * self._speed - self.velocity_down * self.velocity_down))
        air_north, air_east = self._air_movement()
        north, east = self._along_nose(horizontal_speed)
        self.velocity_north: float = north + air_north
        self.velocity_east: float = east + air_east
        self._advance(dt)
        # A throttle of 45 % holds the altitude, and one of 95 % climbs at the maximum rate.
        climb_share = -self.velocity_down / wing.climb_m_s
        throttle = 0.45 + 0.5 * climb_share
        self.throttle = max(0.0, min(1.0, throttle)) if powered else 0.0

    def _touch_down(self) -> None:
        self.impact_speed_m_s: float = self.velocity_down
        self._speed = self.ground_speed_m_s
        self.down = self.ground_down
        self.velocity_down: float = 0.0
        self.roll = self.pitch = 0.0

    def _change_airspeed(self, wanted: float, dt: float) -> None:
        deceleration = self.wing_limits.roll_out_m_s2 if self.is_on_ground else self.wing_limits.acceleration_m_s2
        self._speed += max(-deceleration * dt, min(self.wing_limits.acceleration_m_s2 * dt, wanted - self._speed))

    def _bank(self, wanted: float, dt: float) -> None:
        step = (wanted - self.roll) * min(1.0, dt / _BANK_TIME_CONSTANT_S)
        self.roll += step
        self.roll_rate: float = step / dt
        self.yaw_rate: float = GRAVITY_M_S2 * math.tan(self.roll) / max(self._speed, 1.0)
        self.yaw: float = wrap_pi(self.yaw + self.yaw_rate * dt)

    def _pitch(self, dt: float) -> None:
        sine_of_slope = -self.velocity_down / max(self._speed, 1.0)
        slope = math.asin(max(-_MAX_SLOPE, min(_MAX_SLOPE, sine_of_slope)))
        step = (slope + _ANGLE_OF_ATTACK_RAD - self.pitch) * min(1.0, dt / _PITCH_TIME_CONSTANT_S)
        self.pitch += step
        self.pitch_rate: float = step / dt

    def _along_nose(self, speed: float) -> tuple[float, float]:
        """Return (north, east) of a speed in the direction of the nose."""
        return speed * math.cos(self.yaw), speed * math.sin(self.yaw)

    def _air_movement(self) -> tuple[float, float]:
        """Return the wind (north, east) with its gusts, in m/s."""
        return self.wind.north_m_s + self._gust_north, self.wind.east_m_s + self._gust_east

    def _advance(self, dt: float) -> None:
        self.north += self.velocity_north * dt
        self.east += self.velocity_east * dt
        self.down += self.velocity_down * dt

    def _set_acceleration(self, velocity_before: tuple[float, float, float], dt: float) -> None:
        north, east, down = velocity_before
        self.acceleration_north: float = (self.velocity_north - north) / dt
        self.acceleration_east: float = (self.velocity_east - east) / dt
        self.acceleration_down: float = (self.velocity_down - down) / dt


_SPEED_TIME_CONSTANT_S = 0.3
_HEADING_GAIN_PER_S = 2.0
_SLOW_M_S = 1.0
_SLOW_TURN_ERROR_RAD = math.pi / 2


@dataclass
class GroundLimits:
    """Limits of wheels and steering."""

    acceleration_m_s2: float = 1.0
    top_speed_m_s: float = 10.0
    turn_rate_rad_s: float = math.radians(120.0)
    turn_radius_m: float = 0.9
    sideways_m_s2: float = 5.9


class GroundMotion(Motion):
    """Motion of a rover or boat. `drive`, `head`, `drive_to` and `stop` set the target; ``step`` moves the vehicle."""

    north: float
    east: float

    def __init__(
        self, rng: random.Random, wheels: GroundLimits | None = None, wind: SimulatedWind | None = None
    ) -> None:
        super().__init__(rng, wind=wind)
        self.wheels: GroundLimits = wheels if wheels is not None else GroundLimits()
        self.speed_m_s: float = 0.0
        """Forward speed; negative is backwards."""
        self._wanted_speed = 0.0
        self._wanted_turn_rate = 0.0
        self._wanted_heading: float | None = None
        """Heading to turn to, which replaces the turn rate; None if the turn rate applies."""

    @property
    def is_still(self) -> bool:
        return abs(self.speed_m_s) < 0.01

    def stop(self) -> None:
        self.drive(0.0, 0.0)

    def drive(self, speed: float, turn_rate: float) -> None:
        """Drive at this speed in m/s (negative: backwards), with this turn rate in rad/s."""
        self._wanted_speed = speed
        self._wanted_turn_rate = turn_rate
        self._wanted_heading = None

    def head(self, speed: float, heading: float) -> None:
        """Drive at this speed in m/s, and turn to this heading in radians."""
        self._wanted_speed = speed
        self._wanted_turn_rate = 0.0
        self._wanted_heading = heading

    def drive_to(self, place: Ned, *, speed: float, stops: bool = True) -> None:
        """Drive to a place at up to this speed in m/s. With ``stops``, the rover brakes and stops at the place."""
        if stops:
            speed = min(speed, approach_speed(self.distance_to(place), self.wheels.acceleration_m_s2))
        course = self.bearing_to(place)
        if abs(wrap_pi(course - self.yaw)) > _SLOW_TURN_ERROR_RAD:  # Drive slowly until the rover has turned.
            speed = min(speed, _SLOW_M_S)
        self.head(speed, course)

    @property
    def airspeed_m_s(self) -> float:
        return 0.0  # A rover has no pitot tube.

    def step(self, dt: float, *, powered: bool = True) -> None:
        rate = self._turn_rate()
        self._accelerate(self._curve_speed(rate) if powered else 0.0, dt)
        mean_yaw = self.yaw + 0.5 * rate * dt  # The mean during this step, so that long steps stay on the curve.
        self.yaw: float = wrap_pi(self.yaw + rate * dt)
        self.yaw_rate: float = rate
        north, east = self.speed_m_s * math.cos(mean_yaw), self.speed_m_s * math.sin(mean_yaw)
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
        rate = self._wanted_turn_rate
        if self._wanted_heading is not None:
            rate = _HEADING_GAIN_PER_S * wrap_pi(self._wanted_heading - self.yaw)
        # The steering turns the vehicle only while it moves.
        limit = min(self.wheels.turn_rate_rad_s, abs(self.speed_m_s) / self.wheels.turn_radius_m)
        return max(-limit, min(limit, rate))

    def _curve_speed(self, rate: float) -> float:
        """Return the wanted speed, limited by the sideways acceleration at this turn rate."""
        limit = self.wheels.top_speed_m_s
        if rate:
            limit = min(limit, max(_SLOW_M_S, self.wheels.sideways_m_s2 / abs(rate)))
        return max(-limit, min(limit, self._wanted_speed))

    def _accelerate(self, wanted: float, dt: float) -> None:
        change = (wanted - self.speed_m_s) * min(1.0, dt / _SPEED_TIME_CONSTANT_S)
        limit = self.wheels.acceleration_m_s2 * dt
        is_braking = abs(wanted) < abs(self.speed_m_s)
        if is_braking:
            limit *= 2.0  # The brakes are stronger than the engine.
        self.speed_m_s += max(-limit, min(limit, change))


_DRAG_PER_S = 1.0
_LIMITS = MotionLimits(
    acceleration_m_s2=1.0, vertical_acceleration_m_s2=1.0, turn_rate_rad_s=math.radians(60.0), lean_rad=0.0
)


class UnderwaterMotion(Motion):
    """Motion of a submarine between the water surface and the bottom.

    ``down`` is a coordinate of the local frame: the surface is at ``ground_down``, where the submarine starts, and the
    bottom at ``bottom_down``. ``buoyancy_m_s2`` is the upward acceleration without thrust.
    """

    def __init__(self, rng: random.Random, *, bottom_down: float = 200.0, buoyancy_m_s2: float = 0.1) -> None:
        super().__init__(rng, limits=_LIMITS)
        self.bottom_down = bottom_down
        self.buoyancy_m_s2 = buoyancy_m_s2
        self._is_floating = False  # True if the buoyancy, not a target, determines the depth

    @property
    def is_on_ground(self) -> bool:
        return False

    @property
    def is_at_surface(self) -> bool:
        return self.down <= self.ground_down

    @property
    def is_still(self) -> bool:
        speed = math.hypot(*self.velocity)
        return self.is_at_surface and speed < 0.01

    @property
    def airspeed_m_s(self) -> float:
        # Telemetry reports the speed through the water as airspeed.
        return math.hypot(self.velocity_north, self.velocity_east)

    def seek_velocity(self, north: float, east: float, down: float) -> None:
        super().seek_velocity(north, east, down)
        self._is_floating = False

    def stop(self) -> None:
        self.seek_velocity(0.0, 0.0, 0.0)

    def push(self, north: float, east: float) -> None:
        """Move at this horizontal velocity, and let the buoyancy change the depth."""
        super().seek_velocity(north, east, 0.0)
        self._is_floating = True

    def step(self, dt: float, *, powered: bool = True) -> None:
        # Without thrust, the buoyancy accelerates upwards, and the drag against the velocity.
        floating_down = -self.buoyancy_m_s2 - _DRAG_PER_S * self.velocity_down
        if powered:
            north, east, commanded_down = self._commanded_acceleration()
            down = floating_down if self._is_floating else commanded_down
        else:
            north = -_DRAG_PER_S * self.velocity_north
            east = -_DRAG_PER_S * self.velocity_east
            down = floating_down
        self._integrate(north, east, down, dt)
        self._turn(dt, powered=powered)

    def _integrate(self, north: float, east: float, down: float, dt: float) -> None:
        super()._integrate(north, east, down, dt)
        surface_down = self.ground_down  # A submarine starts at the surface.
        if self.down < surface_down:
            self.down = surface_down
            self.velocity_down = max(0.0, self.velocity_down)
        elif self.down > self.bottom_down:
            self.down: float = self.bottom_down
            self.velocity_down: float = min(0.0, self.velocity_down)
