"""Storage of mission items in ArduPilot: fifteen bytes per item, so that params lose digits or are dropped.

`as_stored` converts an uploaded item to the item that a client downloads afterwards.
"""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.protocols.servers.missions import ItemRefused
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.commands import to_int
from aerokit.sim.missions import float32

_MAX_ALTITUDE_M = 83000.0
_NOT_STORED = "-"  # Storage type of a param that a download returns as 0.
_DOWNLOADED_FRAMES: dict[int, int] = {
    MavFrame.MISSION: MavFrame.GLOBAL,
    MavFrame.GLOBAL: MavFrame.GLOBAL,
    MavFrame.GLOBAL_INT: MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_RELATIVE_ALT_INT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT: MavFrame.GLOBAL_TERRAIN_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT_INT: MavFrame.GLOBAL_TERRAIN_ALT,
}


class StoredCommand(NamedTuple):
    """Format in which ArduPilot stores a command."""

    name: str
    """Name of the command in status texts; empty if a mission cannot contain the command."""
    parameters: str
    """Storage types (see `_CONVERSIONS`) of params 1 to 4, and of x, y and z if they are not a position.

    Empty for an unsupported command.
    """
    has_place: bool
    """True if ``x``, ``y`` and ``z`` are a position."""


def _read_commands() -> dict[int, StoredCommand]:
    text = Path(__file__).with_name("mission_commands.csv").read_text("utf-8")
    return {
        Cmd[row["command"]]: StoredCommand(row["name"], row["parameters"], row["has_place"] == "1")
        for row in csv.DictReader(text.splitlines())
    }


STORED_COMMANDS: dict[int, StoredCommand] = _read_commands()
_UNKNOWN = StoredCommand("?", "", has_place=False)

# ArduPlane stores two params of a waypoint, its acceptance radius and its passing distance. It has no splines.
_PLANE_PARAMETERS: dict[int, str] = {Cmd.NAV_WAYPOINT: "-BB-", Cmd.NAV_SPLINE_WAYPOINT: ""}

# Indices of the params that may be NaN, by command. Index 0 is param 1.
_NAN_ALLOWED: dict[int, tuple[int, ...]] = {
    Cmd.NAV_WAYPOINT: (3,),
    Cmd.NAV_LOITER_UNLIM: (3,),
    Cmd.NAV_LAND: (3,),
    Cmd.NAV_TAKEOFF: (3,),
    Cmd.NAV_VTOL_TAKEOFF: (3,),
    Cmd.NAV_VTOL_LAND: (2, 3),
}


def command_name(command: int) -> str:
    return STORED_COMMANDS.get(command, _UNKNOWN).name or _UNKNOWN.name


def has_location(command: int) -> bool:
    return STORED_COMMANDS.get(command, _UNKNOWN).has_place


def check_place(latitude_e7: float, longitude_e7: float) -> None:
    """Raise ItemRefused for a coordinate that is out of range."""
    # Like the firmware, compare in single precision. `not <=` also refuses NaN.
    if not abs(float32(latitude_e7)) <= 900_000_000:
        raise ItemRefused(MavMissionResult.INVALID_PARAM5_X)
    if not abs(float32(longitude_e7)) <= 1_800_000_000:
        raise ItemRefused(MavMissionResult.INVALID_PARAM6_Y)


def altitude_frame(frame: int) -> int:
    """Return the downloaded MAV_FRAME of an item that was uploaded with ``frame``. Raises ItemRefused."""
    if frame not in _DOWNLOADED_FRAMES:
        raise ItemRefused(MavMissionResult.UNSUPPORTED_FRAME)
    return _DOWNLOADED_FRAMES[frame]


