"""What a simulated camera says of itself when it is asked."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, VideoStreamEncoding, VideoStreamStatusFlags, VideoStreamType
from aerokit.sim.commands import Command, whole
from aerokit.sim.components.camera_body import CameraBody
from aerokit.sim.components.component import Builder
from aerokit.sim.components.lens import FOCAL_LENGTH_MM

_FIRMWARE = 1 << 24
_SENSOR_MM = (6.17, 4.63)
_STREAM_HZ, _STREAM_SIZE, _STREAM_BITS_S = 30.0, (1920, 1080), 4_000_000
_TO_THE_END = -1


def camera_builders(camera: CameraBody) -> dict[int, Builder]:
    """Message id → what to send. Param 2 of REQUEST_MESSAGE picks a card, a stream or the first picture."""
    return {
        m.CameraInformation.ID: lambda _: [_information(camera)],
        m.CameraSettings.ID: lambda _: [camera_settings(camera)],
        m.CameraCaptureStatus.ID: lambda _: [camera.captures.status()],
        m.StorageInformation.ID: lambda command: camera.card.information(camera, _number(command)),
        m.CameraImageCaptured.ID: lambda command: _images(camera, command),
        m.VideoStreamInformation.ID: lambda command: _streams(camera, _number(command)),
        m.VideoStreamStatus.ID: lambda command: _stream_status(camera, _number(command)),
        m.CameraTrackingImageStatus.ID: lambda _: [camera.tracking.image_status()],
        m.CameraTrackingGeoStatus.ID: lambda _: camera.tracking.geo_status(),
        m.CameraThermalRange.ID: lambda _: _thermal_range(camera),
    }


def camera_settings(camera: CameraBody) -> m.CameraSettings:
    """CAMERA_SETTINGS; zoom and focus are NaN when it has none."""
    return m.CameraSettings(
        time_boot_ms=camera.time_boot_ms,
        mode_id=camera.mode,
        zoomLevel=camera.zoom if camera.can(CameraCapFlags.HAS_BASIC_ZOOM) else math.nan,
        focusLevel=camera.focus if camera.can(CameraCapFlags.HAS_BASIC_FOCUS) else math.nan,
    )


def _number(command: Command | None) -> int:
    """Param 2; a stream of messages is of all."""
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


def _images(camera: CameraBody, command: Command | None) -> list[m.CameraImageCaptured]:
    """Param 2 is the first index, -1 for all; param 3 the last one, 0 for only that, -1 for all that follow."""
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
            stream_id=stream,
            count=len(camera.streams),
            type=VideoStreamType.RTSP if uri.startswith("rtsp") else VideoStreamType.RTPUDP,
            flags=_flags(camera, stream),
            framerate=_STREAM_HZ,
            resolution_h=_STREAM_SIZE[0],
            resolution_v=_STREAM_SIZE[1],
            bitrate=_STREAM_BITS_S,
            rotation=0,
            hfov=_field_of_view(),
            name=f"Stream {stream}",
            uri=uri,
            encoding=VideoStreamEncoding.H264,
        )
        for stream, uri in enumerate(camera.streams, start=1)
        if number in (0, stream)
    ]


def _stream_status(camera: CameraBody, number: int) -> list[m.VideoStreamStatus]:
    return [
        m.VideoStreamStatus(
            stream_id=stream,
            flags=_flags(camera, stream),
            framerate=_STREAM_HZ,
            resolution_h=_STREAM_SIZE[0],
            resolution_v=_STREAM_SIZE[1],
            bitrate=_STREAM_BITS_S,
            rotation=0,
            hfov=_field_of_view(),
        )
        for stream in range(1, len(camera.streams) + 1)
        if number in (0, stream)
    ]


def _flags(camera: CameraBody, stream: int) -> int:
    flags: int = VideoStreamStatusFlags.RUNNING if stream in camera.running_streams else 0
    if camera.thermal_celsius and stream == len(camera.streams):
        flags |= VideoStreamStatusFlags.THERMAL | VideoStreamStatusFlags.THERMAL_RANGE_ENABLED
    return flags


def _thermal_range(camera: CameraBody) -> list[m.CameraThermalRange]:
    """Cold at the upper left, hot at the lower right."""
    if camera.thermal_celsius is None:
        return []
    coldest, hottest = camera.thermal_celsius
    stream = len(camera.streams)
    return [m.CameraThermalRange(camera.time_boot_ms, stream, 0, hottest, 1.0, 1.0, coldest, 0.0, 0.0)]


def _field_of_view() -> int:
    """Horizontally, in degrees."""
    return round(math.degrees(2 * math.atan(_SENSOR_MM[0] / 2 / FOCAL_LENGTH_MM)))
