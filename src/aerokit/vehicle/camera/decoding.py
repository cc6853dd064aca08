"""What cameras tell, from the messages in which they do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from aerokit.mavlink.enums import (
    CameraCapFlags,
    StorageStatus,
    StorageType,
    VideoStreamEncoding,
    VideoStreamType,
)
from aerokit.mavlink.enums import CameraTrackingMode as Tracking
from aerokit.mavlink.enums import CameraTrackingStatusFlags as TrackingFlags
from aerokit.mavlink.enums import VideoStreamStatusFlags as StreamFlags
from aerokit.position import Position
from aerokit.vehicle.camera.values import (
    MODES,
    CameraInformation,
    CameraStatus,
    Storage,
    ThermalRange,
    TrackedPlace,
    TrackingStatus,
    VideoStream,
)

if TYPE_CHECKING:
    from enum import IntEnum

    from aerokit.mavlink import messages as m

__all__ = [
    "information_of",
    "known",
    "mode_of",
    "place_of",
    "status_of",
    "storage_of",
    "stream_of",
    "thermal_range_of",
    "tracked_place_of",
    "tracking_of",
    "with_status",
]

NOWHERE_DEG = 0.01
CAPTURING, SERIES = (1, 3), (2, 3)
"""Values of CAMERA_CAPTURE_STATUS.image_status."""
T = TypeVar("T", float, int)


def known(value: T) -> T | None:
    """None for NaN and other numbers that are none."""
    return value if math.isfinite(value) else None


def place_of(
    latitude_e7: int, longitude_e7: int, altitude_amsl_m: float, altitude_relative_m: float | None
) -> Position | None:
    """None near 0, 0, or where it is no place on earth: the vehicle did not know."""
    latitude, longitude = latitude_e7 * 1e-7, longitude_e7 * 1e-7
    is_somewhere = abs(latitude) > NOWHERE_DEG or abs(longitude) > NOWHERE_DEG
    if not is_somewhere or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return None
    relative = None if altitude_relative_m is None else known(altitude_relative_m)
    return Position(latitude, longitude, known(altitude_amsl_m), relative)


def information_of(message: m.CameraInformation, number: int) -> CameraInformation:
    """In words."""
    version = message.firmware_version
    return CameraInformation(
        number=number,
        vendor=_text(message.vendor_name),
        model=_text(message.model_name),
        firmware=".".join(str(version >> shift & 0xFF) for shift in (0, 8, 16, 24)) if version else "",
        focal_length_mm=_positive(message.focal_length),
        sensor_width_mm=_positive(message.sensor_size_h),
        sensor_height_mm=_positive(message.sensor_size_v),
        width_px=message.resolution_h or None,
        height_px=message.resolution_v or None,
        lens_id=message.lens_id,
        capabilities=frozenset(each.name.lower() for each in CameraCapFlags if each & message.flags),  # type: ignore[union-attr]
        definition_uri=message.cam_definition_uri,
        definition_version=message.cam_definition_version,
        gimbal_device_id=message.gimbal_device_id or None,
    )


def mode_of(message: m.CameraSettings) -> str:
    """``"unknown"`` for one that the standard does not have."""
    return next((name for name, number in MODES.items() if number == message.mode_id), "unknown")


def status_of(message: m.CameraCaptureStatus) -> CameraStatus:
    """In words."""
    is_recording = message.video_status == 1
    return CameraStatus(
        is_capturing=message.image_status in CAPTURING,
        is_in_series=message.image_status in SERIES,
        interval_s=message.image_interval,
        is_recording=is_recording,
        recording_s=message.recording_time_ms / 1000 if is_recording else None,
        image_count=message.image_count,
        available_mib=known(message.available_capacity),
    )


def storage_of(message: m.StorageInformation) -> Storage:
    """In words."""
    is_ready = message.status == StorageStatus.READY
    total, used, available = (
        known(each) if is_ready else None
        for each in (message.total_capacity, message.used_capacity, message.available_capacity)
    )
    return Storage(
        message.storage_id,
        message.storage_count,
        message.name,
        _name(StorageType, message.type),
        _name(StorageStatus, message.status),
        total,
        used,
        available,
        _positive(message.read_speed),
        _positive(message.write_speed),
    )


def stream_of(message: m.VideoStreamInformation) -> VideoStream:
    """In words."""
    return VideoStream(
        number=message.stream_id or 1,  # MAVSDK's server says 0
        count=message.count,
        name=message.name,
        uri=message.uri,
        kind=_name(VideoStreamType, message.type),
        encoding=_name(VideoStreamEncoding, message.encoding),
        width_px=message.resolution_h,
        height_px=message.resolution_v,
        frames_per_s=message.framerate,
        bitrate=message.bitrate,
        rotation_deg=message.rotation,
        horizontal_fov_deg=message.hfov or None,
        **_flags(message.flags),
    )


def with_status(stream: VideoStream, message: m.VideoStreamStatus) -> VideoStream:
    """The stream as it is now."""
    return stream.replace(
        width_px=message.resolution_h,
        height_px=message.resolution_v,
        frames_per_s=message.framerate,
        bitrate=message.bitrate,
        rotation_deg=message.rotation,
        horizontal_fov_deg=message.hfov or None,
        **_flags(message.flags),
    )


def tracking_of(message: m.CameraTrackingImageStatus) -> TrackingStatus:
    """In words."""
    corners = (message.rec_top_x, message.rec_top_y, message.rec_bottom_x, message.rec_bottom_y)
    is_point, is_rectangle = (
        message.tracking_mode == Tracking.POINT,
        message.tracking_mode == Tracking.RECTANGLE,
    )
    return TrackingStatus(
        is_active=bool(message.tracking_status & TrackingFlags.ACTIVE),
        has_failed=bool(message.tracking_status & TrackingFlags.ERROR),
        is_coasting=bool(message.tracking_status & TrackingFlags.COASTING),
        mode=_name(Tracking, message.tracking_mode),
        point=_point(message.point_x, message.point_y) if is_point else None,
        radius=known(message.radius) if is_point else None,
        rectangle=corners if is_rectangle and all(map(math.isfinite, corners)) else None,
    )


def tracked_place_of(message: m.CameraTrackingGeoStatus) -> TrackedPlace:
    """In words."""
    heading = known(message.hdg)
    return TrackedPlace(
        is_active=bool(message.tracking_status & TrackingFlags.ACTIVE),
        place=place_of(message.lat, message.lon, message.alt, None),
        horizontal_accuracy_m=known(message.h_acc),
        vertical_accuracy_m=known(message.v_acc),
        north_m_s=known(message.vel_n),
        east_m_s=known(message.vel_e),
        down_m_s=known(message.vel_d),
        distance_m=known(message.dist),
        heading_deg=None if heading is None else math.degrees(heading) % 360.0,
    )


def thermal_range_of(message: m.CameraThermalRange) -> ThermalRange:
    """In words."""
    return ThermalRange(
        message.stream_id,
        message.max,
        _point(message.max_point_x, message.max_point_y),
        message.min,
        _point(message.min_point_x, message.min_point_y),
    )


def _flags(flags: int) -> dict[str, bool]:
    return {
        "is_running": bool(flags & StreamFlags.RUNNING),
        "is_thermal": bool(flags & StreamFlags.THERMAL),
        "has_thermal_range": bool(flags & StreamFlags.THERMAL_RANGE_ENABLED),
    }


def _point(x: float, y: float) -> tuple[float, float] | None:
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def _positive(value: float) -> float | None:
    return value if math.isfinite(value) and value > 0 else None


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode(errors="replace").strip()


def _name(enum: type[IntEnum], number: int) -> str:
    try:
        return enum(number).name.lower()
    except ValueError:
        return "unknown"
