"""Who is near to whom, among many: without IO, and without comparing everybody with everybody."""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import product
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.fleets.paths import Place

__all__ = ["local_places", "near_pairs"]

METRES_PER_DEGREE = 111_319.5


def near_pairs(places: Mapping[str, Place], within_m: float) -> list[tuple[str, str, float]]:
    """All pairs that are nearer to each other than ``within_m``, with their distance in metres.

    The air is divided into cubes of that size: only neighbouring ones are compared.
    """
    cubes: defaultdict[tuple[int, ...], list[str]] = defaultdict(list)
    for name, place in places.items():
        cubes[tuple(math.floor(each / within_m) for each in place)].append(name)
    order = {name: number for number, name in enumerate(places)}
    found: list[tuple[str, str, float]] = []
    for cube, names in cubes.items():
        others = [
            other
            for step in product((-1, 0, 1), repeat=3)
            for other in cubes.get(tuple(a + b for a, b in zip(cube, step, strict=True)), ())
        ]
        for name in names:
            for other in others:
                if order[name] < order[other]:
                    distance = math.dist(places[name], places[other])
                    if distance < within_m:
                        found.append((name, other, distance))
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
