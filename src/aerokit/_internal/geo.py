"""Geodesy on the WGS 84 ellipsoid (geographiclib). Positions are in degrees, lengths in metres."""

from __future__ import annotations

import math
from numbers import Real
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from geographiclib.geodesic import Geodesic


def distance_m(latitude_deg: float, longitude_deg: float, to_latitude_deg: float, to_longitude_deg: float) -> float:
    """Return the distance along the ellipsoid, ignoring altitudes."""
    line = _wgs84().Inverse(latitude_deg, longitude_deg, to_latitude_deg, to_longitude_deg)
    return float(line["s12"])


def bearing_deg(latitude_deg: float, longitude_deg: float, to_latitude_deg: float, to_longitude_deg: float) -> float:
    """Return the initial bearing from the first place to the second, clockwise from north, 0 to below 360."""
    line = _wgs84().Inverse(latitude_deg, longitude_deg, to_latitude_deg, to_longitude_deg)
    return wrap_360(float(line["azi1"]))


def offset(latitude_deg: float, longitude_deg: float, north_m: float, east_m: float) -> tuple[float, float]:
    """Return latitude and longitude of the place ``north_m`` north and ``east_m`` east of the given place."""
    distance, azimuth = math.hypot(north_m, east_m), math.degrees(math.atan2(east_m, north_m))
    line = _wgs84().Direct(latitude_deg, longitude_deg, azimuth, distance)
    return float(line["lat2"]), wrap_longitude(float(line["lon2"]))


def north_east_m(
    latitude_deg: float, longitude_deg: float, to_latitude_deg: float, to_longitude_deg: float
) -> tuple[float, float]:
    """Return how many metres the second place is north and east of the first."""
    line = _wgs84().Inverse(latitude_deg, longitude_deg, to_latitude_deg, to_longitude_deg)
    azimuth = math.radians(line["azi1"])
    return float(line["s12"] * math.cos(azimuth)), float(line["s12"] * math.sin(azimuth))


def check_place(latitude_deg: float, longitude_deg: float) -> None:
    for name, value, limit in (("latitude_deg", latitude_deg, 90), ("longitude_deg", longitude_deg, 180)):
        if not isinstance(value, (float, int, Real)) or not -limit <= value <= limit:
            raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be -{limit} to {limit} degrees")


def wrap_360(angle_deg: float) -> float:
    """Convert an angle to the range from 0 to below 360."""
    wrapped = angle_deg % 360.0
    return 0.0 if wrapped == 360.0 else wrapped  # For a tiny negative angle, the remainder is rounded to 360.


def wrap_longitude(longitude_deg: float) -> float:
    """Convert a longitude to the range from -180 to below 180."""
    return longitude_deg if -180.0 <= longitude_deg < 180.0 else wrap_360(longitude_deg + 180.0) - 180.0


def _wgs84() -> Geodesic:
    # Imported on first use, because this import takes longer than importing all of aerokit.
    from geographiclib.geodesic import Geodesic

    return Geodesic.WGS84
