"""Places on earth: ``Position`` and ``Home``."""

from __future__ import annotations

import math
from numbers import Real
from typing import TYPE_CHECKING

from aerokit._internal import geo
from aerokit._internal.arguments import checks_arguments
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Home", "Position"]


@checks_arguments
class Position(Snapshot):
    """A place on earth in degrees (WGS 84) and metres: ``Position(47.3977, 8.5456, altitude_relative_m=30)``.

    ``altitude_amsl_m`` is above mean sea level, ``altitude_relative_m`` above home; None means unknown, or not given.

    Raises:
        InvalidArgument: latitude or longitude is out of range, or a value is not a finite number.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float | None = None
    altitude_relative_m: float | None = None

    def distance_to(self, other: Position | Home) -> float:
        """Return the distance in metres along the ground, ignoring altitudes."""
        return geo.distance_m(self.latitude_deg, self.longitude_deg, other.latitude_deg, other.longitude_deg)

    def bearing_to(self, other: Position | Home) -> float:
        """Return the bearing to the other place in degrees: 0 to 360, clockwise from north."""
        return geo.bearing_deg(self.latitude_deg, self.longitude_deg, other.latitude_deg, other.longitude_deg)

    def offset(self, *, north_m: float = 0.0, east_m: float = 0.0, up_m: float = 0.0) -> Self:
        """Return the position moved by these distances in metres; an unknown altitude stays unknown."""
        latitude, longitude = geo.offset(self.latitude_deg, self.longitude_deg, north_m, east_m)
        amsl_m, relative_m = _add(self.altitude_amsl_m, up_m), _add(self.altitude_relative_m, up_m)
        return type(self)(latitude, longitude, amsl_m, relative_m)

    def _check(self) -> None:
        geo.check_place(self.latitude_deg, self.longitude_deg)
        for name, altitude in (
            ("altitude_amsl_m", self.altitude_amsl_m),
            ("altitude_relative_m", self.altitude_relative_m),
        ):
            if altitude is not None and not (isinstance(altitude, (float, int, Real)) and math.isfinite(altitude)):
                raise InvalidArgument(f"{name} = {altitude!r} is not a finite number")


class Home(Snapshot):
    """The home position (HOME_POSITION).

    ``north_m``, ``east_m`` and ``down_m`` are metres from the local origin; None if not reported. Calls that take a
    Position also take a Home. With a Home, ``go_to`` keeps the vehicle's present altitude.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float
    north_m: float | None = None
    east_m: float | None = None
    down_m: float | None = None

    @property
    def position(self) -> Position:
        """The home position without its altitude, so that a vehicle that flies there keeps its present altitude."""
        return Position(self.latitude_deg, self.longitude_deg)


def position_with_altitude(place: Position | Home) -> Position:
    """Return a place as a Position. A Home keeps its altitude above mean sea level."""
    return place.position.replace(altitude_amsl_m=place.altitude_amsl_m) if isinstance(place, Home) else place


def travel_target(place: Position | Home) -> Position:
    """Return the position to fly to. For a Home it has no altitude, so that the vehicle keeps its present one."""
    return place.position if isinstance(place, Home) else place


def _add(altitude: float | None, up_m: float) -> float | None:
    return None if altitude is None else altitude + up_m
