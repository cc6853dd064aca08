"""The figures of a flight: what its summary says, and what two flights are compared by."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise
from typing import TYPE_CHECKING

from aerokit.flights.plane import Plane
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.flights.columns import Columns
    from aerokit.flights.flight import Flight

__all__ = ["Figures", "figures", "metres_from_home", "time_in_modes"]

_STEP_M = 1.0
"""Shorter steps are noise of a vehicle that stands."""


class Figures(Snapshot):
    """What was flown while the vehicle was armed (all of the log, where it never was); None is not known."""

    armed_s: float | None
    way_m: float | None
    """Along the ground."""
    highest_m: float | None
    """Above home."""
    farthest_m: float | None
    """From home, along the ground."""
    fastest_m_s: float | None
    """Over the ground."""
    climbed_m_s: float | None
    """The fastest climb."""
    sank_m_s: float | None
    """The fastest descent."""
    tilted_deg: float | None
    """The greatest angle of roll or pitch."""
    ended_m: float | None
    """From home, at the end."""
    voltage_before_v: float | None
    """First battery."""
    voltage_after_v: float | None
    voltage_least_v: float | None
    remaining_before_percent: float | None
    remaining_after_percent: float | None
    current_most_a: float | None
    satellites_least: float | None
    hdop_most: float | None
    vibration_most_m_s2: float | None
    clips: float | None
    """How often an accelerometer reached its limit."""
    estimator_most: float | None
    """The worst ratio; above 1 a measurement is not believed."""
    lost_percent: float | None
    """Of the messages."""


def figures(flight: Flight) -> Figures:
    """Work them out."""
    spans = _Spans(flight)
    north_east = metres_from_home(flight)
    rows = list(spans.rows(flight.track))
    away = [math.hypot(*north_east[row]) for row in rows] if north_east else []
    speeds = [
        math.hypot(flight.velocity["north_m_s"][row], flight.velocity["east_m_s"][row])
        for row in spans.rows(flight.velocity)
    ]
    downs = spans.known(flight.velocity, "down_m_s")
    tilts = [abs(x) for name in ("roll_deg", "pitch_deg") for x in spans.known(flight.attitude, name)]
    volts, left, amps = (
        _battery(flight, spans, name) for name in ("voltage_v", "remaining_percent", "current_a")
    )
    first_gps = next((flight.gps[number] for number in sorted(flight.gps)), None)
    satellites = [] if first_gps is None else spans.known(first_gps, "satellites")
    hdops = [] if first_gps is None else spans.known(first_gps, "hdop")
    levels = [x for axis in "xyz" for x in spans.known(flight.vibration, f"{axis}_m_s2")]
    clips = spans.known(flight.vibration, "clips")
    ratios = [x for name in flight.estimator for x in spans.known(flight.estimator, name)]
    lost = spans.known(flight.link, "lost_percent")
    return Figures(
        armed_s=sum(end - begin for begin, end in flight.armed) if flight.armed else None,
        way_m=_way(north_east, rows) if north_east else None,
        highest_m=_most(spans.known(flight.track, "altitude_relative_m")),
        farthest_m=_most(away),
        fastest_m_s=_most(speeds),
        climbed_m_s=_most([-down for down in downs]),
        sank_m_s=_most(downs),
        tilted_deg=_most(tilts),
        ended_m=away[-1] if away and away[-1] == away[-1] else None,
        voltage_before_v=volts[0] if volts else None,
        voltage_after_v=volts[-1] if volts else None,
        voltage_least_v=min(volts, default=None),
        remaining_before_percent=left[0] if left else None,
        remaining_after_percent=left[-1] if left else None,
        current_most_a=_most(amps),
        satellites_least=min(satellites, default=None),
        hdop_most=_most(hdops),
        vibration_most_m_s2=_most(levels),
        clips=clips[-1] - clips[0] if clips else None,
        estimator_most=_most(ratios),
        lost_percent=sum(lost) / len(lost) if lost else None,
    )


def metres_from_home(flight: Flight) -> list[tuple[float, float]]:
    """Metres north and east of home for each row of the track; empty when there is none."""
    if flight.home is None or not len(flight.track):
        return []
    plane = Plane(flight.home.latitude_deg, flight.home.longitude_deg)
    latitudes, longitudes = flight.track["latitude_deg"], flight.track["longitude_deg"]
    return [plane.metres(*place) for place in zip(latitudes, longitudes, strict=True)]


def time_in_modes(flight: Flight) -> dict[str, float]:
    """Seconds in each mode while armed, in the order of their first use."""
    found: dict[str, float] = {}
    for change, end in flight.mode_spans():
        for armed_from, armed_to in flight.armed or [(0.0, flight.duration_s)]:
            seconds = min(end, armed_to) - max(change.time_s, armed_from)
            if seconds > 0:
                found[change.name] = found.get(change.name, 0.0) + seconds
    return found


class _Spans:
    """The times in which the vehicle was armed."""

    def __init__(self, flight: Flight) -> None:
        self._spans = flight.armed or [(-math.inf, math.inf)]

    def rows(self, columns: Columns) -> Iterator[int]:
        for begin, end in self._spans:
            yield from range(bisect_left(columns.times, begin), bisect_right(columns.times, end))

    def known(self, columns: Columns, name: str) -> list[float]:
        values = columns[name]
        return [values[row] for row in self.rows(columns) if math.isfinite(values[row])]


def _battery(flight: Flight, spans: _Spans, name: str) -> list[float]:
    first = next((flight.batteries[number] for number in sorted(flight.batteries)), None)
    return [] if first is None else spans.known(first, name)


def _most(values: list[float]) -> float | None:
    return max((value for value in values if math.isfinite(value)), default=None)


def _way(north_east: list[tuple[float, float]], rows: list[int]) -> float:
    way, here = 0.0, (math.nan, math.nan)
    for before, row in pairwise([-2, *rows]):
        place = north_east[row]
        if place[0] != place[0]:
            continue
        if here[0] != here[0] or row != before + 1:
            here = place
            continue
        step = math.hypot(place[0] - here[0], place[1] - here[1])
        if step >= _STEP_M:
            way, here = way + step, place
    return way
