"""Finds conflicts between paths, and separates the paths by altitude or time. Without IO."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import Literal, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.fleets.paths import LocalPoint, Path, PathPoint, horizontal_distance, min_path_distance

__all__ = [
    "Conflict",
    "Deconfliction",
    "Route",
    "find_conflicts",
    "pairs_within",
    "separate_by_altitude",
    "separate_by_time",
    "to_local_points",
]

DELAY_STEP_S = 1.0

SLACK_S = 3.0
"""Default of ``slack_s``: the time in seconds by which a vehicle may start late on a path separated by time."""


class Route(Snapshot):
    """A straight path between two points in metres north, east and up of a common origin."""

    name: str
    start: LocalPoint
    target: LocalPoint


class Conflict(Snapshot):
    """Two paths that come too close to each other.

    ``at_s`` is the time of the closest point on the first path; None if times are ignored.
    """

    name: str
    other: str
    distance_m: float
    at_s: float | None = None


class Deconfliction(Snapshot):
    """Result of comparing paths: a decision and its reason.

    ``decision`` is one of

    - ``"clear"``: no conflicts;
    - ``"layers"``: all vehicles climb to ``heights_m``, cross there, and descend after all have crossed;
    - ``"corridors"``: the vehicles fly the direct paths at ``speed_m_s``, each after its delay in ``delays_s``;
      a vehicle that would start more than ``slack_s`` seconds late does not start;
    - ``"refused"``: the conflicts cannot be resolved.

    ``conflicts`` are those of the direct paths, without layers and delays. ``heights_m`` are above sea level.
    ``routes`` has the paths that were compared, and ``stationary`` the positions of members that do not move. All
    coordinates are metres north and east of the first route's target, and metres above sea level.
    """

    decision: Literal["clear", "layers", "corridors", "refused"]
    reason: str
    min_distance_m: float
    conflicts: Sequence[Conflict] = ()
    heights_m: Mapping[str, float] = {}
    delays_s: Mapping[str, float] = {}
    slack_s: float = SLACK_S
    speed_m_s: float | None = None
    routes: Sequence[Route] = ()
    stationary: Mapping[str, LocalPoint] = {}


def find_conflicts(paths: Sequence[Path], min_distance_m: float, *, slack_s: float = math.inf) -> tuple[Conflict, ...]:
    """Return all pairs of paths that come closer than ``min_distance_m``.

    Args:
        paths: paths of the vehicles.
        min_distance_m: minimum distance in metres.
        slack_s: how early or late one vehicle may be relative to another, in seconds; infinite: ignore times.
    """
    _check_distance(min_distance_m)
    conflicts: list[Conflict] = []
    for path, other in combinations(paths, 2):
        approach = min_path_distance(path, other, slack_s=slack_s, below_m=min_distance_m)
        if approach.distance_m < min_distance_m:
            at_s = approach.at_s if slack_s < math.inf else None
            conflicts.append(Conflict(path.name, other.name, approach.distance_m, at_s))
    return tuple(conflicts)


def separate_by_altitude(
    routes: Sequence[Route],
    stationary: Mapping[str, LocalPoint],
    min_distance_m: float,
    *,
    max_altitude_m: float = math.inf,
) -> Deconfliction:
    """Separate conflicting routes by altitude.

    All vehicles climb to layers, then cross, then descend. A phase begins only after all vehicles have finished the
    phase before, so only movements of the same phase have to be separated.

    Args:
        routes: routes of the moving vehicles.
        stationary: positions of the vehicles that do not move, on the ground or in the air.
        min_distance_m: minimum distance in metres, which is also the distance between layers.
        max_altitude_m: highest layer in metres above sea level.
    """
    if math.isnan(max_altitude_m):
        raise InvalidArgument("max_altitude_m = nan is not a number")
    conflicts = _conflicts(routes, stationary, min_distance_m)
    if not conflicts:
        return Deconfliction("clear", "no paths come too close", min_distance_m)
    reason = _vertical_conflict(routes, stationary, min_distance_m)
    if reason:
        return Deconfliction("refused", reason, min_distance_m, conflicts)
    # The lowest layer is at the highest start or target, so that every vehicle climbs to its layer.
    lowest_m = max(max(_altitude_m(route.start), _altitude_m(route.target)) for route in routes)
    heights = _layer_heights(routes, stationary, lowest_m, min_distance_m)
    highest = max(heights.values())
    if highest > max_altitude_m:
        reason = f"the paths cross, and the layers would reach {highest:.0f} m, above {max_altitude_m:.0f} m"
        return Deconfliction("refused", reason, min_distance_m, conflicts)
    reason = f"{describe_pairs(conflicts)} come too close; they cross in {len(set(heights.values()))} layers"
    return Deconfliction("layers", reason, min_distance_m, conflicts, heights_m=heights)


def _layer_heights(
    routes: Sequence[Route], stationary: Mapping[str, LocalPoint], lowest_m: float, min_distance_m: float
) -> dict[str, float]:
    """Return the altitude of each route: that of the lowest layer that nothing blocks."""
    heights: dict[str, float] = {}
    for route in routes:
        earlier_routes = [earlier for earlier in routes if earlier.name in heights]
        used = {heights[earlier.name] for earlier in earlier_routes if _paths_cross(earlier, route, min_distance_m)}
        layer, height_m = 0, lowest_m
        while height_m in used or _is_layer_blocked(route, stationary, height_m, min_distance_m):
            layer += 1
            height_m = lowest_m + layer * min_distance_m
        heights[route.name] = height_m
    return heights


def separate_by_time(
    routes: Sequence[Route],
    stationary: Mapping[str, LocalPoint],
    min_distance_m: float,
    speed_m_s: float,
    *,
    slack_s: float = SLACK_S,
    max_delay_s: float = 300.0,
) -> Deconfliction:
    """Separate conflicting routes by time: delay the starts of vehicles.

    The decision is "clear" if there are no conflicts, "corridors" if delays resolve them, and otherwise "refused".

    Args:
        routes: routes of the moving vehicles.
        stationary: positions of the vehicles that do not move.
        min_distance_m: minimum distance in metres.
        speed_m_s: ground speed of all moving vehicles.
        slack_s: how early or late one vehicle may be relative to another, in seconds.
        max_delay_s: maximum delay of a vehicle's start in seconds.
    """
    conflicts = _conflicts(routes, stationary, min_distance_m)
    if not conflicts:
        return Deconfliction("clear", "no paths come too close", min_distance_m)
    resting = resting_paths(stationary)
    refusal = ""
    sequence = list(routes)
    for _ in routes:  # at most one try for each route
        delays = _delays(sequence, resting, min_distance_m, speed_m_s, slack_s=slack_s, max_delay_s=max_delay_s)
        if not isinstance(delays, _Blocked):
            delays = {route.name: delays[route.name] for route in routes}  # Restore the sequence of `routes`.
            max_s = max(delays.values())
            reason = f"{describe_pairs(conflicts)} come too close; starts are delayed by up to {max_s:g} s"
            return Deconfliction(
                "corridors", reason, min_distance_m, conflicts, delays_s=delays, slack_s=slack_s, speed_m_s=speed_m_s
            )
        blocked = delays.route
        refusal = f"{blocked.name} would have to wait for {delays.blocker} longer than {max_delay_s:g} s"
        # A route waits only for routes before it in the sequence, so the next try begins with the blocked route.
        sequence = [blocked, *(route for route in sequence if route is not blocked)]
    return Deconfliction("refused", refusal, min_distance_m, conflicts)


def _conflicts(
    routes: Sequence[Route], stationary: Mapping[str, LocalPoint], min_distance_m: float
) -> tuple[Conflict, ...]:
    _check_distance(min_distance_m)
    # Times are ignored here, so the paths can have any speed.
    paths = [Path.straight(route.name, route.start, route.target, speed_m_s=1.0) for route in routes]
    conflicts = list(find_conflicts(paths, min_distance_m))
    resting = resting_paths(stationary)
    for path in paths:
        for resting_path in resting:
            approach = min_path_distance(path, resting_path, below_m=min_distance_m)
            if approach.distance_m < min_distance_m:
                conflicts.append(Conflict(path.name, resting_path.name, approach.distance_m))
    return tuple(conflicts)


def resting_paths(stationary: Mapping[str, LocalPoint]) -> list[Path]:
    return [Path(name, (PathPoint(0.0, *point),)) for name, point in stationary.items()]


class _Blocked(NamedTuple):
    """A route that would need more than the maximum delay."""

    route: Route
    blocker: str  # name of the vehicle for which it would have to wait


def _delays(
    sequence: Sequence[Route],
    resting_paths: Sequence[Path],
    min_distance_m: float,
    speed_m_s: float,
    *,
    slack_s: float,
    max_delay_s: float,
) -> dict[str, float] | _Blocked:
    """Find the delays in seconds that prevent all conflicts, route by route in this sequence."""
    delayed_paths: list[Path] = []
    delays: dict[str, float] = {}
    for route in sequence:
        delay_s = 0.0
        while True:
            path = Path.straight(route.name, route.start, route.target, speed_m_s, at_s=delay_s)
            blocker = _find_blocker(path, [*delayed_paths, *resting_paths], min_distance_m, slack_s)
            if blocker is None:
                break
            delay_s += DELAY_STEP_S
            if delay_s > max_delay_s:
                return _Blocked(route, blocker)
        delayed_paths.append(path)
        delays[route.name] = delay_s
    return delays


def _vertical_conflict(routes: Sequence[Route], stationary: Mapping[str, LocalPoint], min_distance_m: float) -> str:
    """Return why the vehicles cannot climb and descend vertically; an empty string if they can."""
    for end in ("start", "target"):
        points: dict[str, LocalPoint] = {route.name: getattr(route, end) for route in routes}
        for name, point in points.items():
            # The vertical path leads upwards from the point, so stationary vehicles well below the point do not matter.
            lowest_m = _altitude_m(point) - min_distance_m
            obstacles = {obstacle: place for obstacle, place in stationary.items() if _altitude_m(place) > lowest_m}
            for neighbour, neighbour_point in {**points, **obstacles}.items():
                distance = math.dist(point[:2], neighbour_point[:2])
                if neighbour != name and distance < min_distance_m:
                    return f"at the {end} of {name}, {neighbour} is horizontally {distance:.1f} m away: too close"
    return ""


def _altitude_m(point: LocalPoint) -> float:
    _, _, up_m = point
    return up_m


def _paths_cross(route: Route, other: Route, min_distance_m: float) -> bool:
    return horizontal_distance((route.start, route.target), (other.start, other.target)) < min_distance_m


def _is_layer_blocked(
    route: Route, stationary: Mapping[str, LocalPoint], height_m: float, min_distance_m: float
) -> bool:
    # A stationary vehicle counts as a path that ends where it begins: (point, point).
    return any(
        abs(_altitude_m(point) - height_m) < min_distance_m
        and horizontal_distance((route.start, route.target), (point, point)) < min_distance_m
        for point in stationary.values()
    )


def _find_blocker(path: Path, others: Sequence[Path], min_distance_m: float, slack_s: float) -> str | None:
    for other in others:
        approach = min_path_distance(path, other, slack_s=slack_s, below_m=min_distance_m)
        if approach.distance_m < min_distance_m:
            return other.name
    return None


def describe_pairs(conflicts: Sequence[Conflict]) -> str:
    texts = [f"{conflict.name} and {conflict.other} ({conflict.distance_m:.1f} m)" for conflict in conflicts[:3]]
    more = len(conflicts) - len(texts)
    more_text = f" and {more} more pairs" if more else ""
    return ", ".join(texts) + more_text


def _check_distance(min_distance_m: float) -> None:
    if not 0 < min_distance_m < math.inf:
        raise InvalidArgument(f"min_distance_m = {min_distance_m!r} is not allowed: it must be above 0 metres")


METRES_PER_DEGREE = 111_319.5

# The steps to 13 of the 26 neighbours of a cube. With half of them, each pair of neighbouring cubes is compared once.
HALF_OF_NEIGHBOURS = tuple(step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0))


def pairs_within(points: Mapping[str, LocalPoint], max_distance_m: float) -> list[tuple[str, str, float]]:
    """Return all pairs of points that are closer than ``max_distance_m``, as two names and the distance in metres.

    Divides space into cubes with edges of ``max_distance_m``, and compares only points in the same or neighbouring
    cubes.
    """
    cubes: dict[tuple[int, int, int], list[str]] = {}
    for name, (north, east, up) in points.items():
        cube = math.floor(north / max_distance_m), math.floor(east / max_distance_m), math.floor(up / max_distance_m)
        cubes.setdefault(cube, []).append(name)
    all_names = list(points)
    index_of = {name: index for index, name in enumerate(all_names)}
    distances: dict[tuple[int, int], float] = {}  # by the indices of both points, the smaller index first
    for (x, y, z), names in cubes.items():
        candidates = list(combinations(names, 2))
        for dx, dy, dz in HALF_OF_NEIGHBOURS:
            neighbours = cubes.get((x + dx, y + dy, z + dz))
            if neighbours is not None:
                candidates += product(names, neighbours)
        for name, other in candidates:
            distance = math.dist(points[name], points[other])
            if distance < max_distance_m:
                index, other_index = index_of[name], index_of[other]
                distances[min(index, other_index), max(index, other_index)] = distance
    return [(all_names[first], all_names[second], distance) for (first, second), distance in sorted(distances.items())]


def to_local_points(positions: Mapping[str, tuple[float, float, float]]) -> dict[str, LocalPoint]:
    """Convert latitude, longitude (degrees) and altitude (metres) to metres.

    North and east are relative to the first position, accurate to 0.1 % within a few kilometres. The altitude is
    unchanged.
    """
    if not positions:
        return {}
    first_latitude, first_longitude, _ = next(iter(positions.values()))
    metres_per_degree_east = METRES_PER_DEGREE * math.cos(math.radians(first_latitude))
    return {
        name: (
            (latitude - first_latitude) * METRES_PER_DEGREE,
            math.remainder(longitude - first_longitude, 360.0) * metres_per_degree_east,
            altitude,
        )
        for name, (latitude, longitude, altitude) in positions.items()
    }
