"""The sections of the report of one flight: a table of functions, each of a flight, which give a section or None."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.report.charts import line, over_time, track_chart, wanted
from aerokit.logs.report.figures import clock, date, span
from aerokit.logs.report.page import Section, Table, Words
from aerokit.missions.item import command_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.logs.flights.columns import Columns
    from aerokit.logs.flights.failsafes import Failsafe
    from aerokit.logs.flights.flight import Flight
    from aerokit.logs.report.page import Part

_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_FIXES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed")
"""GPS_FIX_TYPE, as far as MAVLink, ArduPilot's logs and PX4's have the same numbers."""
_MOST_TEXTS, _MOST_CHANGES, _MOST_PARAMETERS = 2000, 2000, 5000
_OWN = (
    "STAT_",
    "_GND_PRESS",
    "_GND_TEMP",
    "GND_ABS_PRESS",
    "LND_FLIGHT_T",
    "COM_FLIGHT_UUID",
    "MIS_TOTAL",
    "LOG_LASTFILE",
)
"""Parts of names of parameters that the autopilot writes by itself."""


def _shown(section: Section, *charts: Part | None) -> Section:
    """The section with those parts that there are; what is missing is said where there are none."""
    parts = [part for part in charts if part is not None]
    return Section(section.title, parts, section.means, "" if parts else section.missing)


# ------------------------------------------------------------------------------------ what was flown


def _map(flight: Flight) -> Section:
    title = Section(
        "Track",
        means="From above, north is up; a colour for each mode, dotted what was wanted. There is no background, for"
        " that would need the network.",
        missing="The log has no positions.",
    )
    return _shown(title, track_chart(flight))


def _heights(flight: Flight) -> Section:
    relative = "altitude_relative_m"
    chart = over_time(
        flight,
        "heights",
        "metres above home",
        [
            wanted("wanted", flight.position_target, relative),
            line("flown", flight.track, relative),
        ],
    )
    means = "The bands behind all charts are the modes, in the colours of the map; red lines are failsafes."
    return _shown(Section("Height", means=means, missing="The log has no heights."), chart)


def _modes(flight: Flight) -> Section:
    if not flight.modes:
        return Section("Modes", missing="The log does not tell the modes.")
    rows = [
        (clock(change.time_s), change.name, span(end - change.time_s), change.reason)
        for change, end in flight.mode_spans()
    ]
    armed = [
        f"armed {clock(begin)} to {clock(end)} ({span(end - begin)})" for begin, end in flight.armed
    ] or ["never armed"]
    return Section("Modes", [Table(("at", "mode", "for", "why"), rows), Words(["; ".join(armed)])])


def failsafe_section(flight: Flight) -> Section:
    """Each failsafe with what led to it."""
    found = failsafes(flight)
    if not found:
        return Section(
            "Failsafes", [Words(["None: no text, mode, error or flag of a failsafe while armed."])]
        )
    parts: list[Part] = []
    for each in found:
        parts += _failsafe(each)
    means = "What led to each: what was measured before it, and the parameters that say when it acts."
    return Section("Failsafes", parts, means)


def _failsafe(each: Failsafe) -> list[Part]:
    what = "failsafe" if each.acted else "warning"
    head = f"{clock(each.time_s)} {each.title} ({what}): {each.reaction}"
    rows = [("sign", f"{clock(sign.time_s)} {sign.text}") for sign in each.signs]
    rows += [("before", fact) for fact in each.led_to]
    return [Table((what, head), rows, marks=["bad" if each.acted else "warning"] * len(each.signs))]


# --------------------------------------------------------------------------------- against set-points


def _attitude(flight: Flight) -> Section:
    title = Section(
        "Attitude, flown against wanted",
        means="Where the lines part for longer, the vehicle could not do what the controller wanted.",
        missing="The log has no attitude.",
    )
    columns = {name: f"{name}_deg" for name in ("roll", "pitch", "yaw")}
    return _shown(
        title, *_against(flight, "attitude", "degrees", flight.attitude_target, flight.attitude, columns)
    )


def _velocity(flight: Flight) -> Section:
    title = Section("Velocity, flown against wanted", missing="The log has no velocity.")
    columns = {name: f"{name}_m_s" for name in ("north", "east", "down")}
    air = over_time(flight, "air", "air speed, m/s", [_positive(flight)], height=220)
    return _shown(
        title, *_against(flight, "velocity", "m/s", flight.velocity_target, flight.velocity, columns), air
    )


def _against(
    flight: Flight, what: str, unit: str, target: Columns, flown: Columns, columns: Mapping[str, str]
) -> list[Part | None]:
    """A chart for each of ``columns`` (by the name that is shown), and whether it is not known what was wanted."""
    charts = [
        over_time(
            flight,
            f"{what}-{name}",
            f"{name}, {unit}",
            [wanted("wanted", target, column, 2), line("flown", flown, column, 2)],
            height=220,
        )
        for name, column in columns.items()
    ]
    is_unknown = any(charts) and not target.has()
    return [*charts, Words([f"The log does not say what {what} was wanted."]) if is_unknown else None]


def _positive(flight: Flight) -> dict[str, Any] | None:
    has_speed = flight.air.has("air_speed_m_s") and max(flight.air.known("air_speed_m_s")) > 0
    return line("air speed", flight.air, "air_speed_m_s", 2) if has_speed else None


# ------------------------------------------------------------------------------------------ equipment


def _batteries(flight: Flight) -> Section:
    title = Section("Battery", missing="The log has nothing of a battery.")
    charts: list[Part | None] = []
    for name, unit, digits in (
        ("voltage_v", "volts", 3),
        ("current_a", "amperes", 2),
        ("remaining_percent", "per cent left", 1),
    ):
        lines = [
            line(f"battery {number + 1}", battery, name, digits)
            for number, battery in sorted(flight.batteries.items())
        ]
        charts.append(over_time(flight, f"battery-{name}", unit, lines, height=220))
    return _shown(title, *charts)


def _vibration(flight: Flight) -> Section:
    title = Section(
        "Vibration",
        means="Below 30 m/s² is well, above 60 the estimator suffers. Clips count how often an accelerometer reached"
        " its limit; they should not rise in flight.",
        missing="The log has no levels of vibration.",
    )
    names = {"x_m_s2": "x", "y_m_s2": "y", "z_m_s2": "z"}
    if flight.autopilot == "PX4" and not flight.vibration.has("y_m_s2"):
        names = {"x_m_s2": "all axes"}
    levels = over_time(
        flight,
        "vibration",
        "m/s²",
        [line(label, flight.vibration, name, 2) for name, label in names.items()],
    )
    clips = over_time(flight, "clips", "clips", [line("clips", flight.vibration, "clips", 0)], height=180)
    return _shown(title, levels, clips)


def _estimator(flight: Flight) -> Section:
    title = Section(
        "Estimator",
        means="How far each measurement is from what the estimator expects, as a ratio of what it allows: above 1"
        " (the line) it is not believed.",
        missing="The log has nothing of the estimator.",
    )
    limit = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 1, "y1": 1}
    chart = over_time(
        flight,
        "estimator",
        "ratio",
        [line(name.replace("_", " "), flight.estimator, name) for name in flight.estimator],
        shapes=[{**limit, "line": {"color": "#d62728", "width": 1}}],
    )
    return _shown(title, chart)


def _axis_of_fixes(flight: Flight) -> dict[str, Any]:
    """The values that were told, with their names instead of numbers."""
    told = sorted({value for gps in flight.gps.values() for value in gps.known("fix_type")})
    names = [_FIXES[int(value)] if 0 <= value < len(_FIXES) else f"{value:g}" for value in told]
    return {"tickmode": "array", "tickvals": told, "ticktext": names}


def _gps(flight: Flight) -> Section:
    title = Section("Satellites", missing="The log has nothing of a satellite receiver.")
    charts = []
    for name, unit in (("satellites", "satellites"), ("hdop", "HDOP"), ("fix_type", "fix type")):
        lines = [line(f"receiver {n + 1}", gps, name, 2) for n, gps in sorted(flight.gps.items())]
        axis = _axis_of_fixes(flight) if name == "fix_type" else {}
        charts.append(over_time(flight, f"gps-{name}", unit, lines, height=200, yaxis=axis))
    return _shown(title, *charts)


def _link(flight: Flight) -> Section:
    counted = (
        "What the autopilot counted of the messages that it did not get: of several links, the one that got most."
        if flight.path.suffix.lower() == ".ulg"
        else "Lost messages are those whose numbers are missing, each second; 100 % where nothing came."
    )
    title = Section(
        "Link",
        means=counted,
        missing="The log has nothing of the link: a .bin knows it only by a radio that reports, a .ulg by what"
        " PX4 counts, too.",
    )
    lost = over_time(flight, "lost", "% lost", [line("lost", flight.link, "lost_percent", 1)], height=220)
    rate = over_time(
        flight, "received", "messages a second", [line("received", flight.link, "received_hz", 0)], height=180
    )
    radio = over_time(
        flight,
        "radio",
        "the radio's own units",
        [line(name.replace("_", " "), flight.radio, name, 0) for name in flight.radio],
        height=220,
    )
    return _shown(title, lost, rate, radio)


# ---------------------------------------------------------------------------------------------- lists


def _texts(flight: Flight) -> Section:
    if not flight.texts:
        return Section("Texts", missing="The vehicle said nothing, or the log has no texts.")
    rows, marks = [], []
    for said in flight.texts[:_MOST_TEXTS]:
        severity = said.severity
        name = "—" if severity is None else _SEVERITIES[min(max(severity, 0), 7)]
        rows.append((clock(said.time_s), name, said.text))
        marks.append("" if severity is None or severity > 4 else "warning" if severity == 4 else "bad")
    more = len(flight.texts) - len(rows)
    parts: list[Part] = [Table(("at", "severity", "text"), rows, f"{len(rows)} texts", marks)]
    if more:
        parts.append(Words([f"{more} more texts are left out."]))
    if flight.path.suffix.lower() == ".bin":
        parts.append(Words(["A .bin does not keep how severe a text was."]))
    return Section("Texts", parts)


def _parameters(flight: Flight) -> Section:
    if not flight.parameters:
        return Section("Parameters", missing="The log has no parameters.")
    changed = [each for each in flight.parameter_changes if not any(part in each.name for part in _OWN)]
    rows = [
        (clock(each.time_s), each.name, f"{each.before:g}", f"{each.after:g}")
        for each in changed[:_MOST_CHANGES]
    ]
    parts: list[Part] = [
        Table(
            ("at", "parameter", "before", "after"), rows, f"{len(changed)} changes" if len(rows) > 20 else ""
        )
        if rows
        else Words(["No parameter was changed during the log."])
    ]
    own = len(flight.parameter_changes) - len(changed)
    if own:
        parts.append(
            Words([f"{own} changes of counters and the like, by the autopilot itself, are left out."])
        )
    all_of_them = [(name, f"{value:.9g}") for name, value in sorted(flight.parameters.items())]
    parts.append(
        Table(
            ("parameter", "at the beginning"),
            all_of_them[:_MOST_PARAMETERS],
            f"all {len(all_of_them)} parameters",
        )
    )
    return Section("Parameters", parts)


def _mission(flight: Flight) -> Section | None:
    if not flight.mission:
        return None
    if flight.autopilot == "ArduPilot" and all(item.number == 0 for item in flight.mission):
        return Section("Mission", [Words(["No mission: home only, which ArduPilot keeps as item 0."])])
    rows = [
        (
            str(item.number),
            command_name(item.command),
            "" if math.isnan(item.latitude_deg) else f"{item.latitude_deg:.6f}, {item.longitude_deg:.6f}",
            f"{item.altitude_m:.1f} m",
        )
        for item in flight.mission
    ]
    return Section(
        "Mission",
        [
            Table(
                ("item", "command", "place", "altitude"),
                rows,
                f"{len(rows)} item{'' if len(rows) == 1 else 's'}",
            )
        ],
    )


def _about(flight: Flight) -> Section:
    rows = [
        ("file", flight.path.name),
        ("vehicle", f"{flight.vehicle}, system {flight.system_id}"),
        ("begins", date(flight.begins_at)),
        ("lasts", span(flight.duration_s)),
    ]
    if flight.home is not None:
        rows.append(("home", f"{flight.home.latitude_deg:.6f}, {flight.home.longitude_deg:.6f}"))
    return Section("About this log", [Table(("what", "value"), rows)])


SECTIONS: tuple[Callable[[Flight], Section | None], ...] = (
    *(_map, _heights, failsafe_section, _modes, _batteries, _attitude, _velocity, _vibration, _estimator),
    *(_gps, _link, _texts, _parameters, _mission, _about),
)
"""In their order; what needs more than a flight has no place here."""
