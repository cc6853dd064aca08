"""``Travel``: going to places together, on ways that were compared before."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument, OperationRejected, ValueUnknownError
from aerokit.fleets.action import FleetPart
from aerokit.fleets.distances import Around, altitude_amsl, position_of
from aerokit.fleets.events import PathsDecided
from aerokit.fleets.members import Member
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import Deconfliction, Route, in_corridors, in_layers
from aerokit.position import Position
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M

WayApart = Literal["layers", "corridors", "refuse"]
"""What is done about ways that cross: heights of their own, times of their own, or nothing is flown."""


@checks_arguments
class Travel(FleetPart):
    """Places for each, and ways that do not meet."""

    async def go_to(
        self,
        targets: Mapping[str, Position] | Callable[[Member], Position],
        *,
        speed_m_s: float | None = None,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        stagger_s: float | None = None,
        apart: Deconfliction | None = None,
    ) -> FleetResult:
        """Fly each to a place of its own; as :meth:`aerokit.Vehicle.go_to`.

        In a fleet with a ``min_distance_m`` the ways are compared first, and flown in layers if they cross.

        Args:
            targets: name → place; who is not named stays where it is. Or a function that gives the place of a member.
            speed_m_s: ground speed; None leaves it.
            max_distance_m: metres from where each is; a place farther away is refused.
            timeout: seconds that each of them has for a leg; None: as long as it takes.
            stagger_s: each begins so many seconds after the one before; None: all at once.
            apart: what :meth:`plan_apart` has decided about these targets.

        Raises:
            InvalidArgument: a name is nobody's, or a place is too far away. Nothing was sent.
            ValueUnknownError: it is not known where one of them is. Nothing was sent.
            OperationRejected: their ways come too near, and no heights keep them apart: nothing was sent. Or one fell
                out between two legs in layers: the others stay where they are.
        """
        if speed_m_s is not None:
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        places = self._places(targets)
        names = tuple(self.members) if callable(targets) else tuple(places)
        for name, place in places.items():
            self.members[name].vehicle._where.check_reach(f"targets[{name!r}]", [place], max_distance_m)
        return await self._travel(
            "go_to", places, speed_m_s, timeout, stagger_s, apart, names=names, max_distance_m=max_distance_m
        )

    def plan_apart(
        self,
        targets: Mapping[str, Position] | Callable[[Member], Position],
        *,
        min_distance_m: float | None = None,
        by: WayApart = "layers",
        speed_m_s: float | None = None,
        highest_m: float | None = None,
        slack_s: float = 3.0,
    ) -> Deconfliction:
        """Compare the straight ways to these places, and decide how they are flown. Nothing is sent.

        Who is not named counts where it is. The event :class:`PathsDecided` tells what was decided.

        Args:
            targets: as for :meth:`go_to`.
            min_distance_m: metres that have to be between any two; None: the fleet's own.
            by: ``"layers"``: heights of their own; ``"corridors"``: times of their own, for which ``speed_m_s`` is
                needed; ``"refuse"``: ways that cross are not flown.
            speed_m_s: of all of them.
            highest_m: no layer is higher, in metres above the sea; None: no limit.
            slack_s: for corridors: by how many seconds one may be early or late compared with another.

        Raises:
            InvalidArgument: a name is nobody's, or an argument is missing.
            ValueUnknownError: it is not known where one of them is.
        """
        least_m = self._crew.min_distance_m if min_distance_m is None else min_distance_m
        if least_m is None:
            raise InvalidArgument("min_distance_m is needed: this fleet has none")
        routes, standing = self._routes(self._places(targets))
        if by == "corridors":
            if speed_m_s is None:
                raise InvalidArgument("by = 'corridors' needs speed_m_s: times come of ways and speeds")
            decided = in_corridors(routes, standing, least_m, speed_m_s, slack_s=slack_s)
        else:
            decided = in_layers(
                routes, standing, least_m, highest_m=float("inf") if highest_m is None else highest_m
            )
            if by == "refuse" and decided.decision == "layers":
                decided = decided.replace(decision="refused", heights_m={})
        self._crew.tell(PathsDecided(self._crew.now(), 0, "", decided))
        return decided

    # --------------------------------------------------------------------------------------- inside

    async def _travel(
        self,
        what: str,
        places: Mapping[str, Position],
        speed_m_s: float | None,
        timeout: float | None,
        stagger_s: float | None = None,
        apart: Deconfliction | None = None,
        *,
        names: tuple[str, ...] = (),
        max_distance_m: float = MAX_DISTANCE_M,
    ) -> FleetResult:
        """On ways that are compared, if nothing is decided about them; ``what``: the action, as errors call it."""
        if apart is None and self._crew.min_distance_m is not None:
            apart = self.plan_apart(places, speed_m_s=speed_m_s)
        if apart is None or apart.decision == "clear":
            return await self._fly_to(
                what, places, speed_m_s, timeout, stagger_s, None, names, max_distance_m
            )
        if apart.decision == "refused":
            raise OperationRejected(f"{what}: {apart.why}; nothing was sent")
        if apart.decision == "corridors":
            delays_s = apart.delays_s
            return await self._fly_to(
                what, places, speed_m_s, timeout, stagger_s, delays_s, (), max_distance_m
            )
        return await self._fly_in_layers(what, places, speed_m_s, timeout, apart.heights_m, max_distance_m)

    def _places(self, targets: Mapping[str, Position] | Callable[[Member], Position]) -> dict[str, Position]:
        for each in self:
            each.look()
        if callable(targets):
            return {each.name: _target_of(targets, each) for each in self if each.takes_orders}
        for name in targets:
            if name not in self.members:
                raise InvalidArgument(f"targets: {shown(name)} is not one of {', '.join(self.members)}")
        return dict(targets)

    def _routes(
        self, places: Mapping[str, Position]
    ) -> tuple[list[Route], dict[str, tuple[float, float, float]]]:
        """Of those that move, and where all others of the fleet are, as far as that is known."""
        members = self._crew.members
        movers = [members[name] for name in places if members[name].takes_orders]
        if not movers:
            return [], {}
        around = Around(position_of(movers[0]))
        routes = [
            Route(
                each.name,
                around.of_member(each),
                around.place(places[each.name], altitude_amsl(each, places[each.name])),
            )
            for each in movers
        ]
        standing = {
            each.name: around.place(here, here.altitude_amsl_m)
            for each in members.values()
            if each not in movers
            and (here := each.vehicle.position.latest)
            and here.altitude_amsl_m is not None
        }
        return routes, standing

    async def _fly_to(
        self,
        what: str,
        places: Mapping[str, Position],
        speed_m_s: float | None,
        timeout: float | None,
        stagger_s: float | None = None,
        delays_s: Mapping[str, float] | None = None,
        names: tuple[str, ...] = (),
        max_distance_m: float = MAX_DISTANCE_M,
    ) -> FleetResult:
        async def fly(member: Member) -> None:
            if delays_s and delays_s.get(member.name):
                await anyio.sleep(delays_s[member.name])
            await member.vehicle.go_to(
                places[member.name], speed_m_s=speed_m_s, timeout=timeout, max_distance_m=max_distance_m
            )

        return await self._run(what, fly, stagger_s=stagger_s, names=names or tuple(places))

    async def _fly_in_layers(
        self,
        what: str,
        places: Mapping[str, Position],
        speed_m_s: float | None,
        timeout: float | None,
        heights_m: Mapping[str, float],
        max_distance_m: float,
    ) -> FleetResult:
        """Up, across, down: all of them are done with one before anybody begins the next."""
        here = {name: position_of(self._crew.members[name], math.inf) for name in heights_m}
        stages: tuple[dict[str, Position], ...] = (
            {name: _at(here[name], height) for name, height in heights_m.items()},
            {name: _at(places[name], height) for name, height in heights_m.items()},
            {name: places[name] for name in heights_m},
        )
        result: FleetResult | None = None
        for stage in stages:
            gone = [name for name in stage if not self.members[name].takes_orders]
            if gone:  # it may stand in anybody's way
                raise OperationRejected(
                    f"{what}: {', '.join(gone)} fell out between two legs; the others stay in their layers"
                )
            result = await self._fly_to(what, stage, speed_m_s, timeout, max_distance_m=max_distance_m)
            if not result.is_complete:
                break
        assert result is not None
        return result


def _target_of(targets: Callable[[Member], Position], member: Member) -> Position:
    try:
        return targets(member)
    except ValueUnknownError as error:  # such as where it is now
        raise type(error)(f"{member.name}: {error}") from error


def _at(place: Position, altitude_amsl_m: float) -> Position:
    return Position(place.latitude_deg, place.longitude_deg, altitude_amsl_m=altitude_amsl_m)
