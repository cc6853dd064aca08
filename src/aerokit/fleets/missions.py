"""``Missions``: distributed to many, compared before they are flown, and started together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument, OperationRejected
from aerokit.fleets.action import FleetPart
from aerokit.fleets.distances import Around, altitude_amsl, position_of
from aerokit.fleets.events import PathsDecided
from aerokit.fleets.members import Member
from aerokit.fleets.paths import Path, PathPoint
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import Deconfliction, conflicts_of
from aerokit.missions.mission import Mission
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M


@checks_arguments
class Missions(FleetPart):
    """One mission for each."""

    async def upload(
        self,
        missions: Mapping[str, Mission],
        *,
        at_once: int = 8,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
    ) -> FleetResult:
        """Give each its mission, and read it back; as ``vehicle.mission.upload``.

        Only when all of them have theirs, :meth:`start_missions` starts them. In a fleet with a ``min_distance_m`` the
        missions are compared first.

        Args:
            missions: name → mission.
            at_once: so many transfers share a link at the same time, from 1.
            max_distance_m: metres from where each is; a mission with a place farther away is refused.
            timeout: seconds that each of them has; None: as long as something comes.

        Raises:
            InvalidArgument: a name is nobody's, or a mission cannot be right. Nothing was sent.
            OperationRejected: one of them does not take part now, or the ways come too near. Nothing was sent.
            FleetError: one of them did not take its mission: none of them will be started.
        """
        if at_once < 1:
            raise InvalidArgument(f"at_once = {at_once!r} is not allowed: at least 1")
        members = self._named(missions)
        for name, mission in missions.items():
            mission.check(home_is_item_0=members[name].vehicle.autopilot.home_is_item_0)
            places = filter(None, (each.position for each in mission.to_items()))
            members[name].vehicle._where.check_reach(f"missions[{name!r}]", places, max_distance_m)
        self._crew.missions.clear()
        if self._crew.min_distance_m is not None:
            decided = self.compare_missions(missions)
            if decided.decision == "refused":
                raise OperationRejected(f"upload: {decided.why}; nothing was sent")
        turns = {name: anyio.Semaphore(at_once) for name in self._crew.networks}

        async def upload(member: Member) -> None:
            async with turns[member.network]:
                await member.vehicle.mission.upload(
                    missions[member.name], timeout=timeout, max_distance_m=max_distance_m
                )

        result = await self._run("upload", upload, names=tuple(missions))
        result.raise_for_errors()
        self._crew.missions.update(missions)
        return result

    async def start_missions(self, *, timeout: float = 10.0, stagger_s: float | None = None) -> FleetResult:
        """Start the missions that were uploaded together, all at once or nobody; as ``vehicle.mission.start``.

        Args:
            timeout: seconds until each tells its mission mode.
            stagger_s: each begins so many seconds after the one before; None: all at once.

        Raises:
            OperationRejected: there was no upload that all of them took, or one of them does not take part any more or
                is not armed. Nothing was sent.
        """
        names = tuple(name for name in self._crew.missions if name in self.members)
        if not names:
            raise OperationRejected("start_missions: upload() comes first, and all of them have to take it")
        members = self._named(dict.fromkeys(names))
        disarmed = [name for name in names if not members[name].vehicle.is_armed]
        if disarmed:
            raise OperationRejected(f"start_missions: not armed: {', '.join(disarmed)}; nothing was sent")
        return await self._run(
            "mission.start",
            lambda member: member.vehicle.mission.start(timeout=timeout),
            stagger_s=stagger_s,
            names=names,
        )

    async def wait_missions_finished(self, *, timeout: float | None = None) -> FleetResult:
        """Wait until each has flown its mission to its end; as ``vehicle.mission.wait_finished``.

        Args:
            timeout: seconds until all of them have; None: as long as it takes.
        """
        names = tuple(name for name in self._crew.missions if name in self.members)
        return await self._run(
            "mission.wait_finished",
            lambda member: member.vehicle.mission.wait_finished(timeout=timeout),
            names=names,
        )

    def compare_missions(
        self, missions: Mapping[str, Mission], *, min_distance_m: float | None = None
    ) -> Deconfliction:
        """Compare the ways of missions, from place to place, whenever they are flown. Nothing is sent.

        Items without a place and terrain heights are not known to this; a mission with jumps is compared as it stands.
        The event :class:`PathsDecided` tells what came of it.

        Args:
            missions: name → mission.
            min_distance_m: metres that have to be between any two; None: the fleet's own.

        Raises:
            InvalidArgument: a name is nobody's, or an argument is missing.
            ValueUnknownError: it is not known where one of them is.
        """
        least_m = self._crew.min_distance_m if min_distance_m is None else min_distance_m
        if least_m is None:
            raise InvalidArgument("min_distance_m is needed: this fleet has none")
        members = self._named(missions)
        first = next(iter(members.values()), None)
        around = None if first is None else Around(position_of(first, math.inf))
        paths = (
            [] if around is None else [_path(around, members[name], each) for name, each in missions.items()]
        )
        conflicts = conflicts_of([each for each in paths if each is not None], least_m)
        pairs = ", ".join(f"{each.name} and {each.other} ({each.distance_m:.1f} m)" for each in conflicts[:3])
        why = f"{pairs} come too near" if conflicts else "no two ways come too near"
        decided = Deconfliction("refused" if conflicts else "clear", why, least_m, conflicts)
        self._crew.tell(PathsDecided(self._crew.now(), 0, "", decided))
        return decided

    def _named(self, missions: Mapping[str, Any]) -> dict[str, Member]:
        found: dict[str, Member] = {}
        for name in missions:
            if name not in self.members:
                raise InvalidArgument(f"missions: {shown(name)} is not one of {', '.join(self.members)}")
            member = found[name] = self.members[name]
            member.look()
            if not member.takes_orders:
                why = f"{name} is {member.state.value}: {member.why}"
                raise OperationRejected(f"missions: {why}; nothing was sent")
        return found


def _path(around: Around, member: Member, mission: Mission) -> Path | None:
    """From place to place; times count for nothing."""
    places = [item.position for item in mission]
    points = [
        PathPoint(0.0, *around.place(each, altitude_amsl(member, each)))
        for each in places
        if each is not None and not math.isnan(each.latitude_deg)
    ]
    return Path(member.name, points) if points else None
