"""Timed paths, and the distance between two paths. Geometry without IO.

Points are in metres north, east and up of a common origin. Times are in seconds since a common start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Approach", "LocalPoint", "Path", "PathPoint", "horizontal_distance", "min_path_distance"]

LocalPoint = tuple[float, float, float]
"""Metres north, east and up."""
TOLERANCE = 1e-9  # because of rounding errors, a corner that is at most this far outside a polygon counts as inside


class PathPoint(Snapshot):
    """A point of a path: ``t_s`` in seconds, and metres north, east and up of the origin."""

    t_s: float
    north_m: float
    east_m: float
    up_m: float

    @property
    def place(self) -> LocalPoint:
        """The point's position, without its time."""
        return self.north_m, self.east_m, self.up_m

    def _check(self) -> None:
        if not all(math.isfinite(value) for value in (self.t_s, *self.place)):
            raise InvalidArgument(f"{self!r} is not allowed: all numbers must be finite")


class Leg(NamedTuple):
    """A straight line between two points of a path."""

    start: PathPoint
    end: PathPoint


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
            raise InvalidArgument(f"speed_m_s = {speed_m_s!r} is not allowed: it must be above 0")
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

    def legs(self, begin_s: float, end_s: float) -> list[Leg]:
        """Return the legs of the path.

        The vehicle rests at the first point from ``begin_s`` on, and at the last point until ``end_s``; these rests are
        legs, too.
        """
        first, last = self.points[0], self.points[-1]
        points = [first.replace(t_s=min(begin_s, first.t_s)), *self.points, last.replace(t_s=max(end_s, last.t_s))]
        return [Leg(start, end) for start, end in pairwise(points)]

    def _check(self) -> None:
        # A copy, so that the caller may change its own list later. Plain assignment would raise, because the class is
        # immutable.
        object.__setattr__(self, "points", tuple(self.points))
        if not self.points:
            raise InvalidArgument(f"points: the path of {self.name} has no points")
        for point, next_point in pairwise(self.points):
            if next_point.t_s < point.t_s:
                raise InvalidArgument(
                    f"points: times must not decrease; those of {self.name} decrease at {next_point.t_s:g} s"
                )


class Approach(Snapshot):
    """Closest approach of two paths: the distance, and for each path the time at its closest point."""

    distance_m: float
    at_s: float
    other_at_s: float


def min_path_distance(path: Path, other: Path, *, slack_s: float = math.inf, below_m: float = math.inf) -> Approach:
    """Return the closest approach of two paths.

    Args:
        path: the first path.
        other: the second path.
        slack_s: compare points whose times differ by at most this many seconds. With 0, both vehicles are exactly on
            time; infinite: ignore times.
        below_m: larger distances are not computed exactly. The result is then ``below_m`` or more.
    """
    begin_s = min(path.begins_at_s, other.begins_at_s)
    end_s = max(path.ends_at_s, other.ends_at_s)
    best = Approach(math.inf, begin_s, begin_s)
    other_legs = other.legs(begin_s, end_s)
    for leg in path.legs(begin_s, end_s):
        for other_leg in other_legs:
            is_other_later = other_leg.start.t_s - slack_s > leg.end.t_s
            is_other_earlier = other_leg.end.t_s + slack_s < leg.start.t_s
            if is_other_later or is_other_earlier:  # the vehicles never fly these legs at the same time
                continue
            if _lower_bound(leg, other_leg) >= min(best.distance_m, below_m):
                if best.distance_m == math.inf:  # These legs are at least `below_m` apart; other legs may be closer.
                    best = Approach(below_m, leg.start.t_s, other_leg.start.t_s)
                continue
            approach = _closest(leg, other_leg, slack_s)
            if approach is not None and approach.distance_m < best.distance_m:
                best = approach
    return best


def horizontal_distance(line: tuple[LocalPoint, LocalPoint], other: tuple[LocalPoint, LocalPoint]) -> float:
    """Return the smallest horizontal distance in metres between two line segments, given by their end points."""
    approach = _closest(_flat_leg(*line), _flat_leg(*other), math.inf)
    assert approach is not None
    return approach.distance_m


def _flat_leg(start: LocalPoint, end: LocalPoint) -> Leg:
    north_m, east_m, _ = start
    end_north_m, end_east_m, _ = end
    return Leg(PathPoint(0.0, north_m, east_m, up_m=0.0), PathPoint(0.0, end_north_m, end_east_m, up_m=0.0))


def _lower_bound(leg: Leg, other: Leg) -> float:
    """Return a lower bound, in metres, of the distance between two legs; it may be negative."""
    return math.dist(_midpoint(leg), _midpoint(other)) - _length(leg) / 2 - _length(other) / 2


def _length(leg: Leg) -> float:
    return math.dist(leg.start.place, leg.end.place)


def _midpoint(leg: Leg) -> tuple[float, ...]:
    return tuple((a + b) / 2 for a, b in zip(leg.start.place, leg.end.place, strict=True))


