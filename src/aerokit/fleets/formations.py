"""``Formations``: taking places around a leader, and keeping them while it moves."""

from __future__ import annotations

from aerokit.arguments import checks_arguments
from aerokit.errors import InvalidArgument, OperationRejected
from aerokit.fleets.following import Following
from aerokit.fleets.formation import Formation
from aerokit.fleets.members import Member
from aerokit.fleets.results import FleetResult
from aerokit.fleets.travel import Travel
from aerokit.fleets.whereabouts import position_of
from aerokit.position import Position
from aerokit.vehicle.checks import check_range
from aerokit.wording import shown

__all__ = ["Formations"]


@checks_arguments
class Formations(Travel):
    """Places by offsets from a leader."""

    async def form(
        self,
        formation: Formation,
        *,
        leader: str,
        speed_m_s: float | None = None,
        timeout: float | None = None,
    ) -> FleetResult:
        """Fly each to its place around the leader, who stays where it is; as :meth:`go_to`.

        Args:
            formation: who flies where.
            leader: the name of the member around whom it is; it is not in the formation itself.
            speed_m_s: ground speed; None leaves it.
            timeout: seconds that each of them has for a leg; None: as long as it takes.

        Raises:
            InvalidArgument: a name is nobody's, or two places are too near to each other. Nothing was sent.
            OperationRejected: the leader does not take part, or the ways come too near. Nothing was sent.
            ValueUnknownError: it is not known where the leader is, or one whose way is compared.
        """
        member, followers = self._roles(formation, leader)
        here, heading = position_of(member), member.vehicle.heading_deg.latest
        places: dict[str, Position] = {}
        for each in followers:
            offset = formation.offset_of(each.name, heading)
            there = here.offset(north_m=offset.north_m, east_m=offset.east_m, up_m=offset.up_m)
            # above the sea: their homes may not be at the leader's height
            places[each.name] = (
                there
                if there.altitude_amsl_m is None
                else Position(there.latitude_deg, there.longitude_deg, altitude_amsl_m=there.altitude_amsl_m)
            )
        if speed_m_s is not None:
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        return await self._travel("form", places, speed_m_s, timeout)

    def following(
        self, formation: Formation, *, leader: str, rate_hz: float = 5.0, max_speed_m_s: float = 10.0
    ) -> Following:
        """``async with fleet.following(formation, leader="north/1"):`` keep the places while the leader moves.

        Each follower is flown by velocity set-points. When the leader is lost or taken over, the followers hold; when a
        follower fails, the others are told what the fleet's policy says.

        Args:
            formation: who flies where.
            leader: the name of the member whom they follow; somebody else flies it, such as the block's program.
            rate_hz: set-points a second, 2 to 50.
            max_speed_m_s: nobody is told to fly faster, in m/s.

        Raises:
            InvalidArgument: a name is nobody's, or an argument is out of range.
            OperationRejected: the leader does not take part.
        """
        check_range("rate_hz", rate_hz, 2, 50)
        check_range("max_speed_m_s", max_speed_m_s, 0, 100, above=True)
        member, followers = self._roles(formation, leader)
        return Following(self._crew, member, followers, formation, rate_hz, max_speed_m_s)

    def _roles(self, formation: Formation, leader: str) -> tuple[Member, list[Member]]:
        for name in (leader, *formation.offsets):
            if name not in self.members:
                raise InvalidArgument(f"formation: {shown(name)} is not one of {', '.join(self.members)}")
        if leader in formation.offsets:
            raise InvalidArgument(f"formation: {leader!r} is the leader, and has no place of its own")
        least_m = self._crew.min_distance_m
        if least_m is not None and formation.least_distance_m() < least_m:
            nearest = formation.least_distance_m()
            raise InvalidArgument(
                f"formation: two places are {nearest:.1f} m apart, and this fleet keeps {least_m:g} m"
            )
        member = self.members[leader]
        member.look()
        if not member.takes_orders:
            raise OperationRejected(f"the leader {leader} is {member.state.value}: {member.why}")
        return member, [self.members[name] for name in formation.offsets]
