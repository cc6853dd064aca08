"""The figures of a flight: what its summary says, and what two flights are compared by."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from datetime import datetime, timezone
from itertools import pairwise
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.logs.flights.columns import Plane
from aerokit.logs.flights.failsafes import failsafes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.logs.flights.columns import Columns
    from aerokit.logs.flights.flight import Flight

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


_A_YEAR_S = 365 * 86_400.0


def summary(flight: Flight, found: Figures) -> list[str]:
    """Sentences, the most important first."""
    told = [_what(flight, found), _modes(flight), _battery_words(found), _failsafes(flight), _quality(found)]
    return [sentence for sentence in told if sentence] + [
        f"{note[:1].upper()}{note[1:]}." for note in flight.notes
    ]


def _what(flight: Flight, found: Figures) -> str:
    if found.armed_s is None:
        return f"It was never armed: {span(flight.duration_s)} on the ground."
    parts = [f"{span(found.armed_s)} armed"]
    if found.way_m is not None:
        parts.append(f"{length(found.way_m)} flown")
    if found.highest_m is not None:
        parts.append(f"highest {number(found.highest_m)} m above home")
    if found.farthest_m is not None:
        parts.append(f"farthest {length(found.farthest_m)} from home")
    if found.fastest_m_s is not None:
        parts.append(f"fastest {number(found.fastest_m_s)} m/s")
    if found.ended_m is not None:
        parts.append(f"ended {length(found.ended_m)} from home")
    return ", ".join(parts) + "."


def _modes(flight: Flight) -> str:
    modes = time_in_modes(flight)
    return (
        ("Flown in " if flight.armed else "In ")
        + ", ".join(f"{name} ({span(seconds)})" for name, seconds in modes.items())
        + "."
        if modes
        else ""
    )


def _battery_words(found: Figures) -> str:
    if found.voltage_before_v is None or found.voltage_after_v is None:
        return ""
    told = f"Battery {found.voltage_before_v:.1f} → {found.voltage_after_v:.1f} V"
    if found.remaining_before_percent is not None and found.remaining_after_percent is not None:
        told += f", {found.remaining_before_percent:.0f} → {found.remaining_after_percent:.0f} %"
    if found.voltage_least_v is not None:
        told += f", least {found.voltage_least_v:.1f} V"
    return told + "."


def _failsafes(flight: Flight) -> str:
    found = failsafes(flight)
    acted = [each for each in found if each.acted]
    doubts = [each for each in found if not each.acted]
    told = f"{len(acted) or 'No'} failsafe{'' if len(acted) == 1 else 's'}"
    if acted:
        told += ": " + "; ".join(f"{each.title} at {clock(each.time_s)} ({each.reaction})" for each in acted)
    if doubts:
        told += f". {len(doubts)} warning{'' if len(doubts) == 1 else 's'} without a known consequence: "
        told += "; ".join(f"{each.title} at {clock(each.time_s)}" for each in doubts)
    return told + "."


def _quality(found: Figures) -> str:
    doubts = []
    if found.vibration_most_m_s2 is not None and found.vibration_most_m_s2 > 30:
        doubts.append(f"vibration up to {found.vibration_most_m_s2:.0f} m/s² (below 30 is well)")
    if found.clips:
        doubts.append(f"an accelerometer reached its limit {found.clips:.0f} times")
    if found.estimator_most is not None and found.estimator_most > 1:
        doubts.append(
            f"the estimator did not believe a measurement (ratio {found.estimator_most:.2f}, above 1)"
        )
    if found.satellites_least is not None and found.satellites_least < 6:
        doubts.append(f"{found.satellites_least:.0f} satellites at the least")
    if found.lost_percent is not None and found.lost_percent > 2:
        doubts.append(f"{found.lost_percent:.0f} % of the messages lost")
    return "To look at: " + "; ".join(doubts) + "." if doubts else ""


def clock(seconds: float) -> str:
    """Minutes and seconds since the log began: ``3:07.5``."""
    minutes, rest = divmod(round(max(seconds, 0.0), 1), 60)
    return f"{minutes:.0f}:{rest:04.1f}"


def span(seconds: float) -> str:
    """``47 s``, ``12 min 5 s``, ``1 h 3 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s" if whole % 60 else f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def length(metres: float) -> str:
    """``310 m``, ``3.4 km``."""
    if metres >= 1000:
        return f"{metres / 1000:.1f} km"
    return f"{metres:.0f} m" if metres >= 10 else f"{metres:.1f} m"


def number(value: float) -> str:
    """Three digits or so."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def date(unix_s: float) -> str:
    """UTC; what is known where no clock told it."""
    if unix_s < _A_YEAR_S:
        return "at an unknown time"
    return f"{datetime.fromtimestamp(unix_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
