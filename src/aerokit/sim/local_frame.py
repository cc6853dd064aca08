"""A flat earth around one point: metres north, east, down to and from 1e-7 degrees."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from aerokit.errors import InvalidArgument

_METRES_PER_DEGREE_E7 = (
    0.011131884502145034  # ArduPilot's LOCATION_SCALING_FACTOR: the same sphere, the same rounding
)


Ned = tuple[float, float, float]
"""Metres north, east and down."""


class GlobalPoint(NamedTuple):
    """A place on the wire's scale: degrees times 1e7, metres above mean sea level."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float


class LocalFrame:
    """North, east, down in metres around an origin; good for some kilometres, as the autopilots' own."""

    __slots__ = ("_east_scale", "origin")

    def __init__(self, origin: GlobalPoint) -> None:
        self.origin: GlobalPoint = origin
        self._east_scale = _METRES_PER_DEGREE_E7 * math.cos(math.radians(origin.latitude_e7 * 1e-7))

    def to_global(self, north: float, east: float, down: float) -> GlobalPoint:
        """Place a local point on the globe."""
        return GlobalPoint(
            self.origin.latitude_e7 + round(north / _METRES_PER_DEGREE_E7),
            self.origin.longitude_e7 + round(east / self._east_scale),
            self.origin.altitude_m - down,
        )

    def to_local(self, latitude_e7: int, longitude_e7: int) -> tuple[float, float]:
        """Metres north and east of the origin."""
        return (
            (latitude_e7 - self.origin.latitude_e7) * _METRES_PER_DEGREE_E7,
            (longitude_e7 - self.origin.longitude_e7) * self._east_scale,
        )


def true_place(vehicle: Any) -> GlobalPoint:
    """Where a simulated vehicle really is, whatever it says; InvalidArgument for one that is nowhere."""
    frame, motion = getattr(vehicle, "frame", None), getattr(vehicle, "motion", None)
    if frame is None or motion is None:
        raise InvalidArgument(f"{type(vehicle).__name__} has no true place")
    place: GlobalPoint = frame.to_global(*motion.place)
    return place


HOME = (-35.363261, 149.165230, 584.09)
"""The model airfield near Canberra that SITL and the examples of the field begin at: degrees, metres above the sea."""
