"""Builders for items without a place: speed, delays, headings, servos, relays, jumps, cameras, transitions.

Invalid arguments raise :class:`~aerokit.errors.InvalidArgument`, which names the argument and the allowed values.
https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, overload

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavMountMode, MavVtolState
from aerokit.missions.item import Altitudes, action_item, in_range, place_item, whole_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.missions.item import MissionItem
    from aerokit.position import Home, Position

# ArduPilot takes a NAV_DELAY of 0 seconds for a delay until a time of day.
_MIN_DELAY_S = 0.001

_MAX_DURATION_S = 86_400.0 * 365


def _number_of(name: str, choice: str, numbers: Mapping[str, float]) -> float:
    if choice not in numbers:
        raise InvalidArgument(f"{name} = {choice!r} is not allowed: it must be one of {', '.join(map(repr, numbers))}")
    return float(numbers[choice])


def change_speed(
    speed_m_s: float,
    *,
    kind: Literal["air", "ground", "climb", "descent"] = "ground",
    throttle_percent: float | None = None,
) -> MissionItem:
    """Change the speed (0 to 1,000 m/s).

    A speed of -2 means the vehicle's default speed; ArduCopter ignores -2. A speed of -1 means no change; PX4 instead
    sets the default speed.
    ``kind`` selects the speed; ``"climb"`` and ``"descent"`` are for copters. ``throttle_percent`` (0 to 100) is for
    planes without airspeed sensor; None leaves it unchanged.
    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_CHANGE_SPEED
    """
    return action_item(
        MavCmd.DO_CHANGE_SPEED,
        _number_of("kind", kind, {"air": 0, "ground": 1, "climb": 2, "descent": 3}),
        in_range("speed_m_s", speed_m_s, 0, 1000, also_allowed=(-1, -2)),
        -1.0 if throttle_percent is None else in_range("throttle_percent", throttle_percent, 0, 100),
    )


def delay(duration_s: float) -> MissionItem:
    """Hold the position for ``duration_s`` seconds (at least a millisecond).

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    no_time_of_day = (-1.0, -1.0, -1.0)
    return action_item(
        MavCmd.NAV_DELAY, in_range("duration_s", duration_s, _MIN_DELAY_S, _MAX_DURATION_S), *no_time_of_day
    )


