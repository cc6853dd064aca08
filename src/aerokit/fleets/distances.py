"""``DistanceWatch``: looks at how near members are to each other while they fly, and has them hold."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import AerokitError
from aerokit.fleets.events import TooClose
from aerokit.fleets.nearness import local_places, near_pairs
from aerokit.fleets.whereabouts import OLD_S, is_flying

if TYPE_CHECKING:
    from aerokit.fleets.crew import Crew
    from aerokit.fleets.members import Member

__all__ = ["DistanceWatch"]

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