def as_stored(item: MissionItem, kind: Kind) -> MissionItem:
    """Return the uploaded item as a later download contains it. Raises ItemRefused."""
    _check_numbers(item)
    if item.command in (0, 1):  # The storage format reserves these command ids (AP_Mission.cpp).
        raise ItemRefused(MavMissionResult.INVALID)
    # The layout has one letter for each stored param. It is empty for an unsupported command.
    layout = STORED_COMMANDS.get(item.command, _UNKNOWN).parameters
    if kind == "plane":
        layout = _PLANE_PARAMETERS.get(item.command, layout)
    if not layout:
        raise ItemRefused(MavMissionResult.UNSUPPORTED)
    values = (item.param1, item.param2, item.param3, item.param4, float(item.x), float(item.y), item.z)
    types = layout.ljust(len(values), _NOT_STORED)
    stored_values = [_CONVERSIONS[type_](value) for type_, value in zip(types, values, strict=True)]
    if item.command == Cmd.NAV_LOITER_TURNS:
        stored_values[:4] = _stored_turns(item)
    p1, p2, p3, p4, x, y, z = stored_values
    frame: int = MavFrame.GLOBAL  # The frame that a download reports for an item without a position.
    if has_location(item.command):
        x, y, z, frame = _stored_place(item)
    return MissionItem(item.command, frame, p1, p2, p3, p4, int(x), int(y), z)


def _check_numbers(item: MissionItem) -> None:
    may_be_nan = _NAN_ALLOWED.get(item.command, ())
    for index, value in enumerate((item.param1, item.param2, item.param3, item.param4)):
        if math.isinf(value) or (math.isnan(value) and index not in may_be_nan):
            raise ItemRefused(MavMissionResult.INVALID_PARAM1 + index)


def _stored_place(item: MissionItem) -> tuple[float, float, float, int]:
    """Return x, y, z and frame of a position as stored."""
    check_place(item.x, item.y)
    if not abs(item.z) < _MAX_ALTITUDE_M:
        raise ItemRefused(MavMissionResult.INVALID_PARAM7)
    frame = altitude_frame(item.frame)
    # The firmware stores whole centimetres, and calculates in single precision.
    centimetres = int(float32(float32(item.z) * 100.0))
    return item.x, item.y, float32(centimetres * float32(0.01)), frame


def _stored_turns(item: MissionItem) -> tuple[float, float, float, float]:
    """Return params 1 to 4 of NAV_LOITER_TURNS as stored."""
    # The number of turns and the radius have one byte each.
    turns, radius = item.param1, abs(item.param3)
    turn_unit = 1 / 256 if 0 < turns < 1 else 1
    turn_byte = int(min(255.0, turns / turn_unit)) & 0xFF  # The mask keeps only the lowest byte of a negative number.
    radius_unit = 1 if radius <= 255 else 10
    radius_byte = int(min(255.0, radius / radius_unit))
    sign = -1.0 if item.param3 < 0 else 1.0
    exits_at_tangent = float(item.param4 > 0)
    return (turn_byte * float(turn_unit), 0.0, sign * radius_byte * radius_unit, exits_at_tangent)


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


# Maps a storage type to the function that converts an uploaded value to the value that a download returns. The types
# f, e, B, H, b and h are those of the module `struct`.
_CONVERSIONS: dict[str, Callable[[float], float]] = {
    _NOT_STORED: lambda _: 0.0,
    "f": float32,
    "e": _half,
    "B": lambda value: float(to_int(value) & 0xFF),
    "H": lambda value: float(to_int(value) & 0xFFFF),
    "b": lambda value: _signed(to_int(value), 8),
    "h": lambda value: _signed(to_int(value), 16),
    "c": lambda value: float32((to_int(value * 100.0) & 0xFFFF) * float32(0.01)),  # hundredths
    "r": lambda value: math.copysign(float(to_int(abs(value)) & 0xFFFF), value) + 0.0,
    "s": lambda value: -1.0 if value < 0 else 1.0,  # only the sign
    "+": lambda value: 1.0 if value > 0 else 0.0,
    "1": lambda value: float(to_int(value) & 1),
    "2": lambda _: 2.0,
    "t": lambda value: float(int(max(0.0, min(65535.0, value)))),
    "a": lambda value: float(_whole_within(value, -180, 180)),
    "p": lambda value: float(_whole_within(value, -90, 90)),
    "w": lambda value: float(_whole_within(value, -180, 360)),
}
