"""Builders for cameras and gimbals: photos, video, where to look.

What cannot be right raises :class:`~aerokit.errors.InvalidArgument` with the argument and what is allowed.
https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavMountMode
from aerokit.missions.places import action, in_range, place, whole

if TYPE_CHECKING:
    from aerokit.missions.item import MissionItem

__all__ = [
    "point_gimbal",
    "region_of_interest",
    "region_of_interest_none",
    "set_camera_trigger_distance",
    "start_video",
    "stop_photos",
    "stop_video",
    "take_photo",
    "take_photos",
    "trigger_camera",
]


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


def region_of_interest(
    latitude_deg: float,
    longitude_deg: float,
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
