"""Values that cameras report: information, status, storage, streams, tracking, temperatures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from aerokit._internal.formatting import enum_name
from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    StorageStatus,
    StorageType,
    VideoStreamEncoding,
    VideoStreamType,
)
from aerokit.mavlink.enums import CameraTrackingMode as Tracking
from aerokit.mavlink.enums import CameraTrackingStatusFlags as TrackingFlags
from aerokit.mavlink.enums import VideoStreamStatusFlags as StreamFlags
from aerokit.position import Position

if TYPE_CHECKING:
    from enum import IntEnum

    from aerokit.mavlink import messages as m

__all__ = [
    "CameraInformation",
    "CameraStatus",
    "CameraStorage",
    "CameraStream",
    "ModeName",
    "ThermalRange",
    "TrackedPlace",
    "TrackingStatus",
]

ModeName = Literal["photo", "video", "survey"]

MODES: dict[str, int] = {
    "photo": CameraMode.IMAGE,
    "video": CameraMode.VIDEO,
    "survey": CameraMode.IMAGE_SURVEY,
}


class CameraInformation(Snapshot):
    """Identity and capabilities of a camera (CAMERA_INFORMATION); unknown texts are empty, unknown numbers None.

    ``number``: 1 to 6 for a camera attached to the autopilot, otherwise its component id. ``firmware`` is
    ``"major.minor.patch.dev"``. ``capabilities`` are CAMERA_CAP_FLAGS in lower case (``"capture_image"``,
    ``"has_basic_zoom"`` …); an empty set means unknown. ``definition_uri`` is the address of the camera definition
    file, ``gimbal_device_id`` the gimbal that carries the camera. Lengths in mm, resolution in pixels.
    """

    number: int
    vendor: str
    model: str
    firmware: str
    focal_length_mm: float | None
    sensor_width_mm: float | None
    sensor_height_mm: float | None
    width_px: int | None
    height_px: int | None
    lens_id: int
    capabilities: frozenset[str]
    definition_uri: str
    definition_version: int
    gimbal_device_id: int | None

    def can(self, *capabilities: str) -> bool:
        """Return True if the camera has one of these capabilities, or reports no capabilities at all."""
        return not self.capabilities or not self.capabilities.isdisjoint(capabilities)


class CameraStatus(Snapshot):
    """Activity of a camera (CAMERA_CAPTURE_STATUS).

    ``is_capturing``: the camera is taking a picture. ``is_in_series``: it takes a picture every ``interval_s`` seconds.
    ``recording_s`` is the duration of the video so far, None if unknown. ``image_count`` counts pictures until the
    camera's log is cleared. ``available_mib`` is the free storage, None if unknown.
    """

    is_capturing: bool
    is_in_series: bool
    interval_s: float
    is_recording: bool
    recording_s: float | None
    image_count: int
    available_mib: float | None


class CameraStorage(Snapshot):
    """One storage medium of a camera (STORAGE_INFORMATION).

    ``status`` is ``"ready"``, ``"empty"`` (no medium), ``"unformatted"``, ``"not_supported"`` or ``"unknown"``. Sizes
    are in MiB, None unless the medium is ready; speeds in MiB/s, None if unknown. ``kind`` is ``"sd"``, ``"microsd"`` …
    """

    number: int
    count: int
    name: str
    kind: str
    status: str
    total_mib: float | None
    used_mib: float | None
    available_mib: float | None
    read_mib_s: float | None
    write_mib_s: float | None


class CameraStream(Snapshot):
    """One video stream of a camera (VIDEO_STREAM_INFORMATION, VIDEO_STREAM_STATUS).

    ``number`` counts from 1. ``uri`` is the stream's address, or for RTP over UDP the port to listen on. ``kind`` is
    ``"rtsp"``, ``"rtpudp"``, ``"tcp_mpeg"``, ``"mpeg_ts"``, ``"whep"`` or ``"unknown"``. ``encoding`` is ``"h264"``,
    ``"h265"`` or ``"unknown"``. ``bitrate`` is in bits per second, ``rotation_deg`` is clockwise, and
    ``horizontal_fov_deg`` is None if unknown.
    """

    number: int
    count: int
    name: str
    uri: str
    kind: str
    encoding: str
    width_px: int
    height_px: int
    frames_per_s: float
    bitrate: int
    rotation_deg: int
    horizontal_fov_deg: int | None
    is_running: bool
    is_thermal: bool
    has_thermal_range: bool


class TrackingStatus(Snapshot):
    """Tracking in the image (CAMERA_TRACKING_IMAGE_STATUS); coordinates are 0 to 1 from the left and the top.

    ``mode`` is ``"none"``, ``"point"``, ``"rectangle"`` or ``"unknown"``. ``point`` is (x, y), ``radius`` is a fraction
    of the image width, and ``rectangle`` is (left, top, right, bottom). ``has_failed`` is True if the tracked object
    was lost.
    """

    is_active: bool
    has_failed: bool
    is_coasting: bool
    mode: str
    point: tuple[float, float] | None
    radius: float | None
    rectangle: tuple[float, float, float, float] | None


class TrackedPlace(Snapshot):
    """Position on earth of the object that a camera tracks (CAMERA_TRACKING_GEO_STATUS); unknown values are None.

    Velocities are north, east and down, ``distance_m`` is from the camera, and ``heading_deg`` is 0 to 360 from north.
    """

    is_active: bool
    place: Position | None
    horizontal_accuracy_m: float | None
    vertical_accuracy_m: float | None
    north_m_s: float | None
    east_m_s: float | None
    down_m_s: float | None
    distance_m: float | None
    heading_deg: float | None


class ThermalRange(Snapshot):
    """Coldest and hottest point of a thermal image (CAMERA_THERMAL_RANGE).

    Temperatures are in °C, coordinates are fractions of the image from 0 to 1.
    """

    stream: int
    max_celsius: float
    max_at: tuple[float, float] | None
    min_celsius: float
    min_at: tuple[float, float] | None


# If a position is closer than this to 0°N 0°E in both coordinates, the vehicle did not know its position.
MIN_COORDINATE_DEG = 0.01

# Values of CAMERA_CAPTURE_STATUS.image_status while a picture is being taken, and while a series runs.
CAPTURING, SERIES = (1, 3), (2, 3)

T = TypeVar("T", float, int)


def finite_or_none(value: T) -> T | None:
    return value if math.isfinite(value) else None


def place_of(
    latitude_e7: int, longitude_e7: int, altitude_amsl_m: float, altitude_relative_m: float | None
) -> Position | None:
    """Decode a position. Returns None if it is invalid or unknown."""
    latitude, longitude = latitude_e7 * 1e-7, longitude_e7 * 1e-7
    is_unknown = abs(latitude) <= MIN_COORDINATE_DEG and abs(longitude) <= MIN_COORDINATE_DEG
    if is_unknown or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return None
    relative = None if altitude_relative_m is None else finite_or_none(altitude_relative_m)
    return Position(latitude, longitude, finite_or_none(altitude_amsl_m), relative)


def information_of(message: m.CameraInformation, number: int) -> CameraInformation:
    # Major, minor, patch and dev version, one byte each, lowest byte first.
    version = message.firmware_version
    numbers = [(version >> shift) & 0xFF for shift in (0, 8, 16, 24)]
    firmware = ".".join(map(str, numbers)) if version else ""
    return CameraInformation(
        number=number,
        vendor=_text(message.vendor_name),
        model=_text(message.model_name),
        firmware=firmware,
        focal_length_mm=_positive(message.focal_length),
        sensor_width_mm=_positive(message.sensor_size_h),
        sensor_height_mm=_positive(message.sensor_size_v),
        width_px=message.resolution_h or None,
        height_px=message.resolution_v or None,
        lens_id=message.lens_id,
        capabilities=frozenset(flag.name.lower() for flag in CameraCapFlags if flag & message.flags),  # type: ignore[union-attr]
        definition_uri=message.cam_definition_uri,
        definition_version=message.cam_definition_version,
        gimbal_device_id=message.gimbal_device_id or None,
    )


def mode_of(message: m.CameraSettings) -> str:
    return next((name for name, number in MODES.items() if number == message.mode_id), "unknown")


def status_of(message: m.CameraCaptureStatus) -> CameraStatus:
    is_recording = message.video_status == 1
    return CameraStatus(
        is_capturing=message.image_status in CAPTURING,
        is_in_series=message.image_status in SERIES,
        interval_s=message.image_interval,
        is_recording=is_recording,
        recording_s=message.recording_time_ms / 1000 if is_recording else None,
        image_count=message.image_count,
        available_mib=finite_or_none(message.available_capacity),
    )


def storage_of(message: m.StorageInformation) -> CameraStorage:
    is_ready = message.status == StorageStatus.READY  # Only a ready storage has valid sizes.
    return CameraStorage(
        number=message.storage_id,
        count=message.storage_count,
        name=message.name,
        kind=_name(StorageType, message.type),
        status=_name(StorageStatus, message.status),
        total_mib=finite_or_none(message.total_capacity) if is_ready else None,
        used_mib=finite_or_none(message.used_capacity) if is_ready else None,
        available_mib=finite_or_none(message.available_capacity) if is_ready else None,
        read_mib_s=_positive(message.read_speed),
        write_mib_s=_positive(message.write_speed),
    )


def stream_of(message: m.VideoStreamInformation) -> CameraStream:
    return CameraStream(
        number=message.stream_id or 1,  # MAVSDK's camera server sends 0.
        count=message.count,
        name=message.name,
        uri=message.uri,
        kind=_name(VideoStreamType, message.type),
        encoding=_name(VideoStreamEncoding, message.encoding),
        **stream_state(message),
    )


def stream_state(message: m.VideoStreamInformation | m.VideoStreamStatus) -> dict[str, Any]:
    """Return the fields of a CameraStream that may change while the stream runs."""
    return {
        "width_px": message.resolution_h,
        "height_px": message.resolution_v,
        "frames_per_s": message.framerate,
        "bitrate": message.bitrate,
        "rotation_deg": message.rotation,
        "horizontal_fov_deg": message.hfov or None,
        "is_running": bool(message.flags & StreamFlags.RUNNING),
        "is_thermal": bool(message.flags & StreamFlags.THERMAL),
        "has_thermal_range": bool(message.flags & StreamFlags.THERMAL_RANGE_ENABLED),
    }


def tracking_of(message: m.CameraTrackingImageStatus) -> TrackingStatus:
    corners = (message.rec_top_x, message.rec_top_y, message.rec_bottom_x, message.rec_bottom_y)
    is_point = message.tracking_mode == Tracking.POINT
    is_rectangle = message.tracking_mode == Tracking.RECTANGLE
    return TrackingStatus(
        is_active=bool(message.tracking_status & TrackingFlags.ACTIVE),
        has_failed=bool(message.tracking_status & TrackingFlags.ERROR),
        is_coasting=bool(message.tracking_status & TrackingFlags.COASTING),
        mode=_name(Tracking, message.tracking_mode),
        point=_point(message.point_x, message.point_y) if is_point else None,
        radius=finite_or_none(message.radius) if is_point else None,
        rectangle=corners if is_rectangle and all(map(math.isfinite, corners)) else None,
    )


def tracked_place_of(message: m.CameraTrackingGeoStatus) -> TrackedPlace:
    heading = finite_or_none(message.hdg)
    return TrackedPlace(
        is_active=bool(message.tracking_status & TrackingFlags.ACTIVE),
        place=place_of(message.lat, message.lon, message.alt, altitude_relative_m=None),
        horizontal_accuracy_m=finite_or_none(message.h_acc),
        vertical_accuracy_m=finite_or_none(message.v_acc),
        north_m_s=finite_or_none(message.vel_n),
        east_m_s=finite_or_none(message.vel_e),
        down_m_s=finite_or_none(message.vel_d),
        distance_m=finite_or_none(message.dist),
        heading_deg=None if heading is None else math.degrees(heading) % 360.0,
    )


def thermal_range_of(message: m.CameraThermalRange) -> ThermalRange:
    return ThermalRange(
        stream=message.stream_id,
        max_celsius=message.max,
        max_at=_point(message.max_point_x, message.max_point_y),
        min_celsius=message.min,
        min_at=_point(message.min_point_x, message.min_point_y),
    )


def _point(x: float, y: float) -> tuple[float, float] | None:
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def _positive(value: float) -> float | None:
    return value if math.isfinite(value) and value > 0 else None


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode(errors="replace").strip()


def _name(enum: type[IntEnum], number: int) -> str:
    return enum_name(enum, number, "unknown").lower()