def delay_until(hour: int, minute: int = 0, second: int = 0) -> MissionItem:
    """Hold the position until a time of day (UTC, ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    return action_item(
        MavCmd.NAV_DELAY,
        -1.0,  # -1 means that a time of day follows instead of a duration.
        whole_number("hour", hour, 0, 23),
        whole_number("minute", minute, 0, 59),
        whole_number("second", second, 0, 59),
    )


def condition_delay(duration_s: float) -> MissionItem:
    """Delay the following actions by ``duration_s`` seconds, while the vehicle flies on.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DELAY
    """
    return action_item(MavCmd.CONDITION_DELAY, in_range("duration_s", duration_s, 0, _MAX_DURATION_S))


def condition_distance(distance_m: float) -> MissionItem:
    """Delay the following actions until the vehicle is within ``distance_m`` metres of the next waypoint.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DISTANCE
    """
    return action_item(MavCmd.CONDITION_DISTANCE, in_range("distance_m", distance_m, 0, 1e7))


def condition_yaw(
    heading_deg: float,
    *,
    rate_deg_s: float = 0.0,
    direction: Literal["shortest", "clockwise", "counterclockwise"] = "shortest",
    relative: bool = False,
) -> MissionItem:
    """Turn to a heading (ArduCopter): 0 to 360 degrees from north, or with ``relative`` from the current heading.

    ``rate_deg_s`` is 0 (the vehicle's default) to 360.
    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_YAW
    """
    direction_number = _number_of("direction", direction, {"shortest": 0, "clockwise": 1, "counterclockwise": -1})
    return action_item(
        MavCmd.CONDITION_YAW,
        in_range("heading_deg", heading_deg, 0, 360),
        in_range("rate_deg_s", rate_deg_s, 0, 360),
        direction_number,
        float(relative),
    )


def set_servo(servo: int, pwm_us: int) -> MissionItem:
    """Set a servo output (1 to 32) to 500 to 2,500 microseconds; 0 stops the pulses. PX4 refuses this item.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_SERVO
    """
    number = whole_number("servo", servo, 1, 32)
    return action_item(MavCmd.DO_SET_SERVO, number, in_range("pwm_us", pwm_us, 500, 2500, also_allowed=(0,)))


def set_relay(relay: int, on: bool) -> MissionItem:
    """Switch a relay, 0 to 15. PX4 refuses this item.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_RELAY
    """
    return action_item(MavCmd.DO_SET_RELAY, whole_number("relay", relay, 0, 15), float(on))


def jump(to_item: int, *, repeat: int = -1) -> MissionItem:
    """Jump to another item of the mission, ``repeat`` times (0 to 32,767; -1: without limit).

    ``to_item`` is an index in :class:`Mission`, for any autopilot: 0 is the first item, and home does not count.
    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP
    """
    # For ArduPilot, where home is item 0, the number is sent increased by 1. It must still fit into 16 bits.
    target = whole_number("to_item", to_item, 0, 65_534)
    return action_item(MavCmd.DO_JUMP, target, whole_number("repeat", repeat, -1, 32_767))


def jump_tag(tag: int) -> MissionItem:
    """Mark this item as a target for :func:`jump_to_tag` (ArduPilot). ``tag`` is 0 to 65,535.

    https://mavlink.io/en/messages/common.html#MAV_CMD_JUMP_TAG
    """
    return action_item(MavCmd.JUMP_TAG, whole_number("tag", tag, 0, 65_535))


def jump_to_tag(tag: int, *, repeat: int = -1) -> MissionItem:
    """Jump to the first :func:`jump_tag` with this number (ArduPilot), ``repeat`` times; -1: without limit.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP_TAG
    """
    return action_item(
        MavCmd.DO_JUMP_TAG, whole_number("tag", tag, 0, 65_535), whole_number("repeat", repeat, -1, 32_767)
    )


def vtol_transition(to: Literal["multicopter", "fixed_wing"]) -> MissionItem:
    """Transition between multicopter and fixed-wing flight.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_VTOL_TRANSITION
    """
    states = {"multicopter": MavVtolState.MC, "fixed_wing": MavVtolState.FW}
    return action_item(MavCmd.DO_VTOL_TRANSITION, _number_of("to", to, states))


def land_start() -> MissionItem:
    """Mark the start of the landing sequence. The vehicle may jump to this item for a return or in a failsafe.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_LAND_START
    """
    return action_item(MavCmd.DO_LAND_START)


def enable_fence(enable: bool = True) -> MissionItem:
    """Enable or disable the fence (ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE
    """
    return action_item(MavCmd.DO_FENCE_ENABLE, float(enable))


def set_camera_trigger_distance(distance_m: float, *, trigger_now: bool = False) -> MissionItem:
    """Take a photo every ``distance_m`` metres from here on; 0 stops. With ``trigger_now``, also take a photo at once.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_CAM_TRIGG_DIST
    """
    return action_item(
        MavCmd.DO_SET_CAM_TRIGG_DIST,
        in_range("distance_m", distance_m, 0, 1e5),
        0.0,  # leaves the shutter time unchanged
        float(trigger_now),
    )


def take_photo(*, camera: int = 0) -> MissionItem:
    """Take one photo; ``camera`` 0 means all cameras.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_START_CAPTURE
    """
    return take_photos(1, camera=camera)


def take_photos(count: int = 0, *, interval_s: float = 0.0, camera: int = 0) -> MissionItem:
    """Take ``count`` photos, one every ``interval_s`` seconds.

    ``count`` is at most 65,535; 0 means until :func:`stop_photos`.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_START_CAPTURE
    """
    return action_item(
        MavCmd.IMAGE_START_CAPTURE,
        whole_number("camera", camera, 0, 255),
        in_range("interval_s", interval_s, 0, 86_400),
        whole_number("count", count, 0, 65_535),
    )


def stop_photos(*, camera: int = 0) -> MissionItem:
    """Stop taking photos.

    https://mavlink.io/en/messages/common.html#MAV_CMD_IMAGE_STOP_CAPTURE
    """
    return action_item(MavCmd.IMAGE_STOP_CAPTURE, whole_number("camera", camera, 0, 255))


def start_video(*, stream: int = 0) -> MissionItem:
    """Start recording video; ``stream`` 0 means all streams.

    https://mavlink.io/en/messages/common.html#MAV_CMD_VIDEO_START_CAPTURE
    """
    return action_item(MavCmd.VIDEO_START_CAPTURE, whole_number("stream", stream, 0, 255))


def stop_video(*, stream: int = 0) -> MissionItem:
    """Stop recording video.

    https://mavlink.io/en/messages/common.html#MAV_CMD_VIDEO_STOP_CAPTURE
    """
    return action_item(MavCmd.VIDEO_STOP_CAPTURE, whole_number("stream", stream, 0, 255))


def trigger_camera() -> MissionItem:
    """Trigger a camera that is connected to a servo or relay.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_DIGICAM_CONTROL
    """
    return action_item(MavCmd.DO_DIGICAM_CONTROL).replace(x=1)  # param5 = 1 takes a picture.


@overload
def region_of_interest(
    position: Position | Home,
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
    latitude_deg: Position | Home | float,
    longitude_deg: float | None = None,
    *,
    altitude_relative_m: float | None = None,
    altitude_amsl_m: float | None = None,
    altitude_terrain_m: float | None = None,
) -> MissionItem:
    """Point the gimbal or the nose at a place until :func:`region_of_interest_none`. Needs exactly one altitude.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_LOCATION
    """
    return place_item(
        MavCmd.DO_SET_ROI_LOCATION,
        latitude_deg,
        longitude_deg,
        Altitudes(altitude_relative_m, altitude_amsl_m, altitude_terrain_m),
        is_needed=True,
    )


def region_of_interest_none() -> MissionItem:
    """Stop pointing at a region of interest.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_NONE
    """
    return action_item(MavCmd.DO_SET_ROI_NONE)


def point_gimbal(*, pitch_deg: float = 0.0, roll_deg: float = 0.0, yaw_deg: float = 0.0) -> MissionItem:
    """Point the gimbal at angles of -180 to 180 degrees. Negative pitch is down; yaw is relative to the nose.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_MOUNT_CONTROL
    """
    angles = (("pitch_deg", pitch_deg), ("roll_deg", roll_deg), ("yaw_deg", yaw_deg))
    return action_item(
        MavCmd.DO_MOUNT_CONTROL,
        *(in_range(name, value, -180, 180) for name, value in angles),
        z=float(MavMountMode.MAVLINK_TARGETING),  # `z` is param7, the mode.
    )
