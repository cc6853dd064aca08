"""Local frame and motion of a simulated multicopter, which is a point mass that leans as its acceleration requires.

The model has limits of speed, acceleration and turn rate. The copter brakes before a target like the square-root
controller of ArduPilot and PX4, and leans against its drag in steady flight. There is a constant wind with gusts, and a
ground. Not modelled: propeller dynamics, attitude control loops, ground effect, drift.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Any, NamedTuple

from aerokit._internal.rotations import euler_from_quaternion as euler_from_quaternion
from aerokit._internal.rotations import quaternion_from_euler as quaternion_from_euler
from aerokit.errors import InvalidArgument

# ArduPilot's LOCATION_SCALING_FACTOR, so that positions are rounded as in the firmware.
_METRES_PER_DEGREE_E7 = 0.011131884502145034


Ned = tuple[float, float, float]
"""Metres north, east and down."""


class GlobalPoint(NamedTuple):
    """A position in degrees times 1e7 and metres above mean sea level."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float


class LocalFrame:
    """Converts between global positions and metres north, east and down of an origin.

    The conversion is accurate within a few kilometres of the origin, like that of the autopilots.
    """

    __slots__ = ("_east_scale", "origin")

    def __init__(self, origin: GlobalPoint) -> None:
        self.origin: GlobalPoint = origin
        self._east_scale = _METRES_PER_DEGREE_E7 * math.cos(math.radians(origin.latitude_e7 * 1e-7))

    def to_global(self, north: float, east: float, down: float) -> GlobalPoint:
        return GlobalPoint(
            self.origin.latitude_e7 + round(north / _METRES_PER_DEGREE_E7),
            self.origin.longitude_e7 + round(east / self._east_scale),
            self.origin.altitude_m - down,
        )

    def to_local(self, latitude_e7: int, longitude_e7: int) -> tuple[float, float]:
        """Return metres north and east of the origin."""
        return (
            (latitude_e7 - self.origin.latitude_e7) * _METRES_PER_DEGREE_E7,
            (longitude_e7 - self.origin.longitude_e7) * self._east_scale,
        )


def true_place(vehicle: Any) -> GlobalPoint:
    """Return the true position of a simulated vehicle.

    Raises InvalidArgument for a vehicle without a position, such as a recording.
    """
    frame, motion = getattr(vehicle, "frame", None), getattr(vehicle, "motion", None)
    if frame is None or motion is None:
        raise InvalidArgument(f"{type(vehicle).__name__} has no true position, because its motion is not simulated")
    place: GlobalPoint = frame.to_global(*motion.place)
    return place


HOME = (-35.363261, 149.165230, 584.09)
"""SITL's default home, a model airfield near Canberra: degrees, and metres above mean sea level."""


GRAVITY_M_S2 = 9.80665
# Deceleration by drag, divided by the airspeed. With this value the copter leans 19 degrees at 10 m/s, about as a
# quadrotor of 450 mm does.
_DRAG_PER_S = 0.33
_VELOCITY_TIME_CONSTANT_S = 0.3
# Share of a lean error that remains after a second, which has 50 steps of 0.02 s. The time constant is 0.15 s.
_LEAN_KEPT_PER_S = (1.0 - 0.02 / 0.15) ** 50
_TURN_GAIN_PER_S = 2.0
_TERMINAL_SPEED_M_S = 25.0
BRAKING_SHARE = 0.7  # A vehicle plans to brake with 70 % of the acceleration limit, and keeps the rest in reserve.
_APPROACH_PER_S, _MAX_APPROACH_M_S = 0.8, 1.5
# Within these limits, steps of 0.12 s are exact enough: a jerk of 4 m/s³ changes the position by 4 · 0.12³ / 6 m, which
# is 1.2 mm. Near the ground, short steps are needed for the time and speed of a touchdown.
_STEADY_JERK_M_S3 = 4.0
_STEADY_LEAN_RATE_RAD_S = 0.6
_MIN_TIME_TO_GROUND_S = 0.3


