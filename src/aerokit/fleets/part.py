"""``FleetPart``: what all actions of a fleet stand on: who is meant, and doing something with all of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any

from aerokit.fleets.common import CommonAction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.fleets.crew import Crew
    from aerokit.fleets.members import Member
    from aerokit.fleets.results import FleetResult
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["FleetPart"]

ENDS_FLIGHTS = ("hold", "land", "return_to_launch", "disarm", "mission.pause")
"""Actions that end a flight: nobody is stopped in them because another one has failed."""
FLIES_NOBODY = ("arm", "wait_ready", "upload")


class FleetPart:
    """Some or all members of a fleet."""

    def __init__(self, crew: Crew, names: tuple[str, ...] | None) -> None:
        self._crew, self._names = crew, names

    @property
    def members(self) -> Mapping[str, Member]:
        """Name → member, in the order in which they were named or heard."""
        members = self._crew.members
        return dict(members) if self._names is None else {name: members[name] for name in self._names}

    @property
    def vehicles(self) -> Mapping[str, Vehicle]:
        """Name → vehicle."""
        return {name: member.vehicle for name, member in self.members.items()}

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Member]:
        return iter(self.members.values())

    async def _run(
        self,
        what: str,
        act: Callable[[Member], Awaitable[Any]],
        *,
        timeout: float | None = None,
        stagger_s: float | None = None,
        names: tuple[str, ...] | None = None,
    ) -> FleetResult:
        members = [each for each in self if names is None or each.name in names]
        is_safe = what in ENDS_FLIGHTS
        return await CommonAction(
            self._crew,
            what,
            members,
            act,
            timeout=timeout,
            stagger_s=stagger_s,
            is_safe=is_safe,
            holds_if_cancelled=not is_safe and what not in FLIES_NOBODY,
        ).run()
