"""Text of a vehicle's state for the terminal: old values are dimmed and show their age, unknown values are "—"."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.text import Text

from aerokit._internal.formatting import printable
from aerokit.events import SILENT_AFTER_S, LinkState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.vehicle import Vehicle

UNKNOWN = "—"
MAX_AGE_S = SILENT_AFTER_S
FIXES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed")
LINK_STYLES = {LinkState.CONNECTED: "green", LinkState.SILENT: "bold yellow", LinkState.LOST: "bold red"}
ARROWS = "↑↗→↘↓↙←↖"
"""Arrows by heading, clockwise from north."""
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_MIN_SPAN_M = 20.0


def number(value: float | None, form: str = ".1f", unit: str = "") -> str:
    return UNKNOWN if value is None else f"{value:{form}}{unit}"


def cell_text(cell: StateCell[Any], show: Callable[[Any], str], style: str = "") -> Text:
    if not cell.is_known:
        return Text(UNKNOWN, "dim")
    if cell.age <= MAX_AGE_S:
        return Text(printable(show(cell.value)), style)
    return Text(f"{printable(show(cell.value))} ({age(cell.age)} old)", "dim italic")


def age(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def state_lines(vehicle: Vehicle) -> list[tuple[str, Text]]:
    armed = vehicle.armed
    style = "bold red" if armed.latest else "green"
    modes = cell_text(vehicle.mode, lambda mode: str(mode.name), "bold")
    modes.append("  ")
    modes.append_text(cell_text(armed, lambda is_armed: "ARMED" if is_armed else "disarmed", style))
    speeds = cell_text(vehicle.ground_speed_m_s, lambda speed: f"{speed:.1f} m/s")
    speeds.append("  climb ")
    speeds.append_text(cell_text(vehicle.climb_m_s, lambda climb: f"{climb:+.1f} m/s"))
    positions = cell_text(vehicle.position, lambda p: f"{p.latitude_deg:.6f} {p.longitude_deg:.6f}")
    positions.append("  heading ")
    positions.append_text(cell_text(vehicle.heading_deg, lambda heading: f"{heading:.0f}°"))
    return [
        ("mode", modes),
        ("missing", missing_text(vehicle)),
        ("attitude", cell_text(vehicle.attitude, _attitude)),
        ("altitude", cell_text(vehicle.position, _altitude)),
        ("position", positions),
        ("speed", speeds),
        ("battery", cell_text(vehicle.batteries, lambda batteries: " · ".join(map(_battery, batteries)))),
        ("GPS", cell_text(vehicle.gps, lambda receivers: " · ".join(map(_gps, receivers)))),
        ("link", link_line(vehicle)),
    ]


def link_line(vehicle: Vehicle) -> Text:
    state = vehicle.link_state.latest
    text = Text()
    if state is not None:
        text.append(state.value, LINK_STYLES[state])
        if state is not LinkState.CONNECTED:
            text.append(f" for {age(vehicle.heartbeat_age)}", "bold")
    quality = vehicle.link_quality
    text.append("  loss ")
    text.append_text(cell_text(quality, lambda report: number(report.loss_percent, ".1f", " %")))
    text.append("  round trip ")
    text.append_text(
        cell_text(quality, lambda report: number(report.round_trip_s and report.round_trip_s * 1000, ".0f", " ms"))
    )
    return text


def missing_text(vehicle: Vehicle) -> Text:
    missing = vehicle.missing_for_flight()
    if not missing:
        return Text("nothing", "green")
    more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    return Text(printable(f"{missing[0]}{more}"), "yellow")


def list_row(vehicle: Vehicle) -> Text:
    state = vehicle.link_state.latest
    text = Text(f"{vehicle.system_id:>3} ", "bold", no_wrap=True, overflow="ellipsis")
    text.append(f"{vehicle.autopilot.name} ")
    text.append_text(cell_text(vehicle.mode, lambda mode: str(mode.name)))
    text.append(" ")
    style = "bold red" if vehicle.armed.latest else ""
    text.append_text(cell_text(vehicle.armed, lambda is_armed: "ARMED" if is_armed else "disarmed", style))
    text.append(" ")
    text.append_text(cell_text(vehicle.position, lambda place: number(place.altitude_relative_m, ".1f", " m")))
    text.append(" ")
    text.append_text(cell_text(vehicle.batteries, lambda each: number(each[0].remaining_percent, "", " %")))
    if state is not LinkState.CONNECTED and state is not None:
        text.append(f" {state.value} {age(vehicle.heartbeat_age)}", LINK_STYLES[state])
    return text


def _attitude(attitude: Any) -> str:
    return f"roll {attitude.roll_deg:+.0f}° pitch {attitude.pitch_deg:+.0f}° yaw {attitude.yaw_deg:+.0f}°"


def _altitude(place: Any) -> str:
    above_home, above_sea = place.altitude_relative_m, place.altitude_amsl_m
    return f"{number(above_home, '.1f', ' m')} above home, {number(above_sea, '.0f', ' m')} AMSL"


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


class Canvas:
    """A map of ``columns`` by ``rows`` characters that fits all ``points`` (metres north, east); north is up."""

    def __init__(self, columns: int, rows: int, points: Iterable[tuple[float, float]]) -> None:
        self._columns, self._rows = max(columns, 2), max(rows, 2)
        norths, easts = zip(*(list(points) or [(0.0, 0.0)]), strict=True)
        self._middle = (max(norths) + min(norths)) / 2, (max(easts) + min(easts)) / 2
        across, up = 2 * (self._columns - 1), 4 * (self._rows - 1)
        self._metres_per_dot: float = max(
            (max(easts) - min(easts)) / across, (max(norths) - min(norths)) / up, _MIN_SPAN_M / across
        )
        self._dots: dict[tuple[int, int], int] = {}
        self._styles: dict[tuple[int, int], str] = {}
        self._marks: dict[tuple[int, int], tuple[str, str]] = {}

    @property
    def width_m(self) -> float:
        return 2 * self._columns * self._metres_per_dot

    def dot(self, point: tuple[float, float], style: str) -> None:
        across, down = self._place(point)
        cell = down // 4, across // 2
        self._dots[cell] = self._dots.get(cell, 0) | _DOTS[down % 4][across % 2]
        self._styles[cell] = style

    def mark(self, point: tuple[float, float], text: str, style: str) -> None:
        """Write characters at a point, over dots and earlier marks."""
        across, down = self._place(point)
        for number, character in enumerate(text):
            self._marks[down // 4, across // 2 + number] = character, style

    def text(self) -> Text:
        text = Text(no_wrap=True)
        for list_row in range(self._rows):
            for column in range(self._columns):
                cell = list_row, column
                if cell in self._marks:
                    text.append(*self._marks[cell])
                elif cell in self._dots:
                    text.append(chr(0x2800 + self._dots[cell]), self._styles[cell])
                else:
                    text.append(" ")
            text.append("\n")
        text.right_crop(1)
        return text

    def _place(self, point: tuple[float, float]) -> tuple[int, int]:
        across = self._columns + round((point[1] - self._middle[1]) / self._metres_per_dot)
        down = 2 * self._rows - round((point[0] - self._middle[0]) / self._metres_per_dot)
        return min(max(across, 0), 2 * self._columns - 1), min(max(down, 0), 4 * self._rows - 1)
