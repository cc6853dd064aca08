"""Simplifies lines in the plane by the Ramer-Douglas-Peucker algorithm. The largest deviation is split first."""

from __future__ import annotations

import heapq
import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

# At least one of this many consecutive points is selected. Without this limit, spirals and repeated figures would take
# quadratic time.
_MAX_SEGMENT = 1024
MAX_COORDINATE = 1e9
"""Larger coordinates are damaged data. They are ignored, because their squares could overflow."""


class _Segment(NamedTuple):
    """A line segment from the point ``first`` to the point ``last``, which replaces the points between them.

    heapq returns the smallest item first, so the square of the largest deviation is stored with a negative sign.
    """

    negative_square: float
    farthest: int  # index of the point with the largest deviation
    first: int
    last: int


def simplify(
    places: Sequence[tuple[float, float]], max_points: int, tolerance: float, keep: Iterable[int] = ()
) -> tuple[list[int], float]:
    """Select points of a line, so that its shape is preserved.

    Args:
        places: coordinates; NaN interrupts the line.
        max_points: maximum number of selected points. It is exceeded if more points than this must be selected: those
            of ``keep``, those next to a gap, the first, the last, and every 1024th point.
        tolerance: maximum distance of an omitted point from the line through the selected points. The distance may be
            larger if ``max_points`` is reached.
        keep: indices that are selected if their coordinates are known.

    Returns:
        The indices of the selected points and of one NaN for each gap, and the largest distance of an omitted point
        from the line through the selected points.
    """
    known = [abs(x) <= MAX_COORDINATE and abs(y) <= MAX_COORDINATE for x, y in places]
    if not any(known):
        return [], 0.0
    selected = {index for index in keep if known[index]}
    gaps = []  # the first index of each gap
    last_index = len(known) - 1
    for index, is_known in enumerate(known):
        is_end_of_line = index in (0, last_index) or not (known[index - 1] and known[index + 1])
        if is_known and (is_end_of_line or index % _MAX_SEGMENT == 0):
            selected.add(index)
        elif not is_known and index and known[index - 1]:
            gaps.append(index)
    segments = [
        _segment(places, first, last)
        for first, last in pairwise(sorted(selected))
        if last - first > 1 and known[first + 1]
    ]
    heapq.heapify(segments)
    while segments and len(selected) < max_points:
        negative_square, middle, first, last = segments[0]  # the segment with the largest deviation
        if negative_square >= -tolerance * tolerance:  # All deviations are within the tolerance.
            break
        heapq.heappop(segments)
        selected.add(middle)
        for begin, end in ((first, middle), (middle, last)):
            if end - begin > 1:
                heapq.heappush(segments, _segment(places, begin, end))
    largest_deviation = 0.0
    if segments:
        largest_deviation = math.sqrt(-segments[0].negative_square)
    return sorted({*selected, *gaps}), largest_deviation


def _segment(places: Sequence[tuple[float, float]], first: int, last: int) -> _Segment:
    x, y = places[first]
    last_x, last_y = places[last]
    segment_x, segment_y = last_x - x, last_y - y
    squared_length = segment_x * segment_x + segment_y * segment_y
    largest, largest_index = -1.0, first + 1
    for index in range(first + 1, last):
        point_x, point_y = places[index]
        dx, dy = point_x - x, point_y - y
        if squared_length:  # measure from the nearest point of the segment instead of its beginning
            fraction = (dx * segment_x + dy * segment_y) / squared_length
            fraction = 0.0 if fraction < 0.0 else min(fraction, 1.0)
            dx, dy = dx - fraction * segment_x, dy - fraction * segment_y
        squared_distance = dx * dx + dy * dy
        if squared_distance > largest:
            largest, largest_index = squared_distance, index
    return _Segment(-largest, largest_index, first, last)
