"""Kept apart: ways are compared before they are flown, and given heights or times of their own. Without IO."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import Literal

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.fleets.paths import Path, PathPoint, Place, horizontal_distance, least_distance

__all__ = [
    "Conflict",
    "Deconfliction",
    "Route",
    "conflicts_of",
    "in_corridors",
    "in_layers",
    "local_places",
    "near_pairs",
]

STEP_S = 1.0


class Route(Snapshot):
    """Straight from one place to another: metres north, east and up of a common origin."""

    name: str
    start: Place
    target: Place


class Conflict(Snapshot):
    """Two ways come nearer to each other than they may; ``at_s``: when, of the first one's time; None: whenever."""

    name: str
    other: str
    distance_m: float
    at_s: float | None = None


class Deconfliction(Snapshot):
    """What was decided about some ways, and why.

    ``decision`` is ``"clear"`` (they may be flown as they are), ``"layers"`` (all climb to ``heights_m`` first, cross
    there, and come down when all have crossed), ``"corridors"`` (each sets off ``delays_s`` later) or ``"refused"``.
    ``conflicts`` are those of the ways as they were. Heights are metres above the sea.
    """

    decision: Literal["clear", "layers", "corridors", "refused"]
    why: str
    min_distance_m: float
    conflicts: Sequence[Conflict] = ()
    heights_m: Mapping[str, float] = {}
    delays_s: Mapping[str, float] = {}


def conflicts_of(
    paths: Sequence[Path], min_distance_m: float, *, slack_s: float = math.inf
) -> tuple[Conflict, ...]:
    """All pairs of paths that come nearer to each other than ``min_distance_m`` metres.

    Args:
        paths: of the vehicles.
        min_distance_m: metres.
        slack_s: by how many seconds one may be early or late compared with another; infinite: times do not count.
    """
    _check_distance(min_distance_m)
    found: list[Conflict] = []
    for one, other in combinations(paths, 2):
        near = least_distance(one, other, slack_s=slack_s, below_m=min_distance_m)
        if near.distance_m < min_distance_m:
            at_s = near.at_s if slack_s < math.inf else None
            found.append(Conflict(one.name, other.name, near.distance_m, at_s))
    return tuple(found)


def in_layers(
    routes: Sequence[Route],
    standing: Mapping[str, Place],
    min_distance_m: float,
    *,
    highest_m: float = math.inf,
) -> Deconfliction:
    """Let ways cross at heights of their own, if they come too near to each other.

    All go up where they are, then across, then down, and nobody begins the next of these before all are done with the
    one before: so only what happens at the same time has to be apart.

    Args:
        routes: of those that move.
        standing: those that stay where they are, on the ground or in the air.
        min_distance_m: metres; also between two layers.
        highest_m: no layer is above this height.
    """
    conflicts = _conflicts(routes, standing, min_distance_m)
    if not conflicts:
        return Deconfliction("clear", "no two ways come too near", min_distance_m)
    ends = _ends_too_near(routes, standing, min_distance_m)
    if ends:
        return Deconfliction("refused", ends, min_distance_m, conflicts)
    base = max(max(each.start[2], each.target[2]) for each in routes)
    layers: dict[str, int] = {}
    for route in routes:
        taken = {
            layers[each.name]
            for each in routes
            if each.name in layers and _cross(each, route, min_distance_m)
        }
        layer = 0
        while layer in taken or _meets(route, standing, base + layer * min_distance_m, min_distance_m):
            layer += 1
        layers[route.name] = layer
    heights = {name: base + layer * min_distance_m for name, layer in layers.items()}
    highest = max(heights.values())
    if highest > highest_m:
        why = f"the ways cross, and the layers would go up to {highest:.0f} m, above {highest_m:.0f} m"
        return Deconfliction("refused", why, min_distance_m, conflicts)
    why = f"{_pairs(conflicts)} come too near: they cross in {len(set(layers.values()))} layers"
    return Deconfliction("layers", why, min_distance_m, conflicts, heights)


def in_corridors(
    routes: Sequence[Route],
    standing: Mapping[str, Place],
    min_distance_m: float,
    speed_m_s: float,
    *,
    slack_s: float = 3.0,
    longest_s: float = 300.0,
) -> Deconfliction:
    """Let ways cross at times of their own, if they come too near to each other.

    Args:
        routes: of those that move, at one speed.
        standing: those that stay where they are.
        min_distance_m: metres.
        speed_m_s: of all of them.
        slack_s: by how many seconds one may be early or late compared with another.
        longest_s: nobody waits longer than this.
    """
    conflicts = _conflicts(routes, standing, min_distance_m)
    if not conflicts:
        return Deconfliction("clear", "no two ways come too near", min_distance_m)
    rests = [Path(name, (PathPoint(0.0, *place),)) for name, place in standing.items()]
    order, refusal = list(routes), ""
    for _ in routes:
        delays, stuck, behind = _delays(order, rests, min_distance_m, speed_m_s, slack_s, longest_s)
        if stuck is None:
            in_order = {each.name: delays[each.name] for each in routes}
            why = f"{_pairs(conflicts)} come too near: they set off up to {max(delays.values()):g} s later"
            return Deconfliction("corridors", why, min_distance_m, conflicts, {}, in_order)
        refusal = f"{stuck.name} would have to wait for {behind} longer than {longest_s:g} s"
        order = [stuck, *(each for each in order if each is not stuck)]  # who is in the way goes first
    return Deconfliction("refused", refusal, min_distance_m, conflicts)


