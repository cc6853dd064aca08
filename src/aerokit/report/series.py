"""Long series made short enough to draw, so that peaks stay: of each piece the least and the greatest value."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.flights.columns import Columns

__all__ = ["POINTS", "points", "rows_to_draw"]

POINTS = 2000
"""So many points of a line are drawn at most."""


def points(columns: Columns, name: str, digits: int = 3) -> tuple[list[float], list[float | None]]:
    """Times and values of a column to draw; None is a gap."""
    values, times = columns[name], columns.times
    rows = rows_to_draw(len(values), (values,))
    return (
        [round(times[row], 2) for row in rows],
        [round(value, digits) if math.isfinite(value := values[row]) else None for row in rows],
    )


def rows_to_draw(count: int, columns: Sequence[Any], most: int = POINTS) -> list[int]:
    """Rows that show all peaks of these columns; values that are not known stay as gaps."""
    if count <= most:
        return list(range(count))
    pieces = max(most // (2 * len(columns)), 1)
    found = {0, count - 1}
    for piece in range(pieces):
        begin, end = count * piece // pieces, count * (piece + 1) // pieces
        for values in columns:
            known = [row for row in range(begin, end) if values[row] == values[row]]
            if len(known) < end - begin:
                unknown = next(row for row in range(begin, end) if values[row] != values[row])
                if not known or _is_gap(values, begin, end):
                    found.add(unknown)
            if known:
                found.add(min(known, key=values.__getitem__))
                found.add(max(known, key=values.__getitem__))
    return sorted(found)


def _is_gap(values: Any, begin: int, end: int) -> bool:
    """Whether half of a piece is not known: single unknown values between known ones are none."""
    unknown = sum(1 for row in range(begin, end) if values[row] != values[row])
    return unknown * 2 > end - begin
