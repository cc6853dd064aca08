"""The charts of a flight as Plotly reads them: the map without tiles, and lines over time with modes behind them."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.columns import Plane
from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.report.figures import clock, metres_from_home
from aerokit.logs.report.page import Chart
from aerokit.missions.item import command_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.logs.flights.columns import Columns
    from aerokit.logs.flights.flight import Flight

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


COLOURS = ("#1f77b4", "#e4572e", "#2ca02c", "#a05eb5", "#d69e00", "#17a2b8", "#8c564b", "#e377c2")

_WANTED, _FAILED = "#999999", "#d62728"

_MOST_BANDS = 80

_MOST_POINTS = 6000


def mode_colours(flight: Flight) -> dict[str, str]:
    """A colour for each mode, in the order of their first use."""
    names = dict.fromkeys(change.name for change in flight.modes)
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}


def line(name: str, columns: Columns, column: str, digits: int = 3, **look: Any) -> dict[str, Any] | None:
    """A line over time; None when nothing of it is known."""
    if not columns.has(column):
        return None
    x, y = points(columns, column, digits)
    return {"x": x, "y": y, "name": name, "mode": "lines", "connectgaps": False, **look}


def wanted(name: str, columns: Columns, column: str, digits: int = 3) -> dict[str, Any] | None:
    """A line of what was wanted, beside what was flown."""
    found = line(name, columns, column, digits, line={"color": _WANTED, "dash": "dot", "width": 1.5})
    if found is not None:
        found["connectgaps"] = True
    return found


def over_time(
    flight: Flight, name: str, unit: str, traces: Sequence[dict[str, Any] | None], **layout: Any
) -> Chart | None:
    """A chart over time, modes behind it and failsafes across it; None without a line."""
    drawn = [trace for trace in traces if trace is not None]
    if not drawn:
        return None
    height = layout.pop("height", 300)
    whole = {
        "xaxis": {"title": {"text": "seconds since the log began"}},
        "yaxis": {"title": {"text": unit}, **layout.pop("yaxis", {})},
        "shapes": [*_bands(flight), *_failsafe_lines(flight), *layout.pop("shapes", [])],
        **layout,
    }
    return Chart(name, drawn, whole, height, f"{unit} over time: {', '.join(t['name'] for t in drawn)}")


def _bands(flight: Flight) -> list[dict[str, Any]]:
    colours, found = mode_colours(flight), []
    for change, end in flight.mode_spans()[:_MOST_BANDS]:
        found.append(
            {
                "type": "rect",
                "xref": "x",
                "yref": "paper",
                "y0": 0,
                "y1": 1,
                "layer": "below",
                "x0": round(change.time_s, 2),
                "x1": round(end, 2),
                "line": {"width": 0},
                "fillcolor": colours[change.name],
                "opacity": 0.1,
            }
        )
    return found


def _failsafe_lines(flight: Flight) -> list[dict[str, Any]]:
    return [
        {
            "type": "line",
            "xref": "x",
            "yref": "paper",
            "y0": 0,
            "y1": 1,
            "x0": round(each.time_s, 2),
            "x1": round(each.time_s, 2),
            "line": {"color": _FAILED, "width": 1.5, "dash": "solid" if each.acted else "dot"},
        }
        for each in failsafes(flight)[:_MOST_BANDS]
    ]


# ------------------------------------------------------------------------------------------- the map
def track_chart(flight: Flight) -> Chart | None:
    """The track from above, in metres from home, a colour for each mode; None without a place."""
    places = metres_from_home(flight)
    if not places or flight.home is None:
        return None
    plane = Plane(flight.home.latitude_deg, flight.home.longitude_deg)
    traces = [
        *_wanted_path(flight, plane),
        *_mission(flight, plane),
        *_fence(flight),
        *_flown(flight, places),
        _marker("home", [(0.0, 0.0)], "circle", "#2ca02c", 11),
        *_failed(flight, places),
    ]
    layout = {
        "xaxis": {
            "title": {"text": "metres east of home"},
            "constrain": "domain",
            "autorangeoptions": {"include": with_margin([place[1] for place in places])},
        },
        "yaxis": {"title": {"text": "metres north of home"}, "scaleanchor": "x", "scaleratio": 1},
        "hovermode": "closest",
    }
    return Chart("map", traces, layout, 520, "the track from above, north is up")


def with_margin(values: Sequence[float]) -> list[float]:
    """The least and the greatest with some room beside them: Plotly leaves none at the ends of a line in x."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return []
    room = max(0.05 * (max(known) - min(known)), 1.0)
    return [round(min(known) - room, 1), round(max(known) + room, 1)]


def _flown(flight: Flight, places: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    track, colours, found = flight.track, mode_colours(flight), []
    north = [place[0] for place in places]
    east = [place[1] for place in places]
    rows = rows_to_draw(len(places), (north, east), _MOST_POINTS)
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
                "x": [_round(east[row]) for row in part],
                "y": [_round(north[row]) for row in part],
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


def _round(value: float) -> float | None:
    return round(value, 2) if math.isfinite(value) else None


def _wanted_path(flight: Flight, plane: Plane) -> list[dict[str, Any]]:
    target = flight.position_target
    places = [
        plane.metres(*place)
        for place in zip(target["latitude_deg"], target["longitude_deg"], strict=True)
        if place[0] == place[0] and abs(place[0]) <= 90
    ]
    if not places:
        return []
    north, east = [place[0] for place in places], [place[1] for place in places]
    rows = rows_to_draw(len(places), (north, east), _MOST_POINTS // 2)
    return [
        {
            "x": [_round(east[row]) for row in rows],
            "y": [_round(north[row]) for row in rows],
            "mode": "lines",
            "name": "wanted",
            "line": {"color": _WANTED, "width": 1.5, "dash": "dot"},
            "hoverinfo": "skip",
        }
    ]


def _mission(flight: Flight, plane: Plane) -> list[dict[str, Any]]:
    items = [each for each in flight.mission if each.latitude_deg == each.latitude_deg and each.number > 0]
    if not items:
        return []
    found = _marker(
        "mission",
        [plane.metres(each.latitude_deg, each.longitude_deg) for each in items],
        "diamond-open",
        "#555555",
        9,
        [f"{each.number} {command_name(each.command)}" for each in items],
    )
    return [{**found, "mode": "markers+lines", "line": {"color": "#888888", "width": 1, "dash": "dash"}}]


def _fence(flight: Flight) -> list[dict[str, Any]]:
    """The circle around home that the parameters tell; polygons are not in a log."""
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
            "line": {"color": _FAILED, "width": 1, "dash": "dash"},
        }
    ]


def _failed(flight: Flight, places: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    found, names = [], []
    for each in failsafes(flight):
        row = flight.track.index_at(each.time_s)
        if row >= 0 and places[row][0] == places[row][0]:
            found.append(places[row])
            names.append(f"{each.title}, {clock(each.time_s)}")
    return [_marker("failsafe", found, "x", _FAILED, 12, names)] if found else []


def _marker(
    name: str,
    places: Sequence[tuple[float, float]],
    symbol: str,
    colour: str,
    size: int,
    texts: Sequence[str] = (),
) -> dict[str, Any]:
    return {
        "x": [_round(east) for _, east in places],
        "y": [_round(north) for north, _ in places],
        "mode": "markers",
        "name": name,
        "text": list(texts) or [name] * len(places),
        "marker": {"symbol": symbol, "color": colour, "size": size},
        "hovertemplate": "%{text}",
    }
