"""What ArduPilot keeps of a mission item: fifteen bytes, so that parameters lose digits or are lost.

`stored` is the way into the storage and back in one step: what a client that downloads its own mission sees.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.parameter_tables import Kind
from aerokit.sim.missions import float32

_HIGHEST_M = 83000.0
_GIVEN_BACK: dict[int, int] = {
    MavFrame.MISSION: MavFrame.GLOBAL,
    MavFrame.GLOBAL: MavFrame.GLOBAL,
    MavFrame.GLOBAL_INT: MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_RELATIVE_ALT_INT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT: MavFrame.GLOBAL_TERRAIN_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT_INT: MavFrame.GLOBAL_TERRAIN_ALT,
}

_C = MavCmd
_LAYOUTS: dict[int, str] = {
    _C.NAV_WAYPOINT: "H---",
    _C.NAV_LOITER_UNLIM: "--r-",
    _C.NAV_LOITER_TURNS: "----",
    _C.NAV_LOITER_TIME: "H-s+",
    _C.NAV_RETURN_TO_LAUNCH: "----",
    _C.NAV_LAND: "H--s",
    _C.NAV_TAKEOFF: "H---",
    _C.NAV_CONTINUE_AND_CHANGE_ALT: "H---",
    _C.NAV_LOITER_TO_ALT: "-r-+",
    _C.NAV_SPLINE_WAYPOINT: "H---",
    _C.NAV_ALTITUDE_WAIT: "ffB-",
    _C.NAV_VTOL_TAKEOFF: "----",
    _C.NAV_VTOL_LAND: "H---",
    _C.NAV_GUIDED_ENABLE: "H---",
    _C.NAV_DELAY: "fbbb",
    _C.NAV_PAYLOAD_PLACE: "c---",
    _C.CONDITION_DELAY: "f---",
    _C.CONDITION_DISTANCE: "f---",
    _C.CONDITION_YAW: "ffbB",
    _C.DO_JUMP: "Hh--",
    _C.DO_CHANGE_SPEED: "Bff-",
    _C.DO_SET_HOME: "H---",
    _C.DO_SET_RELAY: "BB--",
    _C.DO_REPEAT_RELAY: "Bhf-",
    _C.DO_SET_SERVO: "BH--",
    _C.DO_REPEAT_SERVO: "BHhf",
    _C.DO_RETURN_PATH_START: "----",
    _C.DO_LAND_START: "----",
    _C.DO_GO_AROUND: "----",
    _C.DO_SET_REVERSE: "H---",
    _C.DO_SET_ROI_LOCATION: "H---",
    _C.DO_SET_ROI_NONE: "H---",
    _C.DO_SET_ROI: "H---",
    _C.DO_DIGICAM_CONFIGURE: "BHBHBBf",
    _C.DO_DIGICAM_CONTROL: "BBbBBB-",
    _C.DO_MOUNT_CONTROL: "fff---2",
    _C.DO_SET_CAM_TRIGG_DIST: "f-B-",
    _C.DO_FENCE_ENABLE: "H---",
    _C.DO_PARACHUTE: "H---",
    _C.DO_INVERTED_FLIGHT: "H---",
    _C.DO_GRIPPER: "BB--",
    _C.DO_AUTOTUNE_ENABLE: "H---",
    _C.DO_SET_RESUME_REPEAT_DIST: "H---",
    _C.DO_SPRAYER: "H---",
    _C.DO_SEND_SCRIPT_MESSAGE: "Hfff",
    _C.DO_AUX_FUNCTION: "HB--",
    _C.DO_GUIDED_LIMITS: "Hfff",
    _C.DO_ENGINE_CONTROL: "++c1",
    _C.DO_PAUSE_CONTINUE: "H---",
    _C.NAV_SET_YAW_SPEED: "ffB-",
    _C.SET_CAMERA_ZOOM: "Bf--",
    _C.SET_CAMERA_FOCUS: "Bf--",
    _C.SET_CAMERA_SOURCE: "BBB-",
    _C.JUMP_TAG: "H---",
    _C.DO_JUMP_TAG: "Hh--",
    _C.DO_GIMBAL_MANAGER_PITCHYAW: "bhbbB-B",
    _C.IMAGE_START_CAPTURE: "BfHH",
    _C.IMAGE_STOP_CAPTURE: "H---",
    _C.VIDEO_START_CAPTURE: "B---",
    _C.VIDEO_STOP_CAPTURE: "B---",
    _C.DO_VTOL_TRANSITION: "B---",
    _C.DO_WINCH: "BBff",
    _C.NAV_SCRIPT_TIME: "BBeehh-",
    _C.NAV_ATTITUDE_TIME: "tapwh--",
}
"""Command → how each of params 1 to 4 (and x, y, z where they are no place) is kept; see `_KEEPERS`."""

_OF_A_PLANE: dict[int, str] = {_C.NAV_WAYPOINT: "-BB-", _C.NAV_SPLINE_WAYPOINT: ""}
"""What it keeps otherwise: the radius within which it arrives and the distance at which it passes; no splines."""

_WITH_LOCATION = frozenset(
    {
        _C.NAV_WAYPOINT,
        _C.NAV_LOITER_UNLIM,
        _C.NAV_LOITER_TURNS,
        _C.NAV_LOITER_TIME,
        _C.NAV_LAND,
        _C.NAV_TAKEOFF,
        _C.NAV_CONTINUE_AND_CHANGE_ALT,
        _C.NAV_LOITER_TO_ALT,
        _C.NAV_SPLINE_WAYPOINT,
        _C.NAV_GUIDED_ENABLE,
        _C.NAV_VTOL_TAKEOFF,
        _C.NAV_VTOL_LAND,
        _C.NAV_PAYLOAD_PLACE,
        _C.DO_SET_HOME,
        _C.DO_RETURN_PATH_START,
        _C.DO_LAND_START,
        _C.DO_GO_AROUND,
        _C.DO_SET_ROI_LOCATION,
        _C.DO_SET_ROI,
        _C.NAV_FENCE_POLYGON_VERTEX_INCLUSION,
        _C.NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        _C.NAV_FENCE_CIRCLE_INCLUSION,
        _C.NAV_FENCE_CIRCLE_EXCLUSION,
        _C.NAV_FENCE_RETURN_POINT,
        _C.NAV_RALLY_POINT,
    }
)
_NAN_ALLOWED: dict[int, tuple[int, ...]] = {
    _C.NAV_WAYPOINT: (3,),
    _C.NAV_LOITER_UNLIM: (3,),
    _C.NAV_LAND: (3,),
    _C.NAV_TAKEOFF: (3,),
    _C.NAV_VTOL_TAKEOFF: (3,),
    _C.NAV_VTOL_LAND: (2, 3),
}

COMMAND_NAMES: dict[int, str] = {
    _C.NAV_WAYPOINT: "WP",
    _C.NAV_SPLINE_WAYPOINT: "SplineWP",
    _C.NAV_RETURN_TO_LAUNCH: "RTL",
    _C.NAV_LOITER_UNLIM: "LoitUnlim",
    _C.NAV_LOITER_TIME: "LoitTime",
    _C.NAV_LOITER_TURNS: "LoitTurns",
    _C.NAV_LOITER_TO_ALT: "LoitAltitude",
    _C.NAV_GUIDED_ENABLE: "GuidedEnable",
    _C.NAV_TAKEOFF: "Takeoff",
    _C.NAV_LAND: "Land",
    _C.NAV_VTOL_TAKEOFF: "VTOLTakeoff",
    _C.NAV_VTOL_LAND: "VTOLLand",
    _C.NAV_DELAY: "Delay",
    _C.NAV_PAYLOAD_PLACE: "PayloadPlace",
    _C.NAV_CONTINUE_AND_CHANGE_ALT: "ContinueAndChangeAlt",
    _C.NAV_SET_YAW_SPEED: "SetYawSpd",
    _C.NAV_SCRIPT_TIME: "NavScriptTime",
    _C.NAV_ATTITUDE_TIME: "NavAttitudeTime",
    _C.CONDITION_DELAY: "CondDelay",
    _C.CONDITION_DISTANCE: "CondDist",
    _C.CONDITION_YAW: "CondYaw",
    _C.DO_CHANGE_SPEED: "ChangeSpeed",
    _C.DO_SET_HOME: "SetHome",
    _C.DO_SET_SERVO: "SetServo",
    _C.DO_SET_RELAY: "SetRelay",
    _C.DO_REPEAT_SERVO: "RepeatServo",
    _C.DO_REPEAT_RELAY: "RepeatRelay",
    _C.DO_DIGICAM_CONFIGURE: "DigiCamCfg",
    _C.DO_DIGICAM_CONTROL: "DigiCamCtrl",
    _C.DO_SET_CAM_TRIGG_DIST: "SetCamTrigDst",
    _C.DO_SET_ROI_LOCATION: "SetROILocation",
    _C.DO_SET_ROI_NONE: "SetROINone",
    _C.DO_SET_ROI: "SetROI",
    _C.DO_SET_REVERSE: "SetReverse",
    _C.DO_SET_RESUME_REPEAT_DIST: "SetRepeatDist",
    _C.DO_GUIDED_LIMITS: "GuidedLimits",
    _C.DO_FENCE_ENABLE: "FenceEnable",
    _C.DO_AUTOTUNE_ENABLE: "AutoTuneEnable",
    _C.DO_VTOL_TRANSITION: "VTOLTransition",
    _C.DO_ENGINE_CONTROL: "EngineControl",
    _C.DO_RETURN_PATH_START: "ReturnPathStart",
    _C.DO_LAND_START: "LandStart",
    _C.DO_GO_AROUND: "Go Around",
    _C.DO_GRIPPER: "Gripper",
    _C.DO_PARACHUTE: "Parachute",
    _C.DO_SPRAYER: "Sprayer",
    _C.DO_AUX_FUNCTION: "AuxFunction",
    _C.DO_MOUNT_CONTROL: "MountControl",
    _C.DO_WINCH: "Winch",
    _C.DO_SEND_SCRIPT_MESSAGE: "Scripting",
    _C.DO_JUMP: "Jump",
    _C.DO_JUMP_TAG: "JumpToTag",
    _C.JUMP_TAG: "Tag",
    _C.DO_PAUSE_CONTINUE: "PauseContinue",
}
"""What status texts call a command."""


def has_location(command: int) -> bool:
    """Whether ``x``, ``y`` and ``z`` are a place, and not plain numbers or nothing."""
    return command in _WITH_LOCATION


def is_place(latitude_e7: float, longitude_e7: float) -> int:
    """ACCEPTED, or which of the two cannot be; compared as 32-bit floats, so that some units more pass."""
    if not abs(float32(latitude_e7)) <= 900_000_000:
        return MavMissionResult.INVALID_PARAM5_X
    in_range = abs(float32(longitude_e7)) <= 1_800_000_000
    return MavMissionResult.ACCEPTED if in_range else MavMissionResult.INVALID_PARAM6_Y


def altitude_frame(frame: int) -> int | None:
    """The frame in which an altitude is given back; None when the vehicle does not know the frame."""
    return _GIVEN_BACK.get(frame)


def stored(item: MissionItem, kind: Kind = "copter") -> MissionItem | int:
    """The item as it comes back, or the MAV_MISSION_RESULT that refuses it."""
    result = _check_numbers(item)
    if result == MavMissionResult.ACCEPTED and item.command in (0, 1):
        result = MavMissionResult.INVALID
    layout = _OF_A_PLANE.get(item.command) if kind == "plane" else None
    layout = _LAYOUTS.get(item.command) if layout is None else layout
    if result == MavMissionResult.ACCEPTED and not layout:
        result = MavMissionResult.UNSUPPORTED
    if result != MavMissionResult.ACCEPTED:
        return result
    assert layout is not None
    numbers = (item.param1, item.param2, item.param3, item.param4, float(item.x), float(item.y), item.z)
    kept = [_KEEPERS[kind](number) for kind, number in zip(layout.ljust(7, "-"), numbers, strict=True)]
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
    if not abs(item.z) < _HIGHEST_M:
        return MavMissionResult.INVALID_PARAM7
    frame = altitude_frame(item.frame)
    if frame is None:
        return MavMissionResult.UNSUPPORTED_FRAME
    centimetres = int(float32(float32(item.z) * 100.0))
    return item.x, item.y, float32(centimetres * float32(0.01)), frame


def _kept_turns(item: MissionItem) -> tuple[float, float, float, float]:
    """Turns and radius in a byte each: parts of a turn in 256ths, a radius above 255 m in tens of metres."""
    turns, radius = item.param1, abs(item.param3)
    is_part = 0 < turns < 1
    count = int(min(255.0, turns * 256 if is_part else turns)) & 0xFF
    size = float(int(radius)) if radius <= 255 else int(min(255.0, radius * 0.1)) * 10.0
    sign = -1.0 if item.param3 < 0 else 1.0
    return (count / 256 if is_part else float(count), 0.0, sign * size, float(item.param4 > 0))


def whole(value: float) -> int:
    """As a C program on a processor makes a whole number of a float: towards zero, nothing of what is too large."""
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


_KEEPERS: dict[str, Callable[[float], float]] = {
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
"""How a number is kept: as a C type, in hundredths, with a sign, as an angle, as a yes or no, or not at all."""
