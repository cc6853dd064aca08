"""Timed paths, and the distance between two of them. Geometry without IO.

Points are metres north, east and up of a common origin; times are seconds since a common start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Approach", "LocalPoint", "Path", "PathPoint", "horizontal_distance", "min_path_distance"]

LocalPoint = tuple[float, float, float]
"""Metres north, east and up."""
TOLERANCE = 1e-9


class PathPoint(Snapshot):
    """A point of a path: ``t_s`` in seconds, and metres north, east and up of the origin."""

    t_s: float
    north_m: float
    east_m: float
    up_m: float

    @property
    def place(self) -> LocalPoint:
        """The point without its time."""
        return self.north_m, self.east_m, self.up_m

    def _check(self) -> None:
        if not all(math.isfinite(value) for value in (self.t_s, *self.place)):
            raise InvalidArgument(f"{self!r} is not allowed: finite numbers")


class Path(Snapshot):
    """Path of one vehicle: straight lines between timed points.

    The vehicle rests before the first and after the last point.
    """

    name: str
    points: Sequence[PathPoint]

    @classmethod
    def straight(cls, name: str, start: LocalPoint, end: LocalPoint, speed_m_s: float, at_s: float = 0.0) -> Self:
        """Make a straight path at constant speed that starts at ``at_s``.

        Raises:
            InvalidArgument: the speed is not above 0.
        """
        if not speed_m_s > 0:
            raise InvalidArgument(f"speed_m_s = {speed_m_s!r} is not allowed: above 0")
        duration_s = math.dist(start, end) / speed_m_s
        return cls(name, (PathPoint(at_s, *start), PathPoint(at_s + duration_s, *end)))

    @property
    def begins_at_s(self) -> float:
        """Time of the first point in seconds."""
        return self.points[0].t_s

    @property
    def ends_at_s(self) -> float:
        """Time of the last point in seconds."""
        return self.points[-1].t_s

    def legs(self, begin_s: float, end_s: float) -> list[tuple[PathPoint, PathPoint]]:
        """Return pairs of consecutive points, including the rests from ``begin_s`` and until ``end_s``."""
        first, last = self.points[0], self.points[-1]
        points = [
            first.replace(t_s=min(begin_s, first.t_s)),
            *self.points,
            last.replace(t_s=max(end_s, last.t_s)),
        ]
        return list(pairwise(points))

    def _check(self) -> None:
        object.__setattr__(self, "points", tuple(self.points))
        if not self.points:
            raise InvalidArgument(f"points: the path of {self.name} has no points")
        for one, other in pairwise(self.points):
            if other.t_s < one.t_s:
                raise InvalidArgument(f"points: the times of {self.name} decrease at {other.t_s:g} s")


class Approach(Snapshot):
    """Closest approach of two paths: distance, and the time of the closest point on each path."""

    distance_m: float
    at_s: float
    other_at_s: float


def min_path_distance(one: Path, other: Path, *, slack_s: float = math.inf, below_m: float = math.inf) -> Approach:
    """Return the closest approach of two paths.

    Args:
        one: the first path.
        other: the second path.
        slack_s: compare points whose times differ by at most this many seconds. 0: both vehicles are exactly on time;
            infinite: ignore times.
        below_m: larger distances are not computed exactly; the result is then at least this distance.
    """
    begin = min(one.begins_at_s, other.begins_at_s)
    end = max(one.ends_at_s, other.ends_at_s)
    best = Approach(math.inf, begin, begin)
    others = other.legs(begin, end)
    for leg in one.legs(begin, end):
        for other_leg in others:
            if other_leg[0].t_s - slack_s > leg[1].t_s or other_leg[1].t_s + slack_s < leg[0].t_s:
                continue
            if _lower_bound(leg, other_leg) >= min(best.distance_m, below_m):
                best = best if best.distance_m < math.inf else Approach(below_m, leg[0].t_s, other_leg[0].t_s)
                continue
            found = _closest(leg, other_leg, slack_s)
            if found is not None and found.distance_m < best.distance_m:
                best = found
    return best


def horizontal_distance(one: tuple[LocalPoint, LocalPoint], other: tuple[LocalPoint, LocalPoint]) -> float:
    """Return the distance in metres between two straight lines as seen from above, regardless of time."""
    (a, b), (c, d) = [tuple(PathPoint(0.0, place[0], place[1], 0.0) for place in path) for path in (one, other)]
    found = _closest((a, b), (c, d), math.inf)
    assert found is not None
    return found.distance_m


def _lower_bound(one: tuple[PathPoint, PathPoint], other: tuple[PathPoint, PathPoint]) -> float:
    """Return a lower bound of the distance of two legs: distance of the midpoints minus half of both lengths."""
    middles = [tuple((a + b) / 2 for a, b in zip(leg[0].place, leg[1].place, strict=True)) for leg in (one, other)]
    lengths = math.dist(one[0].place, one[1].place) + math.dist(other[0].place, other[1].place)
    return math.dist(*middles) - lengths / 2


def _closest(one: tuple[PathPoint, PathPoint], other: tuple[PathPoint, PathPoint], slack_s: float) -> Approach | None:
    """Return the closest approach of two legs at times at most ``slack_s`` apart; None if there are no such times.

    With s and t from 0 to 1 along the legs, the squared distance is a convex function of both. The time condition
    limits the unit square to a strip. The minimum is inside this polygon or on its border.
    """
    a, b = one[0].place, other[0].place
    along = [one[1].place[i] - a[i] for i in range(3)]
    others = [other[1].place[i] - b[i] for i in range(3)]
    between = [a[i] - b[i] for i in range(3)]
    one_lasts, other_lasts = one[1].t_s - one[0].t_s, other[1].t_s - other[0].t_s

    def time_difference(s: float, t: float) -> float:
        return (one[0].t_s + s * one_lasts) - (other[0].t_s + t * other_lasts)

    def difference(s: float, t: float) -> list[float]:
        return [between[i] + s * along[i] - t * others[i] for i in range(3)]

    inside = _closest_inside(between, along, others)
    if inside is not None and abs(time_difference(*inside)) <= slack_s:
        corners = [inside]
    else:
        corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        if slack_s < math.inf:
            corners = _cut(corners, lambda s, t: time_difference(s, t) - slack_s)
            corners = _cut(corners, lambda s, t: -time_difference(s, t) - slack_s)
    best: tuple[float, float, float] | None = None
    for number, corner in enumerate(corners):
        s, t = _closest_on_edge(corner, corners[number - 1], difference(*corner), difference(*corners[number - 1]))
        distance = math.hypot(*difference(s, t))
        if best is None or distance < best[0]:
            best = distance, s, t
    if best is None:
        return None
    distance, s, t = best
    return Approach(distance, one[0].t_s + s * one_lasts, other[0].t_s + t * other_lasts)


def _closest_inside(
    between: Sequence[float], along: Sequence[float], others: Sequence[float]
) -> tuple[float, float] | None:
    """Return the closest point of two lines; None if it is outside of a leg, or the lines are parallel."""
    aa, bb, ab = _dot(along, along), _dot(others, others), _dot(along, others)
    determinant = aa * bb - ab * ab
    if determinant <= TOLERANCE * max(aa * bb, TOLERANCE):
        return None
    c, d = _dot(between, along), _dot(between, others)
    s, t = (ab * d - bb * c) / determinant, (aa * d - ab * c) / determinant
    return (s, t) if 0 <= s <= 1 and 0 <= t <= 1 else None


def _cut(corners: list[tuple[float, float]], outside: _Outside) -> list[tuple[float, float]]:
    """Return the part of a convex polygon where ``outside`` is not positive."""
    kept: list[tuple[float, float]] = []
    for number, corner in enumerate(corners):
        before = corners[number - 1]
        here, there = outside(*corner), outside(*before)
        if (here > TOLERANCE) != (there > TOLERANCE):
            share = there / (there - here)
            kept.append(tuple(p + share * (q - p) for p, q in zip(before, corner, strict=True)))  # type: ignore[arg-type]
        if here <= TOLERANCE:
            kept.append(corner)
    return kept


def _closest_on_edge(
    one: tuple[float, float], other: tuple[float, float], here: Sequence[float], there: Sequence[float]
) -> tuple[float, float]:
    """Return the point on an edge where the distance is smallest."""
    step = [q - p for p, q in zip(here, there, strict=True)]
    length = _dot(step, step)
    share = 0.0 if length == 0 else min(1.0, max(0.0, -_dot(here, step) / length))
    return one[0] + share * (other[0] - one[0]), one[1] + share * (other[1] - one[1])


def _dot(one: Sequence[float], other: Sequence[float]) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


if TYPE_CHECKING:
    from collections.abc import Callable

    _Outside = Callable[[float, float], float]
