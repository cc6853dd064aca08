"""Makes Plotly charts of a flight: a map without tiles, and timelines with a coloured band for each mode."""

from __future__ import annotations

import math
from bisect import bisect_left
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.failsafes import Failsafe, failsafes
from aerokit.logs.flights.falls import Fall, falls
from aerokit.logs.flights.flight import ModeChange, TangentPlane
from aerokit.logs.report.formatting import clock_text
from aerokit.logs.report.page import Chart, Paragraphs
from aerokit.logs.report.simplification import MAX_COORDINATE, simplify
from aerokit.logs.report.statistics import metres_from_home
from aerokit.missions.item import command_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from aerokit.logs.flights.flight import FlightLog, TimeSeries
    from aerokit.logs.report.page import Part

MAX_POINTS = 2000
"""Maximum number of points of a line in a timeline."""
MAX_TRACK_POINTS = 6000
"""Maximum number of points of a drawn track, even if it then deviates by more than the tolerance."""
_TRACK_TOLERANCE_M = 0.1
_ROUNDING_M = 0.01
_MAX_FENCE_M = 1e6

# Each colour has a contrast of 3:1 to its background. With any kind of colour blindness, the colours stay different.
_MODE_COLOURS = {
    "light": ("#4477aa", "#cb6471", "#4b7700", "#aa2f71", "#b8860b", "#0d9ba5", "#6a3d25", "#7a5add"),
    "dark": ("#77aadd", "#f98c53", "#00ce98", "#d262a1", "#eedd88", "#69ddee", "#b07d5c", "#9685ff"),
}
_SERIES_COLOURS = {
    "light": ("#0072b2", "#b94900", "#0d9f7a", "#882255", "#bc8300", "#222288"),
    "dark": ("#39cdfd", "#e69f00", "#2cc295", "#c767ac", "#f0e442", "#8888ee"),
}
_NAMED_COLOURS = {
    "light": {
        "ink": "#222222",
        "paper": "#ffffff",
        "soft": "#5f666d",
        "grid": "#e3e3e3",
        "failsafe": "#c62828",
        "home": "#1b7a32",
        "set-point": "#767676",
        "mission": "#555555",
    },
    "dark": {
        "ink": "#d8dee6",
        "paper": "#14181d",
        "soft": "#97a3b0",
        "grid": "#39424d",
        "failsafe": "#ff7b72",
        "home": "#4fd06d",
        "set-point": "#a5adb5",
        "mission": "#b5bcc4",
    },
}
COLOURS = {
    theme: {
        **named_colours,
        **{f"mode{number}": colour for number, colour in enumerate(_MODE_COLOURS[theme])},
        **{f"series{number}": colour for number, colour in enumerate(_SERIES_COLOURS[theme])},
    }
    for theme, named_colours in _NAMED_COLOURS.items()
}
"""Maps themes to their colours by name. Charts refer to a colour as ``colour:NAME``."""
_SETPOINT, _FAILSAFE = "colour:set-point", "colour:failsafe"


def series_colour(number: int) -> str:
    return f"colour:series{number % len(_SERIES_COLOURS['light'])}"


def drawn_points(series: TimeSeries, name: str, digits: int = 3) -> tuple[list[float], list[float | None]]:
    """Return the times and values to draw for a column. The value None interrupts the line."""
    values, times = series[name], series.times
    rows = rows_to_draw(values)
    return (
        [round(times[row], 2) for row in rows],
        [round(values[row], digits) if math.isfinite(values[row]) else None for row in rows],
    )


