"""``Crew``: what all parts of a fleet share: its members, its rules, who is told, and what is under way."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.runtime.background import Background
from aerokit.runtime.bus import Bus
from aerokit.wording import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from aerokit.fleets.common import CommonAction
    from aerokit.fleets.events import FleetEvent
    from aerokit.fleets.members import Member
    from aerokit.fleets.policy import Rules
    from aerokit.missions.mission import Mission
    from aerokit.runtime.connection import Connection

__all__ = ["Crew"]


class Crew:
    """Made for one block of a fleet, and over with it."""

    def __init__(
        self,
        members: Iterable[Member],
        networks: Mapping[str, Connection],
        rules: Rules,
        now: Callable[[], float],
        on_mistake: Callable[[Exception], None],
        min_distance_m: float | None = None,
    ) -> None:
        self.members: dict[str, Member] = {each.name: each for each in members}
        self.networks: dict[str, Connection] = dict(networks)
        self.rules: Rules = rules
        self.now: Callable[[], float] = now
        self.min_distance_m: float | None = min_distance_m
        self.bus: Bus = Bus()
        self.background: Background = Background(on_mistake)
        self.under_way: list[CommonAction] = []
        self.missions: dict[str, Mission] = {}
        """Those that all who were given one have taken."""
        self.is_over: bool = False

    def start(self) -> None:
        """Begin to watch all members."""
        for each in self.members.values():
            each.watch(self.tell, self._on_fallen_out)

    async def aclose(self) -> None:
        """Watch and order nobody any more."""
        self.is_over = True
        for each in self.members.values():
            each.stop_watching()
        await self.background.aclose()

    def tell(self, event: FleetEvent) -> None:
        """Tell who listens."""
        self.bus.publish(event)

    def matching(self, *patterns: str) -> list[str]:
        """The names of members that one of these names or patterns (``"north/*"``) means, each once.

        Raises:
            InvalidArgument: one of them means nobody.
        """
        found: dict[str, None] = {}
        for pattern in patterns:
            names = [name for name in self.members if name == pattern or fnmatchcase(name, pattern)]
            if not names:
                raise InvalidArgument(
                    f"{shown(pattern)} is no member of this fleet: {', '.join(self.members) or 'it is empty'}"
                )
            found.update(dict.fromkeys(names))
        return list(found)

    def _on_fallen_out(self, member: Member) -> None:
        for each in tuple(self.under_way):
            each.note_fallen_out(member)
