"""Texts of a vehicle's state for the terminal. Old values are dim and show their age; unknown values are "—".

All colours are readable on light and dark terminals. A style with a background colour also sets the foreground colour.
Other colours have enough contrast to both white and black.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

from rich.text import Text

from aerokit._internal.formatting import printable
from aerokit.apps.readiness import active_failsafe, readiness
from aerokit.events import SILENT_AFTER_S, LinkState
from aerokit.mavlink.enums import MissionState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.state.condition import MissionProgress
    from aerokit.vehicle.vehicle import Vehicle

UNKNOWN = "—"
MAX_AGE_S = SILENT_AFTER_S
FIXES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed")
DANGER, WARNING = "bold white on red", "black on yellow"
LINK_STYLES = {LinkState.CONNECTED: "", LinkState.SILENT: WARNING, LinkState.LOST: DANGER}
ARROWS = "↑↗→↘↓↙←↖"
"""Arrows for the eight directions, clockwise from north."""
# The bits of a Braille character (U+2800 plus bits) that show its dots, by row and column.
_BRAILLE_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_MIN_SPAN_M = 20.0
# Number of columns between labels and values.
_LABEL_PADDING = 2


def number(value: float | None, digits: int = 1, unit: str = "", sign: str = "-") -> str:
    """Format a number; None becomes "—".

    ``sign`` is as in Python's format specification. A number that rounds to 0 has no sign.
    """
    if value is None:
        return UNKNOWN
    rounded = round(value, digits) + 0.0  # converts -0.0 to 0.0
    return f"{rounded:{sign if rounded else '-'}.{digits}f}{unit}"


def age(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


class VehicleText:
    """Texts that show one vehicle. If the vehicle is silent, its values are dim, and one line says for how long."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._failsafe = active_failsafe(vehicle)
        self._link_state = vehicle.link_state.latest
        is_silent = self._link_state not in (LinkState.CONNECTED, None)
        self._silent_s = vehicle.heartbeat_age if is_silent else 0.0

    def _text_of(self, cell: StateCell[Any], to_text: Callable[[Any], str], style: str = "") -> Text:
        if not cell.is_known:
            return Text(UNKNOWN, "dim")
        text = printable(to_text(cell.value))
        # For a silent vehicle, `age_s` is the age that the value had when the silence began.
        age_s = cell.age - self._silent_s
        if age_s > MAX_AGE_S:
            return Text(f"{text} ({age(age_s)} old)", "dim italic")
        return Text(text, "dim" if self._silent_s else style)

    def rows(self, *, more: bool = False, size: tuple[int, int] = (0, 0)) -> list[tuple[str, Text]]:
        """Return the lines of the state panel as labels and values.

        With ``more``, less important values are included. ``size`` is the number of columns and lines of the panel.
        Unused lines show further reasons that prevent a flight.
        """
        rows = self._main_rows() + (self._more_rows() if more else [])
        if not self._silent_s:
            columns, lines = size
            width = columns - max(len(label) for label, _ in rows) - _LABEL_PADDING
            unused_lines = lines - len(rows)
            label = "missing" if self._failsafe is None else "failsafe"
            # The second row shows only one reason that prevents a flight. Replace it by all reasons that fit.
            rows[1] = (label, self._missing(1 + unused_lines, width))
        return rows

    def _main_rows(self) -> list[tuple[str, Text]]:
        vehicle = self._vehicle
        text_of = self._text_of
        second_row = ("link", self.silence()) if self._silent_s else ("missing", self._missing())
        rows = [
            ("mode", Text("  ").join([text_of(vehicle.mode, _name, "bold"), self._armed()])),
            second_row,
            ("attitude", text_of(vehicle.attitude, _attitude)),
            ("altitude", text_of(vehicle.position, _altitude)),
            ("position", text_of(vehicle.position, _coordinates)),
            ("heading", text_of(vehicle.heading_deg, _heading)),
            ("speed", self._speeds()),
            ("battery", text_of(vehicle.batteries, lambda batteries: " · ".join(map(_battery, batteries)))),
            ("GPS", text_of(vehicle.gps, lambda receivers: " · ".join(map(_gps, receivers)))),
        ]
        if not self._silent_s:
            rows.append(("link", self._link()))
        return rows

    def _more_rows(self) -> list[tuple[str, Text]]:
        vehicle = self._vehicle
        text_of = self._text_of
        return [
            ("home", self._home()),
            ("mission", text_of(vehicle.mission_current, _mission)),
            ("airspeed", text_of(vehicle.air_speed_m_s, _speed)),
            ("throttle", text_of(vehicle.throttle_percent, lambda percent: number(percent, 0, " %"))),
            (
                "wind",
                text_of(vehicle.wind, lambda wind: f"{number(wind.speed_m_s)} m/s from {wind.direction_deg:.0f}°"),
            ),
            ("version", _text_of_constant(vehicle.version)),
        ]

    def list_row(self, *, is_selected: bool, more: bool) -> Text:
        vehicle = self._vehicle
        text_of = self._text_of
        text = Text("▸" if is_selected else " ", no_wrap=True, overflow="ellipsis")
        text.append(f"{vehicle.system_id:>3} ", "bold")
        columns = [  # widths and texts
            (10, Text(vehicle.autopilot.name)),
            (12, text_of(vehicle.mode, _name)),
            (9, self._armed()),
            (9, text_of(vehicle.position, lambda position: number(position.altitude_relative_m, 1, " m"))),
            (6, text_of(vehicle.batteries, lambda batteries: number(batteries[0].remaining_percent, 0, " %"))),
        ]
        if more:
            columns += [
                (10, text_of(vehicle.ground_speed_m_s, _speed)),
                (6, text_of(vehicle.heading_deg, _heading)),
                (40, text_of(vehicle.gps, lambda receivers: _gps(receivers[0]))),
            ]
        if not self._silent_s and more:
            columns.append((0, self._missing() if self._reasons() else self._ready()))
        for width, column in columns:
            column.pad_right(width - len(column))
            text.append_text(column)
            text.append(" ")
        return text.append_text(self.silence(is_short=True))

    def silence(self, *, is_short: bool = False) -> Text:
        """Return a text about how long the vehicle has been silent. It is empty if the vehicle is not silent."""
        if self._link_state is None or not self._silent_s:
            return Text()
        note = "" if is_short else "; values are from before"
        text = f"{self._link_state.value} for {age(self._silent_s)}{note}"
        return Text(text, LINK_STYLES[self._link_state])

    def _armed(self) -> Text:
        style = DANGER if self._vehicle.armed.latest else ""
        return self._text_of(self._vehicle.armed, lambda is_armed: "ARMED" if is_armed else "disarmed", style)

    def _ready(self) -> Text:
        return Text("armed" if self._vehicle.armed.latest else "ready")

    def _speeds(self) -> Text:
        ground_speed = self._text_of(self._vehicle.ground_speed_m_s, _speed)
        climb = self._text_of(self._vehicle.climb_m_s, _climb)
        return Text.assemble(ground_speed, "  climb ", climb)

    def _home(self) -> Text:
        home = self._vehicle.home.latest
        position = self._vehicle.position.latest
        if home is None or position is None:
            return Text(UNKNOWN, "dim")
        distance_m = position.distance_to(home.position)
        bearing = f", bearing {position.bearing_to(home.position):.0f}°" if distance_m >= 1.0 else ""
        return Text(f"{number(distance_m, 0)} m away{bearing}")

    def _link(self) -> Text:
        quality = self._vehicle.link_quality
        state = self._link_state
        text = Text() if state is None else Text(f"{state.value}  ", LINK_STYLES[state])
        text.append("loss ").append_text(self._text_of(quality, lambda report: number(report.loss_percent, 1, " %")))
        text.append("  round trip ")
        return text.append_text(self._text_of(quality, lambda report: _milliseconds(report.round_trip_s)))

    def all_missing(self) -> str:
        """Return one line for each reason that prevents a flight, or "Nothing is missing."."""
        reasons = "\n".join(map(printable, self._reasons())) or "Nothing is missing."
        silence = self.silence().plain
        return f"{silence}\n{reasons}" if silence else reasons

    def _reasons(self) -> list[str]:
        """Return the reasons that prevent a flight, first those that prevent arming."""
        checks = readiness(self._vehicle)
        if self._vehicle.armed.latest:
            failsafe = [f"failsafe: {text}" for text in self._failsafe or ()]
            return [*failsafe, *checks.against_arming, *checks.against_flight]
        flight_prefix = "also missing for flight" if checks.against_arming else "can arm, but not fly by itself"
        against_arming = _with_prefix(checks.prefix, checks.against_arming)
        return against_arming + _with_prefix(flight_prefix, checks.against_flight)

    def _missing(self, max_lines: int = 1, width: int = 0) -> Text:
        """Return the first reason that prevents a flight, and the next ones that fit into ``max_lines`` lines.

        ``width`` is the number of columns of a line.
        """
        missing = self._reasons()
        if not missing:
            return Text("nothing")
        texts: list[str] = []
        for shown in range(len(missing), 0, -1):
            texts = _with_count(missing, shown)
            wrapped = [textwrap.wrap(text, max(1, width), break_on_hyphens=False) for text in texts]
            if sum(map(len, wrapped)) <= max_lines:
                break
        return Text("\n".join(texts), WARNING)


