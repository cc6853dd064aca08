"""Storage of mission items in ArduPilot: fifteen bytes per item, so that params lose digits or are dropped.

`stored` converts an uploaded item to the item that a client downloads afterwards.
"""

from __future__ import annotations

import csv
import math
import pkgutil
import struct
from collections.abc import Callable
from typing import NamedTuple

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.missions import float32

_MAX_ALTITUDE_M = 83000.0
_DOWNLOADED_FRAMES: dict[int, int] = {
    MavFrame.MISSION: MavFrame.GLOBAL,
    MavFrame.GLOBAL: MavFrame.GLOBAL,
    MavFrame.GLOBAL_INT: MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_RELATIVE_ALT_INT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT: MavFrame.GLOBAL_TERRAIN_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT_INT: MavFrame.GLOBAL_TERRAIN_ALT,
}

_C = MavCmd


class StoredCommand(NamedTuple):
    """Format in which ArduPilot stores a command."""

    name: str
    """Name in status texts; empty if a mission cannot contain the command."""
    parameters: str
    """Storage types of params 1 to 4, and of x, y, z without a position; see `_CONVERSIONS`. Empty: unsupported."""
    has_place: bool
    """True if ``x``, ``y`` and ``z`` are a position."""


def _read_commands() -> dict[int, StoredCommand]:
    data = pkgutil.get_data(__name__, "mission_commands.csv")
    assert data is not None
    return {
        MavCmd[row["command"]]: StoredCommand(row["name"], row["parameters"], row["has_place"] == "1")
        for row in csv.DictReader(data.decode().splitlines())
    }


STORED_COMMANDS: dict[int, StoredCommand] = _read_commands()
_UNKNOWN = StoredCommand("?", "", has_place=False)

# ArduPlane stores acceptance radius and passing distance of waypoints, and has no splines.
_PLANE_PARAMETERS: dict[int, str] = {_C.NAV_WAYPOINT: "-BB-", _C.NAV_SPLINE_WAYPOINT: ""}

_NAN_ALLOWED: dict[int, tuple[int, ...]] = {
    _C.NAV_WAYPOINT: (3,),
    _C.NAV_LOITER_UNLIM: (3,),
    _C.NAV_LAND: (3,),
    _C.NAV_TAKEOFF: (3,),
    _C.NAV_VTOL_TAKEOFF: (3,),
    _C.NAV_VTOL_LAND: (2, 3),
}


def command_name(command: int) -> str:
    return STORED_COMMANDS.get(command, _UNKNOWN).name or _UNKNOWN.name


def has_location(command: int) -> bool:
    """Return True if ``x``, ``y`` and ``z`` of a command are a position."""
    return STORED_COMMANDS.get(command, _UNKNOWN).has_place


def is_place(latitude_e7: float, longitude_e7: float) -> int:
    """Return ACCEPTED, or the MAV_MISSION_RESULT of the invalid coordinate.

    Like the firmware, the function compares in single precision.
    """
    if not abs(float32(latitude_e7)) <= 900_000_000:
        return MavMissionResult.INVALID_PARAM5_X
    in_range = abs(float32(longitude_e7)) <= 1_800_000_000
    return MavMissionResult.ACCEPTED if in_range else MavMissionResult.INVALID_PARAM6_Y


def altitude_frame(frame: int) -> int | None:
    """Return the MAV_FRAME of an altitude after upload and download; None for an unsupported frame."""
    return _DOWNLOADED_FRAMES.get(frame)


