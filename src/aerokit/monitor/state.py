"""What is known of a vehicle as lines of text: what is old is dimmed and has its age, what is not known is "—"."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.text import Text

from aerokit.plain import printable
from aerokit.runtime.link_state import SILENT_AFTER_S, LinkState

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["UNKNOWN", "link_line", "missing_text", "row", "state_lines"]

UNKNOWN = "—"
OLD_AFTER_S = SILENT_AFTER_S
FIXES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed")
LINK_STYLES = {LinkState.CONNECTED: "green", LinkState.SILENT: "bold yellow", LinkState.LOST: "bold red"}


def number(value: float | None, form: str = ".1f", unit: str = "") -> str:
    """A number with its unit; None is not known."""
    return UNKNOWN if value is None else f"{value:{form}}{unit}"


def cell_text(cell: StateCell[Any], show: Callable[[Any], str], style: str = "") -> Text:
    """What a cell tells, with its age once it is old."""
    if not cell.is_known:
        return Text(UNKNOWN, "dim")
    if cell.age <= OLD_AFTER_S:
        return Text(printable(show(cell.value)), style)
    return Text(f"{printable(show(cell.value))} ({age(cell.age)} old)", "dim italic")


def age(seconds: float) -> str:
    """Seconds in few characters."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def state_lines(vehicle: Vehicle) -> list[tuple[str, Text]]:
    """Labels and what stands beside them."""
    armed = vehicle.armed
    style = "bold red" if armed.latest else "green"
    modes = cell_text(vehicle.mode, lambda mode: str(mode.name), "bold")
    modes.append("  ")
    modes.append_text(cell_text(armed, lambda is_armed: "ARMED" if is_armed else "disarmed", style))
    speeds = cell_text(vehicle.ground_speed_m_s, lambda speed: f"{speed:.1f} m/s")
    speeds.append("  climb ")
    speeds.append_text(cell_text(vehicle.climb_m_s, lambda climb: f"{climb:+.1f} m/s"))
    places = cell_text(vehicle.position, lambda p: f"{p.latitude_deg:.6f} {p.longitude_deg:.6f}")
    places.append("  heading ")
    places.append_text(cell_text(vehicle.heading_deg, lambda heading: f"{heading:.0f}°"))
    return [
        ("mode", modes),
        ("missing", missing_text(vehicle)),
        ("attitude", cell_text(vehicle.attitude, _attitude)),
        ("altitude", cell_text(vehicle.position, _altitude)),
        ("place", places),
        ("speed", speeds),
        ("battery", cell_text(vehicle.batteries, lambda batteries: " · ".join(map(_battery, batteries)))),
        ("GPS", cell_text(vehicle.gps, lambda receivers: " · ".join(map(_gps, receivers)))),
        ("link", link_line(vehicle)),
    ]


def link_line(vehicle: Vehicle) -> Text:
    """How well it is heard: silence, frames lost, round trip."""
    state = vehicle.link_state.latest
    text = Text()
    if state is not None:
        text.append(state.value, LINK_STYLES[state])
        if state is not LinkState.CONNECTED:
            text.append(f" for {age(vehicle.heartbeat_age)}", "bold")
    quality = vehicle.link_quality
    text.append("  loss ")
    text.append_text(cell_text(quality, lambda report: number(report.loss_percent, ".1f", " %")))
    text.append("  trip ")
    text.append_text(
        cell_text(
            quality,
            lambda report: number(report.round_trip_s and report.round_trip_s * 1000, ".0f", " ms"),
        )
    )
    return text


def missing_text(vehicle: Vehicle) -> Text:
    """What it lacks to fly: the first thing, and how many more there are."""
    missing = vehicle.missing_for_flight()
    if not missing:
        return Text("nothing", "green")
    more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    return Text(printable(f"{missing[0]}{more}"), "yellow")


def row(vehicle: Vehicle) -> Text:
    """The vehicle in the list: one line."""
    state = vehicle.link_state.latest
    text = Text(f"{vehicle.system_id:>3} ", "bold", no_wrap=True, overflow="ellipsis")
    text.append(f"{vehicle.autopilot.name} ")
    text.append_text(cell_text(vehicle.mode, lambda mode: str(mode.name)))
    text.append(" ")
    style = "bold red" if vehicle.armed.latest else ""
    text.append_text(cell_text(vehicle.armed, lambda is_armed: "ARMED" if is_armed else "disarmed", style))
    text.append(" ")
    text.append_text(
        cell_text(vehicle.position, lambda place: number(place.altitude_relative_m, ".1f", " m"))
    )
    text.append(" ")
    text.append_text(cell_text(vehicle.batteries, lambda each: number(each[0].remaining_percent, "", " %")))
    if state is not LinkState.CONNECTED and state is not None:
        text.append(f" {state.value} {age(vehicle.heartbeat_age)}", LINK_STYLES[state])
    return text


def _attitude(attitude: Any) -> str:
    return f"roll {attitude.roll_deg:+.0f}° pitch {attitude.pitch_deg:+.0f}° yaw {attitude.yaw_deg:+.0f}°"


def _altitude(place: Any) -> str:
    above_home, above_sea = place.altitude_relative_m, place.altitude_amsl_m
    return f"{number(above_home, '.1f', ' m')} above home, {number(above_sea, '.0f', ' m')} sea"


def _battery(battery: Any) -> str:
    parts = (
        number(battery.remaining_percent, "", " %"),
        number(battery.voltage_v, ".1f", " V"),
        number(battery.current_a, ".1f", " A"),
    )
    return " ".join(parts)


def _gps(receiver: Any) -> str:
    fix = FIXES[receiver.fix_type] if 0 <= receiver.fix_type < len(FIXES) else f"fix {receiver.fix_type}"
    return f"{fix}, {number(receiver.satellites, '')} satellites, HDOP {number(receiver.hdop)}"
