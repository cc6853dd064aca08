"""``Capture``: one picture that was taken, from the three messages that tell of one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.position import Position
from aerokit.snapshot import Snapshot
from aerokit.vehicle.camera.decoding import known, place_of

if TYPE_CHECKING:
    from aerokit.mavlink.messages import CameraFeedback, CameraImageCaptured, CameraTrigger
    from aerokit.vehicle.state.telemetry import Telemetry

__all__ = [
    "LAST_SECOND",
    "SECONDS_IN_1990",
    "WRAPS",
    "Capture",
    "from_feedback",
    "from_image",
    "from_trigger",
]

Quaternion = tuple[float, float, float, float]
SECONDS_IN_1990 = 631_152_000
"""A time stamp below this counts from the vehicle's boot."""
LAST_SECOND = 253_402_300_799
"""The last one of the year 9999, with which calendars end."""
WRAPS = 1 << 16
"""CAMERA_FEEDBACK counts in 16 bits."""
STRAIGHT = 0.99999
"""Sine of a pitch at which roll and yaw turn about the same axis."""


class Capture(Snapshot):
    """One picture. None, or an empty text, is what was not told.

    - ``camera``: 1 to 6 behind the autopilot, otherwise the camera's component id; ``index`` counts from 0
    - ``success``: False when the camera could not take it; None when nobody said (CAMERA_TRIGGER)
    - ``heard_at``: when we heard of it, on the loop's clock; ``taken_at``: seconds since 1970
    - ``place``, and how the camera lay: ``quaternion`` (w, x, y, z), angles from the horizon and from north
    - ``file_url``: where the file is: ``mftp:///…`` on the camera itself, or ``http://…``
    """

    camera: int
    index: int
    success: bool | None
    heard_at: float
    taken_at: float | None
    place: Position | None
    quaternion: tuple[float, float, float, float] | None
    roll_deg: float | None
    pitch_deg: float | None
    yaw_deg: float | None
    file_url: str


def from_image(message: CameraImageCaptured, camera: int, heard_at: float) -> Capture:
    """Of CAMERA_IMAGE_CAPTURED, the standard's."""
    q = message.q
    length = math.sqrt(sum(each * each for each in q))
    quaternion = (q[0], q[1], q[2], q[3]) if math.isfinite(length) and length > 0 else None
    roll, pitch, yaw = (None, None, None) if quaternion is None else _euler(quaternion)
    place = place_of(message.lat, message.lon, message.alt / 1000, message.relative_alt / 1000)
    taken_at = _utc(message.time_utc)
    success = message.capture_result == 1
    return Capture(
        camera,
        message.image_index,
        success,
        heard_at,
        taken_at,
        place,
        quaternion,
        roll,
        pitch,
        yaw,
        message.file_url,
    )


def from_feedback(message: CameraFeedback, camera: int, heard_at: float) -> Capture:
    """Of CAMERA_FEEDBACK, ArduPilot's, which counts from 1."""
    roll, pitch, yaw = _angles(message.roll, message.pitch, message.yaw)
    return Capture(
        camera,
        (message.img_idx - 1) % WRAPS,
        True,
        heard_at,
        _utc(message.time_usec),
        place_of(message.lat, message.lng, message.alt_msl, message.alt_rel),
        _quaternion_of(roll, pitch, yaw),
        roll,
        pitch,
        yaw,
        "",
    )


def from_trigger(message: CameraTrigger, camera: int, heard_at: float, telemetry: Telemetry) -> Capture:
    """Of CAMERA_TRIGGER, PX4's, which tells no place: the vehicle's own is taken."""
    position, attitude = telemetry.position.latest, telemetry.attitude.latest
    roll, pitch, yaw = (
        (None, None, None)
        if attitude is None
        else _angles(attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg)
    )
    return Capture(
        camera,
        message.seq,
        None,
        heard_at,
        _utc(message.time_usec),
        None
        if position is None
        else Position(
            position.latitude_deg,
            position.longitude_deg,
            position.altitude_amsl_m,
            position.altitude_relative_m,
        ),
        _quaternion_of(roll, pitch, yaw),
        roll,
        pitch,
        yaw,
        "",
    )


def _utc(microseconds: int) -> float | None:
    seconds = microseconds / 1e6
    return seconds if SECONDS_IN_1990 <= seconds < LAST_SECOND else None


def _angles(roll: float, pitch: float, yaw: float) -> tuple[float | None, float | None, float | None]:
    """Those that are numbers."""
    return known(roll), known(pitch), known(yaw % 360.0)


def _quaternion_of(roll: float | None, pitch: float | None, yaw: float | None) -> Quaternion | None:
    """Of angles in degrees, if all are known."""
    if roll is None or pitch is None or yaw is None:
        return None
    return _quaternion(math.radians(roll), math.radians(pitch), math.radians(yaw))


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(each / 2), math.sin(each / 2)) for each in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _euler(quaternion: Quaternion) -> tuple[float, float, float]:
    """Roll, pitch, yaw in degrees; of a camera that looks straight up or down all turning is yaw."""
    length = math.sqrt(sum(each * each for each in quaternion))
    w, x, y, z = (each / length for each in quaternion)
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    if abs(sine) > STRAIGHT:
        roll, yaw = 0.0, -2 * math.copysign(1, sine) * math.atan2(x, w)
    else:
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return (
        _round(math.degrees(roll)),
        _round(math.degrees(math.asin(sine))),
        _round(math.degrees(yaw) % 360.0),
    )


def _round(degrees: float) -> float:
    """The noise of 32 bits is not worth showing."""
    return round(degrees, 3) + 0.0
