"""Builders for what is done on the way: speed, waiting, headings, servos, relays, jumps, transitions.

What cannot be right raises :class:`~aerokit.errors.InvalidArgument` with the argument and what is allowed.
https://mavlink.io/en/messages/common.html#mav_commands

What cannot be right raises :class:`~aerokit.errors.InvalidArgument` with the argument and what is allowed.
https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, overload

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavMountMode
from aerokit.missions.item import action, in_range, place, whole

if TYPE_CHECKING:
    from aerokit.missions.item import MissionItem
    from aerokit.position import Position

_LONGEST_S = 86_400.0 * 365

_SPEEDS = {"air": 0.0, "ground": 1.0, "climb": 2.0, "descent": 3.0}


def change_speed(
    speed_m_s: float,
    *,
    kind: Literal["air", "ground", "climb", "descent"] = "ground",
    throttle_percent: float | None = None,
) -> MissionItem:
    """Fly on with another speed: 0 to 1,000 m/s, or -2 for the vehicle's own (the standard's word; PX4: -1).

    ``kind`` is which speed: ``"climb"`` and ``"descent"`` on copters. ``throttle_percent`` (0 to 100) is for planes
    without airspeed sensor, None leaves it. https://mavlink.io/en/messages/common.html#MAV_CMD_DO_CHANGE_SPEED
    """
    if kind not in _SPEEDS:
        raise InvalidArgument(f"kind = {kind!r} is not allowed: {', '.join(map(repr, _SPEEDS))}")
    return action(
        MavCmd.DO_CHANGE_SPEED,
        _SPEEDS[kind],
        in_range("speed_m_s", speed_m_s, 0, 1000, or_=(-1, -2)),
        -1.0 if throttle_percent is None else in_range("throttle_percent", throttle_percent, 0, 100),
    )


def delay(duration_s: float) -> MissionItem:
    """Stay where the vehicle is for that many seconds, above 0.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    if duration_s == 0:
        raise InvalidArgument("duration_s = 0 is not allowed: ArduPilot takes it for a time of day; above 0")
    return action(MavCmd.NAV_DELAY, in_range("duration_s", duration_s, 0, _LONGEST_S), -1.0, -1.0, -1.0)


