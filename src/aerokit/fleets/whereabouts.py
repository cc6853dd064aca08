"""Where members are, in metres around one of them, and back on the globe."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit import geo
from aerokit.errors import ValueUnknownError
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position

if TYPE_CHECKING:
    from aerokit.fleets.members import Member
    from aerokit.fleets.paths import Place

__all__ = ["Around", "altitude_amsl", "is_flying", "position_of"]

OLD_S = 2.0
"""What was told longer ago is not where it is now."""


def is_flying(member: Member) -> bool:
    """Whether it is armed and has not told that it stands on the ground."""
    vehicle = member.vehicle
    return vehicle.is_armed and vehicle.landed_state.latest != MavLandedState.ON_GROUND


def position_of(member: Member, within_s: float = OLD_S) -> Position:
    """Where it is, told not longer ago than this.

    Raises:
        ValueUnknownError, StaleValueError: that is not known; the text names the member.
    """
    try:
        return member.vehicle.position.fresh(within_s)
    except ValueUnknownError as error:
        raise type(error)(f"{member.name}: {error}") from None


def altitude_amsl(member: Member, place: Position) -> float:
    """Metres above the sea of a place that is meant for this member; without an altitude, of where it is.

    Raises:
        ValueUnknownError, StaleValueError: where it is, or its home, is not known.
    """
    if place.altitude_amsl_m is not None:
        return place.altitude_amsl_m
    here = position_of(member)
    if here.altitude_amsl_m is None:
        raise ValueUnknownError(f"{member.name} does not tell its altitude above the sea")
    if place.altitude_relative_m is None:
        return here.altitude_amsl_m
    if here.altitude_relative_m is None:
        raise ValueUnknownError(f"{member.name} does not tell its altitude above home")
    return here.altitude_amsl_m - here.altitude_relative_m + place.altitude_relative_m


class Around:
    """Metres north and east of a place; up is above the sea."""

    def __init__(self, origin: Position) -> None:
        self._origin = origin

    def place(self, position: Position, altitude_amsl_m: float) -> Place:
        """In metres."""
        north, east = geo.north_east_m(
            self._origin.latitude_deg,
            self._origin.longitude_deg,
            position.latitude_deg,
            position.longitude_deg,
        )
        return north, east, altitude_amsl_m

    def position(self, place: Place) -> Position:
        """On the globe, with its altitude above the sea."""
        there = self._origin.offset(north_m=place[0], east_m=place[1])
        return Position(there.latitude_deg, there.longitude_deg, altitude_amsl_m=place[2])

    def of_member(self, member: Member) -> Place:
        """Where it is now.

        Raises:
            ValueUnknownError, StaleValueError: that is not known.
        """
        here = position_of(member)
        return self.place(here, altitude_amsl(member, here))
