"""Builders for items with a place: waypoints, take-off and landing, loitering, rally points.

A place is a :class:`~aerokit.Position`, or a latitude and a longitude in degrees (WGS 84). A place needs exactly one
altitude in metres: ``altitude_relative_m`` above home, ``altitude_amsl_m`` above mean sea level, or
``altitude_terrain_m`` above the terrain (ArduPilot with terrain data; PX4 refuses it). If no altitude is given, the
altitude of the Position is used; if it has two, the altitude above home. For landings, the altitude is that of the
ground. ``take_off``, ``vtol_take_off`` and ``loiter_to_altitude`` also accept only an altitude above home:
``take_off(10)``. ``yaw_deg`` is a heading in degrees from north; None leaves it to the vehicle. Invalid arguments raise
:class:`~aerokit.errors.InvalidArgument`, which names the argument and the allowed values.
https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

from aerokit.mavlink.enums import MavCmd
from aerokit.missions.item import Altitudes, action_item, heading, in_range, place_item, whole_number

if TYPE_CHECKING:
    from aerokit.missions.item import MissionItem
    from aerokit.position import Home, Position

_MAX_DURATION_S = 65_535.0  # ArduPilot stores seconds in 16 bits.
_MAX_METRES = 65_535.0  # ArduPilot stores metres in 16 bits.
# Value of parameters that have no meaning in a command, or that the functions below leave at their default.
_UNSET = 0.0


@overload
def waypoint(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
    acceptance_radius_m: float = 0.0,
    pass_by_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def waypoint(
    latitude_deg: float,
    longitude_deg: float,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
    acceptance_radius_m: float = 0.0,
    pass_by_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def waypoint(
    latitude_deg: Position | Home | float,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
    acceptance_radius_m: float = 0.0,
    pass_by_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Fly to a place and hold there for ``hold_s`` seconds.

    ``hold_s`` is 0 to 65,535; ArduPilot stores whole seconds, and ArduPlane does not support it. A place counts as
    reached within ``acceptance_radius_m`` (0: the radius in the vehicle's parameters); ArduCopter ignores this radius.
    By the standard, ``pass_by_m`` is the distance at which a plane passes the place, clockwise if positive,
    counter-clockwise if negative. ArduPlane instead flies over the place, to a point ``pass_by_m`` beyond it. PX4
    ignores ``pass_by_m``. ArduPlane stores both distances in whole metres up to 255.
    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_WAYPOINT
    """
    return place_item(
        MavCmd.NAV_WAYPOINT,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("hold_s", hold_s, 0, _MAX_DURATION_S),
        in_range("acceptance_radius_m", acceptance_radius_m, 0, _MAX_METRES),
        in_range("pass_by_m", pass_by_m, -_MAX_METRES, _MAX_METRES),
        heading("yaw_deg", yaw_deg),
        is_needed=True,
    )


@overload
def spline_waypoint(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
) -> MissionItem: ...
@overload
def spline_waypoint(
    latitude_deg: float,
    longitude_deg: float,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
) -> MissionItem: ...
def spline_waypoint(
    latitude_deg: Position | Home | float,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    hold_s: float = 0.0,
) -> MissionItem:
    """Fly to a place along a spline (ArduPilot, not Plane) and hold there for ``hold_s`` seconds (0 to 65,535).

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_SPLINE_WAYPOINT
    """
    return place_item(
        MavCmd.NAV_SPLINE_WAYPOINT,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("hold_s", hold_s, 0, _MAX_DURATION_S),
        is_needed=True,
    )


