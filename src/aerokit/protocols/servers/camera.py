"""Camera protocol: the device, its messages and its commands (https://mavlink.io/en/services/camera.html)."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Iterable
from functools import partial
from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    CameraSource,
    VideoStreamEncoding,
    VideoStreamStatusFlags,
    VideoStreamType,
)
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CameraImageCaptured
from aerokit.protocols.servers.captures import Captures, Shot, Tracking
from aerokit.protocols.servers.commands import ReceivedCommand, whole
from aerokit.protocols.servers.host import ServerHost
from aerokit.protocols.servers.intervals import Builder

# Handlers are coroutines, because a device may need time; those of a simulated device never suspend.
AsyncHandler = Callable[[ReceivedCommand], Coroutine[Any, Any, int]]

_NOWHERE = (math.nan, math.nan, math.nan, math.nan)
_TO_THE_END = -1


class CameraDevice:
    """A camera: its state, and methods that the protocol calls. Subclasses execute them.

    Methods that are refused raise an error; the command is answered with it.
    """

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
    """CAMERA_CAP_FLAGS."""
    max_images: int = 10_000
    """Images that the image log holds."""
    shutter_s: float = 0.0
    """Least time between two images of a series."""
    mode: int = CameraMode.IMAGE
    source: int = CameraSource.DEFAULT

    @property
    def host(self) -> ServerHost:
        """The component."""
        raise NotImplementedError

    def set_up_captures(self) -> None:
        """Create the parts; call it once."""
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
        """Free space for images and videos."""
        return math.inf

    @property
    def gimbal_device_id(self) -> int:
        """Component id of the gimbal that carries the camera; 0 if there is none."""
        return 0

    def expose(self, done: Callable[[Shot | None], None]) -> None:
        """Take an image; call ``done`` when it is taken, with None if it failed."""
        raise NotImplementedError

    def failed_shot(self) -> Shot:
        """Return the content of CAMERA_IMAGE_CAPTURED for an image that could not be taken."""
        return partial(CameraImageCaptured, self.host.time_boot_ms, 0, 0, 0, 0, 0, 0, _NOWHERE, file_url="")

    def has_space(self) -> bool:
        """Return True if another image fits."""
        return self.free_mib > 0

    def store_image(self, image: CameraImageCaptured) -> str | None:
        """Write the file of an image and return its URL; None if it cannot be stored."""
        return ""

    def storage(self, number: int) -> list[m.StorageInformation]:
        """Return STORAGE_INFORMATION of a storage, or of all for 0."""
        return []

    def tracked_place(self) -> list[m.CameraTrackingGeoStatus]:
        """Return CAMERA_TRACKING_GEO_STATUS; empty if unknown."""
        return []

    async def start_video(self) -> None:
        """Begin to record."""

    async def stop_video(self) -> None:
        """End the recording."""

    async def set_mode(self, mode: int) -> None:
        """Set the CAMERA_MODE, which the protocol has checked."""

    async def set_zoom(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_ZOOM; return False if type or value is not supported."""
        return False

    async def set_focus(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_FOCUS; return False if type or value is not supported."""
        return False

    async def set_source(self, source: int) -> bool:
        """Show another sensor (CAMERA_SOURCE); return False if there is none."""
        return source == CameraSource.DEFAULT

    async def switch_stream(self, numbers: set[int], *, on: bool) -> None:
        """Start or stop video streams."""

    async def track(self, place: tuple[float, ...]) -> None:
        """Track a point (x, y, radius), a rectangle (left, top, right, bottom) or nothing (empty)."""

    async def format_storage(self) -> None:
        """Erase images and videos."""

    async def reset_settings(self) -> None:
        """Restore the default settings."""


# ------------------------------------------------------------------------------------- messages


def camera_builders(camera: CameraDevice) -> dict[int, Builder]:
    """Return builders by message id. Param 2 of REQUEST_MESSAGE selects a storage, a stream or the first image."""
    return {
        m.CameraInformation.ID: lambda _: [_information(camera)],
        m.CameraSettings.ID: lambda _: [camera_settings(camera)],
        m.CameraCaptureStatus.ID: lambda _: [camera.captures.status()],
        m.StorageInformation.ID: lambda command: camera.storage(_number(command)),
        m.CameraImageCaptured.ID: lambda command: _images(camera, command),
        m.VideoStreamInformation.ID: lambda command: _streams(camera, _number(command)),
        m.VideoStreamStatus.ID: lambda command: _stream_status(camera, _number(command)),
        m.CameraTrackingImageStatus.ID: lambda _: [camera.tracking.image_status()],
        m.CameraTrackingGeoStatus.ID: lambda _: camera.tracked_place(),
        m.CameraThermalRange.ID: lambda _: _thermal_range(camera),
    }


def camera_settings(camera: CameraDevice) -> m.CameraSettings:
    """Return CAMERA_SETTINGS; zoom and focus are NaN if the camera has none."""
    return m.CameraSettings(
        time_boot_ms=camera.host.time_boot_ms,
        mode_id=camera.mode,
        zoomLevel=camera.zoom if camera.can(CameraCapFlags.HAS_BASIC_ZOOM) else math.nan,
        focusLevel=camera.focus if camera.can(CameraCapFlags.HAS_BASIC_FOCUS) else math.nan,
    )


def _number(command: ReceivedCommand | None) -> int:
    """Return param 2; 0 (all) for streamed messages."""
    return 0 if command is None else whole(command.param2)


def _information(camera: CameraDevice) -> m.CameraInformation:
    return m.CameraInformation(
        time_boot_ms=camera.host.time_boot_ms,
        vendor_name=camera.vendor.encode()[:32].ljust(32, b"\0"),
        model_name=camera.model.encode()[:32].ljust(32, b"\0"),
        firmware_version=camera.firmware_version,
        focal_length=camera.focal_length_mm,
        sensor_size_h=camera.sensor_mm[0],
        sensor_size_v=camera.sensor_mm[1],
        resolution_h=camera.resolution[0],
        resolution_v=camera.resolution[1],
        lens_id=0,
        flags=camera.capabilities,
        cam_definition_version=camera.definition_version if camera.definition_uri else 0,
        cam_definition_uri=camera.definition_uri,
        gimbal_device_id=camera.gimbal_device_id,
    )


def _images(camera: CameraDevice, command: ReceivedCommand | None) -> Iterable[Message]:
    """Select images: param 2 is the first index or -1 for all, param 3 the last index, 0 for one or -1 for all."""
    images = camera.captures.images
    if command is None:
        return images[-1:]
    first, last = whole(command.param2), whole(command.param3)
    if first < 0:
        return list(images)
    if last == _TO_THE_END:
        return images[first:]
    return images[first : max(first, last) + 1]


def _streams(camera: CameraDevice, number: int) -> list[m.VideoStreamInformation]:
    return [
        m.VideoStreamInformation(
            **_stream_fields(camera, stream),
            count=len(camera.streams),
            type=VideoStreamType.RTSP if uri.startswith("rtsp") else VideoStreamType.RTPUDP,
            name=f"Stream {stream}",
            uri=uri,
            encoding=VideoStreamEncoding.H264,
        )
        for stream, uri in enumerate(camera.streams, start=1)
        if number in (0, stream)
    ]


def _stream_status(camera: CameraDevice, number: int) -> list[m.VideoStreamStatus]:
    streams = range(1, len(camera.streams) + 1)
    return [m.VideoStreamStatus(**_stream_fields(camera, stream)) for stream in streams if number in (0, stream)]


def _stream_fields(camera: CameraDevice, stream: int) -> dict[str, Any]:
    return {
        "stream_id": stream,
        "flags": _flags(camera, stream),
        "framerate": camera.stream_hz,
        "resolution_h": camera.stream_size[0],
        "resolution_v": camera.stream_size[1],
        "bitrate": camera.stream_bits_s,
        "rotation": 0,
        "hfov": _field_of_view(camera),
    }


def _flags(camera: CameraDevice, stream: int) -> int:
    flags: int = VideoStreamStatusFlags.RUNNING if stream in camera.running_streams else 0
    if camera.thermal_celsius and stream == len(camera.streams):
        flags |= VideoStreamStatusFlags.THERMAL | VideoStreamStatusFlags.THERMAL_RANGE_ENABLED
    return flags


def _thermal_range(camera: CameraDevice) -> list[m.CameraThermalRange]:
    """Return the range with the coldest point at the upper left, the hottest at the lower right."""
    if camera.thermal_celsius is None:
        return []
    coldest, hottest = camera.thermal_celsius
    stream, now_ms = len(camera.streams), camera.host.time_boot_ms
    return [m.CameraThermalRange(now_ms, stream, 0, hottest, 1.0, 1.0, coldest, 0.0, 0.0)]


def _field_of_view(camera: CameraDevice) -> int:
    """Return the horizontal field of view in degrees; 0 if unknown."""
    width, focal = camera.sensor_mm[0], camera.focal_length_mm
    return 0 if math.isnan(width / focal) else round(math.degrees(2 * math.atan(width / 2 / focal)))
