"""``Selection``: some or all members of a fleet, and what they are ordered in common."""

from __future__ import annotations

from aerokit.arguments import checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.fleets.actions import Actions
from aerokit.fleets.formations import Formations
from aerokit.fleets.missions import Missions
from aerokit.fleets.shows import Shows
from aerokit.wording import shown

__all__ = ["Selection"]


@checks_arguments
class Selection(Actions, Missions, Formations, Shows):
    """Members that are ordered something in common: ``fleet``, ``fleet.group("alpha")``, ``fleet["north/*"]``.

    Every action goes to all of them at once that take part at that moment (not lost, not taken over), and returns a
    :class:`FleetResult` when each has come to its own end. When one fails, the others are told what the fleet's policy
    says, and the action ends when they have done that. Cancelled, all of them hold at once.
    """

    def __getitem__(self, pattern: str) -> Selection:
        found = self._crew.matching(pattern)
        return Selection(self._crew, tuple(name for name in found if name in self.members))

    def group(self, name: str) -> Selection:
        """Those of one group.

        Raises:
            InvalidArgument: there is no such group.
        """
        return self._those("group", name)

    def role(self, name: str) -> Selection:
        """Those with one role.

        Raises:
            InvalidArgument: nobody has it.
        """
        return self._those("role", name)

    def _those(self, what: str, name: str) -> Selection:
        found = tuple(each.name for each in self if getattr(each, what) == name)
        if not found:
            there = dict.fromkeys(getattr(each, what) for each in self if getattr(each, what))
            those = f"the {what}s are {', '.join(there)}" if there else f"there are no {what}s"
            raise InvalidArgument(f"{what} = {shown(name)} is not allowed: {those}")
        return Selection(self._crew, found)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self)}: {', '.join(self.members)}>"
