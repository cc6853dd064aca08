"""State values and decoders: position, velocity, attitude, wind."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal import geo
from aerokit._internal.rotations import euler_from_quaternion, quaternion_from_euler
from aerokit._internal.values import Snapshot
from aerokit.position import Home, Position
from aerokit.vehicle.state.field import U16, Context, finite

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.mavlink import messages

__all__ = [
    "Attitude",
    "Home",
    "LocalPosition",
    "Velocity",
    "Wind",
    "air_speed_m_s",
    "attitude",
    "attitude_of_quaternion",
    "climb_m_s",
    "global_velocity",
    "ground_speed_m_s",
    "heading_deg",
    "heading_of_hud",
    "home",
    "local_position",
    "local_velocity",
    "origin",
    "position",
    "throttle_percent",
    "valid_coordinates",
    "wind",
    "wind_of_covariance",
]

# A position counts as missing if it is less than this (0.01 degrees) from 0°N 0°E in both coordinates.
MIN_COORDINATE = 100_000
# Two altitudes in GLOBAL_POSITION_INT that differ by at most this much count as equal.
SAME_ALTITUDE_MM = 100


class LocalPosition(Snapshot):
    """Position in metres from the estimator's origin, and velocity in m/s (LOCAL_POSITION_NED)."""

    north_m: float
    east_m: float
    down_m: float
    north_m_s: float
    east_m_s: float
    down_m_s: float


class Velocity(Snapshot):
    """Velocity over ground in m/s."""

    north_m_s: float
    east_m_s: float
    down_m_s: float

    @property
    def ground_speed_m_s(self) -> float:
        """Horizontal speed."""
        return math.hypot(self.north_m_s, self.east_m_s)

    @property
    def course_deg(self) -> float:
        """Direction of the horizontal movement, 0 to 360 degrees."""
        return geo.wrap_360(math.degrees(math.atan2(self.east_m_s, self.north_m_s)))


class Attitude(Snapshot):
    """Attitude in degrees and turn rates about the body axes in degrees per second.

    ``roll_deg`` is positive with the right side down, ``pitch_deg`` with the nose up. ``yaw_deg`` is −180 to 180,
    clockwise from north. A rate is None if not reported.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    roll_rate_deg_s: float | None = None
    pitch_rate_deg_s: float | None = None
    yaw_rate_deg_s: float | None = None

    @classmethod
    def from_quaternion(
        cls,
        w: float,
        x: float,
        y: float,
        z: float,
        rates_deg_s: tuple[float | None, float | None, float | None],
    ) -> Self:
        """Return the attitude of a quaternion (w first), which converts vectors from body axes to north, east, down.

        ``rates_deg_s`` are the turn rates about the body axes.
        """
        roll, pitch, yaw = euler_from_quaternion(w, x, y, z)
        return cls(math.degrees(roll), math.degrees(pitch), math.degrees(yaw), *rates_deg_s)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The same attitude as a quaternion w, x, y, z."""
        return quaternion_from_euler(*map(math.radians, (self.roll_deg, self.pitch_deg, self.yaw_deg)))


class Wind(Snapshot):
    """Wind speed in m/s. ``direction_deg`` (0 to 360) is where the wind comes from.

    ``down_m_s`` is the vertical wind speed, None if not reported.
    """

    speed_m_s: float
    direction_deg: float
    down_m_s: float | None = None


def valid_coordinates(latitude: int, longitude: int) -> tuple[float, float] | None:
    """Convert 1e-7 degrees to degrees; return None for a place near 0°N 0°E, and for numbers out of range."""
    # Autopilots without a fix report 0°N 0°E. ArduPlane was also observed to dead-reckon from there.
    if abs(latitude) < MIN_COORDINATE and abs(longitude) < MIN_COORDINATE:
        return None
    if abs(latitude) > 900_000_000 or abs(longitude) > 1_800_000_000:
        return None
    return latitude / 1e7, longitude / 1e7


