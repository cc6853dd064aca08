"""``CameraDevice``: the interface between a camera and its protocol server, with captures and tracking."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, CameraMode, CameraSource, CameraTrackingMode, MavResult
from aerokit.mavlink.enums import CameraTrackingStatusFlags as Flags
from aerokit.mavlink.enums import CameraTrackingTargetData as Target
from aerokit.mavlink.messages import CameraCaptureStatus, CameraImageCaptured

if TYPE_CHECKING:
    from aerokit.protocols.servers.commands import ReceivedCommand
    from aerokit.protocols.servers.host import ServerHost

_IDLE, _CAPTURING, _WAITING, _WAITING_AND_CAPTURING = 0, 1, 2, 3
_UNLIMITED = -1

MIN_STATUS_INTERVAL_S = 0.02
"""Minimum seconds between two CAMERA_CAPTURE_STATUS messages, even if a client requests a higher rate."""

UNKNOWN_ATTITUDE = (math.nan, math.nan, math.nan, math.nan)
"""Quaternion of CAMERA_IMAGE_CAPTURED for an unknown attitude."""


class CameraDevice:
    """Base class of a camera: its state, and the methods that the protocol server calls.

    A subclass implements the methods. To refuse a command, a method raises an exception, which becomes the command's
    result.
    """

    host: ServerHost
    """The component that serves the camera."""
    vendor: str = "aerokit"
    model: str = "camera"
    firmware_version: int = 1 << 24
    definition_version: int = 0
    definition_uri: str = ""
    resolution: tuple[int, int] = (0, 0)
    sensor_mm: tuple[float, float] = (math.nan, math.nan)
    focal_length_mm: float = math.nan
    streams: tuple[str, ...] = ()
    stream_size: tuple[int, int] = (1920, 1080)
    stream_hz: float = 30.0
    stream_bits_s: int = 4_000_000
    thermal_celsius: tuple[float, float] | None = None
    capabilities: int = 0
    """Capabilities of the camera (CAMERA_CAP_FLAGS)."""
    max_images: int = 10_000
    """Maximum number of images in the image log."""
    shutter_s: float = 0.0
    """Minimum time between two images of a series."""
    mode: int = CameraMode.IMAGE
    source: int = CameraSource.DEFAULT

    def set_up_captures(self) -> None:
        """Create the image log and the tracking; call this once."""
        self.captures: Captures = Captures(self)
        self.tracking: Tracking = Tracking(self)
        self.running_streams: set[int] = set()
        """Numbers of the active streams, starting at 1."""

    def can(self, *flags: int) -> bool:
        """Return True if the camera has one of these CAMERA_CAP_FLAGS."""
        return any(self.capabilities & flag for flag in flags)

    @property
    def zoom(self) -> float:
        """Zoom in percent; NaN if unknown."""
        return math.nan

    @property
    def focus(self) -> float:
        """Focus in percent; NaN if unknown."""
        return math.nan

    @property
    def free_mib(self) -> float:
        """Free space for images and videos, in MiB."""
        return math.inf

    @property
    def gimbal_device_id(self) -> int:
        """Component id of the gimbal that carries the camera; 0 if there is none."""
        return 0

    def expose(self, done: Callable[[CameraImageCaptured | None], None]) -> None:
        """Take an image, then call ``done`` with the image, or with None after a failure.

        The caller sets the image's index, result and URL.
        """
        raise NotImplementedError

    def failed_image(self) -> CameraImageCaptured:
        return CameraImageCaptured(
            time_boot_ms=self.host.time_boot_ms, time_utc=0, camera_id=0, lat=0, lon=0, alt=0, relative_alt=0,
            q=UNKNOWN_ATTITUDE, image_index=0, capture_result=0, file_url="",
        )  # fmt: skip

    def has_space(self) -> bool:
        """Return True if another image fits."""
        return self.free_mib > 0

    def store_image(self, image: CameraImageCaptured) -> str | None:
        """Store an image and return its URL; empty if images have no URL, None if the image cannot be stored."""
        return ""

    def storage(self, number: int) -> list[m.StorageInformation]:
        """Return STORAGE_INFORMATION for one storage, or for all storages if ``number`` is 0."""
        return []

    def tracked_place(self) -> list[m.CameraTrackingGeoStatus]:
        """Return CAMERA_TRACKING_GEO_STATUS; empty if unknown."""
        return []

    async def start_video(self) -> None:
        """Begin to record."""

    async def stop_video(self) -> None:
        """End the recording."""

    async def set_mode(self, mode: int) -> None:
        """Set the CAMERA_MODE. The protocol server has already checked the value."""

    async def set_zoom(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_ZOOM. Return False if ``kind`` (CAMERA_ZOOM_TYPE) or ``value`` is not supported."""
        return False

    async def set_focus(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_FOCUS. Return False if ``kind`` (SET_FOCUS_TYPE) or ``value`` is not supported."""
        return False

    async def set_source(self, source: int) -> bool:
        """Show another sensor (CAMERA_SOURCE); return False if there is no such sensor."""
        return source == CameraSource.DEFAULT

    async def switch_stream(self, numbers: set[int], *, on: bool) -> None:
        """Start or stop video streams."""

    async def track(self, place: tuple[float, ...]) -> None:
        """Track a point (x, y, radius) or a rectangle (left, top, right, bottom), or stop tracking (empty tuple).

        The numbers are fractions of the image.
        """

    async def format_storage(self) -> None:
        """Erase images and videos."""

    async def reset_settings(self) -> None:
        """Restore the default settings."""


class Captures:
    """Takes single images and series, records videos, and keeps the image log.

    The next image begins when the device has finished the previous image.
    """

    def __init__(self, camera: CameraDevice) -> None:
        self._camera = camera
        self.images: list[CameraImageCaptured] = []
        """The image log: the latest images since it was cleared, at most ``max_images``."""
        self.dropped_count: int = 0
        """Number of images that the log has dropped. It is also the index of the first image in the log."""
        self.interval_s: float = 0.0
        """Seconds between two images of the current series."""
        self._remaining = 0  # number of images of the series that are still to be taken; -1 if unlimited
        self._is_exposing = False  # True while an image is being taken
        self._is_late = False  # True if the next image is due, but the previous one is not finished
        self._series = 0  # number of the series; callbacks of earlier series are ignored
        self._recording_since: float | None = None  # start of the video; None while there is no video

    def switch_off(self) -> None:
        """End the series and the video at once, as a power failure does. The image log is kept."""
        self._remaining = 0
        self._is_exposing = False
        self._is_late = False
        self._recording_since = None
        self._series += 1

    @property
    def is_busy(self) -> bool:
        return self._is_exposing or self._remaining != 0

    @property
    def is_recording(self) -> bool:
        return self._recording_since is not None

    def take(self) -> None:
        self.take_series(interval_s=0.0, count=1)

    def take_series(self, interval_s: float, count: int) -> None:
        """Take ``count`` images, one every ``interval_s`` seconds.

        The first image is taken at once. With a count of 0, the series continues until `stop`.
        """
        self.interval_s = interval_s if count != 1 else 0.0
        self._remaining = count or _UNLIMITED
        self._is_late = False
        self._series += 1
        self._begin_image(self._series)

    def stop(self) -> None:
        """End the series. An image that is being taken is still completed."""
        self._remaining = 0

    def clear(self) -> None:
        self.images.clear()
        self.dropped_count = 0

    @property
    def image_count(self) -> int:
        """Number of images since the image log was cleared. It is also the next image index."""
        return self.dropped_count + len(self.images)

    def between(self, first: int, last: int | None) -> list[CameraImageCaptured]:
        """Return the logged images from index ``first`` to ``last``, or to the newest image if ``last`` is None."""
        end = None if last is None else max(0, last + 1 - self.dropped_count)
        return self.images[max(0, first - self.dropped_count) : end]

    def _begin_image(self, series: int) -> None:
        camera = self._camera
        if series != self._series or self._remaining == 0:  # The series was replaced, or has ended.
            return
        if self._is_exposing:
            self._is_late = True
            return
        if self._remaining != _UNLIMITED:
            self._remaining -= 1
        self._is_exposing = True
        camera.expose(lambda image: self._finish_image(series, image))
        if self._remaining:
            wait_s = max(self.interval_s, camera.shutter_s)
            camera.host.call_later(wait_s, lambda: self._begin_image(series))

    def _finish_image(self, series: int, taken: CameraImageCaptured | None) -> None:
        """Log and announce an image. None means that the device failed to take it."""
        if series != self._series:  # The camera was switched off in the meantime.
            return
        self._is_exposing = False
        camera, index = self._camera, self.image_count
        image = _changed(taken or camera.failed_image(), image_index=index, capture_result=1)
        url = None if taken is None else camera.store_image(image)
        if url is None:
            self.stop()
            image = _changed(image, capture_result=0)
        else:
            image = _changed(image, file_url=url)
            self.images.append(image)
            if len(self.images) > camera.max_images:
                del self.images[0]
                self.dropped_count += 1
        camera.host.send(image)
        if not self._remaining:
            camera.host.send(self.status())
        elif self._is_late:
            self._is_late = False
            self._begin_image(series)

    def record(self, status_interval_s: float) -> None:
        """Register the start of a video. Send CAMERA_CAPTURE_STATUS now and, if the interval is not 0, periodically."""
        self._recording_since = self._camera.host.now
        self._camera.host.send(self.status())
        if 0.0 < status_interval_s < math.inf:
            self._send_status_every(self._recording_since, max(MIN_STATUS_INTERVAL_S, status_interval_s))

    def stop_recording(self) -> float:
        """Register the end of the video, and return its length in seconds.

        The length is 0 if no video was being recorded.
        """
        seconds = self._recording_s
        self._recording_since = None
        return seconds

    @property
    def _recording_s(self) -> float:
        return 0.0 if self._recording_since is None else self._camera.host.now - self._recording_since

    def _send_status_every(self, recording_since: float, interval_s: float) -> None:
        def send_status() -> None:
            if self._recording_since == recording_since:  # Another value means that this video has ended.
                self._camera.host.send(self.status())
                self._send_status_every(recording_since, interval_s)

        self._camera.host.call_later(interval_s, send_status)

    def status(self) -> CameraCaptureStatus:
        camera = self._camera
        is_series = self._remaining != 0 and self.interval_s > 0.0
        if is_series:
            image_status = _WAITING_AND_CAPTURING if self._is_exposing else _WAITING
        else:
            image_status = _CAPTURING if self._is_exposing else _IDLE
        return CameraCaptureStatus(
            time_boot_ms=camera.host.time_boot_ms, image_status=image_status, video_status=int(self.is_recording),
            image_interval=self.interval_s if is_series else 0.0, recording_time_ms=round(self._recording_s * 1000),
            available_capacity=camera.free_mib, image_count=self.image_count,
        )  # fmt: skip


def _changed(image: CameraImageCaptured, **fields: Any) -> CameraImageCaptured:
    return CameraImageCaptured(**{**image.to_dict(), **fields})


_UNKNOWN = math.nan


class Tracking:
    """Tracking of a point or a rectangle in the image. ``lose()`` simulates the loss of the target."""

    def __init__(self, camera: CameraDevice) -> None:
        self._camera = camera
        self.reset()

    def reset(self) -> None:
        self.mode: CameraTrackingMode = CameraTrackingMode.NONE
        self.place: tuple[float, ...] = ()
        """x, y and radius of a point, or left, top, right and bottom of a rectangle, as fractions of the image."""
        self.is_lost: bool = False

    def lose(self) -> None:
        self.is_lost = True

    async def track_point(self, command: ReceivedCommand) -> int:
        place = (command.param1, command.param2, command.param3)
        return await self._track(CameraCapFlags.HAS_TRACKING_POINT, CameraTrackingMode.POINT, place)

    async def track_rectangle(self, command: ReceivedCommand) -> int:
        place = (command.param1, command.param2, command.param3, command.param4)
        return await self._track(CameraCapFlags.HAS_TRACKING_RECTANGLE, CameraTrackingMode.RECTANGLE, place)

    async def _track(self, capability: int, mode: CameraTrackingMode, place: tuple[float, ...]) -> int:
        if not self._camera.can(capability):
            return MavResult.UNSUPPORTED
        if not all(0.0 <= share <= 1.0 for share in place):
            return MavResult.DENIED
        await self._camera.track(place)
        self.mode = mode
        self.place = place
        self.is_lost = False
        return MavResult.ACCEPTED

    async def stop(self, _: ReceivedCommand) -> int:
        if not self._camera.can(CameraCapFlags.HAS_TRACKING_POINT, CameraCapFlags.HAS_TRACKING_RECTANGLE):
            return MavResult.UNSUPPORTED
        await self._camera.track(())
        self.reset()
        return MavResult.ACCEPTED

    @property
    def flags(self) -> int:
        """CAMERA_TRACKING_STATUS_FLAGS of the tracking."""
        if self.mode == CameraTrackingMode.NONE:
            return 0
        return Flags.ERROR if self.is_lost else Flags.ACTIVE

    def image_status(self) -> m.CameraTrackingImageStatus:
        is_point = self.mode == CameraTrackingMode.POINT
        x, y, radius = self.place if is_point else (_UNKNOWN,) * 3
        is_rectangle = self.mode == CameraTrackingMode.RECTANGLE
        left, top, right, bottom = self.place if is_rectangle else (_UNKNOWN,) * 4
        return m.CameraTrackingImageStatus(
            tracking_status=self.flags, tracking_mode=int(self.mode), target_data=Target.IN_STATUS, point_x=x,
            point_y=y, radius=radius, rec_top_x=left, rec_top_y=top, rec_bottom_x=right, rec_bottom_y=bottom,
        )  # fmt: skip
