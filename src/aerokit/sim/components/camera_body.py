"""State and messages of a simulated camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    CameraSource,
    MavType,
    VideoStreamEncoding,
    VideoStreamStatusFlags,
    VideoStreamType,
)
from aerokit.mavlink.messages import CameraImageCaptured
from aerokit.parameters import parse_definition
from aerokit.parameters.definition import CameraDefinition
from aerokit.protocols.servers.files import FileTree
from aerokit.sim.commands import ReceivedCommand, whole
from aerokit.sim.components.captures import (
    FOCAL_LENGTH_MM,
    GREY_JPEG,
    CameraHost,
    Captures,
    Lens,
    MemoryCard,
    Tracking,
)
from aerokit.sim.components.component import Builder, ExtendedParameters, pose_of
from aerokit.sim.components.gimbal import SimulatedGimbal

DEFINITION_PATH = "/camera_definition.xml"
"""MAVFTP path of the camera definition."""
CAPABILITIES = (
    CameraCapFlags.CAPTURE_IMAGE
    | CameraCapFlags.CAPTURE_VIDEO
    | CameraCapFlags.HAS_MODES
    | CameraCapFlags.HAS_BASIC_ZOOM
    | CameraCapFlags.HAS_BASIC_FOCUS
)


def own_definition() -> bytes:
    return Path(__file__).with_name("camera_definition.xml").read_bytes()


class CameraBody(CameraHost):
    """Lens, card, shutter and settings; see `SimulatedCamera` for the arguments."""

    TYPE: ClassVar[int] = MavType.CAMERA

    parameters: ExtendedParameters
    """Settings; available once the camera has joined a vehicle."""

    def __init__(
        self,
        component_id: int = 100,
        *,
        system_id: int | None = None,
        vendor: str = "aerokit",
        model: str = "Simulated camera",
        definition: bytes | None = None,
        definition_uri: str | None = None,
        capabilities: int = CAPABILITIES,
        resolution: tuple[int, int] = (4000, 3000),
        streams: Sequence[str] = (),
        thermal_celsius: tuple[float, float] | None = None,
        gimbal: SimulatedGimbal | None = None,
        capacity_mib: float = 8192.0,
        image_mib: float = 5.0,
        video_mib_s: float = 10.0,
        shutter_s: float = 0.2,
        picture: bytes | Callable[[CameraImageCaptured], bytes] = GREY_JPEG,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.vendor: str = vendor
        self.model: str = model
        content = own_definition() if definition is None else definition
        self.definition: CameraDefinition = parse_definition(content)
        self.definition_uri = f"mftp://{DEFINITION_PATH}" if definition_uri is None else definition_uri
        self.files: FileTree = FileTree().put(DEFINITION_PATH, content)
        """Files served by MAVFTP: the definition, and images in ``/DCIM``."""
        self.resolution = resolution
        self.streams: tuple[str, ...] = tuple(streams)
        self.gimbal = gimbal
        self.image_mib: float = image_mib
        self.video_mib_s: float = video_mib_s
        self.shutter_s: float = shutter_s
        self.thermal_celsius: tuple[float, float] | None = thermal_celsius
        self.picture = picture
        self.capabilities: int = capabilities | (CameraCapFlags.HAS_VIDEO_STREAM if streams else 0)
        self.capabilities |= CameraCapFlags.HAS_THERMAL_RANGE if thermal_celsius else 0
        self.card: MemoryCard = MemoryCard(capacity_mib)
        self.captures: Captures = Captures(self)
        self.running_streams: set[int] = set()
        """Numbers of the active streams, starting at 1."""
        self.mode: int = CameraMode.IMAGE
        """CAMERA_MODE."""
        self.source: int = CameraSource.DEFAULT
        """CAMERA_SOURCE of the displayed sensor."""
        self.lens: Lens = Lens(lambda: self.now)
        self.tracking: Tracking = Tracking(self)

    @property
    def zoom(self) -> float:
        """Zoom in percent."""
        return self.lens.zoom.percent

    @property
    def focus(self) -> float:
        """Focus in percent."""
        return self.lens.focus.percent

    @property
    def image_count(self) -> int:
        """Number of images on the card."""
        return len(self.captures.images)

    def angles(self) -> tuple[float, float, float] | None:
        """Roll, pitch and yaw (from north) of the view in radians; None if unknown."""
        pose = pose_of(self.vehicle)
        if self.gimbal is not None:
            roll, pitch, yaw = self.gimbal.angles_from_north()
            return roll, pitch, yaw
        return None if pose is None else (pose.roll, pose.pitch, pose.yaw)

    def reset_settings(self) -> None:
        """Restore the default mode, zoom and focus."""
        self.mode, self.source = CameraMode.IMAGE, CameraSource.DEFAULT
        self.lens.zoom.set(0.0)
        self.lens.focus.set(0.0)

    def start(self) -> None:
        """Called at power-on; streams start at once."""
        self.captures.switch_off()
        self.reset_settings()
        self.parameters.restart()
        self.tracking.reset()
        self.running_streams = set(range(1, len(self.streams) + 1))

    def builders(self) -> dict[int, Builder]:
        """Return builders by message id. Param 2 of REQUEST_MESSAGE selects a card, a stream or the first image."""
        return {
            m.CameraInformation.ID: lambda _: [_information(self)],
            m.CameraSettings.ID: lambda _: [camera_settings(self)],
            m.CameraCaptureStatus.ID: lambda _: [self.captures.status()],
            m.StorageInformation.ID: lambda command: self.card.information(self, _number(command)),
            m.CameraImageCaptured.ID: lambda command: _images(self, command),
            m.VideoStreamInformation.ID: lambda command: _streams(self, _number(command)),
            m.VideoStreamStatus.ID: lambda command: _stream_status(self, _number(command)),
            m.CameraTrackingImageStatus.ID: lambda _: [self.tracking.image_status()],
            m.CameraTrackingGeoStatus.ID: lambda _: self.tracking.geo_status(),
            m.CameraThermalRange.ID: lambda _: _thermal_range(self),
        }

    def clear_files(self) -> None:
        """Delete all images."""
        for name, _ in self.files.entries("/DCIM") if "/DCIM" in self.files else ():
            self.files.remove_file(f"/DCIM/{name}")

    def store_image(self, image: CameraImageCaptured) -> str:
        path = f"/DCIM/IMG_{len(self.captures.images) + 1:04d}.JPG"
        picture = self.picture
        self.files.put(path, picture if isinstance(picture, bytes) else picture(image))
        return f"mftp://{path}"


_FIRMWARE = 1 << 24
_SENSOR_MM = (6.17, 4.63)
_STREAM_HZ, _STREAM_SIZE, _STREAM_BITS_S = 30.0, (1920, 1080), 4_000_000
_TO_THE_END = -1


def camera_settings(camera: CameraBody) -> m.CameraSettings:
    """Return CAMERA_SETTINGS; zoom and focus are NaN if the camera has none."""
    return m.CameraSettings(
        time_boot_ms=camera.time_boot_ms,
        mode_id=camera.mode,
        zoomLevel=camera.zoom if camera.can(CameraCapFlags.HAS_BASIC_ZOOM) else math.nan,
        focusLevel=camera.focus if camera.can(CameraCapFlags.HAS_BASIC_FOCUS) else math.nan,
    )


def _number(command: ReceivedCommand | None) -> int:
    """Return param 2; 0 (all) for streamed messages."""
    return 0 if command is None else whole(command.param2)


def _information(camera: CameraBody) -> m.CameraInformation:
    return m.CameraInformation(
        time_boot_ms=camera.time_boot_ms,
        vendor_name=camera.vendor.encode()[:32].ljust(32, b"\0"),
        model_name=camera.model.encode()[:32].ljust(32, b"\0"),
        firmware_version=_FIRMWARE,
        focal_length=FOCAL_LENGTH_MM,
        sensor_size_h=_SENSOR_MM[0],
        sensor_size_v=_SENSOR_MM[1],
        resolution_h=camera.resolution[0],
        resolution_v=camera.resolution[1],
        lens_id=0,
        flags=camera.capabilities,
        cam_definition_version=camera.definition.version if camera.definition_uri else 0,
        cam_definition_uri=camera.definition_uri,
        gimbal_device_id=0 if camera.gimbal is None else camera.gimbal.component_id,
    )


def _images(camera: CameraBody, command: ReceivedCommand | None) -> list[m.CameraImageCaptured]:
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


def _streams(camera: CameraBody, number: int) -> list[m.VideoStreamInformation]:
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


def _stream_status(camera: CameraBody, number: int) -> list[m.VideoStreamStatus]:
    streams = range(1, len(camera.streams) + 1)
    return [m.VideoStreamStatus(**_stream_fields(camera, stream)) for stream in streams if number in (0, stream)]


def _stream_fields(camera: CameraBody, stream: int) -> dict[str, Any]:
    return {
        "stream_id": stream,
        "flags": _flags(camera, stream),
        "framerate": _STREAM_HZ,
        "resolution_h": _STREAM_SIZE[0],
        "resolution_v": _STREAM_SIZE[1],
        "bitrate": _STREAM_BITS_S,
        "rotation": 0,
        "hfov": _field_of_view(),
    }


def _flags(camera: CameraBody, stream: int) -> int:
    flags: int = VideoStreamStatusFlags.RUNNING if stream in camera.running_streams else 0
    if camera.thermal_celsius and stream == len(camera.streams):
        flags |= VideoStreamStatusFlags.THERMAL | VideoStreamStatusFlags.THERMAL_RANGE_ENABLED
    return flags


def _thermal_range(camera: CameraBody) -> list[m.CameraThermalRange]:
    """Return the range with the coldest point at the upper left, the hottest at the lower right."""
    if camera.thermal_celsius is None:
        return []
    coldest, hottest = camera.thermal_celsius
    stream = len(camera.streams)
    return [m.CameraThermalRange(camera.time_boot_ms, stream, 0, hottest, 1.0, 1.0, coldest, 0.0, 0.0)]


def _field_of_view() -> int:
    """Return the horizontal field of view in degrees."""
    return round(math.degrees(2 * math.atan(_SENSOR_MM[0] / 2 / FOCAL_LENGTH_MM)))
