"""Storage of mission items in PX4. A param without a field in the storage is 0 in a download."""

from __future__ import annotations

import csv
import math
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavFrame as Frame
from aerokit.mavlink.enums import MavMissionResult, MavMissionType, MavRoi
from aerokit.missions import MissionItem
from aerokit.protocols.servers.missions import ItemRefused
from aerokit.sim.commands import to_int
from aerokit.sim.missions import POLYGON_CORNERS, float32

_ROWS = list(csv.DictReader(Path(__file__).with_name("mission_commands.csv").read_text("utf-8").splitlines()))
# Storage types (see `_CONVERSIONS`) of params 1 to 4 of each command that is allowed in a global frame.
_COMMANDS_WITH_PLACE = {int(Cmd[row["command"]]): row["with_place"] for row in _ROWS if row["with_place"]}
# Commands that are allowed in MAV_FRAME_MISSION. All their seven params are stored.
_COMMANDS_WITHOUT_PLACE = frozenset(int(Cmd[row["command"]]) for row in _ROWS if row["without_place"] == "1")

_ROI_COMMANDS = (Cmd.NAV_ROI, Cmd.DO_SET_ROI)
_ROI_WITH_PLACE = (MavRoi.NONE, MavRoi.LOCATION)
_ROI_WITHOUT_PLACE = (MavRoi.NONE, MavRoi.WPNEXT, MavRoi.WPINDEX)
_INT_FRAMES: dict[int, int] = {Frame.GLOBAL_INT: Frame.GLOBAL, Frame.GLOBAL_RELATIVE_ALT_INT: Frame.GLOBAL_RELATIVE_ALT}
_AS_INT = {plain: int_frame for int_frame, plain in _INT_FRAMES.items()}
_NO_MISSION_COMMANDS = frozenset(
    {*POLYGON_CORNERS, Cmd.NAV_FENCE_CIRCLE_INCLUSION, Cmd.NAV_FENCE_CIRCLE_EXCLUSION, Cmd.NAV_RALLY_POINT}
)
_INT_MIN = -(1 << 31)
_PI = float32(math.pi)
_TURN = float32(math.tau)
_RADIANS_PER_DEGREE, _DEGREES_PER_RADIAN = float32(_PI / 180.0), float32(180.0 / _PI)


def as_stored(item: MissionItem, mission_type: int, *, is_int: bool = True) -> MissionItem:
    """Return the item as PX4 stores it (with frame 0, 2 or 3). Raises ItemRefused.

    ``is_int`` is True for an item of a MISSION_ITEM_INT. PX4 accepts the frames 5 and 6 only in this message.
    """
    frame = _INT_FRAMES.get(item.frame, item.frame) if is_int else item.frame
    if frame in (Frame.GLOBAL, Frame.GLOBAL_RELATIVE_ALT):
        stored_item = _with_place(item, frame)
    elif frame == Frame.MISSION:
        stored_item = _without_place(item)
    else:
        raise ItemRefused(MavMissionResult.UNSUPPORTED_FRAME)
    if mission_type == MavMissionType.MISSION and stored_item.command in _NO_MISSION_COMMANDS:
        raise ItemRefused(MavMissionResult.ERROR)
    if mission_type == MavMissionType.FENCE:
        if stored_item.command in POLYGON_CORNERS and stored_item.param1 < 3:
            raise ItemRefused(MavMissionResult.ERROR)
        return _as_fence_point(stored_item)
    return stored_item


def as_downloaded(item: MissionItem, *, as_int: bool) -> MissionItem:
    """Return an item as downloaded. With ``as_int``, global frames become _INT frames."""
    return item.replace(frame=_AS_INT.get(item.frame, item.frame)) if as_int else item


