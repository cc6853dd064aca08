"""Who is near to whom, among many: without IO, and without comparing everybody with everybody."""

from __future__ import annotations

import math
from itertools import combinations, product
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.fleets.paths import Place

__all__ = ["local_places", "near_pairs"]

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
