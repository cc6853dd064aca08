"""Simplification of lines in the plane: Ramer-Douglas-Peucker, with the largest deviation first."""

from __future__ import annotations

import heapq
import math
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

# Of this many consecutive points, at least one is kept. Otherwise spirals and repeated figures take quadratic time.
_MAX_SEGMENT = 1024
MAX_COORDINATE = 1e9
"""Larger coordinates are damaged data and are ignored, because their squares could overflow."""


def simplify(
    places: Sequence[tuple[float, float]], max_points: int, tolerance: float, keep: Iterable[int] = ()
) -> tuple[list[int], float]:
    """Select the points of a line that preserve its shape.

    Args:
        places: coordinates; NaN interrupts the line.
        max_points: maximum number of selected points, which takes precedence over ``tolerance``. Ends of gaps, the
            points of ``keep``, and one point in about a thousand are selected in addition.
        tolerance: distance within which points may be omitted.
        keep: indices that are always selected.

    Returns:
        The selected indices, with one for each gap, and the largest distance of any point from the line through the
        selected points.
    """
    known = [abs(x) <= MAX_COORDINATE and abs(y) <= MAX_COORDINATE for x, y in places]
    if not any(known):
        return [], 0.0
    fixed = {index for index in keep if known[index]}
    gaps, end = [], len(known) - 1
    for index, is_known in enumerate(known):
        is_edge = index in (0, end) or not (known[index - 1] and known[index + 1])
        if is_known and (is_edge or not index % _MAX_SEGMENT):
            fixed.add(index)
        elif not is_known and index and known[index - 1]:
            gaps.append(index)
    # Heap of (negative square of the largest deviation, its index, first and last index of the segment).
    segments = [
        (*_deviation(places, first, last), first, last)
        for first, last in pairwise(sorted(fixed))
        if last - first > 1 and known[first + 1]
    ]
    heapq.heapify(segments)
    limit = -tolerance * tolerance
    while segments and segments[0][0] < limit and len(fixed) < max_points:
        _, middle, first, last = heapq.heappop(segments)
        fixed.add(middle)
        for part in ((first, middle), (middle, last)):
            if part[1] - part[0] > 1:
                heapq.heappush(segments, (*_deviation(places, *part), *part))
    return sorted({*fixed, *gaps}), math.sqrt(-segments[0][0]) if segments else 0.0


def _deviation(places: Sequence[tuple[float, float]], first: int, last: int) -> tuple[float, int]:
    """Return the negative square of the largest distance from the segment between two points, and its index."""
    x, y = places[first]
    along_x, along_y = places[last][0] - x, places[last][1] - y
    length = along_x * along_x + along_y * along_y
    found, where = -1.0, first + 1
    for index in range(first + 1, last):
        right, up = places[index][0] - x, places[index][1] - y
        if length:
            share = (right * along_x + up * along_y) / length
            share = 0.0 if share < 0.0 else min(share, 1.0)
            right, up = right - share * along_x, up - share * along_y
        distance = right * right + up * up
        if distance > found:
            found, where = distance, index
    return -found, where