def checksum(items: Sequence[MissionItem], previous: int = 0) -> int:
    """Return the opaque id of a list of items: a CRC-32 over the uploaded messages.

    ``previous`` is the CRC of the items that precede these items.
    """
    crc = previous
    for item in items:
        params = (item.param1, item.param2, item.param3, item.param4)
        header = struct.pack("<BHB4f", item.frame, item.command, item.autocontinue, *params)
        # Like PX4, use x and y as received: integers from MISSION_ITEM_INT, and floats from MISSION_ITEM.
        place = struct.pack("<iif" if isinstance(item.x, int) else "<3f", item.x, item.y, item.z)
        # zlib inverts the CRC at the start and at the end. PX4 does not, so the inversion is undone here.
        crc = zlib.crc32(header + place, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
    return crc


def _as_fence_point(item: MissionItem) -> MissionItem:
    if item.frame == Frame.MISSION:
        return MissionItem(item.command, item.frame, item.param1, z=item.z, autocontinue=False)
    place = {"x": item.x, "y": item.y, "z": item.z}
    return MissionItem(item.command, Frame.GLOBAL, item.param1, **place, autocontinue=False)


def _with_place(item: MissionItem, frame: int) -> MissionItem:
    layout = _COMMANDS_WITH_PLACE.get(item.command)
    if layout is None:
        raise ItemRefused(MavMissionResult.UNSUPPORTED)
    command = item.command
    if command in _ROI_COMMANDS:
        if to_int(item.param1) not in _ROI_WITH_PLACE:
            raise ItemRefused(MavMissionResult.INVALID_PARAM1)
        command = Cmd.DO_SET_ROI  # PX4 stores both commands as DO_SET_ROI (mavlink_mission.cpp).
    params = (item.param1, item.param2, item.param3, item.param4)
    p1, p2, p3, p4 = (_CONVERSIONS[type_](param) for type_, param in zip(layout, params, strict=True))
    return item.replace(command=command, frame=frame, param1=p1, param2=p2, param3=p3, param4=p4)


def _without_place(item: MissionItem) -> MissionItem:
    if item.command not in _COMMANDS_WITHOUT_PLACE:
        raise ItemRefused(MavMissionResult.UNSUPPORTED)
    p1, p2, command = item.param1, item.param2, item.command
    if command == Cmd.DO_JUMP:  # PX4 stores the target as int16 and the number of repetitions as uint16.
        target = to_int(p1) & 0xFFFF
        if target & 0x8000:  # The highest bit of an int16 is its sign.
            target -= 0x10000
        p1, p2 = float(target), float(to_int(p2) & 0xFFFF)
    if command in _ROI_COMMANDS:
        if to_int(p1) not in _ROI_WITHOUT_PLACE:
            raise ItemRefused(MavMissionResult.INVALID_PARAM1)
        command = Cmd.DO_SET_ROI  # PX4 stores both commands as DO_SET_ROI (mavlink_mission.cpp).
    # PX4 stores x and y as floats, and rounds them to integers for a download (mavlink_mission.cpp).
    x, y = _rounded(float32(item.x)), _rounded(float32(item.y))
    return item.replace(command=command, frame=Frame.MISSION, param1=p1, param2=p2, x=x, y=y)


def _rounded(value: float) -> int:
    return round(value) if abs(value) < 2**31 else _INT_MIN


def _heading(degrees: float) -> float:
    """Return a heading in degrees with the rounding errors of PX4, which stores radians."""
    if not math.isfinite(degrees):
        return math.nan
    radians = float32(degrees * _RADIANS_PER_DEGREE)
    if not 0.0 <= radians < _TURN:
        turns = math.floor(float32(radians * float32(1.0 / _TURN)))
        radians = float32(radians - float32(_TURN * turns))
    return float32(radians * _DEGREES_PER_RADIAN)


# Maps a storage type to the function that converts an uploaded value to the value that a download returns.
_CONVERSIONS: dict[str, Callable[[float], float]] = {
    "-": lambda _: 0.0,
    "f": float32,
    "u": lambda value: float(to_int(value) & 0xFFFF),
    "v": lambda value: float(to_int(value + 0.5) & 0xFFFF),
    "?": lambda value: 1.0 if value > 0 else 0.0,
    "y": _heading,
}