def _with_prefix(prefix: str, reasons: Sequence[str]) -> list[str]:
    return [f"{prefix}: {reason}" if index == 0 else reason for index, reason in enumerate(reasons)]


def _with_count(reasons: Sequence[str], shown: int) -> list[str]:
    """Return the first ``shown`` reasons. The last one says how many more there are."""
    more = len(reasons) - shown
    texts = [printable(reason) for reason in reasons[:shown]]
    return [*texts[:-1], f"{texts[-1]} (and {more} more)"] if more else texts


def _text_of_constant(cell: StateCell[Any]) -> Text:
    """Return the text of a value that does not become old, such as a version."""
    return Text(printable(str(cell.value))) if cell.is_known else Text(UNKNOWN, "dim")


def _name(mode: Any) -> str:
    return str(mode.name)


def _attitude(attitude: Any) -> str:
    return f"roll {number(attitude.roll_deg, 0, '°', '+')} pitch {number(attitude.pitch_deg, 0, '°', '+')}"


def _altitude(position: Any) -> str:
    above_home, above_sea = position.altitude_relative_m, position.altitude_amsl_m
    return f"{number(above_home, 1, ' m')} above home, {number(above_sea, 0, ' m')} AMSL"


def _milliseconds(seconds: float | None) -> str:
    return number(None if seconds is None else seconds * 1000, 0, " ms")


