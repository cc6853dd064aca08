"""``DistanceWatch``: looks at how near members are to each other while they fly, and has them hold."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit._internal import geo
from aerokit.errors import AerokitError, ValueUnknownError
from aerokit.fleets.events import TooClose
from aerokit.fleets.separation import local_places, near_pairs
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position

if TYPE_CHECKING:
    from aerokit.fleets.action import Crew
    from aerokit.fleets.members import Member
    from aerokit.fleets.paths import Place

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


LOOK_S = 0.25

FREE_AGAIN = 1.2
"""A pair is told of again once it has been so many times as far apart."""


class DistanceWatch:
    """Four times a second; a pair is told of once, until they are well apart again."""

    def __init__(self, crew: Crew, min_distance_m: float, *, holds: bool) -> None:
        self._crew, self._min_distance_m, self._holds = crew, min_distance_m, holds
        self._near: set[tuple[str, str]] = set()

    async def run(self) -> None:
        """Until it is cancelled."""
        while True:
            self.look()
            await anyio.sleep(LOOK_S)

    def look(self) -> None:
        """Look now."""
        places = local_places(self._told_places())
        pairs = near_pairs(places, FREE_AGAIN * self._min_distance_m)
        self._near &= {(one, other) for one, other, _ in pairs}
        for one, other, distance_m in pairs:
            if distance_m < self._min_distance_m and (one, other) not in self._near:
                self._near.add((one, other))
                self._on_near(self._crew.members[one], self._crew.members[other], distance_m)

    def _told_places(self) -> dict[str, tuple[float, float, float]]:
        """Of those that fly and are heard, whoever flies them."""
        told: dict[str, tuple[float, float, float]] = {}
        for member in self._crew.members.values():
            here = member.vehicle.position.latest
            if here is None or here.altitude_amsl_m is None or member.vehicle.position.age > OLD_S:
                continue
            if is_flying(member):
                told[member.name] = here.latitude_deg, here.longitude_deg, here.altitude_amsl_m
        return told

    def _on_near(self, one: Member, other: Member, distance_m: float) -> None:
        for each in (one, other):
            each.look()
        ordered = [each for each in (one, other) if self._holds and each.is_flown_by_program]
        for each in ordered:
            self._crew.background.start(partial(self._hold, each), f"aerokit apart {each.name}")
        self._crew.tell(
            TooClose(
                self._crew.now(),
                one.vehicle.system_id,
                one.name,
                other.name,
                distance_m,
                tuple(each.name for each in ordered),
            )
        )

    async def _hold(self, member: Member) -> None:
        try:
            await member.vehicle.hold()
        except AerokitError as error:
            member.note_failed("hold", error)