def _closest(leg: Leg, other: Leg, slack_s: float) -> Approach | None:
    """Return the closest approach of two legs at times that differ by at most ``slack_s`` seconds.

    Returns None if no such times exist.
    """
    start, end = leg
    other_start, other_end = other
    vector = vector_between(start.place, end.place)
    other_vector = vector_between(other_start.place, other_end.place)
    start_difference = vector_between(other_start.place, start.place)
    duration_s = end.t_s - start.t_s
    other_duration_s = other_end.t_s - other_start.t_s

    def time_difference(s: float, t: float) -> float:
        return (start.t_s + s * duration_s) - (other_start.t_s + t * other_duration_s)

    def difference(s: float, t: float) -> LocalPoint:
        north, east, up = [start_difference[i] + s * vector[i] - t * other_vector[i] for i in range(3)]
        return north, east, up

    # With s and t from 0 to 1 along the legs, the squared distance is a convex function of both. The maximum time
    # difference cuts a strip out of the unit square of (s, t). If the closest points of the whole legs are in this
    # strip, they are the result. If not, the minimum is on the border of the polygon that remains of the square.
    inside = _closest_inside(start_difference, vector, other_vector)
    if inside is not None and abs(time_difference(*inside)) <= slack_s:
        corners = [inside]  # a polygon that is a single point
    else:
        corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        if slack_s < math.inf:
            corners = _clip(corners, lambda s, t: time_difference(s, t) - slack_s)
            corners = _clip(corners, lambda s, t: -time_difference(s, t) - slack_s)
    best: Approach | None = None
    for index, corner in enumerate(corners):
        previous = corners[index - 1]  # the last corner is before the first one
        s, t = _closest_on_edge(corner, previous, difference(*corner), difference(*previous))
        distance = math.hypot(*difference(s, t))
        if best is None or distance < best.distance_m:
            best = Approach(distance, start.t_s + s * duration_s, other_start.t_s + t * other_duration_s)
    return best


def _closest_inside(
    start_difference: Sequence[float], vector: Sequence[float], other_vector: Sequence[float]
) -> tuple[float, float] | None:
    """Return the closest points of the lines through two legs, each as a fraction of its leg, 0 to 1.

    Returns None if one of the points is beyond the ends of its leg, or if the lines are parallel.
    """
    # Dot products of a (`vector`), b (`other_vector`) and d (`start_difference`).
    aa, bb = _dot(vector, vector), _dot(other_vector, other_vector)
    ab = _dot(vector, other_vector)
    determinant = aa * bb - ab * ab
    if determinant <= TOLERANCE * max(aa * bb, TOLERANCE):  # the lines are parallel, or a leg has no length
        return None
    da, db = _dot(start_difference, vector), _dot(start_difference, other_vector)
    # At these values, both derivatives of the squared distance are 0.
    s = (ab * db - bb * da) / determinant
    t = (aa * db - ab * da) / determinant
    return (s, t) if 0 <= s <= 1 and 0 <= t <= 1 else None


def _clip(corners: list[tuple[float, float]], outside: Callable[[float, float], float]) -> list[tuple[float, float]]:
    """Return the part of a convex polygon where ``outside`` is not positive (Sutherland-Hodgman)."""
    clipped: list[tuple[float, float]] = []
    for index, corner in enumerate(corners):
        previous = corners[index - 1]  # the last corner is before the first one
        value, previous_value = outside(*corner), outside(*previous)
        if (value > TOLERANCE) != (previous_value > TOLERANCE):  # the edge crosses the border
            fraction = (previous_value - TOLERANCE) / (previous_value - value)  # the border is at TOLERANCE
            crossing = tuple(p + fraction * (q - p) for p, q in zip(previous, corner, strict=True))
            clipped.append(crossing)  # type: ignore[arg-type]
        if value <= TOLERANCE:
            clipped.append(corner)
    return clipped


def _closest_on_edge(
    corner: tuple[float, float],
    other_corner: tuple[float, float],
    difference: LocalPoint,
    other_difference: LocalPoint,
) -> tuple[float, float]:
    """Return where two legs are closest, among the points (s, t) of one edge of the polygon in `_closest`.

    ``difference`` and ``other_difference`` are the vectors between the legs at the two corners.
    """
    step = vector_between(difference, other_difference)
    squared_length = _dot(step, step)
    fraction = 0.0
    if squared_length > 0:
        fraction = min(1.0, max(0.0, -_dot(difference, step) / squared_length))
    s, t = corner
    other_s, other_t = other_corner
    return s + fraction * (other_s - s), t + fraction * (other_t - t)


def vector_between(start: LocalPoint, end: LocalPoint) -> LocalPoint:
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


def _dot(vector: Sequence[float], other: Sequence[float]) -> float:
    return vector[0] * other[0] + vector[1] * other[1] + vector[2] * other[2]
