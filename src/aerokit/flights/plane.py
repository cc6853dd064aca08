"""``Plane``: degrees ↔ metres north and east near a place, quick enough for millions of points."""

from __future__ import annotations

import math

from aerokit import geo

__all__ = ["Plane"]


class Plane:
    """A plane that touches the ellipsoid at a place; good to a metre within some kilometres."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self.latitude_deg: float = latitude_deg
        self.longitude_deg: float = longitude_deg
        middle = max(-89.9, min(89.9, latitude_deg))
        north = geo.distance_m(middle - 0.005, longitude_deg, middle + 0.005, longitude_deg)
        east = geo.distance_m(middle, longitude_deg - 0.005, middle, longitude_deg + 0.005)
        self.north_m_per_deg: float = north * 100
        self.east_m_per_deg: float = east * 100

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Metres north and east of the place; NaN for NaN."""
        east = longitude_deg - self.longitude_deg
        if not -180.0 <= east < 180.0 and math.isfinite(east):
            east = geo.wrap_longitude(east)
        return (latitude_deg - self.latitude_deg) * self.north_m_per_deg, east * self.east_m_per_deg

    def degrees(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Latitude and longitude of the place that many metres north and east."""
        return (
            self.latitude_deg + north_m / self.north_m_per_deg,
            self.longitude_deg + east_m / self.east_m_per_deg,
        )
