"""The sections of a report that compares two flights; their times count from when each was first armed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from aerokit.logs.report.charts import COLOURS, points, rows_to_draw, with_margin
from aerokit.logs.report.figures import metres_from_home, span
from aerokit.logs.report.page import Chart, Section, Table, Words
from aerokit.logs.report.sections import failsafe_section

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.logs.flights.columns import Columns
    from aerokit.logs.flights.flight import Flight
    from aerokit.logs.report.figures import Figures
    from aerokit.logs.report.page import Part

NAMES = ("A", "B")
"""What the two flights are called in charts and tables."""

_FIGURES = {
    "armed_s": ("armed, s", 0),
    "way_m": ("flown, m", 0),
    "highest_m": ("highest above home, m", 1),
    "farthest_m": ("farthest from home, m", 0),
    "fastest_m_s": ("fastest, m/s", 1),
    "climbed_m_s": ("fastest climb, m/s", 1),
    "sank_m_s": ("fastest descent, m/s", 1),
    "tilted_deg": ("greatest angle, °", 0),
    "ended_m": ("end from home, m", 1),
    "voltage_before_v": ("battery before, V", 2),
    "voltage_after_v": ("battery after, V", 2),
    "voltage_least_v": ("battery at the least, V", 2),
    "remaining_before_percent": ("left before, %", 0),
    "remaining_after_percent": ("left after, %", 0),
    "current_most_a": ("greatest current, A", 1),
    "satellites_least": ("fewest satellites", 0),
    "hdop_most": ("worst HDOP", 2),
    "vibration_most_m_s2": ("greatest vibration, m/s²", 1),
    "clips": ("clips", 0),
    "estimator_most": ("worst ratio of the estimator", 2),
    "lost_percent": ("messages lost, %", 2),
}
"""Field of `Figures` → in words, digits."""
_CHARTS: tuple[tuple[str, str, Callable[[Flight], Columns | None], str], ...] = (
    ("Height", "metres above home", lambda flight: flight.track, "altitude_relative_m"),
    ("Roll", "degrees", lambda flight: flight.attitude, "roll_deg"),
    ("Pitch", "degrees", lambda flight: flight.attitude, "pitch_deg"),
    ("Battery", "volts", lambda flight: _first(flight.batteries), "voltage_v"),
    ("Current", "amperes", lambda flight: _first(flight.batteries), "current_a"),
    ("Vibration, x", "m/s²", lambda flight: flight.vibration, "x_m_s2"),
    ("Vibration, z", "m/s²", lambda flight: flight.vibration, "z_m_s2"),
    ("Estimator, horizontal position", "ratio", lambda flight: flight.estimator, "horizontal_position"),
    ("Satellites", "satellites", lambda flight: _first(flight.gps), "satellites"),
    ("Link", "% lost", lambda flight: flight.link, "lost_percent"),
)
"""Heading, unit, where the column is, the column."""


def comparison(flights: tuple[Flight, Flight], found: tuple[Figures, Figures]) -> list[Section]:
    """The sections, for two flights and their figures."""
    failed = [failsafe_section(flight) for flight in flights]
    return [
        _differences(found),
        _maps(flights),
        *(_overlaid(flights, *row) for row in _CHARTS),
        _modes(flights),
        _parameters(flights),
        *(
            Section(f"{each.title} of {name}", each.parts, each.means, each.missing)
            for name, each in zip(NAMES, failed, strict=True)
        ),
    ]


def _first(by_number: dict[int, Columns]) -> Columns | None:
    return by_number[min(by_number)] if by_number else None


def _differences(found: tuple[Figures, Figures]) -> Section:
    rows = []
    for field, (name, digits) in _FIGURES.items():
        values = [getattr(each, field) for each in found]
        if any(value is not None for value in values):
            one, other = values
            change = "" if one is None or other is None else f"{round(other - one, digits) + 0.0:+.{digits}f}"
            rows.append((name, *("unknown" if v is None else f"{v:.{digits}f}" for v in values), change))
    return Section("Differences", [Table(("figure", *NAMES, "B − A"), rows)])


def _maps(flights: Sequence[Flight]) -> Section:
    traces = []
    all_east: list[float] = []
    for number, flight in enumerate(flights):
        places = metres_from_home(flight)
        all_east += [place[1] for place in places]
        north, east = [place[0] for place in places], [place[1] for place in places]
        rows = rows_to_draw(len(places), (north, east), 4000)
        if rows:
            traces.append(
                {
                    "x": [_known(east[row]) for row in rows],
                    "y": [_known(north[row]) for row in rows],
                    **_look(number),
                }
            )
    title, missing = "Tracks", "Neither log has positions."
    if not traces:
        return Section(title, missing=missing)
    layout = {
        "xaxis": {
            "title": {"text": "metres east of home"},
            "autorangeoptions": {"include": with_margin(all_east)},
        },
        "yaxis": {"title": {"text": "metres north of home"}, "scaleanchor": "x", "scaleratio": 1},
        "hovermode": "closest",
    }
    chart = Chart("maps", traces, layout, 520, "both tracks from above, north is up")
    return Section(title, [chart], "From above, each from its own home, north is up.")


def _known(value: float) -> float | None:
    return round(value, 2) if math.isfinite(value) else None


def _look(number: int) -> dict[str, Any]:
    return {"mode": "lines", "name": NAMES[number], "line": {"color": COLOURS[number], "width": 1.8}}


def _overlaid(
    flights: Sequence[Flight],
    title: str,
    unit: str,
    where: Callable[[Flight], Columns | None],
    column: str,
) -> Section:
    traces, lacking = [], []
    for number, flight in enumerate(flights):
        columns = where(flight)
        if columns is None or not columns.has(column):
            lacking.append(NAMES[number])
            continue
        times, values = points(columns, column)
        begin = flight.armed[0][0] if flight.armed else 0.0
        traces.append({"x": [round(time - begin, 2) for time in times], "y": values, **_look(number)})
    if not traces:
        return Section(title, missing="Neither log has this.")
    layout = {"xaxis": {"title": {"text": "seconds since arming"}}, "yaxis": {"title": {"text": unit}}}
    chart = Chart("both-" + title.lower().replace(" ", "-"), traces, layout, 240, f"{unit}, both flights")
    missing = [Words([f"The log of {lacking[0]} has nothing of this."])] if lacking else []
    return Section(title, [chart, *missing])


def _modes(flights: Sequence[Flight]) -> Section:
    told = []
    for name, flight in zip(NAMES, flights, strict=True):
        modes = (f"{change.name} ({span(end - change.time_s)})" for change, end in flight.mode_spans())
        told.append(f"{name}: {' → '.join(modes) or 'not told'}")
    return Section("Modes", [Words(told)])


def _parameters(flights: Sequence[Flight]) -> Section:
    one, other = (flight.parameters for flight in flights)
    if not one or not other:
        lacking = [name for name, each in zip(NAMES, (one, other), strict=True) if not each]
        return Section(
            "Parameters that differ", missing=f"The log of {' and of '.join(lacking)} has no parameters."
        )
    rows = [
        (name, _value(one.get(name)), _value(other.get(name)))
        for name in sorted(one.keys() | other.keys())
        if not _same(one.get(name), other.get(name))
    ]
    parts: list[Part] = [
        Table(("parameter", *NAMES), rows, f"{len(rows)} differ" if len(rows) > 40 else "")
        if rows
        else Words([f"None: all {len(one)} are the same."])
    ]
    return Section("Parameters that differ", parts, "At the beginning of each log.")


def _value(value: float | None) -> str:
    return "not there" if value is None else f"{value:.9g}"


def _same(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return one == other or (one != one and other != other)
