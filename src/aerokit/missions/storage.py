"""What vehicles keep of an item: an autopilot stores less than the wire carries, and gives back what it stored.

Seen in the firmwares' own conversions (ArduPilot 4.7 AP_Mission, PX4 1.17 mavlink_mission) and on the vehicles. A
letter for each of the seven numbers of an item, what is not mentioned comes back as 0:
``f`` as it is, ``u`` ``b`` ``s`` ``i`` cut to an unsigned integer of 16 or 8 bits or to a signed one, ``c`` the same
but at most 255, ``U`` 16 bits that wrap, ``?`` only whether it is above 0, ``g`` only the sign, ``r`` radius in whole
metres with its sign, ``R`` that in 8 bits, tens of metres above 255, ``n`` turns in 8 bits, fractions below 1 in
1/256, ``k`` whole centimetres, ``h`` 16-bit float, ``2`` always 2, ``y`` a heading, turned into 0 to 360.
"""

from __future__ import annotations

import math
import struct
from enum import Enum
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.missions.item import MissionItem

__all__ = ["Storage", "kept"]

FIELDS = ("param1", "param2", "param3", "param4", "x", "y", "z")


class Storage(Enum):
    """Through what items have gone before they are compared."""

    WIRE = "wire"
    """MISSION_ITEM_INT only: 32-bit floats, frames that are alike."""
    ARDUPILOT = "ardupilot"
    """And ArduPilot's 15 bytes for each item."""
    PX4 = "px4"
    """And PX4's structure of an item."""
    ANY = "any"
    """Any of these."""


