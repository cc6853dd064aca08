"""Makes the sections of a report on one flight. Each function returns a section, or None if the section is omitted."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.flights.flight import battery_name
from aerokit.logs.report.charts import line_trace, setpoint_trace, timeline, track_parts
from aerokit.logs.report.formatting import clock_text, date_text, duration_text
from aerokit.logs.report.page import Collapsed, Paragraphs, Section, Table
from aerokit.logs.report.silences import silence_sentences
from aerokit.mavlink.enums import MavSeverity
from aerokit.missions.item import command_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.logs.flights.failsafes import Failsafe
    from aerokit.logs.flights.flight import FlightLog, TimeSeries, Waypoint
    from aerokit.logs.report.page import Part

_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
# Names of GPS_FIX_TYPE values. Higher values have different meanings in MAVLink, ArduPilot's logs and PX4's logs.
_FIX_NAMES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed")
_MAX_TEXTS, _MAX_CHANGES, _MAX_PARAMETERS = 2000, 2000, 5000
_MAX_OPEN_FAILSAFES = 10
# The autopilot itself writes parameters with one of these strings in their names.
_WRITTEN_BY_AUTOPILOT = (
    "STAT_",
    "_GND_PRESS",
    "_GND_TEMP",
    "GND_ABS_PRESS",
    "LND_FLIGHT_T",
    "COM_FLIGHT_UUID",
    "MIS_TOTAL",
    "LOG_LASTFILE",
)


def _with_parts(section: Section, *optional_parts: Part | None) -> Section:
    parts = [part for part in optional_parts if part is not None]
    return replace(section, parts=parts, missing="" if parts else section.missing)


def _map(flight: FlightLog) -> Section:
    section = Section(
        "Track",
        explanation="From above, north is up. Colours are modes, dotted lines are set-points. There are no map tiles,"
        " because they would need network access.",
        missing="The log contains no positions.",
    )
    return _with_parts(section, *track_parts(flight))


def _heights(flight: FlightLog) -> Section:
    relative = "altitude_relative_m"
    traces = [setpoint_trace(flight.position_target, relative), line_trace("actual", flight.track, relative)]
    chart = timeline(flight, "heights", "metres above home", traces)
    explanation = "In all charts, background colours are modes, as in the map, and red lines are failsafes and falls."
    return _with_parts(Section("Height", explanation=explanation, missing="The log contains no heights."), chart)


def _modes(flight: FlightLog) -> Section:
    if not flight.modes:
        return Section("Modes", missing="The log contains no modes.")
    armed = [
        (
            clock_text(begin),
            clock_text(end) if end < flight.duration_s else "not before the end",
            duration_text(end - begin),
        )
        for begin, end in flight.armed
    ]
    times = Table(("armed", "disarmed", "duration"), armed, f"armed {len(armed)} times")
    return Section("Modes", [mode_table(flight), times if armed else Paragraphs(["No arming was logged."])])


def mode_table(flight: FlightLog) -> Table:
    rows = [
        (clock_text(change.time_s), change.name, duration_text(end - change.time_s), change.reason)
        for change, end in flight.mode_spans()
    ]
    return Table(("time", "mode", "duration", "reason"), rows, f"{len(rows)} modes")


def failsafe_section(flight: FlightLog) -> Section:
    all_failsafes = failsafes(flight)
    if not all_failsafes:
        return Section(
            "Failsafes",
            [Paragraphs(["No failsafe was reported: no text, mode change, error or flag in the log indicates one."])],
        )
    tables = [_failsafe(failsafe) for failsafe in all_failsafes]
    parts: list[Part] = [*tables[:_MAX_OPEN_FAILSAFES]]
    collapsed = tables[_MAX_OPEN_FAILSAFES:]
    if collapsed:
        parts.append(Collapsed(f"{len(collapsed)} more", collapsed))
    parameters = "the parameters that configure it."
    if not flight.parameters:
        parameters = (
            "the names of the parameters that configure it: the log contains no parameters, `aerokit params get NAME`"
            " reads them from the vehicle."
        )
    explanation = f"Each failsafe has its evidence, the values measured before it, and {parameters}"
    return Section("Failsafes", parts, explanation)


def _failsafe(failsafe: Failsafe) -> Table:
    kind, mark = ("failsafe", "bad") if failsafe.acted else ("warning", "warning")
    head = f"{clock_text(failsafe.time_s)} {failsafe.title} ({kind}): {failsafe.reaction}"
    rows = [("evidence", f"{clock_text(item.time_s)} {item.text}") for item in failsafe.evidence]
    rows += [("context", text) for text in failsafe.context]
    return Table((kind, head), rows, title=head, marks=[mark] * len(failsafe.evidence))


def _attitude(flight: FlightLog) -> Section:
    section = Section(
        "Attitude, actual and set-point",
        explanation="Where the lines stay apart, the vehicle could not follow the set-points.",
        missing="The log contains no attitude.",
    )
    columns = {name: f"{name}_deg" for name in ("roll", "pitch", "yaw")}
    return _with_parts(
        section, *_actual_and_setpoint(flight, "attitude", "degrees", flight.attitude_target, flight.attitude, columns)
    )


def _velocity(flight: FlightLog) -> Section:
    section = Section("Velocity, actual and set-point", missing="The log contains no velocity.")
    columns = {name: f"{name}_m_s" for name in ("north", "east", "down")}
    air = timeline(flight, "air", "air speed, m/s", [_air_speed_line(flight)], height=220)
    return _with_parts(
        section, *_actual_and_setpoint(flight, "velocity", "m/s", flight.velocity_target, flight.velocity, columns), air
    )


def _actual_and_setpoint(
    flight: FlightLog, quantity: str, unit: str, setpoints: TimeSeries, actual: TimeSeries, columns: Mapping[str, str]
) -> list[Part | None]:
    """Return a chart for each entry of ``columns``, which maps labels to names of columns."""
    charts = [
        timeline(
            flight,
            f"{quantity}-{name}",
            f"{name}, {unit}",
            [setpoint_trace(setpoints, column, digits=2), line_trace("actual", actual, column, digits=2)],
            height=220,
        )
        for name, column in columns.items()
    ]
    if any(charts) and not setpoints.has_values():
        return [*charts, Paragraphs([f"The log contains no {quantity} set-points."])]
    return [*charts]


def _air_speed_line(flight: FlightLog) -> dict[str, Any] | None:
    # Without a sensor, all air speeds are 0.
    has_speed = flight.air.has_values("air_speed_m_s") and max(flight.air.known("air_speed_m_s")) > 0
    return line_trace("air speed", flight.air, "air_speed_m_s", digits=2) if has_speed else None


def _batteries(flight: FlightLog) -> Section:
    section = Section("Battery", missing="The log contains no battery data.")
    charts: list[Part | None] = []
    for name, unit, digits in (
        ("voltage_v", "volts", 3),
        ("current_a", "amperes", 2),
        ("remaining_percent", "% remaining", 1),
    ):
        lines = [
            line_trace(battery_name(number), battery, name, digits=digits)
            for number, battery in sorted(flight.batteries.items())
        ]
        charts.append(timeline(flight, f"battery-{name}", unit, lines, height=220))
    return _with_parts(section, *charts)


def _vibration(flight: FlightLog) -> Section:
    section = Section(
        "Vibration",
        explanation="Normal is below 30 m/s²; above 60 m/s² the estimator degrades. Clips count how often an"
        " accelerometer reached its limit; they should not increase in flight.",
        missing="The log contains no vibration levels.",
    )
    names = {"x_m_s2": "x", "y_m_s2": "y", "z_m_s2": "z"}
    if flight.autopilot == "PX4" and not flight.vibration.has_values("y_m_s2"):
        names = {"x_m_s2": "all axes"}
    axes = [line_trace(label, flight.vibration, name, digits=2) for name, label in names.items()]
    levels = timeline(flight, "vibration", "m/s²", axes)
    clips = timeline(flight, "clips", "clips", [line_trace("clips", flight.vibration, "clips", digits=0)], height=180)
    return _with_parts(section, levels, clips)


def _estimator(flight: FlightLog) -> Section:
    section = Section(
        "Estimator",
        explanation="Innovation test ratios: the difference of each measurement from the estimator's prediction,"
        " relative to the allowed one. Above 1 (the line) the estimator rejects the measurement.",
        missing="The log contains no estimator data.",
    )
    ratios = [line_trace(name.replace("_", " "), flight.estimator, name) for name in flight.estimator]
    limit = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 1, "y1": 1}
    limit_line = {**limit, "line": {"color": "colour:failsafe", "width": 1}}
    return _with_parts(section, timeline(flight, "estimator", "ratio", ratios, shapes=[limit_line]))


def _fix_type_axis(flight: FlightLog) -> dict[str, Any]:
    values = sorted({value for gps in flight.gps.values() for value in gps.known("fix_type")})
    names = [_FIX_NAMES[int(value)] if 0 <= value < len(_FIX_NAMES) else f"{value:g}" for value in values]
    return {"tickmode": "array", "tickvals": values, "ticktext": names}


def _gps(flight: FlightLog) -> Section:
    section = Section("Satellites", missing="The log contains no GNSS data.")
    charts = []
    for name, unit in (("satellites", "satellites"), ("hdop", "HDOP"), ("fix_type", "fix type")):
        lines = [line_trace(f"receiver {index + 1}", gps, name, digits=2) for index, gps in sorted(flight.gps.items())]
        axis = _fix_type_axis(flight) if name == "fix_type" else {}
        charts.append(timeline(flight, f"gps-{name}", unit, lines, height=200, yaxis=axis))
    return _with_parts(section, *charts)


def _link(flight: FlightLog) -> Section:
    explanations = {
        ".ulg": "Messages that the autopilot did not receive, by its own count. With several links, those of the"
        " busiest one.",
        ".bin": "Reports of the telemetry radio. A .bin has no counts of lost messages.",
    }
    explanation = explanations.get(
        flight.path.suffix.lower(),
        "Lost messages in each second, by gaps in the sequence numbers; 100 % during silence.",
    )
    section = Section(
        "Link",
        explanation=explanation,
        missing="The log contains no link data. A .bin has the reports of a telemetry radio only, a .ulg also PX4's own"
        " counts.",
    )
    lost = timeline(flight, "lost", "% lost", [line_trace("lost", flight.link, "lost_percent", digits=1)], height=220)
    received = line_trace("received", flight.link, "received_hz", digits=0)
    rate = timeline(flight, "received", "messages per second", [received], height=180)
    radio_values = [line_trace(name.replace("_", " "), flight.radio, name, digits=0) for name in flight.radio]
    radio = timeline(flight, "radio", "units of the radio", radio_values, height=220)
    silences = silence_sentences(flight)
    return _with_parts(section, Paragraphs(silences) if silences else None, lost, rate, radio)


def _texts(flight: FlightLog) -> Section:
    if not flight.texts:
        return Section("Texts", missing="The log contains no texts.")
    rows, marks = [], []
    for text in flight.texts[:_MAX_TEXTS]:
        severity = text.severity
        name = "—" if severity is None else _SEVERITIES[min(max(severity, 0), 7)]
        rows.append((clock_text(text.time_s), name, text.text))
        if severity is None or severity > MavSeverity.WARNING:
            marks.append("")
        else:
            marks.append("warning" if severity == MavSeverity.WARNING else "bad")
    more = len(flight.texts) - len(rows)
    parts: list[Part] = [Table(("time", "severity", "text"), rows, title=f"{len(rows)} texts", marks=marks)]
    if more:
        parts.append(Paragraphs([f"{more} more texts are not shown."]))
    if flight.path.suffix.lower() == ".bin":
        parts.append(Paragraphs(["A .bin does not contain severities."]))
    return Section("Texts", parts)


def _parameters(flight: FlightLog) -> Section:
    if not flight.parameters:
        return Section("Parameters", missing="The log contains no parameters.")
    changes = [
        change for change in flight.parameter_changes if not any(part in change.name for part in _WRITTEN_BY_AUTOPILOT)
    ]
    rows = [
        (clock_text(change.time_s), change.name, f"{change.before:g}", f"{change.after:g}")
        for change in changes[:_MAX_CHANGES]
    ]
    parts: list[Part] = [Paragraphs(["The log contains no change of a parameter by the pilot or a program."])]
    if rows:
        parts = [Table(("time", "parameter", "before", "after"), rows, _title(len(rows), len(changes), "changes"))]
    hidden_count = len(flight.parameter_changes) - len(changes)
    if hidden_count:
        text = f"{hidden_count} changes by the autopilot itself, of counters and the like, are not shown."
        parts.append(Paragraphs([text]))
    parameters = [(name, f"{value:.9g}") for name, value in sorted(flight.parameters.items())]
    shown = parameters[:_MAX_PARAMETERS]
    title = _title(len(shown), len(parameters), "parameters")
    parts.append(Table(("parameter", "initial value"), shown, title))
    return Section("Parameters", parts)


def _title(shown_count: int, count: int, noun: str) -> str:
    return f"all {count} {noun}" if shown_count == count else f"first {shown_count} of {count} {noun}"


def _mission(flight: FlightLog) -> Section | None:
    if not flight.mission:
        return None
    if flight.autopilot == "ArduPilot" and all(item.number == 0 for item in flight.mission):
        return Section("Mission", [Paragraphs(["No mission: the only item is home, ArduPilot's item 0."])])
    rows = [
        (
            flight.item_label(item),
            command_name(item.command),
            "" if math.isnan(item.latitude_deg) else f"{item.latitude_deg:.6f}, {item.longitude_deg:.6f}",
            f"{item.altitude_m:.1f} m" if _has_altitude(item) else "—",
        )
        for item in flight.mission
    ]
    explanation = ""
    if flight.autopilot == "ArduPilot":
        explanation = "Items are numbered from 0, without home. The numbers in ArduPilot's texts are one higher."
    return Section(
        "Mission", [Table(("item", "command", "position", "altitude"), rows, f"{len(rows)} items")], explanation
    )


def _has_altitude(item: Waypoint) -> bool:
    has_position = not math.isnan(item.latitude_deg)
    # In an item without a position, such as RTL, 0 means no altitude.
    return math.isfinite(item.altitude_m) and (has_position or item.altitude_m != 0)


def _about(flight: FlightLog) -> Section:
    rows = [
        ("file", flight.path.name),
        ("vehicle", f"{flight.vehicle}, system {flight.system_id}"),
        ("start", date_text(flight.begins_at)),
        ("duration", _duration(flight)),
    ]
    if flight.home is not None:
        rows.append(("home", f"{flight.home.latitude_deg:.6f}, {flight.home.longitude_deg:.6f}"))
    return Section("About this log", [Table(("property", "value"), rows)])


def _duration(flight: FlightLog) -> str:
    if flight.speed == 1.0:
        return duration_text(flight.duration_s)
    return f"{duration_text(flight.duration_s)} simulated, {duration_text(flight.duration_s / flight.speed)} recorded"


SECTIONS: tuple[Callable[[FlightLog], Section | None], ...] = (
    *(_map, _heights, failsafe_section, _modes, _batteries, _attitude, _velocity, _vibration, _estimator),
    *(_gps, _link, _texts, _parameters, _mission, _about),
)
"""The functions of all sections, in the order of the report."""
