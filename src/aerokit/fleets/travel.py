"""``Travel`` and ``Missions``: flights to targets and of missions. Their paths are compared before the flight."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument, OperationRejected, ValueUnknownError
from aerokit.fleets.action import SelectionBase
from aerokit.fleets.distances import LocalOrigin, altitude_amsl, position_of
from aerokit.fleets.events import PathsCompared
from aerokit.fleets.members import Member
from aerokit.fleets.paths import LocalPoint, Path, PathPoint
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import (
    SLACK_S,
    Deconfliction,
    Route,
    describe_pairs,
    find_conflicts,
    resting_paths,
    separate_by_altitude,
    separate_by_time,
)
from aerokit.mavlink.enums import MavCmd
from aerokit.missions.mission import Mission
from aerokit.position import Home, Position, travel_target
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions.item import MissionItem

# Starts and targets may differ by this much from those of a plan, because vehicles drift and positions are noisy.
MAX_PLAN_DRIFT_M = 3.0

SeparationMethod = Literal["layers", "corridors", "refuse"]
"""Method to separate crossing paths: by altitude (layers), by time (corridors), or not at all (refuse)."""


class FlightOptions(NamedTuple):
    """Options of :meth:`Travel.go_to` that apply to each leg."""

    speed_m_s: float | None = None
    timeout: float | None = None
    max_distance_m: float = MAX_DISTANCE_M
    stagger_s: float | None = None


@checks_arguments
class Travel(SelectionBase):
    """Flights of several members to targets, on paths that do not conflict."""

    async def go_to(
        self,
        targets: Mapping[str, Position | Home] | Callable[[Member], Position | Home],
        *,
        speed_m_s: float | None = None,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
        stagger_s: float | None = None,
        separation: Deconfliction | None = None,
    ) -> FleetResult:
        """Fly each member to its own target; see :meth:`aerokit.Vehicle.go_to`.

        A fleet with a ``min_distance_m`` compares the paths first, and separates crossing paths by altitude. Members
        then fly three legs: they climb to different altitudes (layers), cross, and descend to their targets.

        Args:
            targets: mapping of member names to targets, or a function that returns a member's target. Members that a
                mapping omits stay where they are.
            speed_m_s: ground speed in m/s; None: unchanged.
            max_distance_m: reject targets that are farther than this from the vehicle.
            timeout: seconds for each member and leg; None: no limit.
            stagger_s: delay in seconds between the starts of consecutive members, on each leg; None: all at once. Not
                with a ``separation`` by corridors, which has delays of its own.
            separation: result of :meth:`plan_separation` for these targets, if no member has moved since.

        Raises:
            InvalidArgument: a name is unknown, a target is too far away, or ``stagger_s`` or ``speed_m_s`` does not fit
                a ``separation`` by corridors. Nothing was sent.
            ValueUnknownError: the position of a member is unknown. Nothing was sent.
            OperationRejected: paths come too close and cannot be separated, or the separation was planned for other
                members, targets or positions; nothing was sent. Between two legs: a member became unavailable or got
                another order; the others stay in their layers.
        """
        if speed_m_s is not None:
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        positions = self._resolve_targets(targets)
        # If `targets` is a function, it was called for available members only. `names` then has all members, so that
        # the result lists unavailable members as skipped.
        names = tuple(self.members) if callable(targets) else tuple(positions)
        for name, target in positions.items():
            self.members[name].vehicle._position.check_reach(f"targets[{name!r}]", [target], max_distance_m)
        options = FlightOptions(speed_m_s, timeout, max_distance_m, stagger_s)
        return await self._travel("go_to", positions, options, separation, names=names)

    def plan_separation(
        self,
        targets: Mapping[str, Position | Home] | Callable[[Member], Position | Home],
        *,
        min_distance_m: float | None = None,
        by: SeparationMethod = "layers",
        speed_m_s: float | None = None,
        max_altitude_m: float | None = None,
        slack_s: float = SLACK_S,
    ) -> Deconfliction:
        """Compare the straight paths to these targets and plan their separation. Nothing is sent.

        Members without a target count as obstacles at their last known positions. Publishes :class:`PathsCompared`.

        Args:
            targets: as for :meth:`go_to`.
            min_distance_m: minimum distance between any two members in metres; None: that of the fleet.
            by: ``"layers"`` separates crossing paths by altitude, ``"corridors"`` by time, which needs ``speed_m_s``.
                ``"refuse"`` refuses crossing paths.
            speed_m_s: ground speed of all members in m/s, for corridors; above 0.
            max_altitude_m: highest layer in metres above sea level; None: no limit.
            slack_s: for corridors: how early or late a member may be relative to another, in seconds. A member does
                not start if a blocked event loop makes it late by more than this.

        Raises:
            InvalidArgument: a name is unknown, or a required argument is missing.
            ValueUnknownError: the position of a member is unknown.
        """
        min_m = self._context.min_distance_m if min_distance_m is None else min_distance_m
        if min_m is None:
            raise InvalidArgument("min_distance_m is required, because this fleet was created without it")
        routes, stationary = self._routes(self._resolve_targets(targets))
        if by == "corridors":
            if speed_m_s is None:
                raise InvalidArgument("by = 'corridors' needs speed_m_s to compute times")
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
            check_range("slack_s", slack_s, 0, 300)
            deconfliction = separate_by_time(routes, stationary, min_m, speed_m_s, slack_s=slack_s)
        else:
            max_m = math.inf if max_altitude_m is None else max_altitude_m
            deconfliction = separate_by_altitude(routes, stationary, min_m, max_altitude_m=max_m)
            if by == "refuse" and deconfliction.decision == "layers":  # the paths cross
                reason = f"{describe_pairs(deconfliction.conflicts)} come too close"
                deconfliction = deconfliction.replace(decision="refused", reason=reason, heights_m={})
        deconfliction = deconfliction.replace(routes=tuple(routes), stationary=stationary)
        self._context.publish(
            PathsCompared(at=self._context.now(), system_id=0, member="", deconfliction=deconfliction)
        )
        return deconfliction

    # --------------------------------------------------------------------------------------- private

    async def _travel(
        self,
        action: str,
        targets: Mapping[str, Position],
        options: FlightOptions,
        separation: Deconfliction | None = None,
        *,
        names: tuple[str, ...] = (),
    ) -> FleetResult:
        """Fly members to their targets, directly or with the planned separation.

        ``names`` lists the members of the result. By default, these are the members with a target.
        """
        if separation is not None:
            self._check_plan(action, targets, separation)
        elif self._context.min_distance_m is not None:
            separation = self.plan_separation(targets, speed_m_s=options.speed_m_s)
        if separation is None or separation.decision == "clear":
            return await self._fly_to(action, targets, options, names=names)
        if separation.decision == "refused":
            raise OperationRejected(f"{action}: {separation.reason}; nothing was sent")
        if separation.decision == "corridors":
            if options.stagger_s:
                raise InvalidArgument(f"{action}: stagger_s would change the delays of corridors; nothing was sent")
            if options.speed_m_s != separation.speed_m_s:
                raise InvalidArgument(
                    f"{action}: speed_m_s = {options.speed_m_s} is not allowed: the separation by time was planned for"
                    f" {separation.speed_m_s} m/s; nothing was sent"
                )
            return await self._fly_to(action, targets, options, names=names, corridors=separation)
        heights_m = separation.heights_m
        result = await self._fly_in_layers(action, targets, options, heights_m)
        reported_names = names or tuple(targets)
        result.skipped |= {name: self.members[name].status for name in reported_names if name not in heights_m}
        return result

    def _check_plan(self, action: str, targets: Mapping[str, Position], plan: Deconfliction) -> None:
        """Raise OperationRejected if the plan was made for other targets or positions."""
        routes, stationary = self._routes(targets)
        present = {route.name: route for route in routes}
        planned = {route.name: route for route in plan.routes}
        for name in {**planned, **present}:
            if name not in present:
                reason = f"{name} became unavailable after the separation was planned"
            elif name not in planned:
                reason = f"the separation was planned without {name}"
            elif math.dist(present[name].start, planned[name].start) > MAX_PLAN_DRIFT_M:
                reason = f"{name} has moved since the separation was planned"
            elif math.dist(present[name].target, planned[name].target) > MAX_PLAN_DRIFT_M:
                reason = f"the separation was planned for another target of {name}"
            else:
                continue
            raise OperationRejected(f"{action}: {reason}; nothing was sent")
        for name, place in stationary.items():
            if name not in plan.stationary or math.dist(place, plan.stationary[name]) > MAX_PLAN_DRIFT_M:
                reason = f"the separation was planned for another place of {name}"
                raise OperationRejected(f"{action}: {reason}; nothing was sent")

    def _resolve_targets(
        self, targets: Mapping[str, Position | Home] | Callable[[Member], Position | Home]
    ) -> dict[str, Position]:
        """Return the targets by member name. A function is called for available members only."""
        for member in self:
            member.refresh()
        if callable(targets):
            return {member.name: _target_from_function(targets, member) for member in self if member.is_available}
        self._check_members("targets", targets)
        return {name: travel_target(target) for name, target in targets.items()}

    def _routes(self, targets: Mapping[str, Position]) -> tuple[list[Route], dict[str, LocalPoint]]:
        """Return the routes of the available members, and the known positions of all other members of the fleet."""
        members = self._context.members
        moving = [members[name] for name in targets if members[name].is_available]
        if not moving:
            return [], {}
        origin = LocalOrigin(targets[moving[0].name])  # Unlike the members, the targets do not move.
        routes = [
            Route(
                member.name,
                origin.local_position_of(member),
                origin.to_local(targets[member.name], altitude_amsl(member, targets[member.name])),
            )
            for member in moving
        ]
        return routes, stationary_members(members, origin, moving=[member.name for member in moving])

    async def _fly_to(
        self,
        action: str,
        targets: Mapping[str, Position],
        options: FlightOptions,
        *,
        names: tuple[str, ...] = (),
        corridors: Deconfliction | None = None,
    ) -> FleetResult:
        async def fly(member: Member) -> None:
            await member.vehicle.go_to(
                targets[member.name],
                speed_m_s=options.speed_m_s,
                timeout=options.timeout,
                max_distance_m=options.max_distance_m,
            )

        names = names or tuple(targets)
        return await self._run(action, fly, stagger_s=options.stagger_s, names=names, corridors=corridors)

    async def _fly_in_layers(
        self, action: str, targets: Mapping[str, Position], options: FlightOptions, heights_m: Mapping[str, float]
    ) -> FleetResult:
        starts = {name: position_of(self._context.members[name]) for name in heights_m}
        climb = {name: _at_altitude(starts[name], height) for name, height in heights_m.items()}
        crossing = {name: _at_altitude(targets[name], height) for name, height in heights_m.items()}
        descent = {name: targets[name] for name in heights_m}
        result: FleetResult | None = None
        for leg in (climb, crossing, descent):
            missing = [name for name in leg if not self.members[name].is_available]
            if missing:  # an unavailable member may be in the way of the others, so the flight ends
                raise OperationRejected(
                    f"{action}: {', '.join(missing)} became unavailable after the altitudes were assigned; "
                    + ("nothing was sent" if result is None else "the others stay at their assigned altitudes")
                )
            if result is not None:
                self._check_not_ordered_since(
                    result._final_orders, action, "the others stay at their assigned altitudes"
                )
            result = await self._fly_to(action, leg, options)
            if not result.is_complete:
                break
        assert result is not None
        return result


def stationary_members(
    members: Mapping[str, Member], origin: LocalOrigin, moving: Collection[str]
) -> dict[str, LocalPoint]:
    """Return the last known positions of all members that are not ``moving``."""
    stationary: dict[str, LocalPoint] = {}
    for name, member in members.items():
        position = member.vehicle.position.latest
        if name not in moving and position is not None and position.altitude_amsl_m is not None:
            stationary[name] = origin.to_local(position, position.altitude_amsl_m)
    return stationary


def _target_from_function(targets: Callable[[Member], Position | Home], member: Member) -> Position:
    try:
        return travel_target(targets(member))
    except ValueUnknownError as error:
        raise type(error)(f"{member.name}: {error}") from error


def _at_altitude(position: Position, altitude_amsl_m: float) -> Position:
    return Position(position.latitude_deg, position.longitude_deg, altitude_amsl_m=altitude_amsl_m)


@checks_arguments
class Missions(SelectionBase):
    """Uploads and flights of missions, one for each member."""

    async def upload(
        self,
        missions: Mapping[str, Mission],
        *,
        max_concurrent: int = 8,
        max_distance_m: float = MAX_DISTANCE_M,
        timeout: float | None = None,
    ) -> FleetResult:
        """Upload a mission to each member and verify it; see ``vehicle.mission.upload``.

        :meth:`start_missions` starts the missions, but only if all uploads succeeded, and no newer upload has begun. A
        fleet with a ``min_distance_m`` compares the missions first.

        Args:
            missions: maps names of members to missions.
            max_concurrent: maximum number of simultaneous transfers on each network, at least 1.
            max_distance_m: reject missions with a position farther than this from the vehicle.
            timeout: seconds for each member; None: no limit as long as data arrives.

        Raises:
            InvalidArgument: a name is unknown, or a mission is invalid. Nothing was sent.
            OperationRejected: a member is unavailable, or paths come too close. Nothing was sent.
            FleetError: an upload failed; ``start_missions`` will start no mission.
        """
        if max_concurrent < 1:
            raise InvalidArgument(f"max_concurrent = {max_concurrent!r} is not allowed: it must be at least 1")
        members = self._require_available(missions)
        for name, mission in missions.items():
            mission.check(home_is_item_0=members[name].vehicle.autopilot.home_is_item_0)
            positions = [item.position for item in mission.to_items()]
            members[name].vehicle._position.check_reach(
                f"missions[{name!r}]", positions, max_distance_m, are_items=True
            )
        missions = self._context.newest_upload = dict(missions)
        self._context.missions.clear()
        if self._context.min_distance_m is not None:
            deconfliction = self.compare_missions(missions)
            if deconfliction.decision == "refused":
                raise OperationRejected(f"upload: {deconfliction.reason}; nothing was sent")
        slots = {name: anyio.Semaphore(max_concurrent) for name in self._context.networks}
        uploaded_items: dict[str, Sequence[MissionItem] | None] = {}

        async def upload(member: Member) -> None:
            async with slots[member.network]:
                newest = self._context.newest_upload
                if newest is not missions and member.name in newest:  # This upload may replace the newer mission.
                    self._context.newest_upload = {}
                    self._context.missions.clear()
                await member.vehicle.mission.upload(
                    missions[member.name], timeout=timeout, max_distance_m=max_distance_m
                )
                # Read now, because this plan may be replaced while other members still receive their plans.
                uploaded_items[member.name] = member.vehicle.mission._known_items

        result = await self._run("upload", upload, names=tuple(missions))
        result.raise_for_errors()
        # If a newer upload has begun, only its missions count: they were not compared with the missions of this one.
        if self._context.newest_upload is missions:
            self._context.missions.update(missions)
            self._context.uploaded_items = uploaded_items
        return result

    async def start_missions(self, *, timeout: float = 10.0, stagger_s: float | None = None) -> FleetResult:
        """Start the uploaded missions if all members can start; see ``vehicle.mission.start``.

        Args:
            timeout: seconds until each member reports its mission mode.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.

        Raises:
            OperationRejected: no mission was uploaded, the last upload failed or was for other members only, a mission
                was replaced or its vehicle has rebooted since, or a member is unavailable or not armed. Nothing was
                sent.
        """
        names = self._names_with_mission("start_missions")
        members = self._require_available(dict.fromkeys(names))
        disarmed = [name for name in names if not members[name].vehicle.is_armed]
        if disarmed:
            raise OperationRejected(f"start_missions: members not armed: {', '.join(disarmed)}; nothing was sent")
        uploaded_items = self._context.uploaded_items

        def may_be_replaced(member: Member) -> bool:
            return member.vehicle.mission._may_differ_from(uploaded_items[member.name])

        if replaced := [name for name in names if may_be_replaced(members[name])]:
            raise OperationRejected(
                f"start_missions: the mission of {', '.join(replaced)} may have been replaced since the upload (another"
                " upload, or a reboot); nothing was sent; call upload() again"
            )

        async def start(member: Member) -> None:
            if may_be_replaced(member):  # The plan may be replaced while the member waits for its start.
                raise OperationRejected(
                    f"start_missions: the mission of {member.name} may have been replaced before its delayed start;"
                    " nothing was sent to it; call upload() again"
                )
            await member.vehicle.mission.start(timeout=timeout)

        return await self._run("mission.start", start, stagger_s=stagger_s, names=names)

    async def wait_missions_finished(self, *, timeout: float | None = None) -> FleetResult:
        """Wait until each member has finished its mission; see ``vehicle.mission.wait_finished``.

        Args:
            timeout: seconds until all members have finished; None: no limit.

        Raises:
            OperationRejected: no mission was uploaded, or the last upload failed or was for other members only.
        """
        names = self._names_with_mission("wait_missions_finished")
        return await self._run(
            "mission.wait_finished", lambda member: member.vehicle.mission.wait_finished(timeout=timeout), names=names
        )

    def compare_missions(
        self, missions: Mapping[str, Mission], *, min_distance_m: float | None = None
    ) -> Deconfliction:
        """Compare the paths of missions, regardless of time, and publish :class:`PathsCompared`. Nothing is sent.

        Paths begin at the members' present positions. Members on the ground first climb to the altitude of the first
        item. Items without a position are left out, and jumps are not followed. An altitude above terrain is replaced
        by the member's present altitude. Members without a mission that are in the air count as obstacles at their last
        known positions.

        Args:
            missions: maps names of members to missions.
            min_distance_m: minimum distance between any two paths in metres; None: that of the fleet.

        Raises:
            InvalidArgument: a name is unknown, or a required argument is missing.
            OperationRejected: a member is unavailable.
            ValueUnknownError: the position of a member is unknown.
        """
        min_m = self._context.min_distance_m if min_distance_m is None else min_distance_m
        if min_m is None:
            raise InvalidArgument("min_distance_m is required, because this fleet was created without it")
        members = self._require_available(missions)
        paths: list[Path] = []
        if members:
            first_member = next(iter(members.values()))
            # A position of any age will do, because it is only the origin of the coordinates.
            origin = LocalOrigin(position_of(first_member, math.inf))
            paths = [_mission_path(origin, members[name], mission) for name, mission in missions.items()]
            # Members on the ground are ignored, because missions take off and land next to them.
            flying = {
                name: member
                for name, member in self._context.members.items()
                if member.vehicle.is_armed and not is_reported_on_ground(member.vehicle.telemetry)
            }
            stationary = stationary_members(flying, origin, moving=missions)
            paths += resting_paths(stationary)
        conflicts = tuple(conflict for conflict in find_conflicts(paths, min_m) if conflict.name in missions)
        reason = f"{describe_pairs(conflicts)} come too close" if conflicts else "no paths come too close"
        deconfliction = Deconfliction("refused" if conflicts else "clear", reason, min_m, conflicts)
        self._context.publish(
            PathsCompared(at=self._context.now(), system_id=0, member="", deconfliction=deconfliction)
        )
        return deconfliction

    def _names_with_mission(self, action: str) -> tuple[str, ...]:
        names = tuple(name for name in self._context.missions if name in self.members)
        if not names:
            raise OperationRejected(
                f"{action}: the last upload failed, or had no mission for these members; call upload() first"
            )
        return names

    def _require_available(self, missions: Mapping[str, Any]) -> dict[str, Member]:
        self._check_members("missions", missions)
        members = {name: self.members[name] for name in missions}
        for member in members.values():
            self._check_available(member, "missions", "nothing was sent")
        return members


def _mission_path(origin: LocalOrigin, member: Member, mission: Mission) -> Path:
    """Return the path of a mission from the member's present position, with time 0 for all points."""
    here = position_of(member)
    points = [PathPoint(0.0, *origin.local_position_of(member))]
    for item in mission:
        if item.command >= MavCmd.NAV_LAST or item.command == MavCmd.NAV_ROI:  # the vehicle does not fly there
            continue
        position = item.position
        if position is None and item.command in (MavCmd.NAV_TAKEOFF, MavCmd.NAV_VTOL_TAKEOFF):
            position = item.replace(x=round(here.latitude_deg * 1e7), y=round(here.longitude_deg * 1e7)).position
        if position is not None:
            points.append(PathPoint(0.0, *origin.to_local(position, altitude_amsl(member, position))))
    if is_reported_on_ground(member.vehicle.telemetry):  # The member first climbs to the altitude of the first item.
        points[0] = points[0].replace(up_m=max(point.up_m for point in points[:2]))
    return Path(member.name, points)