_ARDUPILOT: dict[int, tuple[str, ...]] = {
    MavCmd.NAV_WAYPOINT: ("u", "-cc"),  # Copter, Rover and Sub; Plane
    MavCmd.NAV_LOITER_UNLIM: ("--r",),
    MavCmd.NAV_LOITER_TURNS: ("n-R?",),
    MavCmd.NAV_LOITER_TIME: ("u-g?",),
    MavCmd.NAV_LAND: ("u--g",),
    MavCmd.NAV_TAKEOFF: ("u",),
    MavCmd.NAV_CONTINUE_AND_CHANGE_ALT: ("u",),
    MavCmd.NAV_LOITER_TO_ALT: ("-r-?",),
    MavCmd.NAV_SPLINE_WAYPOINT: ("u",),
    MavCmd.NAV_ALTITUDE_WAIT: ("ffb",),
    MavCmd.NAV_VTOL_LAND: ("u",),
    MavCmd.NAV_GUIDED_ENABLE: ("u",),
    MavCmd.NAV_DELAY: ("fiii",),
    MavCmd.NAV_PAYLOAD_PLACE: ("k",),
    MavCmd.CONDITION_DELAY: ("f",),
    MavCmd.CONDITION_DISTANCE: ("f",),
    MavCmd.CONDITION_YAW: ("ffib",),
    MavCmd.DO_JUMP: ("us",),
    MavCmd.DO_CHANGE_SPEED: ("bff",),
    MavCmd.DO_SET_HOME: ("u",),
    MavCmd.DO_SET_RELAY: ("bb",),
    MavCmd.DO_REPEAT_RELAY: ("bsf",),
    MavCmd.DO_SET_SERVO: ("bu",),
    MavCmd.DO_REPEAT_SERVO: ("busf",),
    MavCmd.DO_PAUSE_CONTINUE: ("u",),
    MavCmd.DO_SET_REVERSE: ("u",),
    MavCmd.DO_SET_ROI_LOCATION: ("u",),
    MavCmd.DO_SET_ROI_NONE: ("u",),
    MavCmd.DO_SET_ROI: ("u",),
    MavCmd.DO_DIGICAM_CONFIGURE: ("bububbf",),
    MavCmd.DO_DIGICAM_CONTROL: ("bbibbb",),
    MavCmd.DO_MOUNT_CONTROL: ("fff---2",),
    MavCmd.DO_SET_CAM_TRIGG_DIST: ("f-b",),
    MavCmd.DO_FENCE_ENABLE: ("u",),
    MavCmd.DO_PARACHUTE: ("u",),
    MavCmd.DO_INVERTED_FLIGHT: ("u",),
    MavCmd.DO_GRIPPER: ("bb",),
    MavCmd.DO_AUTOTUNE_ENABLE: ("u",),
    MavCmd.NAV_SET_YAW_SPEED: ("ffb",),
    MavCmd.DO_SET_RESUME_REPEAT_DIST: ("u",),
    MavCmd.DO_SPRAYER: ("u",),
    MavCmd.DO_SEND_SCRIPT_MESSAGE: ("ufff",),
    MavCmd.DO_AUX_FUNCTION: ("ub",),
    MavCmd.DO_GUIDED_LIMITS: ("ufff",),
    MavCmd.DO_ENGINE_CONTROL: ("??kb",),
    MavCmd.SET_CAMERA_ZOOM: ("bf",),
    MavCmd.SET_CAMERA_FOCUS: ("bf",),
    MavCmd.SET_CAMERA_SOURCE: ("bbb",),
    MavCmd.JUMP_TAG: ("u",),
    MavCmd.DO_JUMP_TAG: ("us",),
    MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: ("isiib-b",),
    MavCmd.IMAGE_START_CAPTURE: ("bfuu",),
    MavCmd.IMAGE_STOP_CAPTURE: ("u",),
    MavCmd.VIDEO_START_CAPTURE: ("b",),
    MavCmd.VIDEO_STOP_CAPTURE: ("b",),
    MavCmd.DO_VTOL_TRANSITION: ("b",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: ("u",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: ("u",),
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION: ("f", "u"),  # the radius was an integer before 4.5
    MavCmd.NAV_FENCE_CIRCLE_EXCLUSION: ("f", "u"),
    MavCmd.DO_WINCH: ("bbff",),
    MavCmd.NAV_SCRIPT_TIME: ("bbhhss",),
    MavCmd.NAV_ATTITUDE_TIME: ("usiss",),
}

_PX4: dict[int, tuple[str, ...]] = {
    MavCmd.NAV_WAYPOINT: ("ff-y",),
    MavCmd.NAV_LOITER_UNLIM: ("--fy",),
    MavCmd.NAV_LOITER_TIME: ("f?f?",),
    MavCmd.NAV_LAND: ("-u-y",),
    MavCmd.NAV_TAKEOFF: ("---y",),
    MavCmd.NAV_LOITER_TO_ALT: ("?f-?",),
    MavCmd.NAV_VTOL_TAKEOFF: ("---y",),
    MavCmd.NAV_VTOL_LAND: ("---y",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: ("u",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: ("u",),
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION: ("f",),
    MavCmd.NAV_FENCE_CIRCLE_EXCLUSION: ("f",),
}
_PX4_JUMP = ("sUfffff",)
_PX4_OTHERS = ("fffffff",)

_INTEGERS = {"b": (0, 0xFF), "u": (0, 0xFFFF), "i": (-0x80, 0x7F), "s": (-0x8000, 0x7FFF)}


def kept(item: MissionItem, field: str, storage: Storage) -> Iterator[float]:
    """What that field of the item may be when it comes back, besides what it is."""
    number, value = FIELDS.index(field), getattr(item, field)
    if storage in (Storage.ARDUPILOT, Storage.ANY):
        for letters in _ARDUPILOT.get(item.command, ("",)):
            yield from _cut(letters[number : number + 1], value)
    if storage in (Storage.PX4, Storage.ANY):
        yield from _cut(_px4_letters(item)[number : number + 1], value)


def _px4_letters(item: MissionItem) -> str:
    if item.frame != MavFrame.MISSION:
        return _PX4.get(item.command, ("",))[0]
    return (_PX4_JUMP if item.command == MavCmd.DO_JUMP else _PX4_OTHERS)[0]


def _cut(letter: str, value: float) -> Iterator[float]:
    """The value after that conversion; nothing when a C program could make anything of it."""
    if letter in ("", "-"):
        yield 0.0
    elif letter == "2":
        yield 2.0
    elif letter in "?g" or not math.isfinite(value):
        yield {"?": float(value > 0), "g": -1.0 if value < 0 else 1.0}.get(letter, math.nan)
    elif letter in _INTEGERS:
        low, high = _INTEGERS[letter]
        if low <= math.trunc(value) <= high:
            yield float(math.trunc(value))
    else:
        yield from _cut_specially(letter, value)


def _cut_specially(letter: str, value: float) -> Iterator[float]:
    if letter == "f":
        yield struct.unpack("<f", struct.pack("<f", value))[0]
    elif letter == "c":
        yield float(min(255, math.trunc(value))) if value >= 0 else 0.0
    elif letter == "U":
        yield float(math.trunc(value) & 0xFFFF)
    elif letter == "y":
        yield value % 360.0
    elif letter == "k":
        yield math.trunc(value * 100.0) / 100.0
    elif letter == "h" and abs(value) <= 65_504:
        yield struct.unpack("<e", struct.pack("<e", value))[0]
    elif letter == "n":
        yield math.trunc(value * 256.0) / 256.0 if 0 < value < 1 else float(min(255, math.trunc(value)))
    elif letter in "rR":
        yield math.copysign(_radius(abs(value), letter == "R"), value)


def _radius(metres: float, in_a_byte: bool) -> float:
    if not in_a_byte:
        return float(math.trunc(metres))
    return float(math.trunc(metres) if metres <= 255 else 10 * min(255, math.trunc(metres / 10)))