# ------------------------------------------------------------------------------------------- inside
def _conflicts(
    routes: Sequence[Route], standing: Mapping[str, Place], min_distance_m: float
) -> tuple[Conflict, ...]:
    _check_distance(min_distance_m)
    paths = [Path.straight(each.name, each.start, each.target, 1.0) for each in routes]
    moving = conflicts_of(paths, min_distance_m)
    rests = [Path(name, (PathPoint(0.0, *place),)) for name, place in standing.items()]
    found = list(moving)
    for path in paths:
        for rest in rests:
            near = least_distance(path, rest, below_m=min_distance_m)
            if near.distance_m < min_distance_m:
                found.append(Conflict(path.name, rest.name, near.distance_m))
    return tuple(found)


def _delays(
    order: Sequence[Route],
    rests: Sequence[Path],
    min_distance_m: float,
    speed_m_s: float,
    slack_s: float,
    longest_s: float,
) -> tuple[dict[str, float], Route | None, str]:
    """How long each waits; and who would wait too long, if anybody, and for whom."""
    placed: list[Path] = []
    delays: dict[str, float] = {}
    for route in order:
        delay_s = 0.0
        while True:
            path = Path.straight(route.name, route.start, route.target, speed_m_s, delay_s)
            in_the_way = _first_near(path, [*placed, *rests], min_distance_m, slack_s)
            if in_the_way is None:
                break
            delay_s += STEP_S
            if delay_s > longest_s:
                return delays, route, in_the_way
        placed.append(path)
        delays[route.name] = delay_s
    return delays, None, ""


def _ends_too_near(routes: Sequence[Route], standing: Mapping[str, Place], min_distance_m: float) -> str:
    """Why nobody can go straight up or down; empty: they can."""
    for what in ("start", "target"):
        ends = {each.name: getattr(each, what) for each in routes}
        # who stands well below an end is not in the way of one who goes up from it, or comes down to it
        for name, place in ends.items():
            near = {other: there for other, there in standing.items() if there[2] > place[2] - min_distance_m}
            for other, there in {**ends, **near}.items():
                distance = math.dist(place[:2], there[:2])
                if other != name and distance < min_distance_m:
                    return (
                        f"the {what} of {name} is {distance:.1f} m beside that of {other}, as seen from above"
                    )
    return ""


def _cross(one: Route, other: Route, min_distance_m: float) -> bool:
    return horizontal_distance((one.start, one.target), (other.start, other.target)) < min_distance_m


def _meets(route: Route, standing: Mapping[str, Place], height_m: float, min_distance_m: float) -> bool:
    return any(
        abs(place[2] - height_m) < min_distance_m
        and horizontal_distance((route.start, route.target), (place, place)) < min_distance_m
        for place in standing.values()
    )


def _first_near(path: Path, others: Sequence[Path], min_distance_m: float, slack_s: float) -> str | None:
    for other in others:
        if least_distance(path, other, slack_s=slack_s, below_m=min_distance_m).distance_m < min_distance_m:
            return other.name
    return None


def _pairs(conflicts: Sequence[Conflict]) -> str:
    shown = [f"{each.name} and {each.other} ({each.distance_m:.1f} m)" for each in conflicts[:3]]
    more = len(conflicts) - len(shown)
    return ", ".join(shown) + (f" and {more} more pairs" if more else "")


def _check_distance(min_distance_m: float) -> None:
    if not 0 < min_distance_m < math.inf:
        raise InvalidArgument(f"min_distance_m = {min_distance_m!r} is not allowed: above 0 metres")


METRES_PER_DEGREE = 111_319.5

AHEAD = tuple(step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0))
"""Half of the neighbours of a cube: the others have it for a neighbour."""


def near_pairs(places: Mapping[str, Place], within_m: float) -> list[tuple[str, str, float]]:
    """All pairs that are nearer to each other than ``within_m``, with their distance in metres.

    The air is divided into cubes of that size: only neighbouring ones are compared.
    """
    cubes: dict[tuple[int, int, int], list[str]] = {}
    for name, (north, east, up) in places.items():
        cube = math.floor(north / within_m), math.floor(east / within_m), math.floor(up / within_m)
        cubes.setdefault(cube, []).append(name)
    order = {name: number for number, name in enumerate(places)}
    found: list[tuple[str, str, float]] = []
    for (x, y, z), names in cubes.items():
        pairs = list(combinations(names, 2))
        for dx, dy, dz in AHEAD:
            others = cubes.get((x + dx, y + dy, z + dz))
            if others is not None:
                pairs += product(names, others)
        for one, other in pairs:
            distance = math.dist(places[one], places[other])
            if distance < within_m:
                first, second = (one, other) if order[one] < order[other] else (other, one)
                found.append((first, second, distance))
    return sorted(found, key=lambda pair: (order[pair[0]], order[pair[1]]))


def local_places(places: Mapping[str, tuple[float, float, float]]) -> dict[str, Place]:
    """Latitudes, longitudes (degrees) and altitudes (metres) as metres around the first of them.

    Good to a thousandth for some kilometres: for distances between neighbours.
    """
    if not places:
        return {}
    latitude, longitude, _ = next(iter(places.values()))
    east = METRES_PER_DEGREE * math.cos(math.radians(latitude))
    return {
        name: (
            (each[0] - latitude) * METRES_PER_DEGREE,
            math.remainder(each[1] - longitude, 360.0) * east,
            each[2],
        )
        for name, each in places.items()
    }