def stored(item: MissionItem, kind: Kind = "copter") -> MissionItem | int:
    """Return the item that a download sends, or the MAV_MISSION_RESULT that refuses the upload."""
    result = _check_numbers(item)
    if result == MavMissionResult.ACCEPTED and item.command in (0, 1):
        result = MavMissionResult.INVALID
    layout = _PLANE_PARAMETERS.get(item.command) if kind == "plane" else None
    layout = STORED_COMMANDS.get(item.command, _UNKNOWN).parameters if layout is None else layout
    if result == MavMissionResult.ACCEPTED and not layout:
        result = MavMissionResult.UNSUPPORTED
    if result != MavMissionResult.ACCEPTED:
        return result
    assert layout is not None
    numbers = (item.param1, item.param2, item.param3, item.param4, float(item.x), float(item.y), item.z)
    kept = [_CONVERSIONS[kind](number) for kind, number in zip(layout.ljust(7, "-"), numbers, strict=True)]
    if item.command == _C.NAV_LOITER_TURNS:
        kept[:4] = _kept_turns(item)
    p1, p2, p3, p4, x, y, z = kept
    frame: int = MavFrame.GLOBAL
    if has_location(item.command):
        place = _kept_place(item)
        if isinstance(place, int):
            return place
        x, y, z, frame = place
    return MissionItem(item.command, frame, p1, p2, p3, p4, int(x), int(y), z)


def _check_numbers(item: MissionItem) -> int:
    allowed = _NAN_ALLOWED.get(item.command, ())
    for index, number in enumerate((item.param1, item.param2, item.param3, item.param4)):
        if math.isinf(number) or (math.isnan(number) and index not in allowed):
            return MavMissionResult.INVALID_PARAM1 + index
    return MavMissionResult.ACCEPTED


def _kept_place(item: MissionItem) -> tuple[float, float, float, int] | int:
    result = is_place(item.x, item.y)
    if result != MavMissionResult.ACCEPTED:
        return result
    if not abs(item.z) < _MAX_ALTITUDE_M:
        return MavMissionResult.INVALID_PARAM7
    frame = altitude_frame(item.frame)
    if frame is None:
        return MavMissionResult.UNSUPPORTED_FRAME
    centimetres = int(float32(float32(item.z) * 100.0))
    return item.x, item.y, float32(centimetres * float32(0.01)), frame


def _kept_turns(item: MissionItem) -> tuple[float, float, float, float]:
    """Return params 1 to 4 of NAV_LOITER_TURNS. Turns and radius have one byte each.

    Less than one turn is stored in 256ths, a radius above 255 m in tens of metres.
    """
    turns, radius = item.param1, abs(item.param3)
    is_part = 0 < turns < 1
    count = int(min(255.0, turns * 256 if is_part else turns)) & 0xFF
    size = float(int(radius)) if radius <= 255 else int(min(255.0, radius * 0.1)) * 10.0
    sign = -1.0 if item.param3 < 0 else 1.0
    return (count / 256 if is_part else float(count), 0.0, sign * size, float(item.param4 > 0))


def whole(value: float) -> int:
    """Truncate towards zero, like C; 0 for values beyond 32 bits."""
    return int(value) if abs(value) < 2**31 else 0


def _whole_within(value: float, low: int, high: int) -> int:
    return int(value) if low <= value <= high else 0


def _half(value: float) -> float:
    try:
        return float(struct.unpack("<e", struct.pack("<e", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def _signed(value: int, bits: int) -> float:
    value &= (1 << bits) - 1
    return float(value - (1 << bits) if value >> bits - 1 else value)


# Conversions of a value to its storage and back, by storage type.
_CONVERSIONS: dict[str, Callable[[float], float]] = {
    "-": lambda _: 0.0,
    "f": float32,
    "e": _half,
    "B": lambda value: float(whole(value) & 0xFF),
    "H": lambda value: float(whole(value) & 0xFFFF),
    "b": lambda value: _signed(whole(value), 8),
    "h": lambda value: _signed(whole(value), 16),
    "c": lambda value: float32((whole(value * 100.0) & 0xFFFF) * float32(0.01)),
    "r": lambda value: math.copysign(float(whole(abs(value)) & 0xFFFF), value) + 0.0,
    "s": lambda value: -1.0 if value < 0 else 1.0,
    "+": lambda value: 1.0 if value > 0 else 0.0,
    "1": lambda value: float(whole(value) & 1),
    "2": lambda _: 2.0,
    "t": lambda value: float(int(max(0.0, min(65535.0, value)))),
    "a": lambda value: float(_whole_within(value, -180, 180)),
    "p": lambda value: float(_whole_within(value, -90, 90)),
    "w": lambda value: float(_whole_within(value, -180, 360)),
}
