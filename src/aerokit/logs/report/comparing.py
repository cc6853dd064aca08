"""Makes the sections of a report that compares two flights. Times count from the first arming of each flight."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from aerokit.logs.report.charts import (
    coordinates,
    drawn_points,
    map_layout,
    series_colour,
    simplification_note,
    time_range,
    track_rows_to_draw,
)
from aerokit.logs.report.page import Chart, Paragraphs, Section, Table
from aerokit.logs.report.sections import failsafe_section, mode_table
from aerokit.logs.report.statistics import STATISTICS, metres_from_home

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.logs.flights.flight import FlightLog, TimeSeries
    from aerokit.logs.report.page import Part
    from aerokit.logs.report.statistics import FlightStatistics

NAMES = ("A", "B")
"""Names of the two flights in charts and tables."""

# The charts: title, unit, function that returns the time series of a flight, and column.
_CHARTS: tuple[tuple[str, str, Callable[[FlightLog], TimeSeries | None], str], ...] = (
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


def comparison(
    flights: tuple[FlightLog, FlightLog], statistics: tuple[FlightStatistics, FlightStatistics]
) -> list[Section]:
    failsafe_sections = [failsafe_section(flight) for flight in flights]
    return [
        _differences(statistics),
        _maps(flights),
        *(_overlay_section(flights, *chart) for chart in _CHARTS),
        _modes(flights),
        _parameters(flights),
        *(
            replace(section, title=f"{section.title} of {name}")
            for name, section in zip(NAMES, failsafe_sections, strict=True)
        ),
    ]


def _first(by_number: dict[int, TimeSeries]) -> TimeSeries | None:
    return by_number[min(by_number)] if by_number else None


def _armed_at(flight: FlightLog) -> float:
    armed_s, _ = flight.armed[0] if flight.armed else (0.0, 0.0)
    return armed_s


def _differences(statistics: tuple[FlightStatistics, FlightStatistics]) -> Section:
    rows = []
    for name, statistic in STATISTICS.items():
        digits = statistic.decimals
        value_a, value_b = (getattr(flight_statistics, name) for flight_statistics in statistics)
        if value_a is None and value_b is None:
            continue
        difference = ""
        if value_a is not None and value_b is not None:
            difference = f"{round(value_b - value_a, digits) + 0.0:+.{digits}f}"  # + 0.0 converts -0.0 to 0.0
        texts = ("unknown" if value is None else f"{value:.{digits}f}" for value in (value_a, value_b))
        rows.append((statistic.label, *texts, difference))
    return Section("Differences", [Table(("statistic", *NAMES, "B − A"), rows)])


def _maps(flights: Sequence[FlightLog]) -> Section:
    traces = []
    deviations: list[float] = []
    for number, flight in enumerate(flights):
        places = metres_from_home(flight)
        rows, deviation_m = track_rows_to_draw(places)
        deviations.append(deviation_m)
        if rows:
            traces.append({**coordinates(places[row] for row in rows), **_line_style(number)})
    if not traces:
        return Section("Tracks", missing="Neither log has positions.")
    chart = Chart("maps", traces, map_layout(traces), height=520, label="tracks from above, north is up")
    return Section(
        "Tracks",
        [chart, *simplification_note(max(deviations))],
        explanation="From above, relative to each flight's home; north is up.",
    )


def _line_style(number: int) -> dict[str, Any]:
    return {"mode": "lines", "name": NAMES[number], "line": {"color": series_colour(number), "width": 1.8}}


def _overlay_section(
    flights: Sequence[FlightLog],
    title: str,
    unit: str,
    get_series: Callable[[FlightLog], TimeSeries | None],
    column: str,
) -> Section:
    traces, names_without_data = [], []
    for number, flight in enumerate(flights):
        series = get_series(flight)
        if series is None or not series.has_values(column):
            names_without_data.append(NAMES[number])
            continue
        times, values = drawn_points(series, column)
        armed_s = _armed_at(flight)
        traces.append({"x": [round(time - armed_s, 2) for time in times], "y": values, **_line_style(number)})
    if not traces:
        return Section(title, missing="Neither log contains this.")
    begin = min(-_armed_at(flight) for flight in flights)
    end = max(flight.duration_s - _armed_at(flight) for flight in flights)
    axis = {"title": {"text": "seconds since arming"}, "range": time_range(begin, end)}
    layout = {"xaxis": axis, "yaxis": {"title": {"text": unit}}}
    name = "both-" + title.lower().replace(" ", "-")
    chart = Chart(name, traces, layout, height=240, label=f"{unit}, both flights", is_timeline=True)
    parts: list[Part] = [chart]
    if names_without_data:
        parts.append(Paragraphs([f"The log of {names_without_data[0]} does not contain this."]))
    return Section(title, parts)


def _modes(flights: Sequence[FlightLog]) -> Section:
    parts: list[Part] = []
    for name, flight in zip(NAMES, flights, strict=True):
        if flight.modes:
            parts += [Paragraphs([f"{name}:"]), mode_table(flight)]
        else:
            parts.append(Paragraphs([f"{name}: not logged"]))
    return Section("Modes", parts)


def _parameters(flights: Sequence[FlightLog]) -> Section:
    title = "Parameters that differ"
    parameters_a, parameters_b = (flight.parameters for flight in flights)
    if not parameters_a or not parameters_b:
        names = [name for name, flight in zip(NAMES, flights, strict=True) if not flight.parameters]
        return Section(title, missing=f"The log of {' and of '.join(names)} has no parameters.")
    rows = [
        (name, _value(parameters_a.get(name)), _value(parameters_b.get(name)))
        for name in sorted(parameters_a.keys() | parameters_b.keys())
        if not _is_same_value(parameters_a.get(name), parameters_b.get(name))
    ]
    part: Part = Paragraphs([f"None: all {len(parameters_a)} are the same."])
    if rows:
        part = Table(("parameter", *NAMES), rows, title=f"{len(rows)} differ")
    return Section(title, [part], explanation="Values at the start of each log.")


def _value(value: float | None) -> str:
    return "missing" if value is None else f"{value:.9g}"


def _is_same_value(value_a: float | None, value_b: float | None) -> bool:
    if value_a is None or value_b is None:
        return value_a is value_b
    return value_a == value_b or (math.isnan(value_a) and math.isnan(value_b))
