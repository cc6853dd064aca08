"""What the standard says of commands as items of a plan: which have a place, which frames are alike, where NaN may be.

https://mavlink.io/en/services/mission.html and https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from aerokit.mavlink.enums import MavCmd, MavFrame

__all__ = [
    "DEFAULT_XY",
    "DESTINATIONS",
    "FENCE_COMMANDS",
    "GLOBAL_FRAMES",
    "LOCAL_FRAMES",
    "NUMBERS",
    "PLACES",
    "RALLY_COMMANDS",
    "canonical_frame",
    "command_name",
    "has_place",
    "xy_scale",
]

DEFAULT_XY = 0x7FFFFFFF
"""INT32_MAX in x or y: "not given", as NaN is in the other parameters."""

FENCE_COMMANDS = frozenset(
    {
        MavCmd.NAV_FENCE_RETURN_POINT,
        MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION,
        MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        MavCmd.NAV_FENCE_CIRCLE_INCLUSION,
        MavCmd.NAV_FENCE_CIRCLE_EXCLUSION,
    }
)
RALLY_COMMANDS = frozenset({MavCmd.NAV_RALLY_POINT})

DESTINATIONS = frozenset(
    {
        MavCmd.NAV_WAYPOINT,
        MavCmd.NAV_LOITER_UNLIM,
        MavCmd.NAV_LOITER_TURNS,
        MavCmd.NAV_LOITER_TIME,
        MavCmd.NAV_LAND,
        MavCmd.NAV_TAKEOFF,
        MavCmd.NAV_CONTINUE_AND_CHANGE_ALT,
        MavCmd.NAV_LOITER_TO_ALT,
        MavCmd.NAV_SPLINE_WAYPOINT,
        MavCmd.NAV_VTOL_TAKEOFF,
        MavCmd.NAV_VTOL_LAND,
        MavCmd.NAV_PAYLOAD_PLACE,
        MavCmd.CONDITION_GATE,
        *FENCE_COMMANDS,
        *RALLY_COMMANDS,
    }
)
"""Commands whose altitude means nothing without a frame that says what it is above."""

PLACES = frozenset(
    {
        *DESTINATIONS,
        MavCmd.NAV_FOLLOW,
        MavCmd.DO_ORBIT,
        MavCmd.DO_FIGURE_EIGHT,
        MavCmd.NAV_ROI,
        MavCmd.NAV_PATHPLANNING,
        MavCmd.DO_SET_HOME,
        MavCmd.DO_RETURN_PATH_START,
        MavCmd.DO_LAND_START,
        MavCmd.DO_REPOSITION,
        MavCmd.DO_SET_ROI_LOCATION,
        MavCmd.DO_SET_ROI,
        MavCmd.OVERRIDE_GOTO,
        MavCmd.PAYLOAD_PREPARE_DEPLOY,
        *range(MavCmd.WAYPOINT_USER_1, MavCmd.SPATIAL_USER_5 + 1),
    }
)
"""Commands whose x and y are latitude and longitude when the frame is a global one."""

NUMBERS: dict[int, tuple[int, ...]] = {
    MavCmd.NAV_WAYPOINT: (1, 2, 3),
    MavCmd.NAV_LOITER_UNLIM: (3,),
    MavCmd.NAV_LOITER_TURNS: (1, 3),
    MavCmd.NAV_LOITER_TIME: (1, 3),
    MavCmd.NAV_LAND: (1, 2),
    MavCmd.NAV_TAKEOFF: (1,),
    MavCmd.NAV_CONTINUE_AND_CHANGE_ALT: (1,),
    MavCmd.NAV_LOITER_TO_ALT: (2,),
    MavCmd.NAV_ROI: (1,),
    MavCmd.NAV_SPLINE_WAYPOINT: (1,),
    MavCmd.NAV_GUIDED_ENABLE: (1,),
    MavCmd.NAV_DELAY: (1, 2, 3, 4),
    MavCmd.NAV_PAYLOAD_PLACE: (1,),
    MavCmd.CONDITION_DELAY: (1,),
    MavCmd.CONDITION_DISTANCE: (1,),
    MavCmd.CONDITION_YAW: (1, 2, 3, 4),
    MavCmd.DO_JUMP: (1, 2),
    MavCmd.DO_CHANGE_SPEED: (1, 2),
    MavCmd.DO_SET_HOME: (1,),
    MavCmd.DO_SET_RELAY: (1, 2),
    MavCmd.DO_REPEAT_RELAY: (1, 2, 3),
    MavCmd.DO_SET_SERVO: (1, 2),
    MavCmd.DO_REPEAT_SERVO: (1, 2, 3, 4),
    MavCmd.DO_SET_REVERSE: (1,),
    MavCmd.DO_SET_ROI: (1,),
    MavCmd.DO_DIGICAM_CONTROL: (1, 2, 3, 4),
    MavCmd.DO_MOUNT_CONTROL: (1, 2, 3),
    MavCmd.DO_SET_CAM_TRIGG_DIST: (1, 2, 3),
    MavCmd.DO_FENCE_ENABLE: (1,),
    MavCmd.DO_PARACHUTE: (1,),
    MavCmd.DO_GRIPPER: (1, 2),
    MavCmd.DO_SET_CAM_TRIGG_INTERVAL: (1,),
    MavCmd.DO_GUIDED_LIMITS: (1, 2, 3, 4),
    MavCmd.DO_ENGINE_CONTROL: (1,),
    MavCmd.SET_CAMERA_MODE: (1, 2),
    MavCmd.SET_CAMERA_ZOOM: (1, 2),
    MavCmd.SET_CAMERA_FOCUS: (1, 2),
    MavCmd.JUMP_TAG: (1,),
    MavCmd.DO_JUMP_TAG: (1, 2),
    MavCmd.IMAGE_START_CAPTURE: (1, 2, 3),
    MavCmd.IMAGE_STOP_CAPTURE: (1,),
    MavCmd.VIDEO_START_CAPTURE: (1,),
    MavCmd.VIDEO_STOP_CAPTURE: (1,),
    MavCmd.DO_VTOL_TRANSITION: (1,),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: (1,),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: (1,),
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION: (1,),
    MavCmd.NAV_FENCE_CIRCLE_EXCLUSION: (1,),
    MavCmd.DO_WINCH: (1, 2),
    MavCmd.NAV_SCRIPT_TIME: (1, 2),
}
"""The parameters 1 to 4 of common commands for which the standard gives NaN no meaning."""

_ALIKE: dict[int, int] = {
    MavFrame.GLOBAL_INT: MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT_INT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT_INT: MavFrame.GLOBAL_TERRAIN_ALT,
}
GLOBAL_FRAMES = frozenset({*_ALIKE, *_ALIKE.values()})
LOCAL_FRAMES = frozenset(
    {
        MavFrame.LOCAL_NED,
        MavFrame.LOCAL_ENU,
        MavFrame.LOCAL_OFFSET_NED,
        MavFrame.LOCAL_FRD,
        MavFrame.LOCAL_FLU,
    }
)
_STANDARD_COMMANDS = frozenset(int(command) for command in MavCmd)


def canonical_frame(frame: int) -> int:
    """The frame without "_INT", which the standard deprecated: in MISSION_ITEM_INT both mean the same."""
    return _ALIKE.get(frame, frame)


def has_place(command: int) -> bool:
    """Whether x and y of this command are a latitude and a longitude; commands of other dialects count as such."""
    return command in PLACES or command not in _STANDARD_COMMANDS


def xy_scale(command: int, frame: int) -> int:
    """By how much x and y are multiplied in MISSION_ITEM_INT: 10,000,000 for degrees, 10,000 for local metres, else 1.

    ArduPilot decides by the command, PX4 by the frame; where they would differ, PX4 refuses the item.
    """
    if not has_place(command):
        return 1
    if frame in GLOBAL_FRAMES:
        return 10_000_000
    return 10_000 if frame in LOCAL_FRAMES else 1


def command_name(command: int) -> str:
    """The standard's name without its MAV_CMD prefix, or the number as text."""
    return MavCmd(command).name if command in _STANDARD_COMMANDS else f"command {command}"