def delay_until(hour: int, minute: int = 0, second: int = 0) -> MissionItem:
    """Stay where the vehicle is until that time of day, in UTC (ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    return action(
        MavCmd.NAV_DELAY,
        -1.0,
        whole("hour", hour, 0, 23),
        whole("minute", minute, 0, 59),
        whole("second", second, 0, 59),
    )


def condition_delay(duration_s: float) -> MissionItem:
    """Do the actions behind this one only after that many seconds, and fly on meanwhile.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DELAY
    """
    return action(MavCmd.CONDITION_DELAY, in_range("duration_s", duration_s, 0, _LONGEST_S))


def condition_distance(distance_m: float) -> MissionItem:
    """Do the actions behind this one only within that many metres of the next place.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DISTANCE
    """
    return action(MavCmd.CONDITION_DISTANCE, in_range("distance_m", distance_m, 0, 1e7))


def condition_yaw(
    heading_deg: float,
    *,
    rate_deg_s: float = 0.0,
    direction: Literal["shortest", "clockwise", "counterclockwise"] = "shortest",
    relative: bool = False,
) -> MissionItem:
    """Turn to a heading (ArduCopter): 0 to 360 degrees from north, or from where it points with ``relative``.

    ``rate_deg_s`` is 0 (its own) to 360. https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_YAW
    """
    directions = {"shortest": 0.0, "clockwise": 1.0, "counterclockwise": -1.0}
    if direction not in directions:
        raise InvalidArgument(f"direction = {direction!r} is not allowed: {', '.join(map(repr, directions))}")
    return action(
        MavCmd.CONDITION_YAW,
        in_range("heading_deg", heading_deg, 0, 360),
        in_range("rate_deg_s", rate_deg_s, 0, 360),
        directions[direction],
        float(relative),
    )


def set_servo(servo: int, pwm_us: int) -> MissionItem:
    """Put an output (1 to 32) to a pulse of 500 to 2,500 microseconds, or 0: no pulse (ArduPilot; PX4 refuses it).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_SERVO
    """
    number = whole("servo", servo, 1, 32)
    return action(MavCmd.DO_SET_SERVO, number, in_range("pwm_us", pwm_us, 500, 2500, or_=(0,)))


def set_relay(relay: int, on: bool) -> MissionItem:
    """Switch a relay, 0 to 15 (ArduPilot; PX4 refuses it).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_RELAY
    """
    return action(MavCmd.DO_SET_RELAY, whole("relay", relay, 0, 15), float(on))


def jump(to_item: int, *, repeat: int = -1) -> MissionItem:
    """Go on with another item of the mission, ``repeat`` times (0 to 32,767, -1: for ever).

    Items are counted from 0 without home, as in :class:`Mission`, whatever the autopilot: jump(0) leads to the first.
    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP
    """
    target = whole("to_item", to_item, 0, 65_534)
    return action(MavCmd.DO_JUMP, target, whole("repeat", repeat, -1, 32_767))


def jump_tag(tag: int) -> MissionItem:
    """A mark for :func:`jump_to_tag` (ArduPilot): 0 to 65,535.

    https://mavlink.io/en/messages/common.html#MAV_CMD_JUMP_TAG
    """
    return action(MavCmd.JUMP_TAG, whole("tag", tag, 0, 65_535))


def jump_to_tag(tag: int, *, repeat: int = -1) -> MissionItem:
    """Go on with the first :func:`jump_tag` of that number (ArduPilot), ``repeat`` times, -1: for ever.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP_TAG
    """
    return action(MavCmd.DO_JUMP_TAG, whole("tag", tag, 0, 65_535), whole("repeat", repeat, -1, 32_767))


def vtol_transition(to: Literal["multicopter", "fixed_wing"]) -> MissionItem:
    """Go over to the other kind of flight.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_VTOL_TRANSITION
    """
    states = {"multicopter": 3.0, "fixed_wing": 4.0}
    if to not in states:
        raise InvalidArgument(f"to = {to!r} is not allowed: {', '.join(map(repr, states))}")
    return action(MavCmd.DO_VTOL_TRANSITION, states[to])


def land_start() -> MissionItem:
    """Mark where the landing begins, for a return or a failsafe that goes on from here.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_LAND_START
    """
    return action(MavCmd.DO_LAND_START)


def enable_fence(enable: bool = True) -> MissionItem:
    """Switch the fence on or off (ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE
    """
    return action(MavCmd.DO_FENCE_ENABLE, float(enable))


def set_camera_trigger_distance(distance_m: float, *, trigger_now: bool = False) -> MissionItem:
    """Take a photo every that many metres from here on, 0: no more; with ``trigger_now`` the first one at once.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_CAM_TRIGG_DIST
    """
    return action(
        MavCmd.DO_SET_CAM_TRIGG_DIST, in_range("distance_m", distance_m, 0, 1e5), 0.0, float(trigger_now)
    )


def take_photo(*, camera: int = 0) -> MissionItem:
    """Take one photo; ``camera`` 0: all of them.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_START_CAPTURE
    """
    return take_photos(1, camera=camera)


def take_photos(count: int = 0, *, interval_s: float = 0.0, camera: int = 0) -> MissionItem:
    """Take that many photos (0: until :func:`stop_photos`, 65,535 at most), one every ``interval_s`` seconds.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_START_CAPTURE
    """
    return action(
        MavCmd.IMAGE_START_CAPTURE,
        whole("camera", camera, 0, 255),
        in_range("interval_s", interval_s, 0, 86_400),
        whole("count", count, 0, 65_535),
    )


def stop_photos(*, camera: int = 0) -> MissionItem:
    """Take no more photos.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_STOP_CAPTURE
    """
    return action(MavCmd.IMAGE_STOP_CAPTURE, whole("camera", camera, 0, 255))


def start_video(*, stream: int = 0) -> MissionItem:
    """Start to record; ``stream`` 0: all of them.

    https://mavlink.io/en/messages/common.html#MAV_CMD_VIDEO_START_CAPTURE
    """
    return action(MavCmd.VIDEO_START_CAPTURE, whole("stream", stream, 0, 255))


def stop_video(*, stream: int = 0) -> MissionItem:
    """Record no more.

    https://mavlink.io/en/messages/common.html#MAV_CMD_VIDEO_STOP_CAPTURE
    """
    return action(MavCmd.VIDEO_STOP_CAPTURE, whole("stream", stream, 0, 255))


def trigger_camera() -> MissionItem:
    """Press the shutter of a camera on a servo or a relay.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_DIGICAM_CONTROL
    """
    return action(MavCmd.DO_DIGICAM_CONTROL).replace(x=1)


@overload
def region_of_interest(
    position: Position,
    /,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem: ...
@overload
def region_of_interest(
    latitude_deg: float,
    longitude_deg: float,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem: ...
def region_of_interest(
    latitude_deg: Position | float,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem:
    """Look at a place from here on, with the gimbal or the nose; exactly one altitude.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_LOCATION
    """
    return place(
        MavCmd.DO_SET_ROI_LOCATION,
        latitude_deg,
        longitude_deg,
        (altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        is_needed=True,
    )


def region_of_interest_none() -> MissionItem:
    """Look at no place any more.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_NONE
    """
    return action(MavCmd.DO_SET_ROI_NONE)


def point_gimbal(*, pitch_deg: float = 0.0, roll_deg: float = 0.0, yaw_deg: float = 0.0) -> MissionItem:
    """Point the gimbal: -180 to 180 degrees each, pitch negative is downwards, yaw is from the nose.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_MOUNT_CONTROL
    """
    angles = (("pitch_deg", pitch_deg), ("roll_deg", roll_deg), ("yaw_deg", yaw_deg))
    return action(
        MavCmd.DO_MOUNT_CONTROL,
        *(in_range(name, value, -180, 180) for name, value in angles),
        z=float(MavMountMode.MAVLINK_TARGETING),
    )
