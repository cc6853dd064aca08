"""`Whereabouts`: where a vehicle is, how far from a place, and places as it reads them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit import geo
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position
from aerokit.vehicle.checks import check_range
from aerokit.vehicle.orders.progress import OLD_POSITION_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.vehicle.talk.talk import Talk

__all__ = ["MAX_DISTANCE_M", "Whereabouts"]

METRES_PER_DEGREE = 112_000
"""Of latitude, or of longitude at the equator, at most."""
MAX_DISTANCE_M = 100_000.0
"""Farther away, a place is taken for a mistake (coordinates exchanged, a sign lost) unless the call says so."""


class Whereabouts:
    """By what the vehicle has told."""

    def __init__(self, talk: Talk) -> None:
        self._telemetry, self._autopilot = talk.telemetry, talk.autopilot

    def distance_to(self, target: Position) -> float:
        """Metres from where the vehicle is to ``target``; in three dimensions when ``target`` has an altitude.

        Infinite while the position is unknown.
        """
        here = self._telemetry.position.latest
        if here is None:
            return math.inf
        along = geo.distance_m(
            here.latitude_deg, here.longitude_deg, target.latitude_deg, target.longitude_deg
        )
        return math.hypot(along, self._altitude_difference(here, target))

    def check_reach(self, name: str, places: Iterable[Position], max_distance_m: float) -> None:
        """Raise InvalidArgument for a place that is farther away; none is while the position is unknown."""
        check_range("max_distance_m", max_distance_m, 0, math.inf, above=True)
        here = self._telemetry.position.latest
        if here is None:
            return
        for place in places:
            degrees = abs(place.latitude_deg - here.latitude_deg) + abs(
                place.longitude_deg - here.longitude_deg
            )
            if degrees * METRES_PER_DEGREE < max_distance_m:  # missions have thousands of places nearby
                continue
            distance_m = self.distance_to(place)
            if distance_m > max_distance_m:
                raise InvalidArgument(
                    f"{name} = {place.latitude_deg:.7f}, {place.longitude_deg:.7f} is not allowed: it is"
                    f" {distance_m / 1000:,.0f} km away, more than max_distance_m = {max_distance_m:,.0f}; nothing was"
                    " sent. Pass a greater max_distance_m if that is meant"
                )

    def way_left(self, target: Position) -> float:
        """Along the ground for a vehicle that stays on it; the altitude it tells may count from anywhere."""
        if self._autopilot.stays_on_the_ground:
            return self.distance_to(Position(target.latitude_deg, target.longitude_deg))
        return self.distance_to(target)

    @staticmethod
    def _altitude_difference(here: Position, target: Position) -> float:
        for mine, its in (
            (here.altitude_relative_m, target.altitude_relative_m),
            (here.altitude_amsl_m, target.altitude_amsl_m),
        ):
            if mine is not None and its is not None:
                return mine - its
        return 0.0

    def is_known_since(self, started: float) -> bool:
        """Whether a position has come since then and is not old: nobody arrives by an old one."""
        position = self._telemetry.position
        return position.updated_at >= started and position.age <= OLD_POSITION_S

    def altitude_relative(self) -> float:
        """Metres above home; −inf while that is not known."""
        here = self._telemetry.position.latest
        altitude = None if here is None else here.altitude_relative_m
        return -math.inf if altitude is None else altitude

    def home_altitude(self) -> float:
        """Metres above the sea; ValueUnknownError while home is not known."""
        return self._telemetry.home.value.altitude_amsl_m

    def global_target(self, target: Position) -> tuple[int, int, float, bool]:
        """Latitude and longitude in 1e-7 degrees, altitude in metres, and whether it is above home.

        PX4 reads altitudes above mean sea level only, so home must be known there for one above home.
        """
        relative, amsl = target.altitude_relative_m, target.altitude_amsl_m
        if relative is None and amsl is None:
            relative = self._telemetry.position.fresh(OLD_POSITION_S).altitude_relative_m
        is_relative = relative is not None
        altitude = relative if relative is not None else amsl
        if altitude is None:
            raise InvalidArgument("the target has no altitude, and the vehicle's own is not known")
        check_range("altitude", altitude, -12_000, 100_000)
        if is_relative and not self.takes_relative_altitude:
            altitude, is_relative = altitude + self.home_altitude(), False
        return round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7), altitude, is_relative

    def stands_on_the_ground(self) -> bool:
        """Whether it was told just now that a vehicle which flies is on the ground."""
        landed = self._telemetry.landed_state
        flies = self._autopilot.mode_for("take_off", is_vtol=self._telemetry.is_vtol) is not None
        return flies and landed.latest == MavLandedState.ON_GROUND and landed.age <= OLD_POSITION_S

    @property
    def takes_relative_altitude(self) -> bool:
        """Whether it understands altitudes above home."""
        return self._autopilot.reposition is None or self._autopilot.reposition.relative_altitude
