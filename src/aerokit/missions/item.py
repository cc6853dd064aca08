"""``MissionItem``: one item of a mission, a fence or rally points, with the fields of MISSION_ITEM_INT.

https://mavlink.io/en/services/mission.html and https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from aerokit._internal.formatting import short_repr
from aerokit._internal.geo import check_place
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.position import Home, Position, travel_target

DEFAULT_XY = 0x7FFFFFFF  # In x or y, this value means "not given", like NaN in the other parameters.

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

# Commands with an altitude, whose frame must define the reference of the altitude.
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

# Commands whose x and y are latitude and longitude in a global frame.
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

# Maps common commands to the numbers of those parameters, from 1 to 4, that must not be NaN according to the standard.
PARAMS_WITHOUT_NAN: dict[int, tuple[int, ...]] = {
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

# The suffix _INT of a frame has no meaning in MISSION_ITEM_INT.
_FRAME_ALIASES: dict[int, int] = {
    MavFrame.GLOBAL_INT: MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT_INT: MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT_INT: MavFrame.GLOBAL_TERRAIN_ALT,
}

GLOBAL_FRAMES = frozenset({*_FRAME_ALIASES, *_FRAME_ALIASES.values()})

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
    """Return the equivalent frame without the deprecated suffix "_INT"."""
    return _FRAME_ALIASES.get(frame, frame)


def has_place(command: int) -> bool:
    """Return True if x and y of the command are coordinates, and for all commands outside the standard."""
    return command in PLACES or command not in _STANDARD_COMMANDS


DEGREE_SCALE = 10_000_000
"""Units of x and y per degree in MISSION_ITEM_INT."""


def xy_scale(command: int, frame: int) -> int:
    """Return the scale of x and y in MISSION_ITEM_INT: 10,000,000 for degrees, 10,000 for local metres, else 1."""
    # ArduPilot chooses the scale by the command, PX4 by the frame. Both agree for every item that PX4 accepts.
    if not has_place(command):
        return 1
    if frame in GLOBAL_FRAMES:
        return DEGREE_SCALE
    return 10_000 if frame in LOCAL_FRAMES else 1


def command_name(command: int) -> str:
    """Return the name without the prefix MAV_CMD, or ``command 123`` if it is unknown."""
    return MavCmd(command).name if command in _STANDARD_COMMANDS else f"command {command}"


class MissionItem(Snapshot):
    """One raw item, as sent to the vehicle. Use it for commands that have no builder.

    ``command`` is a MAV_CMD, ``frame`` a MAV_FRAME. ``param1`` to ``param4`` belong to the command; NaN means "not
    given" where the standard allows it. ``x`` and ``y`` are integers as in MISSION_ITEM_INT: latitude and longitude in
    1e-7 degrees in a global frame, or 1e-4 m in a local frame. ``z`` is in metres, from the reference of the frame. For
    commands without a place, ``x``, ``y`` and ``z`` are parameters 5, 6 and 7, unscaled. Only MISSION_ITEM can carry an
    ``x`` or ``y`` with a fraction.

    Values are not checked on construction, because vehicles and files may contain anything; the method ``check`` of the
    plan checks them. Items are equal if all their fields are equal; NaN equals NaN.
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
        """Name of the command without the MAV_CMD prefix: ``"NAV_WAYPOINT"``."""
        return command_name(self.command)

    @property
    def position(self) -> Position | None:
        """Position of the item, with the altitude above home or above mean sea level, depending on the frame.

        None for commands without a place, for local frames, for 0°, 0° (on ArduPilot the current position), and if x
        and y are not given or out of range. If the frame is relative to terrain, the position has no altitude; use
        ``z``.
        """
        if xy_scale(self.command, self.frame) != DEGREE_SCALE:
            return None
        if (self.x, self.y) in ((0, 0), (DEFAULT_XY, DEFAULT_XY)):
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
        except InvalidArgument:  # Items of vehicles and files may have coordinates out of range.
            return None

    def _key(self) -> tuple[Any, ...]:
        values: tuple[Any, ...] = self._values(self)
        # Replace NaN, the only value that differs from itself, so that items with NaN can be equal.
        return tuple("NaN" if value != value else value for value in values)

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, MissionItem) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())


MAX_ALTITUDE_M = 83_000.0  # ArduPilot's LOCATION_ALT_MAX_M


class Altitudes(NamedTuple):
    """The altitude arguments of a place: above home, above mean sea level, above the terrain."""

    relative_m: float | None = None
    amsl_m: float | None = None
    terrain_m: float | None = None


