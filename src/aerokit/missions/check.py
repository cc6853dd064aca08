"""Checks of items before they are sent: ranges, frames, NaN, jump targets, number of items."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionType
from aerokit.missions.item import (
    DEFAULT_XY,
    DEGREE_SCALE,
    DESTINATIONS,
    FENCE_COMMANDS,
    GLOBAL_FRAMES,
    LOCAL_FRAMES,
    PARAMS_WITHOUT_NAN,
    RALLY_COMMANDS,
    MissionItem,
    xy_scale,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_ITEMS = 65_535  # The number of items in MISSION_COUNT has 16 bits.

_FRAMES = frozenset(int(frame) for frame in MavFrame)
_FRAME_TEXT = "a global frame (0, 3, 10, or 5, 6, 11) or a local one (1, 4, 7, 20, 21)"
_GLOBAL_TEXT = "a global frame: 0, 3, 10, or 5, 6, 11"


def check_items(items: Sequence[MissionItem], mission_type: int = 0, *, home_is_item_0: bool | None = None) -> None:
    """Raise InvalidArgument if an item cannot be sent to a vehicle. ``items`` do not include home.

    ``home_is_item_0`` is True for missions of ArduPilot, False for other autopilots, and None if the autopilot is
    unknown.
    """
    check_count(len(items), home_is_item_0=bool(home_is_item_0))
    for index, item in enumerate(items):
        check_item(item, f"item {index}", mission_type)
        means_current_position = item.command in DESTINATIONS and item.x == item.y == 0  # on ArduPilot
        if means_current_position and home_is_item_0 is False:
            raise InvalidArgument(
                f"item {index} ({item.name}): x, y = 0, 0 is not allowed: only ArduPilot understands it as the current"
                " position; give a latitude and a longitude"
            )
    check_jumps(items)


def check_count(count: int, *, home_is_item_0: bool = False) -> None:
    limit = MAX_ITEMS - 1 if home_is_item_0 else MAX_ITEMS  # Home is sent as an item, too.
    if count > limit:
        raise InvalidArgument(f"{count} items are too many: at most {limit} are possible")


def check_item(item: MissionItem, where: str = "item", mission_type: int = 0) -> None:
    """Raise InvalidArgument if the item is not valid. The error text begins with ``where``."""
    if not isinstance(item, MissionItem):
        raise InvalidArgument(f"{where} = {item!r} is not a MissionItem")
    _check_integer(where, "command", item.command, 0xFFFF)
    where = f"{where} ({item.name})"
    _check_command(where, item.command, mission_type)
    _check_frame(where, item, mission_type)
    for number in (1, 2, 3, 4):
        name = f"param{number}"
        may_be_nan = number not in PARAMS_WITHOUT_NAN.get(item.command, ())
        _check_float(where, name, getattr(item, name), may_be_nan=may_be_nan)
    _check_float(where, "z", item.z, may_be_nan=item.command not in DESTINATIONS)
    _check_place(where, item)
    if not isinstance(item.autocontinue, bool):
        raise _wrong(where, "autocontinue", item.autocontinue, "True or False")


def check_jumps(items: Sequence[MissionItem]) -> None:
    """Raise InvalidArgument if a DO_JUMP or DO_JUMP_TAG has no target."""
    tags = {item.param1 for item in items if item.command == MavCmd.JUMP_TAG}
    for index, item in enumerate(items):
        if item.command == MavCmd.DO_JUMP:
            is_valid = 0 <= item.param1 < len(items) and float(item.param1).is_integer()
            allowed = f"the number of an item of this mission, 0 to {len(items) - 1} (the first item is 0)"
        elif item.command == MavCmd.DO_JUMP_TAG:
            is_valid = item.param1 in tags
            allowed = f"the tag of a JUMP_TAG in this mission: {sorted(tags) or 'it has none'}"
        else:
            continue
        if not is_valid:
            raise _wrong(f"item {index} ({item.name})", "param1", item.param1, allowed)


def _wrong(where: str, field: str, value: object, allowed: str) -> InvalidArgument:
    return InvalidArgument(f"{where}: {field} = {value!r} is not allowed: it must be {allowed}")


def _check_integer(where: str, field: str, value: object, high: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= high:
        raise _wrong(where, field, value, f"an integer from 0 to {high}")


def _check_command(where: str, command: int, mission_type: int) -> None:
    is_fence_command = command in FENCE_COMMANDS
    is_rally_command = command in RALLY_COMMANDS
    if mission_type == MavMissionType.FENCE:
        is_allowed, allowed = is_fence_command, "a fence command (5000 to 5004), because it is in a fence"
    elif mission_type == MavMissionType.RALLY:
        is_allowed, allowed = is_rally_command, "NAV_RALLY_POINT (5100), because it is among rally points"
    else:
        is_allowed = not is_fence_command and not is_rally_command
        allowed = "a command that is not for fences or rally points, because it is in a mission"
    if not is_allowed:
        raise _wrong(where, "command", int(command), allowed)


def _check_frame(where: str, item: MissionItem, mission_type: int) -> None:
    _check_integer(where, "frame", item.frame, 0xFF)
    if item.frame not in _FRAMES:
        raise _wrong(where, "frame", item.frame, "a MAV_FRAME")
    if mission_type != MavMissionType.MISSION and item.frame not in GLOBAL_FRAMES:
        raise _wrong(where, "frame", item.frame, _GLOBAL_TEXT)
    if item.command in DESTINATIONS and item.frame not in GLOBAL_FRAMES | LOCAL_FRAMES:
        raise _wrong(where, "frame", item.frame, _FRAME_TEXT)


def _check_float(where: str, field: str, value: object, *, may_be_nan: bool) -> None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise _wrong(where, field, value, "a number")
    if math.isnan(value) and may_be_nan:
        return
    if math.isnan(value) or not _fits_float32(value):
        or_nan = ", or NaN" if may_be_nan else ""
        raise _wrong(where, field, value, f"a finite number that fits into 32 bits{or_nan}")


def _fits_float32(value: float) -> bool:
    try:
        (rounded,) = struct.unpack("<f", struct.pack("<f", value))
        return math.isfinite(rounded)
    except (OverflowError, struct.error):
        return False


def _check_place(where: str, item: MissionItem) -> None:
    scale = xy_scale(item.command, item.frame)
    for field, limit, name in (("x", 90, "latitude"), ("y", 180, "longitude")):
        value = getattr(item, field)
        if not isinstance(value, int) or isinstance(value, bool):
            raise _wrong(where, field, value, "an integer, because MISSION_ITEM_INT has no fraction there")
        is_outside = value != DEFAULT_XY and abs(value) > limit * scale
        if is_outside and scale == DEGREE_SCALE:
            allowed = f"a {name} of -{limit} to {limit} degrees in 1e-7 degrees; this is {value / 1e7:g} degrees"
            raise _wrong(where, field, value, allowed)
        if not -0x80000000 <= value <= 0x7FFFFFFF:
            raise _wrong(where, field, value, "an integer of 32 bits")