def _mission(mission: MissionProgress) -> str:
    if mission.state == MissionState.NO_MISSION or mission.current is None:
        return "No mission"
    return f"item {mission.current}"


def _heading(heading_deg: float) -> str:
    return f"{round(heading_deg) % 360}°"


def _speed(speed: float) -> str:
    return number(speed, 1, " m/s")


def _climb(climb: float) -> str:
    return number(climb, 1, " m/s", "+")


def _coordinates(position: Any) -> str:
    return f"{position.latitude_deg:.6f} {position.longitude_deg:.6f}"


def _battery(battery: Any) -> str:
    parts = (
        number(battery.remaining_percent, 0, " %"),
        number(battery.voltage_v, 1, " V"),
        number(battery.current_a, 1, " A"),
    )
    return " ".join(parts)


def _gps(receiver: Any) -> str:
    fix = FIXES[receiver.fix_type] if 0 <= receiver.fix_type < len(FIXES) else f"fix {receiver.fix_type}"
    return f"{fix}, {number(receiver.satellites, 0)} satellites, HDOP {number(receiver.hdop)}"


class Canvas:
    """A map of ``columns`` by ``rows`` characters, scaled to contain all ``points`` (metres north, east).

    The last row has a scale bar and a north arrow.
    """

    def __init__(self, columns: int, rows: int, points: Iterable[tuple[float, float]]) -> None:
        self._columns = max(columns, 2)
        self._rows = max(rows - 1, 2)  # without the row of the scale bar
        all_points = list(points) or [(0.0, 0.0)]
        norths, easts = zip(*all_points, strict=True)
        self._middle_north = (max(norths) + min(norths)) / 2
        self._middle_east = (max(easts) + min(easts)) / 2
        # Each Braille character has two columns and four rows of dots. One column and one row of characters stay free.
        width_dots = 2 * (self._columns - 1)
        height_dots = 4 * (self._rows - 1)
        self._metres_per_dot: float = max(
            (max(easts) - min(easts)) / width_dots, (max(norths) - min(norths)) / height_dots, _MIN_SPAN_M / width_dots
        )
        self._dots: dict[tuple[int, int], int] = {}
        self._styles: dict[tuple[int, int], str] = {}
        self._marks: dict[tuple[int, int], tuple[str, str]] = {}

    def line(self, points: Sequence[tuple[float, float]], style: str) -> None:
        """Draw lines between consecutive points, in metres north and east."""
        dots = [self._dot_at(point) for point in points]
        ends = dots[1:] or dots  # a single point is a line to itself
        for (x, y), (end_x, end_y) in zip(dots, ends, strict=False):
            steps = max(abs(end_x - x), abs(end_y - y), 1)
            for step in range(steps + 1):
                dot_x = x + round((end_x - x) * step / steps)
                dot_y = y + round((end_y - y) * step / steps)
                cell = dot_y // 4, dot_x // 2
                self._dots[cell] = self._dots.get(cell, 0) | _BRAILLE_BITS[dot_y % 4][dot_x % 2]
                self._styles[cell] = style

    def mark(self, point: tuple[float, float], text: str, style: str) -> None:
        dot_x, dot_y = self._dot_at(point)
        for offset, character in enumerate(text):
            self._marks[dot_y // 4, dot_x // 2 + offset] = character, style

    def _scale(self) -> str:
        """Return a scale bar of 1, 2 or 5 times a power of ten metres."""
        column_m = 2 * self._metres_per_dot
        max_m = max(self._columns / 3, 3) * column_m
        power = 10.0 ** math.floor(math.log10(max_m))
        length_m = max(factor * power for factor in (1, 2, 5) if factor * power <= max_m)
        bar = "─" * max(round(length_m / column_m) - 2, 0)
        label = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
        return f"├{bar}┤ {label}"

    def text(self) -> Text:
        text = Text(no_wrap=True)
        for row in range(self._rows):
            for column in range(self._columns):
                cell = row, column
                if cell in self._marks:
                    text.append(*self._marks[cell])
                elif cell in self._dots:
                    text.append(chr(0x2800 + self._dots[cell]), self._styles[cell])
                else:
                    text.append(" ")
            text.append("\n")
        return text.append(f"{self._scale():{self._columns - 2}}▲N", "bold")

    def _dot_at(self, point: tuple[float, float]) -> tuple[int, int]:
        """Return the column and row of the dot for a point, counted from the top left."""
        north, east = point
        dot_x = self._columns + round((east - self._middle_east) / self._metres_per_dot)
        dot_y = 2 * self._rows - round((north - self._middle_north) / self._metres_per_dot)
        return min(max(dot_x, 0), 2 * self._columns - 1), min(max(dot_y, 0), 4 * self._rows - 1)