def position(message: messages.GlobalPositionInt, context: Context) -> Position | None:
    """Return the position; None before the first fix.

    Until home is set, ``relative_alt`` repeats the altitude above mean sea level. The result then has no relative
    altitude.
    """
    coordinates = valid_coordinates(message.lat, message.lon)
    if coordinates is None:
        return None
    is_relative_to_home = context.home_is_known() or abs(message.relative_alt - message.alt) > SAME_ALTITUDE_MM
    relative_m = message.relative_alt / 1e3 if is_relative_to_home else None
    return Position(*coordinates, message.alt / 1e3, relative_m)


def global_velocity(message: messages.GlobalPositionInt) -> Velocity | None:
    """Return the velocity over ground; None before the first fix."""
    if valid_coordinates(message.lat, message.lon) is None:
        return None
    return Velocity(message.vx / 100, message.vy / 100, message.vz / 100)


def heading_deg(message: messages.GlobalPositionInt) -> float | None:
    """Return the heading in degrees, 0 to below 360; None if it is unknown."""
    return None if message.hdg == U16 else message.hdg / 100 % 360


def local_position(message: messages.LocalPositionNed) -> LocalPosition:
    """Return position and velocity in the local frame."""
    return LocalPosition(message.x, message.y, message.z, message.vx, message.vy, message.vz)


def local_velocity(message: messages.LocalPositionNed) -> Velocity:
    """Return the velocity in the local frame, without the position."""
    return Velocity(message.vx, message.vy, message.vz)


def heading_of_hud(message: messages.VfrHud) -> float:
    """Return the heading in whole degrees."""
    return float(message.heading % 360)


def ground_speed_m_s(message: messages.VfrHud) -> float:
    """Return the ground speed."""
    return message.groundspeed


def air_speed_m_s(message: messages.VfrHud) -> float | None:
    """Return the airspeed; None for NaN, which PX4 sends without a sensor."""
    return finite(message.airspeed)


def climb_m_s(message: messages.VfrHud) -> float:
    """Return the climb rate."""
    return message.climb


def throttle_percent(message: messages.VfrHud) -> float:
    """Return the throttle."""
    return float(message.throttle)


def attitude(message: messages.Attitude) -> Attitude:
    """Return the attitude from ATTITUDE as Euler angles and rates in degrees."""
    degrees = math.degrees
    return Attitude(
        roll_deg=degrees(message.roll),
        pitch_deg=degrees(message.pitch),
        yaw_deg=degrees(message.yaw),
        roll_rate_deg_s=degrees(message.rollspeed),
        pitch_rate_deg_s=degrees(message.pitchspeed),
        yaw_rate_deg_s=degrees(message.yawspeed),
    )


def attitude_of_quaternion(message: messages.AttitudeQuaternion) -> Attitude:
    """Return the attitude from ATTITUDE_QUATERNION as Euler angles and rates in degrees."""
    rates = (
        math.degrees(message.rollspeed),
        math.degrees(message.pitchspeed),
        math.degrees(message.yawspeed),
    )
    return Attitude.from_quaternion(message.q1, message.q2, message.q3, message.q4, rates)


def home(message: messages.HomePosition) -> Home | None:
    """Return the home position; None if its coordinates are invalid."""
    coordinates = valid_coordinates(message.latitude, message.longitude)
    if coordinates is None:
        return None
    return Home(*coordinates, message.altitude / 1e3, finite(message.x), finite(message.y), finite(message.z))


def origin(message: messages.GpsGlobalOrigin) -> Position | None:
    """Return the origin of the local frame; None if its coordinates are invalid."""
    coordinates = valid_coordinates(message.latitude, message.longitude)
    return None if coordinates is None else Position(*coordinates, message.altitude / 1e3)


def wind(message: messages.Wind) -> Wind:
    """Return the wind in WIND (ArduPilot), whose direction is where the wind comes from."""
    return Wind(message.speed, geo.wrap_360(message.direction), finite(message.speed_z))


def wind_of_covariance(message: messages.WindCov) -> Wind | None:
    """Return the wind in WIND_COV (PX4); None if unknown."""
    if not (math.isfinite(message.wind_x) and math.isfinite(message.wind_y)):
        return None
    # The message has the direction that the air moves to.
    comes_from = math.degrees(math.atan2(-message.wind_y, -message.wind_x))
    return Wind(math.hypot(message.wind_x, message.wind_y), geo.wrap_360(comes_from), finite(message.wind_z))
