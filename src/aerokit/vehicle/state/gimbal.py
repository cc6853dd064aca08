"""Where a gimbal points, from the three messages that tell it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import GimbalDeviceFlags
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus, MountOrientation, MountStatus

__all__ = ["GimbalAttitude", "from_device", "from_orientation", "from_status"]

YAW_LOCK = GimbalDeviceFlags.YAW_LOCK.value
YAW_IN_VEHICLE_FRAME = GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME.value
YAW_IN_EARTH_FRAME = GimbalDeviceFlags.YAW_IN_EARTH_FRAME.value
STRAIGHT = 0.99999
"""Sine of a pitch at which roll and yaw turn about the same axis."""


class GimbalAttitude(Snapshot):
    """Where it points, in degrees, None for what is not told: ``pitch_deg`` (0 level, −90 straight down) and
    ``roll_deg`` from the horizon, ``yaw_deg`` 0 to 360 clockwise from north, ``yaw_from_nose_deg`` −180 to 180
    clockwise from the vehicle's nose.

    While the vehicle's heading is not known, the yaw of a gimbal that tells it so is from the nose; of MOUNT_STATUS
    (ArduPilot before 4.3) it is that number, whatever it counts from.
    """

    pitch_deg: float | None
    roll_deg: float | None
    yaw_deg: float | None
    yaw_from_nose_deg: float | None = None


def from_status(message: MountStatus) -> GimbalAttitude:
    """Of MOUNT_STATUS: the numbers as they are."""
    return GimbalAttitude(message.pointing_a / 100.0, message.pointing_b / 100.0, message.pointing_c / 100.0)


def from_orientation(message: MountOrientation, heading: float | None) -> GimbalAttitude:
    """Of MOUNT_ORIENTATION; its yaw is the vehicle's, and the one from north may be missing in it.

    ``heading``: where the vehicle's nose points, degrees; while it is not known, yaw is from there.
    """
    if message.yaw_absolute and math.isfinite(message.yaw_absolute):
        yaw = _compass(message.yaw_absolute)
    elif heading is not None:
        yaw = _compass(message.yaw + heading)
    else:
        yaw = _known(message.yaw)
    return GimbalAttitude(_known(message.pitch), _known(message.roll), yaw, _turned(message.yaw))


def from_device(message: GimbalDeviceAttitudeStatus, heading: float | None) -> GimbalAttitude:
    """Of GIMBAL_DEVICE_ATTITUDE_STATUS.

    ``heading``: where the vehicle's nose points, degrees, for a gimbal that tells its yaw from there and does not
    tell what is in between; while neither is known, yaw is from the nose.
    """
    pitch, roll, yaw = _euler(message.q)
    tells_delta = message.flags & (YAW_IN_VEHICLE_FRAME | YAW_IN_EARTH_FRAME) and math.isfinite(
        message.delta_yaw
    )
    if tells_delta and message.delta_yaw:  # 0 is also what PX4 says when it does not know
        nose: float | None = math.degrees(message.delta_yaw)
    else:
        nose = heading
    angles = (_known(pitch), _known(roll))
    if not _is_from_nose(message.flags):
        return GimbalAttitude(*angles, _compass(yaw), None if nose is None else _turned(yaw - nose))
    from_north = _known(yaw) if nose is None else _compass(yaw + nose)
    return GimbalAttitude(*angles, from_north, _turned(yaw))


def _is_from_nose(flags: int) -> bool:
    if flags & (YAW_IN_VEHICLE_FRAME | YAW_IN_EARTH_FRAME):
        return not flags & YAW_IN_EARTH_FRAME
    return not flags & YAW_LOCK


def _euler(q: tuple[float, ...]) -> tuple[float, float, float]:
    """Pitch, roll, yaw in degrees; of a camera that looks straight up or down all turning is yaw."""
    length = math.sqrt(sum(each * each for each in q))
    if not length > 0:
        return math.nan, math.nan, math.nan
    w, x, y, z = (each / length for each in q)
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    if abs(sine) > STRAIGHT:
        return (
            math.degrees(math.asin(sine)),
            0.0,
            math.degrees(-2 * math.copysign(1, sine) * math.atan2(x, w)),
        )
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return math.degrees(math.asin(sine)), math.degrees(roll), math.degrees(yaw)


def _known(degrees: float) -> float | None:
    """To hundredths, as MOUNT_STATUS has them: the noise of 32 bits is not worth showing."""
    return round(degrees, 2) + 0.0 if math.isfinite(degrees) else None


def _turned(degrees: float) -> float | None:
    return round(math.remainder(degrees, 360.0), 2) + 0.0 if math.isfinite(degrees) else None


def _compass(degrees: float) -> float | None:
    return round(degrees % 360.0, 2) % 360.0 if math.isfinite(degrees) else None
