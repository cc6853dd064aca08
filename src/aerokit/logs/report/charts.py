"""Plotly charts of a flight: a map without tiles, and lines over time with mode bands."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.flights.flight import TangentPlane
from aerokit.logs.report.page import Chart
from aerokit.logs.report.statistics import clock, metres_from_home
from aerokit.missions.item import command_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.logs.flights.flight import FlightLog, TimeSeries

MAX_POINTS = 2000
"""Maximum number of points of a line."""
COLOURS = ("#1f77b4", "#e4572e", "#2ca02c", "#a05eb5", "#d69e00", "#17a2b8", "#8c564b", "#e377c2")
_MAX_BANDS = 80
_MAX_POINTS = 6000


def points(columns: TimeSeries, name: str, digits: int = 3) -> tuple[list[float], list[float | None]]:
    """Return times and values of a column for drawing; None is a gap."""
    values, times = columns[name], columns.times
    rows = rows_to_draw(len(values), (values,))
    return (
        [round(times[row], 2) for row in rows],
        [round(value, digits) if math.isfinite(value := values[row]) else None for row in rows],
    )


def rows_to_draw(count: int, columns: Sequence[Any], max_rows: int = MAX_POINTS) -> list[int]:
    """Select rows that preserve all peaks and gaps of these columns."""
    if count <= max_rows:
        return list(range(count))
    pieces = max(max_rows // (2 * len(columns)), 1)
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
    """Return True if more than half of a segment is unknown; single unknown values are not drawn as gaps."""
    unknown = sum(1 for row in range(begin, end) if values[row] != values[row])
    return unknown * 2 > end - begin


_SETPOINT_COLOUR, _FAILSAFE_COLOUR = "#999999", "#d62728"


def mode_colours(flight: FlightLog) -> dict[str, str]:
    names = dict.fromkeys(change.name for change in flight.modes)
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}


def line(name: str, columns: TimeSeries, column: str, digits: int = 3, **style: Any) -> dict[str, Any] | None:
    """Return a line over time; None if all values are unknown."""
    if not columns.has(column):
        return None
    x, y = points(columns, column, digits)
    return {"x": x, "y": y, "name": name, "mode": "lines", "connectgaps": False, **style}


def setpoint_line(name: str, columns: TimeSeries, column: str, digits: int = 3) -> dict[str, Any] | None:
    """Return a line of set-points, in the style that distinguishes them from measured values."""
    found = line(name, columns, column, digits, line={"color": _SETPOINT_COLOUR, "dash": "dot", "width": 1.5})
    if found is not None:
        found["connectgaps"] = True
    return found


def over_time(
    flight: FlightLog, name: str, unit: str, traces: Sequence[dict[str, Any] | None], **layout: Any
) -> Chart | None:
    """Return a chart over time with mode bands and failsafe lines; None without lines."""
    drawn = [trace for trace in traces if trace is not None]
    if not drawn:
        return None
    height = layout.pop("height", 300)
    full_layout = {
        "xaxis": {"title": {"text": "seconds since the start of the log"}},
        "yaxis": {"title": {"text": unit}, **layout.pop("yaxis", {})},
        "shapes": [*_bands(flight), *_failsafe_lines(flight), *layout.pop("shapes", [])],
        **layout,
    }
    return Chart(name, drawn, full_layout, height, f"{unit} over time: {', '.join(t['name'] for t in drawn)}")


def _vertical(kind: str, x0: float, x1: float, **style: Any) -> dict[str, Any]:
    span = {"x0": round(x0, 2), "x1": round(x1, 2), "y0": 0, "y1": 1}
    return {"type": kind, "xref": "x", "yref": "paper", **span, **style}


def _bands(flight: FlightLog) -> list[dict[str, Any]]:
    colours, style = mode_colours(flight), {"layer": "below", "line": {"width": 0}, "opacity": 0.1}
    return [
        _vertical("rect", change.time_s, end, fillcolor=colours[change.name], **style)
        for change, end in flight.mode_spans()[:_MAX_BANDS]
    ]


def _failsafe_lines(flight: FlightLog) -> list[dict[str, Any]]:
    return [
        _vertical(
            "line",
            failsafe.time_s,
            failsafe.time_s,
            line={"color": _FAILSAFE_COLOUR, "width": 1.5, "dash": "solid" if failsafe.acted else "dot"},
        )
        for failsafe in failsafes(flight)[:_MAX_BANDS]
    ]


def track_chart(flight: FlightLog) -> Chart | None:
    """Return the track from above, in metres from home, with a colour for each mode; None without positions."""
    places = metres_from_home(flight)
    if not places or flight.home is None:
        return None
    plane = TangentPlane(flight.home.latitude_deg, flight.home.longitude_deg)
    traces = [
        *_setpoint_path(flight, plane),
        *_mission(flight, plane),
        *_fence(flight),
        *_track_lines(flight, places),
        _marker("home", [(0.0, 0.0)], "circle", "#2ca02c", 11),
        *_failsafe_markers(flight, places),
    ]
    layout = map_layout([place[1] for place in places], constrain="domain")
    return Chart("map", traces, layout, 520, "the track from above, north is up")


def map_layout(east: Sequence[float], **xaxis: Any) -> dict[str, Any]:
    """Return the layout of a map that shows these eastings."""
    include = {"autorangeoptions": {"include": _with_margin(east)}}
    return {
        "xaxis": {"title": {"text": "metres east of home"}, **include, **xaxis},
        "yaxis": {"title": {"text": "metres north of home"}, "scaleanchor": "x", "scaleratio": 1},
        "hovermode": "closest",
    }


def _with_margin(values: Sequence[float]) -> list[float]:
    """Return minimum and maximum with a margin, which Plotly omits at the ends of lines in x."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return []
    margin = max(0.05 * (max(known) - min(known)), 1.0)
    return [round(min(known) - margin, 1), round(max(known) + margin, 1)]