def place_item(
    command: int,
    latitude_deg: Position | Home | float | None,
    longitude_deg: float | None,
    altitudes: Altitudes,
    *parameters: float,
    is_needed: bool = False,
) -> MissionItem:
    """Create an item at a place. If no place is given, x and y are 0; ArduPilot then uses the current position.

    Exactly one of the ``altitudes`` must be given, unless the place is a Position with an altitude. With ``is_needed``,
    a missing place raises InvalidArgument.
    """
    if isinstance(latitude_deg, (Position, Home)):
        if longitude_deg is not None:
            raise InvalidArgument(
                f"longitude_deg = {short_repr(longitude_deg)} is not allowed together with a Position: the second"
                " argument was taken for the longitude; for an altitude write altitude_relative_m=…"
            )
        position = travel_target(latitude_deg)
        latitude_deg, longitude_deg = position.latitude_deg, position.longitude_deg
        if altitudes == Altitudes():
            altitudes = _altitudes_of(position)
    if isinstance(longitude_deg, (Position, Home)):
        raise InvalidArgument(
            f"longitude_deg = {short_repr(longitude_deg)} is not allowed: it must be a number; the first argument,"
            f" {latitude_deg!r}, was taken for the latitude. Pass the place as the first argument, and the altitude by"
            " name: (place, altitude_relative_m=…)"
        )
    z, frame = altitude_and_frame(altitudes)
    if latitude_deg is None and longitude_deg is None and not is_needed:
        return MissionItem(command, frame, *_four(parameters), z=z)
    if latitude_deg is None or longitude_deg is None:
        or_none = "" if is_needed else " or none of them"
        raise InvalidArgument(f"latitude_deg and longitude_deg: give both{or_none}, or a Position instead")
    in_range("latitude_deg", latitude_deg, -90, 90)
    in_range("longitude_deg", longitude_deg, -180, 180)
    check_place(latitude_deg, longitude_deg)
    x, y = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    return MissionItem(command, frame, *_four(parameters), x, y, z)


def _altitudes_of(position: Position) -> Altitudes:
    # Like go_to, prefer the altitude above home.
    if position.altitude_relative_m is not None:
        return Altitudes(relative_m=position.altitude_relative_m)
    return Altitudes(amsl_m=position.altitude_amsl_m)


def altitude_and_frame(altitudes: Altitudes) -> tuple[float, MavFrame]:
    """Return the altitude that is given and its frame. Exactly one altitude must be given."""
    candidates = (
        ("altitude_relative_m", altitudes.relative_m, MavFrame.GLOBAL_RELATIVE_ALT),
        ("altitude_amsl_m", altitudes.amsl_m, MavFrame.GLOBAL),
        ("altitude_terrain_m", altitudes.terrain_m, MavFrame.GLOBAL_TERRAIN_ALT),
    )
    given_altitudes = [(name, value, frame) for name, value, frame in candidates if value is not None]
    if len(given_altitudes) != 1:
        names = " and ".join(name for name, _, _ in given_altitudes)
        raise InvalidArgument(
            "give exactly one of altitude_relative_m (above home), altitude_amsl_m (above mean sea level) and"
            f" altitude_terrain_m (above the ground), not {names or 'none'}"
        )
    [(name, value, frame)] = given_altitudes
    in_range(name, value, -MAX_ALTITUDE_M, MAX_ALTITUDE_M)
    return float(value), frame


def action_item(command: int, *parameters: float, z: float = 0.0) -> MissionItem:
    """Create an item without a place."""
    # PX4 requires the frame MISSION for items without a place.
    return MissionItem(command, MavFrame.MISSION, *_four(parameters), z=z)


def in_range(name: str, value: object, low: float, high: float, *, also_allowed: tuple[float, ...] = ()) -> float:
    """Return the value as a float. Raises InvalidArgument if it is not allowed."""
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and (low <= value <= high or value in also_allowed)
    ):
        return float(value)
    alternatives = "".join(f", or {number:g}" for number in also_allowed)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be {low:g} to {high:g}{alternatives}")


def whole_number(name: str, value: object, low: int, high: int) -> float:
    """Return an ``int`` as a float. Raises InvalidArgument for another type, or if it is out of range."""
    if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
        return float(value)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be a whole number from {low} to {high}")


def heading(name: str, value: float | None) -> float:
    """Return the heading in degrees. None becomes NaN, which means "not given" in the standard."""
    return math.nan if value is None else in_range(name, value, -360, 360)


def _four(parameters: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return param1 to param4; those that are not given are 0."""
    param1, param2, param3, param4 = (*parameters, 0.0, 0.0, 0.0, 0.0)[:4]
    return param1, param2, param3, param4
