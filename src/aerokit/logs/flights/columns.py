"""``Columns``: values over time, a column for each; millions of them fit."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING

from aerokit._internal import geo

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_NAN = math.nan


class Columns:
    """Rows of numbers with their times, oldest first. NaN stands for what was not told.

    ``columns["roll_deg"]`` is the column of that name; names hold the units. ``len(columns)`` is the number of rows.
    """

    def __init__(self, *names: str) -> None:
        self.names: tuple[str, ...] = names
        """Names of the columns."""
        self.times: array[float] = array("d")
        """Seconds since the flight began."""
        self._values = {name: array("d") for name in names}
        self._rows = tuple(self._values.values())

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, name: str) -> array[float]:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __repr__(self) -> str:
        return f"<Columns {', '.join(self.names)}: {len(self)} rows>"

    def add(self, time_s: float, *values: float) -> None:
        """Add a row, a value for each column; one that is older than the last row gets its time."""
        times = self.times
        if times and time_s < times[-1]:
            time_s = times[-1]
        times.append(time_s)
        for column, value in zip(self._rows, values):  # noqa: B905 - of one length, and this is called millions of times
            column.append(value)

    def extend(self, times: Sequence[float], **columns: Sequence[float]) -> None:
        """Add many rows; a column that is not given is NaN."""
        self.times.extend(times)
        missing = array("d", [_NAN]) * len(times)
        for name, column in self._values.items():
            column.extend(columns.get(name, missing))

    def has(self, *names: str) -> bool:
        """Whether any value is known in any of these columns (of all without a name)."""
        return any(value == value for name in names or self.names for value in self._values[name])

    def index_at(self, time_s: float) -> int:
        """The last row at that time or before it; -1 when there is none."""
        return bisect_right(self.times, time_s) - 1

    def at(self, name: str, time_s: float, *, not_older_s: float = 10.0) -> float:
        """The last known value at that time; NaN when it is older than ``not_older_s``, or there is none."""
        column, index = self._values[name], self.index_at(time_s)
        while index >= 0 and self.times[index] >= time_s - not_older_s:
            if column[index] == column[index]:
                return column[index]
            index -= 1
        return _NAN

    def known(self, name: str) -> array[float]:
        """The values of a column that are known."""
        return array("d", (value for value in self._values[name] if value == value))

    def between(self, name: str, start_s: float, end_s: float) -> array[float]:
        """The known values of a column in a span of time."""
        part = self._values[name][bisect_left(self.times, start_s) : self.index_at(end_s) + 1]
        return array("d", (value for value in part if value == value))


class Plane:
    """A plane that touches the ellipsoid at a place; good to a metre within some kilometres."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self.latitude_deg: float = latitude_deg
        self.longitude_deg: float = longitude_deg
        middle = max(-89.9, min(89.9, latitude_deg))
        north = geo.distance_m(middle - 0.005, longitude_deg, middle + 0.005, longitude_deg)
        east = geo.distance_m(middle, longitude_deg - 0.005, middle, longitude_deg + 0.005)
        self.north_m_per_deg: float = north * 100
        self.east_m_per_deg: float = east * 100

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Metres north and east of the place; NaN for NaN."""
        east = longitude_deg - self.longitude_deg
        if not -180.0 <= east < 180.0 and math.isfinite(east):
            east = geo.wrap_longitude(east)
        return (latitude_deg - self.latitude_deg) * self.north_m_per_deg, east * self.east_m_per_deg

    def degrees(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Latitude and longitude of the place that many metres north and east."""
        return (
            self.latitude_deg + north_m / self.north_m_per_deg,
            self.longitude_deg + east_m / self.east_m_per_deg,
        )
