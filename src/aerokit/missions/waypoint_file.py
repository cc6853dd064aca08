"""``QGC WPL`` files (.waypoints, .txt) of Mission Planner, MAVProxy and QGroundControl.

See https://mavlink.io/en/file_formats/#mission_plain_text_file. Each line is an item, separated by tabs: index, current
flag, frame, command, parameters 1 to 4, latitude (or x, or parameter 5), longitude, altitude, autocontinue. In version
110, item 0 is home, and jump targets count home as an item. Version 120 has no home.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.files import read_text, write_atomically
from aerokit._internal.formatting import short_repr
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import DEGREE_SCALE, DESTINATIONS, MissionItem, canonical_frame, xy_scale
from aerokit.missions.mission import Mission
from aerokit.missions.wire import scaled_coordinate, shift_jumps, unscaled_xy
from aerokit.position import Position

if TYPE_CHECKING:
    import os

_COLUMNS = (
    "index",
    "current",
    "frame",
    "command",
    "param1",
    "param2",
    "param3",
    "param4",
    "latitude",
    "longitude",
    "altitude",
    "autocontinue",
)


def read_waypoint_file(path: str | os.PathLike[str]) -> Mission:
    """Read a mission from a ``QGC WPL`` file (.waypoints, .txt).

    Spaces are accepted instead of tabs; empty lines and lines that begin with ``#`` are skipped. The home line becomes
    ``mission.home``. MAVProxy rounds places to 1e-6 degrees when it writes a file.

    Raises:
        FileFormatError: the file is invalid; the error text names the file, the line and what was expected there.
        OSError: the file cannot be read.
    """
    return parse_waypoints(read_text(path), Path(path).name)


def write_waypoint_file(path: str | os.PathLike[str], mission: Mission, *, version: int = 110) -> None:
    """Write a mission to a file; see :func:`format_waypoints`."""
    write_atomically(path, format_waypoints(mission, version=version))


def parse_waypoints(text: str, name: str = "waypoints") -> Mission:
    """Parse the text of a ``QGC WPL`` file. Error texts begin with ``name``."""
    numbered_lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    numbered_lines = [(number, line) for number, line in numbered_lines if line and not line.startswith("#")]
    header_number, header = numbered_lines[0] if numbered_lines else (1, "")
    version = _version_in(header, f"{name}: line {header_number}")
    rows = [
        _Row(f"{name}: line {number}", line.split(), index) for index, (number, line) in enumerate(numbered_lines[1:])
    ]
    has_home = version == "110" and bool(rows) and rows[0].is_home()
    if not has_home:
        return Mission([row.item() for row in rows])
    # In the file, jump targets count home as an item, unlike in `Mission`.
    home = rows[0].home()
    return Mission(shift_jumps([row.item() for row in rows[1:]], -1), home)


def _version_in(header: str, where: str) -> str:
    *file_type, version = header.split() or [""]
    if file_type != ["QGC", "WPL"] or version not in ("110", "120"):
        found = repr(header[:40]) if header else "no text"
        raise FileFormatError(f"{where}: expected 'QGC WPL 110' or 'QGC WPL 120', found {found}")
    return version


def format_waypoints(mission: Mission, *, version: int = 110) -> str:
    """Format a mission as a ``QGC WPL`` file. Numbers have as many decimal places as in Mission Planner, or more.

    Values that are not given (NaN) become 0, because Mission Planner rejects a file that contains NaN
    (https://github.com/ArduPilot/pymavlink/issues/1096). PX4 then turns to the north, because a heading of 0 means
    north; use a .plan file for PX4, because it keeps NaN (as null).

    Raises:
        InvalidArgument: ``mission`` is no mission, a number is infinite, the altitude of a place is NaN, or the version
            is neither 110 nor 120.
    """
    if not isinstance(mission, Mission):
        raise InvalidArgument(
            f"mission = {short_repr(mission)} is not a Mission: pass Mission([…]), or plan.mission of a Plan"
        )
    if version not in (110, 120):
        raise InvalidArgument(f"version = {version!r} is not allowed: it must be 110 (home is item 0) or 120 (no home)")
    rows = [f"QGC WPL {version}"]
    items = mission.items
    if version == 110:
        rows.append(_home_row(mission.home))
        items = shift_jumps(items, 1)
    first_index = len(rows) - 1  # The header line has no index.
    rows += [_item_row(item, index) for index, item in enumerate(items, first_index)]
    return "\n".join(rows) + "\n"


class _Row:
    """One line, split into its columns."""

    def __init__(self, where: str, texts: list[str], index: int) -> None:
        self.where, self.texts = where, texts
        if len(texts) != len(_COLUMNS):
            raise FileFormatError(f"{where}: expected {len(_COLUMNS)} columns, found {len(texts)}")
        if self._integer("index", 0xFFFF) != index:
            raise FileFormatError(f"{where}: index = {texts[0]}: expected {index}; lines are missing or not in order")
        self.frame, self.command = self._integer("frame", 0xFF), self._integer("command", 0xFFFF)
        self._integer("current", 0xFF)  # Raises for an invalid number. The value is not used.

    def is_home(self) -> bool:
        """Return True if this line can be home."""
        # Mission Planner used to write command 0 for home.
        return self.command in (0, MavCmd.NAV_WAYPOINT) and canonical_frame(self.frame) == MavFrame.GLOBAL

    def home(self) -> Position | None:
        """Return the place of home, or None for 0°, 0°, which files contain if home is unknown."""
        latitude, longitude = self._number("latitude", 90), self._number("longitude", 180)
        return Position(latitude, longitude, self._number("altitude")) if latitude or longitude else None

    def item(self) -> MissionItem:
        has_degrees = xy_scale(self.command, self.frame) == DEGREE_SCALE
        latitude = self._number("latitude", 90.0 if has_degrees else math.inf, may_be_nan=True)
        longitude = self._number("longitude", 180.0 if has_degrees else math.inf, may_be_nan=True)
        return MissionItem(
            self.command,
            self.frame,
            self._number("param1", may_be_nan=True),
            self._number("param2", may_be_nan=True),
            self._number("param3", may_be_nan=True),
            self._number("param4", may_be_nan=True),
            x=scaled_coordinate(latitude, self.command, self.frame),
            y=scaled_coordinate(longitude, self.command, self.frame),
            z=self._number("altitude", may_be_nan=True),
            autocontinue=bool(self._integer("autocontinue", 0xFF)),
        )

    def _integer(self, column: str, high: int) -> int:
        text = self.texts[_COLUMNS.index(column)]
        # Valid numbers have at most five digits. Refuse very long texts here, because int() would take long for them.
        is_short_number = text.isascii() and text.isdigit() and len(text) < 9
        if not is_short_number or int(text) > high:
            raise FileFormatError(f"{self.where}: {column} = {text!r}: expected a whole number from 0 to {high}")
        return int(text)

    def _number(self, column: str, limit: float = math.inf, *, may_be_nan: bool = False) -> float:
        text = self.texts[_COLUMNS.index(column)]
        try:
            value = float(text) if "_" not in text else math.inf  # float() would accept 1_000.
        except ValueError:
            value = math.inf
        is_forbidden_nan = math.isnan(value) and not may_be_nan
        if math.isinf(value) or is_forbidden_nan or abs(value) > limit:
            bounds = f" from {-limit:g} to {limit:g}" if math.isfinite(limit) else ""
            raise FileFormatError(f"{self.where}: {column} = {text!r}: expected a number{bounds}")
        return value


def _home_row(home: Position | None) -> str:
    place = (0.0, 0.0, 0.0)
    if home is not None:
        place = (home.latitude_deg, home.longitude_deg, home.altitude_amsl_m or 0.0)
    # Item 0, the current one, is a NAV_WAYPOINT (16) in the frame GLOBAL (0).
    return "\t".join(("0\t1\t0\t16\t0\t0\t0\t0", *(_text(value, 6) for value in place), "1"))


def _item_row(item: MissionItem, index: int) -> str:
    integers = (index, 0, int(item.frame), int(item.command))
    numbers = (item.param1, item.param2, item.param3, item.param4, *unscaled_xy(item))
    if any(math.isinf(number) for number in (*numbers, item.z)):
        raise InvalidArgument(f"{item!r} has an infinite number, which a waypoint file cannot store")
    if math.isnan(item.z) and (item.command in DESTINATIONS or item.position is not None):
        raise InvalidArgument(f"{item!r} has a place without an altitude, which a waypoint file cannot store")
    # Mission Planner writes 8 decimal places of each number, but 6 of the altitude.
    columns = [(number, 8) for number in numbers] + [(item.z, 6)]
    texts = (
        *map(str, integers),
        *(_text(0.0 if math.isnan(number) else number, digits) for number, digits in columns),
    )
    return "\t".join((*texts, str(int(item.autocontinue))))


def _text(value: float, digits: int) -> str:
    """Format a number with ``digits`` decimal places, or with more if they are needed to read the same number back."""
    text = f"{value:.{digits}f}"
    return text if float(text) == value else repr(float(value))