def _track_lines(flight: FlightLog, places: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    track, colours, found = flight.track, mode_colours(flight), []
    north = [place[0] for place in places]
    east = [place[1] for place in places]
    rows = rows_to_draw(len(places), (north, east), _MAX_POINTS)
    heights = track["altitude_relative_m"]
    changes = [(change.time_s, change.name) for change in flight.modes] or [(0.0, "")]
    changes[0] = (-math.inf, changes[0][1])
    named: set[str] = set()
    for (begin, name), (end, _) in pairwise([*changes, (math.inf, "")]):
        part = [row for row in rows if begin <= track.times[row] < end]
        after = next((row for row in rows if track.times[row] >= end), None)
        part += [] if after is None else [after]
        if not part:
            continue
        found.append(
            {
                "x": [rounded(east[row]) for row in part],
                "y": [rounded(north[row]) for row in part],
                "text": [_here(track.times[row], heights[row]) for row in part],
                "mode": "lines",
                "name": name or "track",
                "legendgroup": name,
                "showlegend": name not in named,
                "line": {"color": colours.get(name, COLOURS[0]), "width": 2.5},
                "hovertemplate": "%{text}<br>%{x:.1f} m east, %{y:.1f} m north",
            }
        )
        named.add(name)
    return found


def _here(time_s: float, height_m: float) -> str:
    return clock(time_s) + (f", {height_m:.1f} m up" if height_m == height_m else "")


def rounded(value: float) -> float | None:
    return round(value, 2) if math.isfinite(value) else None


def _setpoint_path(flight: FlightLog, plane: TangentPlane) -> list[dict[str, Any]]:
    target = flight.position_target
    places = [
        plane.metres(*place)
        for place in zip(target["latitude_deg"], target["longitude_deg"], strict=True)
        if place[0] == place[0] and abs(place[0]) <= 90
    ]
    if not places:
        return []
    north, east = [place[0] for place in places], [place[1] for place in places]
    rows = rows_to_draw(len(places), (north, east), _MAX_POINTS // 2)
    return [
        {
            "x": [rounded(east[row]) for row in rows],
            "y": [rounded(north[row]) for row in rows],
            "mode": "lines",
            "name": "set-point",
            "line": {"color": _SETPOINT_COLOUR, "width": 1.5, "dash": "dot"},
            "hoverinfo": "skip",
        }
    ]


def _mission(flight: FlightLog, plane: TangentPlane) -> list[dict[str, Any]]:
    items = [item for item in flight.mission if item.latitude_deg == item.latitude_deg and item.number > 0]
    if not items:
        return []
    found = _marker(
        "mission",
        [plane.metres(item.latitude_deg, item.longitude_deg) for item in items],
        "diamond-open",
        "#555555",
        9,
        [f"{item.number} {command_name(item.command)}" for item in items],
    )
    return [{**found, "mode": "markers+lines", "line": {"color": "#888888", "width": 1, "dash": "dash"}}]


def _fence(flight: FlightLog) -> list[dict[str, Any]]:
    """Return the circular fence from the parameters. Logs do not contain polygons."""
    end, value = flight.duration_s, flight.parameter_at
    radius = value("GF_MAX_HOR_DIST", end)
    if value("FENCE_ENABLE", end) >= 1 and int(value("FENCE_TYPE", end)) & 2:
        radius = value("FENCE_RADIUS", end)
    if not radius > 0:
        return []
    angles = [math.tau * number / 90 for number in range(91)]
    return [
        {
            "x": [round(radius * math.sin(angle), 1) for angle in angles],
            "y": [round(radius * math.cos(angle), 1) for angle in angles],
            "mode": "lines",
            "name": "fence",
            "hoverinfo": "skip",
            "line": {"color": _FAILSAFE_COLOUR, "width": 1, "dash": "dash"},
        }
    ]


def _failsafe_markers(flight: FlightLog, places: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    found, names = [], []
    for failsafe in failsafes(flight):
        row = flight.track.index_at(failsafe.time_s)
        if row >= 0 and places[row][0] == places[row][0]:
            found.append(places[row])
            names.append(f"{failsafe.title}, {clock(failsafe.time_s)}")
    return [_marker("failsafe", found, "x", _FAILSAFE_COLOUR, 12, names)] if found else []


def _marker(
    name: str,
    places: Sequence[tuple[float, float]],
    symbol: str,
    colour: str,
    size: int,
    texts: Sequence[str] = (),
) -> dict[str, Any]:
    return {
        "x": [rounded(east) for _, east in places],
        "y": [rounded(north) for north, _ in places],
        "mode": "markers",
        "name": name,
        "text": list(texts) or [name] * len(places),
        "marker": {"symbol": symbol, "color": colour, "size": size},
        "hovertemplate": "%{text}",
    }