def wrap_pi(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def centidegrees(angle: float) -> int:
    """Convert an angle in radians to hundredths of a degree, from 0 to 35999."""
    return round(math.degrees(angle) % 360.0 * 100) % 36000  # Rounding may give 36000, which is 0.


def _clamp(value: float, limit: float) -> float:
    if value > limit:
        return limit
    return value if value > -limit else -limit


def velocity_to_landing_target(north: float, east: float) -> tuple[float, float]:
    """Return the horizontal velocity in m/s towards a landing target at this offset in metres."""
    gain_per_s = min(_APPROACH_PER_S, _MAX_APPROACH_M_S / max(math.hypot(north, east), 1e-6))
    return (north * gain_per_s, east * gain_per_s)


def approach_speed(distance: float, deceleration: float) -> float:
    """Return the speed in m/s that lets a vehicle stop at a point ``distance`` metres away.

    Near the point, the speed is 1 m/s for each metre of distance. Farther away, it is that of a constant
    ``deceleration``.
    """
    if distance <= deceleration:
        return distance
    return math.sqrt(2.0 * deceleration * (distance - deceleration / 2.0))


@dataclass
class MotionLimits:
    """Limits of the airframe and its controller."""

    acceleration_m_s2: float = 2.5
    vertical_acceleration_m_s2: float = 1.5
    turn_rate_rad_s: float = math.radians(60.0)
    lean_rad: float = math.radians(30.0)


@dataclass
class SimulatedWind:
    """Velocity of the air in m/s. ``gusts_m_s`` is the standard deviation of the gusts, also in m/s."""

    north_m_s: float = 0.0
    east_m_s: float = 0.0
    gusts_m_s: float = 0.0


class Motion:
    """Position (metres north, east, down of an origin), velocity (m/s) and attitude (rad) of a multicopter.

    A ``seek_…`` method sets the target; ``step`` moves towards it. The ground is level at ``ground_down``.
    """

    def __init__(
        self, rng: random.Random, limits: MotionLimits | None = None, wind: SimulatedWind | None = None
    ) -> None:
        self.limits: MotionLimits = limits if limits is not None else MotionLimits()
        self.wind: SimulatedWind = wind if wind is not None else SimulatedWind()
        self._rng = rng
        self.ground_down: float = 0.0
        self.north: float = 0.0
        self.east: float = 0.0
        self.down: float = 0.0
        self.velocity_north: float = 0.0
        self.velocity_east: float = 0.0
        self.velocity_down: float = 0.0
        self.acceleration_north: float = 0.0
        self.acceleration_east: float = 0.0
        self.acceleration_down: float = 0.0
        self.roll: float = 0.0
        self.pitch: float = 0.0
        self.yaw: float = 0.0
        self.roll_rate: float = 0.0
        self.pitch_rate: float = 0.0
        self.yaw_rate: float = 0.0
        self.impact_speed_m_s: float = 0.0
        """Vertical speed at the last touchdown."""
        # Present gust in m/s, which is added to the mean wind.
        self._gust_north = 0.0
        self._gust_east = 0.0
        self._jerk_m_s3 = math.inf  # present change of the acceleration; infinite before the first step
        # The target velocity (north, east, down), or the target acceleration if `_target_is_acceleration` is True.
        self._target = (0.0, 0.0, 0.0)
        self._target_is_acceleration = False
        # Acceleration (north, east, down) that is added to the one towards the target velocity.
        self._feed_forward = (0.0, 0.0, 0.0)
        # The target roll and pitch, which replace the horizontal components of `_target`; None without such a target.
        self._target_lean: tuple[float, float] | None = None
        self._wanted_yaw: float | None = None  # None while the vehicle turns with `_wanted_yaw_rate`
        self._wanted_yaw_rate = 0.0
        self._max_yaw_rate = math.inf  # limit of the rate towards `_wanted_yaw`

    @property
    def place(self) -> Ned:
        return (self.north, self.east, self.down)

    @property
    def velocity(self) -> Ned:
        return (self.velocity_north, self.velocity_east, self.velocity_down)

    @property
    def acceleration(self) -> Ned:
        return (self.acceleration_north, self.acceleration_east, self.acceleration_down)

    @property
    def angles(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw."""
        return (self.roll, self.pitch, self.yaw)

    @property
    def angular_rates(self) -> tuple[float, float, float]:
        """Rates of change of roll, pitch and yaw, in radians per second."""
        return (self.roll_rate, self.pitch_rate, self.yaw_rate)

    @property
    def course(self) -> float:
        """Direction of the movement over ground, in radians from north."""
        return math.atan2(self.velocity_east, self.velocity_north)

    @property
    def thrust_share(self) -> float:
        """Thrust divided by the thrust of a level hover. The lean counts only up to 60 degrees (cosine 0.5)."""
        vertical_share = max(0.5, math.cos(self.roll) * math.cos(self.pitch))
        return max(0.0, 1.0 - self.acceleration_down / GRAVITY_M_S2) / vertical_share

    def distance_to(self, place: Ned) -> float:
        """Return the horizontal distance to a place."""
        north, east, _ = place
        return math.hypot(north - self.north, east - self.east)

    def bearing_to(self, place: Ned) -> float:
        """Return the direction of a place, in radians from north."""
        north, east, _ = place
        return math.atan2(east - self.east, north - self.north)

    def elevation_of(self, place: Ned) -> float:
        """Return the angle in radians by which a place is above the horizon."""
        _, _, down = place
        depth = down - self.down
        return math.atan2(-depth, self.distance_to(place))

    @property
    def stopping_place(self) -> Ned:
        """The place ahead at which :meth:`seek_position` stops the vehicle without flying back."""
        speed, deceleration = self.ground_speed_m_s, BRAKING_SHARE * self.limits.acceleration_m_s2
        # `approach_speed` returns the present speed if the target is `speed * seconds` metres away.
        seconds = 1.0 if speed <= deceleration else speed / (2.0 * deceleration) + deceleration / (2.0 * speed)
        return (self.north + self.velocity_north * seconds, self.east + self.velocity_east * seconds, self.down)

    def seek_velocity(self, north: float, east: float, down: float) -> None:
        self._set_target((north, east, down))

    def follow_trajectory(self, velocity: Ned, acceleration: Ned) -> None:
        """Seek a velocity with a feed-forward acceleration; only the lean limits the horizontal acceleration."""
        self._set_target(velocity, feed_forward=acceleration)

    def seek_acceleration(self, north: float, east: float, down: float) -> None:
        self._set_target((north, east, down), is_acceleration=True)

    def seek_attitude(self, roll: float, pitch: float, velocity_down: float) -> None:
        """Hold these angles in radians, and this vertical velocity in m/s (positive down)."""
        self._set_target((0.0, 0.0, velocity_down), lean=(roll, pitch))

    def _set_target(
        self,
        target: Ned,
        *,
        is_acceleration: bool = False,
        feed_forward: Ned = (0.0, 0.0, 0.0),
        lean: tuple[float, float] | None = None,
    ) -> None:
        self._target = target
        self._feed_forward = feed_forward
        self._target_is_acceleration = is_acceleration
        self._target_lean = lean

    def seek_position(
        self, north: float, east: float, down: float, *, speed: float, climb: float, descent: float
    ) -> None:
        """Fly to a point and stop there, with limits of the horizontal speed, climb rate and sink rate in m/s."""
        offset_north, offset_east, offset_down = north - self.north, east - self.east, down - self.down
        distance = math.hypot(offset_north, offset_east)
        speed_per_metre = 0.0
        if distance > 1e-6:  # At the point, the direction is undefined.
            deceleration = BRAKING_SHARE * self.limits.acceleration_m_s2
            speed_per_metre = min(speed, approach_speed(distance, deceleration)) / distance
        vertical = approach_speed(abs(offset_down), BRAKING_SHARE * self.limits.vertical_acceleration_m_s2)
        vertical = min(vertical, descent if offset_down > 0 else climb)
        velocity_down = math.copysign(vertical, offset_down)
        self.seek_velocity(offset_north * speed_per_metre, offset_east * speed_per_metre, velocity_down)

    def face(self, yaw: float, max_rate: float = math.inf) -> None:
        """Turn to this heading (rad), at no more than ``max_rate`` (rad/s)."""
        self._wanted_yaw = yaw
        self._max_yaw_rate = max_rate

    def turn(self, rate: float) -> None:
        """Turn at this rate (rad/s)."""
        self._wanted_yaw = None
        self._wanted_yaw_rate = rate

    @property
    def is_on_ground(self) -> bool:
        return self.down >= self.ground_down

    @property
    def is_steady(self) -> bool:
        """True in flight while acceleration and lean hardly change, so that long steps are exact enough."""
        height_m = self.ground_down - self.down
        return (
            self._jerk_m_s3 < _STEADY_JERK_M_S3
            and not self.wind.gusts_m_s
            and abs(self.roll_rate) + abs(self.pitch_rate) < _STEADY_LEAN_RATE_RAD_S
            and height_m > max(0.0, self.velocity_down * _MIN_TIME_TO_GROUND_S)
        )

    @property
    def airspeed_m_s(self) -> float:
        return math.hypot(
            self.velocity_north - self.wind.north_m_s - self._gust_north,
            self.velocity_east - self.wind.east_m_s - self._gust_east,
        )

    @property
    def ground_speed_m_s(self) -> float:
        return math.hypot(self.velocity_north, self.velocity_east)

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Advance by ``dt`` seconds. A copter without power falls."""
        if self.wind.gusts_m_s > 0.0:
            self._update_gusts(dt)
        if powered:
            north, east, down = self._commanded_acceleration()
        else:
            drag_per_s = GRAVITY_M_S2 / _TERMINAL_SPEED_M_S  # At the terminal speed, the drag equals the weight.
            north = -drag_per_s * self.velocity_north
            east = -drag_per_s * self.velocity_east
            down = GRAVITY_M_S2 - drag_per_s * self.velocity_down
        change = abs(north - self.acceleration_north) + abs(east - self.acceleration_east)
        self._jerk_m_s3 = (change + abs(down - self.acceleration_down)) / dt
        self._integrate(north, east, down, dt)
        self._lean(north, east, dt, powered=powered)
        self._turn(dt, powered=powered)

    def settle(self) -> None:
        """Stop level on the ground and forget all targets."""
        self.down = self.ground_down
        self.velocity_north = self.velocity_east = self.velocity_down = 0.0
        self.acceleration_north = self.acceleration_east = self.acceleration_down = 0.0
        self.roll = self.pitch = self.roll_rate = self.pitch_rate = self.yaw_rate = 0.0
        self._set_target((0.0, 0.0, 0.0))
        self._wanted_yaw = None
        self._wanted_yaw_rate = 0.0

    def _update_gusts(self, dt: float) -> None:
        # The gusts are a random walk that returns to zero. Its standard deviation is `gusts_m_s`.
        decay = 1.0 - dt / 2.0
        kick = self.wind.gusts_m_s * math.sqrt(dt)
        self._gust_north = self._gust_north * decay + self._rng.gauss(0.0, kick)
        self._gust_east = self._gust_east * decay + self._rng.gauss(0.0, kick)

    def _commanded_acceleration(self) -> tuple[float, float, float]:
        limits = self.limits
        north, east, down = self._target
        forward_north, forward_east, forward_down = self._feed_forward
        if not self._target_is_acceleration:
            north = (north - self.velocity_north) / _VELOCITY_TIME_CONSTANT_S + forward_north
            east = (east - self.velocity_east) / _VELOCITY_TIME_CONSTANT_S + forward_east
            down = (down - self.velocity_down) / _VELOCITY_TIME_CONSTANT_S + forward_down
        down = _clamp(down, limits.vertical_acceleration_m_s2)
        if self._target_lean is not None:
            roll, pitch = self._target_lean
            return (*self._acceleration_from_lean(roll, pitch), down)
        horizontal = math.hypot(north, east)
        max_m_s2 = limits.acceleration_m_s2
        if any(self._feed_forward):
            max_m_s2 = max(max_m_s2, GRAVITY_M_S2 * math.tan(limits.lean_rad))
        if horizontal > max_m_s2:
            north, east = north * max_m_s2 / horizontal, east * max_m_s2 / horizontal
        return north, east, down

    def _acceleration_from_lean(self, roll: float, pitch: float) -> tuple[float, float]:
        max_lean = self.limits.lean_rad
        # A positive pitch raises the nose, which pushes the copter backwards. A positive roll pushes it to the right.
        forward = -GRAVITY_M_S2 * math.tan(_clamp(pitch, max_lean))
        right = GRAVITY_M_S2 * math.tan(_clamp(roll, max_lean))
        cos_yaw, sin_yaw = math.cos(self.yaw), math.sin(self.yaw)
        drag_north, drag_east = self._drag()
        return (forward * cos_yaw - right * sin_yaw - drag_north, forward * sin_yaw + right * cos_yaw - drag_east)

    def _drag(self) -> tuple[float, float]:
        """Return the deceleration (north, east) by the air, in m/s²."""
        return (
            _DRAG_PER_S * (self.velocity_north - self.wind.north_m_s - self._gust_north),
            _DRAG_PER_S * (self.velocity_east - self.wind.east_m_s - self._gust_east),
        )

    def _integrate(self, north: float, east: float, down: float, dt: float) -> None:
        self.acceleration_north = north
        self.acceleration_east = east
        self.acceleration_down = down
        was_on_ground = self.is_on_ground
        self.north += (self.velocity_north + 0.5 * north * dt) * dt
        self.east += (self.velocity_east + 0.5 * east * dt) * dt
        self.down += (self.velocity_down + 0.5 * down * dt) * dt
        self.velocity_north += north * dt
        self.velocity_east += east * dt
        self.velocity_down += down * dt
        if self.is_on_ground and self.velocity_down >= 0.0:  # A copter that climbs must be able to leave the ground.
            if not was_on_ground:
                self.impact_speed_m_s = self.velocity_down
            self.down = self.ground_down
            self.velocity_north = 0.0
            self.velocity_east = 0.0
            self.velocity_down = 0.0

    def _lean(self, north: float, east: float, dt: float, *, powered: bool) -> None:
        roll = pitch = 0.0
        if powered and not self.is_on_ground:
            # The thrust must also overcome the drag; `_drag` returns this acceleration.
            drag_north, drag_east = self._drag()
            north += drag_north
            east += drag_east
            cos_yaw, sin_yaw = math.cos(self.yaw), math.sin(self.yaw)
            limit = self.limits.lean_rad
            pitch = _clamp(-math.atan2(north * cos_yaw + east * sin_yaw, GRAVITY_M_S2), limit)
            roll = _clamp(math.atan2(east * cos_yaw - north * sin_yaw, GRAVITY_M_S2), limit)
        share = 1.0 - _LEAN_KEPT_PER_S**dt  # The lean approaches its target exponentially.
        roll_step = (roll - self.roll) * share
        pitch_step = (pitch - self.pitch) * share
        self.roll += roll_step
        self.pitch += pitch_step
        self.roll_rate = roll_step / dt
        self.pitch_rate = pitch_step / dt

    def _turn(self, dt: float, *, powered: bool) -> None:
        rate = 0.0
        if powered and not self.is_on_ground:
            rate = self._wanted_yaw_rate
            if self._wanted_yaw is not None:  # A heading replaces the turn rate.
                rate = _clamp(_TURN_GAIN_PER_S * wrap_pi(self._wanted_yaw - self.yaw), self._max_yaw_rate)
            rate = _clamp(rate, self.limits.turn_rate_rad_s)
        self.yaw_rate = rate
        if rate != 0.0:
            self.yaw = wrap_pi(self.yaw + rate * dt)
