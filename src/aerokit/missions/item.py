"""``MissionItem``: one line of a mission, a fence or rally points, as MISSION_ITEM_INT has it.

https://mavlink.io/en/services/mission.html and https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

import math
from typing import Any

from aerokit._internal.geo import check_place
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.position import Position

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


class MissionItem(Snapshot):
    """One item, raw: the numbers that go out, for commands that have no builder.

    ``command`` is a MAV_CMD, ``frame`` a MAV_FRAME, ``param1`` to ``param4`` are the command's, NaN where the standard
    allows "not given". ``x`` and ``y`` are integers as in MISSION_ITEM_INT: latitude and longitude in 1e-7 degrees in
    a global frame, 1e-4 m in a local one, for commands without a place their parameters 5 and 6 as they are (a
    fraction there fits only into the float form of the item). ``z`` is in metres, above what the frame says.

    Anything can be put in, because a vehicle or a file may hold anything; ``check`` of the whole plan refuses what
    makes no sense. Items are equal when all their fields are, NaN and NaN included.
    https://mavlink.io/en/messages/common.html#MISSION_ITEM_INT
    """

    command: int
    frame: int
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x: int | float = 0
    y: int | float = 0
    z: float = 0.0
    autocontinue: bool = True

    @property
    def name(self) -> str:
        """The command's name without its MAV_CMD prefix: ``"NAV_WAYPOINT"``."""
        return command_name(self.command)

    @property
    def position(self) -> Position | None:
        """Where the item is, with the altitude above home or above the sea that its frame says.

        None for commands without a place, for local frames, and for 0°, 0°, which means "where the vehicle is". An
        altitude above the terrain is neither of the two: see ``z`` then.
        """
        if xy_scale(self.command, self.frame) != 10_000_000 or (self.x, self.y) in (
            (0, 0),
            (DEFAULT_XY,) * 2,
        ):
            return None
        altitude = self.z if math.isfinite(self.z) else None
        frame = canonical_frame(self.frame)
        try:
            return Position(
                self.x / 1e7,
                self.y / 1e7,
                altitude_amsl_m=altitude if frame == MavFrame.GLOBAL else None,
                altitude_relative_m=altitude if frame == MavFrame.GLOBAL_RELATIVE_ALT else None,
            )
        except InvalidArgument:
            return None

    def _key(self) -> tuple[Any, ...]:
        values: tuple[Any, ...] = self._values(self)
        return tuple("NaN" if value != value else value for value in values)

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, MissionItem) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())


HIGHEST_M = 83_000.0
"""ArduPilot stores no altitude beyond (its LOCATION_ALT_MAX_M)."""

Altitudes = tuple["float | None", "float | None", "float | None"]


def place(
    command: int,
    latitude_deg: Position | float | None,
    longitude_deg: float | None,
    altitudes: Altitudes,
    *parameters: float,
    is_needed: bool = False,
) -> MissionItem:
    """An item at a place; ``altitudes`` are those relative to home, above the sea, above the terrain: one is given.

    A Position stands for latitude and longitude, and for the altitude when none is given.
    Without a place it is 0°, 0°, by which ArduPilot means where the vehicle is then, unless it ``is_needed``.
    """
    if isinstance(latitude_deg, Position):
        if longitude_deg is not None:
            raise InvalidArgument(f"longitude_deg = {longitude_deg!r} is not allowed beside a Position")
        position = latitude_deg
        latitude_deg, longitude_deg = position.latitude_deg, position.longitude_deg
        altitudes = _altitudes_of(position) if altitudes == (None, None, None) else altitudes
    z, frame = altitude_and_frame(*altitudes)
    if latitude_deg is None and longitude_deg is None and not is_needed:
        return MissionItem(command, frame, *_four(parameters), z=z)
    if latitude_deg is None or longitude_deg is None:
        none = "" if is_needed else " or none of them"
        raise InvalidArgument(
            f"latitude_deg and longitude_deg: give both{none}, or a Position in their place"
        )
    in_range("latitude_deg", latitude_deg, -90, 90)
    in_range("longitude_deg", longitude_deg, -180, 180)
    check_place(latitude_deg, longitude_deg)
    x, y = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    return MissionItem(command, frame, *_four(parameters), x, y, z)


def _altitudes_of(position: Position) -> Altitudes:
    """Of the two that it may have, the one above home, as ``go_to`` takes it."""
    if position.altitude_relative_m is not None:
        return position.altitude_relative_m, None, None
    return None, position.altitude_amsl_m, None


def altitude_and_frame(
    relative_m: float | None, amsl_m: float | None, terrain_m: float | None
) -> tuple[float, MavFrame]:
    """The one altitude that is given, and the frame that says what it is above."""
    given = {
        name: (value, frame)
        for name, value, frame in (
            ("altitude_relative_m", relative_m, MavFrame.GLOBAL_RELATIVE_ALT),
            ("altitude_amsl_m", amsl_m, MavFrame.GLOBAL),
            ("altitude_terrain_m", terrain_m, MavFrame.GLOBAL_TERRAIN_ALT),
        )
        if value is not None
    }
    if len(given) != 1:
        raise InvalidArgument(
            "give exactly one of altitude_relative_m (above home), altitude_amsl_m (above mean sea level) and"
            f" altitude_terrain_m (above the ground), not {' and '.join(given) or 'none'}"
        )
    ((name, (value, frame)),) = given.items()
    in_range(name, value, -HIGHEST_M, HIGHEST_M)
    return float(value), frame


def action(command: int, *parameters: float, z: float = 0.0) -> MissionItem:
    """An item without a place, in the frame that PX4 wants for those: MISSION."""
    return MissionItem(command, MavFrame.MISSION, *_four(parameters), z=z)


def in_range(name: str, value: object, low: float, high: float, *, or_: tuple[float, ...] = ()) -> float:
    """The value; :class:`InvalidArgument` unless it is a number from low to high, or one of ``or_``."""
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and (low <= value <= high or value in or_)
    ):
        return float(value)
    others = "".join(f", or {other:g}" for other in or_)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: {low:g} to {high:g}{others}")


def whole(name: str, value: object, low: int, high: int) -> float:
    """The value; :class:`InvalidArgument` unless it is a whole number from low to high."""
    if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
        return float(value)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: a whole number from {low} to {high}")


def heading(name: str, value: float | None) -> float:
    """The heading in degrees, NaN (the standard's "not given") for None."""
    return math.nan if value is None else in_range(name, value, -360, 360)


def _four(parameters: tuple[float, ...]) -> tuple[float, float, float, float]:
    one, two, three, four = (*parameters, 0.0, 0.0, 0.0, 0.0)[:4]
    return one, two, three, four
