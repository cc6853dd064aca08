"""Points of a track, and details of a failed assertion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from aerokit._internal import geo
from aerokit.position import Position


@dataclass(frozen=True)
class TrackPoint:
    """Real state of a vehicle at one time, without the errors of its sensors and estimator."""

    time_s: float
    """Simulated seconds."""
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Altitude above home in metres."""
    armed: bool
    mode: str
    """Mode name, as in ``vehicle.mode``."""
    speed_m_s: float = 0.0
    """Ground speed in m/s."""
    battery_percent: float = 100.0

    @property
    def position(self) -> Position:
        """Position with its altitude above home."""
        return Position(self.latitude_deg, self.longitude_deg, altitude_relative_m=self.altitude_m)

    def __str__(self) -> str:
        place = f"{self.latitude_deg:.6f}, {self.longitude_deg:.6f}"
        armed = "armed" if self.armed else "disarmed"
        return f"at {self.time_s:.1f} s: {place}, {self.altitude_m:.1f} m above home, {armed}, {self.mode}"


@dataclass(frozen=True)
class TrackFailure:
    """The point and the limit of a failed assertion. Pictures of the track show both."""

    point: TrackPoint
    circle: tuple[Position, float] | None = None
    """The allowed area of the assertion: its center, and its radius in metres. None if the assertion has no circle."""
    polygon: Sequence[Position] | None = None
    altitude_m: float | None = None
    """Altitude above home."""


def metres_from(origin: Position) -> Callable[[Position | TrackPoint], tuple[float, float]]:
    """Return a function that converts a position to metres north and east of ``origin``."""
    # The metres are measured on the tangent plane of the earth's ellipsoid at `origin`.
    latitude = origin.latitude_deg
    longitude = origin.longitude_deg
    # Metres per degree, from the length of a hundredth of a degree around the origin.
    per_latitude = geo.distance_m(latitude - 0.005, longitude, latitude + 0.005, longitude) * 100
    per_longitude = geo.distance_m(latitude, longitude - 0.005, latitude, longitude + 0.005) * 100

    def offset_of(point: Position | TrackPoint) -> tuple[float, float]:
        north = (point.latitude_deg - latitude) * per_latitude
        return north, geo.wrap_longitude(point.longitude_deg - longitude) * per_longitude

    return offset_of