def rows_to_draw(values: Sequence[float], max_rows: int = MAX_POINTS) -> list[int]:
    """Select about ``max_rows`` rows with which a chart still shows all peaks and the longer gaps."""
    count = len(values)
    if count <= max_rows:
        return list(range(count))
    # From each of `pieces` parts of equal length, draw the lowest and the highest value.
    pieces = max(max_rows // 2, 1)
    selected = {0, count - 1}
    for piece in range(pieces):
        begin = count * piece // pieces
        end = count * (piece + 1) // pieces
        part = values[begin:end]
        known_values = part
        if math.isnan(sum(part)):  # the sum is NaN if any value is unknown
            known_values = [value for value in part if not math.isnan(value)]
            # Draw a gap only if most values of the part are unknown.
            if len(known_values) * 2 < len(part):
                selected.add(next(row for row in range(begin, end) if math.isnan(values[row])))
        if known_values:
            selected.add(begin + part.index(min(known_values)))
            selected.add(begin + part.index(max(known_values)))
    return sorted(selected)


def mode_colours(flight: FlightLog) -> dict[str, str]:
    names = dict.fromkeys(change.name for change in flight.modes)
    return {name: f"colour:mode{number % len(_MODE_COLOURS['light'])}" for number, name in enumerate(names)}


def line_trace(name: str, series: TimeSeries, column: str, digits: int = 3, **style: Any) -> dict[str, Any] | None:
    """Return a column as a line of a timeline; None if all of its values are unknown."""
    if not series.has_values(column):
        return None
    x, y = drawn_points(series, column, digits)
    return {"x": x, "y": y, "name": name, "mode": "lines", "connectgaps": False, **style}


def setpoint_trace(series: TimeSeries, column: str, digits: int = 3) -> dict[str, Any] | None:
    trace = line_trace("set-point", series, column, digits, line={"color": _SETPOINT, "dash": "dot", "width": 1.5})
    if trace is not None:
        trace["connectgaps"] = True
    return trace


def timeline(
    flight: FlightLog, name: str, unit: str, traces: Sequence[dict[str, Any] | None], **layout: Any
) -> Chart | None:
    """Return a chart over time with these traces; None if there are none."""
    drawn = [trace for trace in traces if trace is not None]
    if not drawn:
        return None
    height = layout.pop("height", 300)
    times = {"title": {"text": "seconds since the start of the log"}, "range": time_range(0.0, flight.duration_s)}
    full_layout = {"xaxis": times, "yaxis": {"title": {"text": unit}, **layout.pop("yaxis", {})}, **layout}
    without_colour = [trace for trace in drawn if "line" not in trace]
    for number, trace in enumerate(without_colour):
        trace["line"] = {"color": series_colour(number), "width": 1.6}
    label = f"{unit} over time: {', '.join(trace['name'] for trace in drawn)}"
    return Chart(name, drawn, full_layout, height=height, label=label, is_timeline=True)


def time_range(begin_s: float, end_s: float) -> list[float]:
    margin = max(0.02 * (end_s - begin_s), 0.5)
    return [round(begin_s - margin, 2), round(end_s + margin, 2)]


def timeline_shapes(flight: FlightLog) -> list[dict[str, Any]]:
    # The shapes are SVG paths over the whole height, 0 to 1: rectangles for modes, vertical lines for events.
    spans: dict[str, list[str]] = {}
    for change, end in flight.mode_spans():
        band = f"M{change.time_s:.2f},0H{end:.2f}V1H{change.time_s:.2f}Z"
        spans.setdefault(change.name, []).append(band)
    colours = mode_colours(flight)
    shapes = [
        _path_shape(paths, fillcolor=colours[name], opacity=0.16, line={"width": 0}, layer="below")
        for name, paths in spans.items()
    ]
    all_failsafes = failsafes(flight)
    serious: list[Failsafe | Fall] = [*(failsafe for failsafe in all_failsafes if failsafe.acted), *falls(flight)]
    warnings = [failsafe for failsafe in all_failsafes if not failsafe.acted]
    for events, dash in ((serious, "solid"), (warnings, "dot")):
        if events:
            paths = [f"M{event.time_s:.2f},0V1" for event in events]
            shapes.append(_path_shape(paths, line={"color": _FAILSAFE, "width": 1.5, "dash": dash}))
    return shapes


def _path_shape(paths: Sequence[str], **style: Any) -> dict[str, Any]:
    return {"type": "path", "xref": "x", "yref": "paper", "path": "".join(paths), **style}


def track_parts(flight: FlightLog) -> list[Part]:
    places = metres_from_home(flight)
    if not places or flight.home is None:
        return []
    plane = TangentPlane(flight.home.latitude_deg, flight.home.longitude_deg)
    lines, deviation_m = _track_lines(flight, places)
    traces = [
        *_setpoint_traces(flight, plane),
        *_mission_traces(flight, plane),
        *_fence_traces(flight),
        *lines,
        _marker("home", [(0.0, 0.0)], symbol="circle", colour="colour:home", size=11),
        *_failsafe_markers(flight, places),
    ]
    label = "the track from above, north is up"
    chart = Chart("map", traces, map_layout(traces), height=520, label=label)
    return [chart, *simplification_note(deviation_m)]


def simplification_note(deviation_m: float) -> list[Part]:
    if not deviation_m:
        return []
    return [Paragraphs([f"The line is simplified: no recorded position is more than {deviation_m:.2f} m from it."])]


def track_rows_to_draw(
    places: Sequence[tuple[float, float]], max_rows: int = MAX_TRACK_POINTS, keep: Iterable[int] = ()
) -> tuple[list[int], float]:
    """Return the indices of the places to draw, and the largest distance of a place from the drawn line.

    Places in ``keep`` are always drawn. If all places are NaN, nothing is drawn.
    """
    if len(places) <= MAX_POINTS:  # short lines are drawn completely
        has_known = any(None not in map(rounded_or_none, place) for place in places)
        rows = list(range(len(places))) if has_known else []
        return rows, 0.0
    rows, deviation_m = simplify(places, max_rows, _TRACK_TOLERANCE_M, keep)
    if deviation_m:
        deviation_m = math.ceil((deviation_m + _ROUNDING_M) * 100) / 100  # an upper bound, in whole centimetres
    return rows, deviation_m


def map_layout(traces: Sequence[dict[str, Any]]) -> dict[str, Any]:
    axes: dict[str, dict[str, Any]] = {}
    for name, direction in (("x", "east"), ("y", "north")):
        values: list[float] = []
        for trace in traces:
            values += [value for value in trace[name] if value is not None]
        margin = max(0.05 * (max(values) - min(values)), 1.0)
        axes[f"{name}axis"] = {
            "title": {"text": f"metres {direction} of home"},
            "range": [round(min(values) - margin, 1), round(max(values) + margin, 1)],
            "constrain": "domain",
        }
    axes["yaxis"].update(scaleanchor="x", scaleratio=1)
    return {**axes, "hovermode": "closest"}


def _track_lines(flight: FlightLog, places: Sequence[tuple[float, float]]) -> tuple[list[dict[str, Any]], float]:
    """Return one line per mode, and the largest distance of a position from the drawn track."""
    times, heights = flight.track.times, flight.track["altitude_relative_m"]
    changes = flight.modes or [ModeChange(0.0, "")]
    # The rows at which the modes begin, and the end of the last mode.
    boundaries = [0, *(bisect_left(times, change.time_s) for change in changes[1:]), len(places)]
    rows, deviation_m = track_rows_to_draw(places, keep=(row for row in boundaries if row < len(places)))
    rows_by_mode: dict[str, list[int | None]] = {}  # None interrupts the line
    for (begin_row, end_row), change in zip(pairwise(boundaries), changes, strict=True):
        # The line of a mode ends at the first position of the next mode, so that the track has no gaps.
        begin, end = bisect_left(rows, begin_row), bisect_left(rows, end_row)
        line = rows[begin : end + 1] if begin_row < end_row else []
        if line:
            mode_rows = rows_by_mode.setdefault(change.name, [])
            if mode_rows:  # the mode was used before
                mode_rows.append(None)
            mode_rows += line
    colours = mode_colours(flight)
    lines = [
        {
            **coordinates(None if row is None else places[row] for row in mode_rows),
            "text": ["" if row is None else _hover_text(times[row], heights[row]) for row in mode_rows],
            "mode": "lines",
            "name": name or "track",
            "line": {"color": colours.get(name, "colour:mode0"), "width": 2.5},
            "hovertemplate": "%{text}<br>%{x:.1f} m east, %{y:.1f} m north",
        }
        for name, mode_rows in rows_by_mode.items()
    ]
    return lines, deviation_m


def coordinates(places: Iterable[tuple[float, float] | None]) -> dict[str, list[float | None]]:
    """Convert pairs of metres north and east to Plotly's x and y. None interrupts the line."""
    pairs = [(math.nan, math.nan) if place is None else place for place in places]
    return {"x": [rounded_or_none(east) for _, east in pairs], "y": [rounded_or_none(north) for north, _ in pairs]}


def _hover_text(time_s: float, height_m: float) -> str:
    return clock_text(time_s) if math.isnan(height_m) else f"{clock_text(time_s)}, {height_m:.1f} m up"


def rounded_or_none(value: float) -> float | None:
    """Round a coordinate for drawing; None if it is unknown or damaged."""
    return round(value, 2) if abs(value) <= MAX_COORDINATE else None


def _setpoint_traces(flight: FlightLog, plane: TangentPlane) -> list[dict[str, Any]]:
    target = flight.position_target
    places = [
        plane.metres(latitude, longitude)
        for latitude, longitude in zip(target["latitude_deg"], target["longitude_deg"], strict=True)
        if abs(latitude) <= 90  # False for NaN
    ]
    if not places:
        return []
    rows, _ = track_rows_to_draw(places, max_rows=MAX_TRACK_POINTS // 2)
    return [
        {
            **coordinates(places[row] for row in rows),
            "mode": "lines",
            "name": "set-point",
            "line": {"color": _SETPOINT, "width": 1.5, "dash": "dot"},
            "hoverinfo": "skip",
        }
    ]


def _mission_traces(flight: FlightLog, plane: TangentPlane) -> list[dict[str, Any]]:
    items = [item for item in flight.mission if not math.isnan(item.latitude_deg) and flight.item_label(item) != "home"]
    if not items:
        return []
    markers = _marker(
        "mission",
        [plane.metres(item.latitude_deg, item.longitude_deg) for item in items],
        symbol="diamond-open",
        colour="colour:mission",
        size=9,
        texts=[f"{flight.item_label(item)} {command_name(item.command)}" for item in items],
    )
    return [{**markers, "mode": "markers+lines", "line": {"color": "colour:mission", "width": 1, "dash": "dash"}}]


def _fence_traces(flight: FlightLog) -> list[dict[str, Any]]:
    # Fences of polygons are not in the logs.
    end_s, parameter_at = flight.duration_s, flight.parameter_at
    radius = parameter_at("GF_MAX_HOR_DIST", end_s)  # PX4
    fence_type = parameter_at("FENCE_TYPE", end_s)  # ArduPilot; bit 1 is the circle
    has_circle = math.isfinite(fence_type) and int(fence_type) & 2
    if parameter_at("FENCE_ENABLE", end_s) >= 1 and has_circle:
        radius = parameter_at("FENCE_RADIUS", end_s)
    if not 0 < radius < _MAX_FENCE_M:
        return []
    angles = [math.tau * number / 90 for number in range(91)]  # a polygon with 90 sides
    return [
        {
            "x": [round(radius * math.sin(angle), 1) for angle in angles],
            "y": [round(radius * math.cos(angle), 1) for angle in angles],
            "mode": "lines",
            "name": "fence",
            "hoverinfo": "skip",
            "line": {"color": _FAILSAFE, "width": 1, "dash": "dash"},
        }
    ]


def _failsafe_markers(flight: FlightLog, places: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    events_by_legend: tuple[tuple[str, str, Sequence[Failsafe | Fall]], ...] = (
        ("failsafe", "x", failsafes(flight)),
        ("fall", "triangle-down", falls(flight)),
    )
    markers = []
    for legend, symbol, events in events_by_legend:
        event_places, names = [], []
        for event in events:
            row = flight.track.index_at(event.time_s)
            if row >= 0 and not math.isnan(math.hypot(*places[row])):
                event_places.append(places[row])
                names.append(f"{event.title}, {clock_text(event.time_s)}")
        if event_places:
            markers.append(_marker(legend, event_places, symbol=symbol, colour=_FAILSAFE, size=12, texts=names))
    return markers


def _marker(
    name: str, places: Sequence[tuple[float, float]], *, symbol: str, colour: str, size: int, texts: Sequence[str] = ()
) -> dict[str, Any]:
    return {
        **coordinates(places),
        "mode": "markers",
        "name": name,
        "text": list(texts) or [name] * len(places),
        "marker": {"symbol": symbol, "color": colour, "size": size},
        "hovertemplate": "%{text}",
    }
