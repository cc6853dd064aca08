"""What cameras tell, as values: information, status, storage, streams, tracking, temperatures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from aerokit.mavlink.enums import CameraMode
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.position import Position

__all__ = [
    "MODES",
    "CameraInformation",
    "CameraStatus",
    "ModeName",
    "Storage",
    "ThermalRange",
    "TrackedPlace",
    "TrackingStatus",
    "VideoStream",
]

ModeName = Literal["photo", "video", "survey"]
MODES: dict[str, int] = {
    "photo": CameraMode.IMAGE,
    "video": CameraMode.VIDEO,
    "survey": CameraMode.IMAGE_SURVEY,
}


class CameraInformation(Snapshot):
    """What a camera is (CAMERA_INFORMATION); texts are empty and numbers None where it tells nothing.

    ``number``: 1 to 6 for a camera behind the autopilot, otherwise its component id. ``firmware`` is
    ``"major.minor.patch.dev"``. ``capabilities`` are CAMERA_CAP_FLAGS in small letters (``"capture_image"``,
    ``"has_basic_zoom"`` …); an empty set tells nothing. ``definition_uri`` is where its settings are described,
    ``gimbal_device_id`` the gimbal that it hangs on. Lengths in mm, resolution in pixels.
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
        """Whether it says that it has one of these, or says nothing about what it can."""
        return not self.capabilities or not self.capabilities.isdisjoint(capabilities)


class CameraStatus(Snapshot):
    """What a camera does (CAMERA_CAPTURE_STATUS).

    ``is_capturing``: a picture is being taken; ``is_in_series``: one follows the other, every ``interval_s`` seconds.
    ``recording_s`` is how long the video has been recorded for, None where that is not told. ``image_count`` counts
    pictures until the log of them is cleared. ``available_mib`` is what is left of the storage, None if not told.
    """

    is_capturing: bool
    is_in_series: bool
    interval_s: float
    is_recording: bool
    recording_s: float | None
    image_count: int
    available_mib: float | None


class Storage(Snapshot):
    """One storage medium of a camera (STORAGE_INFORMATION).

    ``status`` is ``"ready"``, ``"empty"`` (no medium), ``"unformatted"`` or ``"not_supported"``; sizes in MiB are None
    unless it is ready, speeds in MiB/s where they are not told. ``kind`` is ``"sd"``, ``"microsd"`` …
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


class VideoStream(Snapshot):
    """One video stream of a camera (VIDEO_STREAM_INFORMATION, VIDEO_STREAM_STATUS).

    ``number`` counts from 1. ``uri`` is where to fetch it, or for RTP over UDP the port to listen at. ``kind`` is
    ``"rtsp"``, ``"rtpudp"``, ``"tcp_mpeg"``, ``"mpeg_ts"`` or ``"whep"``, ``encoding`` ``"h264"``, ``"h265"`` or
    ``"unknown"``. ``bitrate`` in bits per second, ``rotation_deg`` clockwise, ``horizontal_fov_deg`` None if not told.
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
    """What a camera tracks in its picture (CAMERA_TRACKING_IMAGE_STATUS); places 0 to 1 from the left and the top.

    ``mode`` is ``"none"``, ``"point"`` or ``"rectangle"``; ``point`` is (x, y) and ``radius`` a part of the picture's
    width, ``rectangle`` (left, top, right, bottom). ``has_failed``: it has lost what it tracked.
    """

    is_active: bool
    has_failed: bool
    is_coasting: bool
    mode: str
    point: tuple[float, float] | None
    radius: float | None
    rectangle: tuple[float, float, float, float] | None


class TrackedPlace(Snapshot):
    """Where on earth it is that a camera tracks (CAMERA_TRACKING_GEO_STATUS); None is not known.

    Velocities to the north, east and down; ``distance_m`` from the camera; ``heading_deg`` 0 to 360 from north.
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
    """The coldest and the hottest point of a thermal picture (CAMERA_THERMAL_RANGE): °C, places 0 to 1."""

    stream: int
    max_celsius: float
    max_at: tuple[float, float] | None
    min_celsius: float
    min_at: tuple[float, float] | None
