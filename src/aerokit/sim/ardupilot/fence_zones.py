"""Polygons and circles of an uploaded fence: how far outside of them a place is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.local_frame import LocalFrame

__all__ = ["Zones"]

_IN, _OUT = MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION
_CIRCLE_IN, _CIRCLE_OUT = MavCmd.NAV_FENCE_CIRCLE_INCLUSION, MavCmd.NAV_FENCE_CIRCLE_EXCLUSION
Point = tuple[float, float]


class Zones:
    """Made of the items of a stored fence; places are metres north and east in the same frame."""

    def __init__(self, items: Sequence[MissionItem], frame: LocalFrame) -> None:
        self._inside: list[Polygon | Circle] = []
        self._outside: list[Polygon | Circle] = []
        corners: list[Point] = []
        for item in items:
            place = frame.to_local(int(item.x), int(item.y))
            if item.command in (_CIRCLE_IN, _CIRCLE_OUT):
                zones = self._inside if item.command == _CIRCLE_IN else self._outside
                zones.append(Circle(place, item.param1))
            elif item.command in (_IN, _OUT):
                corners.append(place)
                if len(corners) == int(item.param1):
                    (self._inside if item.command == _IN else self._outside).append(Polygon(corners))
                    corners = []

    def __bool__(self) -> bool:
        """Whether there is any; a return point alone is none."""
        return bool(self._inside or self._outside)

    @property
    def smallest_inclusion_m(self) -> float:
        """Radius of the smallest circle to stay in; infinity without one."""
        return min((zone.radius for zone in self._inside if isinstance(zone, Circle)), default=math.inf)

    def breach_m(self, place: Point, *, union: bool = False) -> float:
        """Metres beyond the border; negative while all is well. ``union``: one inclusion zone is enough."""
        kept_in = [zone.outside_m(place) for zone in self._inside]
        kept_out = [-zone.outside_m(place) for zone in self._outside]
        if union and kept_in:
            kept_in = [min(kept_in)]
        return max(kept_in + kept_out, default=-math.inf)


class Circle:
    """A circle; its radius in metres."""

    def __init__(self, centre: Point, radius: float) -> None:
        self.radius = radius
        self._centre = centre

    def outside_m(self, place: Point) -> float:
        """Metres from the border to a place outside; negative inside."""
        return math.dist(place, self._centre) - self.radius


class Polygon:
    """Corners in order; the last is joined to the first."""

    def __init__(self, corners: Sequence[Point]) -> None:
        self._sides = list(zip(corners, [*corners[1:], corners[0]], strict=True))

    def outside_m(self, place: Point) -> float:
        """Metres from the border to a place outside; negative inside."""
        distance = min(_distance(place, start, end) for start, end in self._sides)
        crossings = sum(_crosses(place, start, end) for start, end in self._sides)
        return -distance if crossings % 2 else distance


def _distance(place: Point, start: Point, end: Point) -> float:
    north, east = end[0] - start[0], end[1] - start[1]
    length2 = north * north + east * east
    along = 0.0
    if length2 > 0.0:
        along = ((place[0] - start[0]) * north + (place[1] - start[1]) * east) / length2
    share = min(1.0, max(0.0, along))
    return math.dist(place, (start[0] + share * north, start[1] + share * east))


def _crosses(place: Point, start: Point, end: Point) -> bool:
    """Whether a ray to the north meets the side."""
    if (start[1] > place[1]) == (end[1] > place[1]):
        return False
    share = (place[1] - start[1]) / (end[1] - start[1])
    return place[0] < start[0] + share * (end[0] - start[0])