@overload
def take_off(
    altitude_relative_m: float,
    /,
    *,
    pitch_deg: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def take_off(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    pitch_deg: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def take_off(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    pitch_deg: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def take_off(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    pitch_deg: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Take off to an altitude. If no place is given, take off at the current position (ArduPilot; PX4 needs the place).

    A number as the only argument is the altitude above home: ``take_off(15)``. A place comes before the altitude:
    ``take_off(place, altitude_relative_m=15)``.

    ``pitch_deg`` is the minimum pitch of a plane, 0 to 90 degrees.
    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_TAKEOFF
    """
    return place_item(
        MavCmd.NAV_TAKEOFF,
        *_place_or_altitude(latitude_deg, longitude_deg, altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("pitch_deg", pitch_deg, 0, 90),
        _UNSET,
        _UNSET,
        heading("yaw_deg", yaw_deg),
    )


@overload
def vtol_take_off(
    altitude_relative_m: float,
    /,
    *,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def vtol_take_off(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def vtol_take_off(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def vtol_take_off(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Take off vertically. PX4 needs a place, and transitions to forward flight towards this place after the take-off.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_VTOL_TAKEOFF
    """
    return place_item(
        MavCmd.NAV_VTOL_TAKEOFF,
        *_place_or_altitude(latitude_deg, longitude_deg, altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        _UNSET,
        _UNSET,
        _UNSET,
        heading("yaw_deg", yaw_deg),
    )


@overload
def land(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    abort_altitude_m: float = 0.0,
    precision: int = 0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def land(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    abort_altitude_m: float = 0.0,
    precision: int = 0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def land(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    abort_altitude_m: float = 0.0,
    precision: int = 0,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Land at a place, or at the current position if none is given (ArduPilot; PX4 needs the place).

    Give the altitude of the ground at the place; the default is the altitude of home. The altitude of a Position is
    ignored.

    ``abort_altitude_m`` (0 to 65,535 m) is the altitude to which a plane climbs if it aborts the landing; 0 means the
    altitude in its parameters. ``precision`` requests a precision landing from PX4: 0 no, 1 opportunistic, 2 required.
    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_LAND
    """
    return place_item(
        MavCmd.NAV_LAND,
        latitude_deg,
        longitude_deg,
        _altitudes_or_home(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("abort_altitude_m", abort_altitude_m, 0, _MAX_METRES),
        whole_number("precision", precision, 0, 2),
        _UNSET,
        heading("yaw_deg", yaw_deg),
    )


@overload
def vtol_land(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def vtol_land(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def vtol_land(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Land vertically at a place, or at the current position if none is given (ArduPilot; PX4 needs the place).

    Give the altitude of the ground at the place; the default is the altitude of home. The altitude of a Position is
    ignored. https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_VTOL_LAND
    """
    return place_item(
        MavCmd.NAV_VTOL_LAND,
        latitude_deg,
        longitude_deg,
        _altitudes_or_home(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        _UNSET,
        _UNSET,
        _UNSET,
        heading("yaw_deg", yaw_deg),
    )


@overload
def loiter_unlimited(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
@overload
def loiter_unlimited(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem: ...
def loiter_unlimited(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    yaw_deg: float | None = None,
) -> MissionItem:
    """Stay at a place indefinitely. Planes circle with ``radius_m``; a negative radius means counter-clockwise.

    With 0, planes use the radius in their parameters.
    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_LOITER_UNLIM
    """
    return place_item(
        MavCmd.NAV_LOITER_UNLIM,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        _UNSET,
        _UNSET,
        in_range("radius_m", radius_m, -_MAX_METRES, _MAX_METRES),
        heading("yaw_deg", yaw_deg),
    )


@overload
def loiter_time(
    duration_s: float,
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
@overload
def loiter_time(
    duration_s: float,
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
def loiter_time(
    duration_s: float,
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem:
    """Stay at a place for 0 to 65,535 seconds. ArduPilot stores whole seconds, and only the sign of the radius.

    With ``leave_tangentially``, a plane flies straight from its circle to the next item. Without it, a plane joins the
    line from the circle's center to the next item. https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_LOITER_TIME
    """
    return place_item(
        MavCmd.NAV_LOITER_TIME,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("duration_s", duration_s, 0, _MAX_DURATION_S),
        _UNSET,
        in_range("radius_m", radius_m, -_MAX_METRES, _MAX_METRES),
        float(leave_tangentially),
    )


@overload
def loiter_turns(
    turns: float,
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
@overload
def loiter_turns(
    turns: float,
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
def loiter_turns(
    turns: float,
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem:
    """Circle around a place 0 to 255 times with a radius of up to 2,550 m. PX4 refuses this item.

    ArduPilot stores whole turns, or a fraction below one turn. It stores a radius above 255 m in tens of metres. A
    negative radius means counter-clockwise. https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_LOITER_TURNS
    """
    return place_item(
        MavCmd.NAV_LOITER_TURNS,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        in_range("turns", turns, 0, 255),
        _UNSET,
        in_range("radius_m", radius_m, -2550, 2550),
        float(leave_tangentially),
    )


@overload
def loiter_to_altitude(
    altitude_relative_m: float,
    /,
    *,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
@overload
def loiter_to_altitude(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
@overload
def loiter_to_altitude(
    latitude_deg: float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem: ...
def loiter_to_altitude(
    latitude_deg: Position | Home | float | None = None,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
    radius_m: float = 0.0,
    leave_tangentially: bool = False,
) -> MissionItem:
    """Circle at a place until the altitude is reached. A negative ``radius_m`` means counter-clockwise.

    The place is a Position, a Home, or a latitude and a longitude.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_LOITER_TO_ALT
    """
    return place_item(
        MavCmd.NAV_LOITER_TO_ALT,
        *_place_or_altitude(latitude_deg, longitude_deg, altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        _UNSET,
        in_range("radius_m", radius_m, -_MAX_METRES, _MAX_METRES),
        _UNSET,
        float(leave_tangentially),
    )


def return_to_launch() -> MissionItem:
    """Return to home, or to a rally point, depending on the vehicle's settings.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_RETURN_TO_LAUNCH
    """
    return action_item(MavCmd.NAV_RETURN_TO_LAUNCH)


@overload
def rally_point(
    position: Position | Home,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem: ...
@overload
def rally_point(
    latitude_deg: float,
    longitude_deg: float,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem: ...
def rally_point(
    latitude_deg: Position | Home | float,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem:
    """A rally point for :class:`RallyPoints`. ArduPilot stores whole metres of altitude, -32,768 to 32,767.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_RALLY_POINT
    """
    altitudes = Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m)
    item = place_item(MavCmd.NAV_RALLY_POINT, latitude_deg, longitude_deg, altitudes, is_needed=True)
    in_range("altitude", item.z, -32_768, 32_767)
    return item


def _place_or_altitude(
    latitude_deg: Position | Home | float | None, longitude_deg: float | None, *altitudes: float | None
) -> tuple[Position | Home | float | None, float | None, Altitudes]:
    """Return latitude, longitude and altitudes. A number without a longitude is an altitude above home."""
    given = Altitudes(*altitudes)
    if isinstance(latitude_deg, (int, float)) and longitude_deg is None and given == Altitudes():
        return None, None, Altitudes(relative_m=latitude_deg)
    return latitude_deg, longitude_deg, given


def _altitudes_or_home(relative_m: float | None, amsl_m: float | None, terrain_m: float | None) -> Altitudes:
    """Return the altitudes of a landing. If none is given, the ground is as high as home."""
    altitudes = Altitudes(relative_m, amsl_m, terrain_m)
    return Altitudes(relative_m=0.0) if altitudes == Altitudes() else altitudes
