"""Messages of the camera protocol (https://mavlink.io/en/services/camera.html)."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, VideoStreamEncoding, VideoStreamStatusFlags, VideoStreamType
from aerokit.mavlink.message import Message
from aerokit.protocols.servers.camera_device import CameraDevice
from aerokit.protocols.servers.commands import ReceivedCommand, to_int
from aerokit.protocols.servers.intervals import Builder

# Handlers are coroutine functions, because a device may need time. The handlers of simulated devices never suspend.
AsyncHandler = Callable[[ReceivedCommand], Coroutine[Any, Any, int]]

_TO_THE_END = -1


def camera_builders(camera: CameraDevice) -> dict[int, Builder]:
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
    return m.CameraSettings(
        time_boot_ms=camera.host.time_boot_ms,
        mode_id=camera.mode,
        zoomLevel=camera.zoom if camera.can(CameraCapFlags.HAS_BASIC_ZOOM) else math.nan,
        focusLevel=camera.focus if camera.can(CameraCapFlags.HAS_BASIC_FOCUS) else math.nan,
    )


def _number(command: ReceivedCommand | None) -> int:
    """Return the requested number of a storage or stream. 0 means all."""
    # `command` is None for a message that is streamed.
    return 0 if command is None else to_int(command.param2)


def _information(camera: CameraDevice) -> m.CameraInformation:
    sensor_width_mm, sensor_height_mm = camera.sensor_mm
    width, height = camera.resolution
    return m.CameraInformation(
        time_boot_ms=camera.host.time_boot_ms, vendor_name=camera.vendor.encode()[:32].ljust(32, b"\0"),
        model_name=camera.model.encode()[:32].ljust(32, b"\0"), firmware_version=camera.firmware_version,
        focal_length=camera.focal_length_mm, sensor_size_h=sensor_width_mm, sensor_size_v=sensor_height_mm,
        resolution_h=width, resolution_v=height, lens_id=0, flags=camera.capabilities,
        cam_definition_version=camera.definition_version if camera.definition_uri else 0,
        cam_definition_uri=camera.definition_uri, gimbal_device_id=camera.gimbal_device_id,
    )  # fmt: skip


def _images(camera: CameraDevice, command: ReceivedCommand | None) -> Iterable[Message]:
    """Return the requested images, or the last image for a periodic message (None)."""
    if command is None:
        return camera.captures.images[-1:]
    # Param 2 is the index of the first image, or -1 for all images. Param 3 is the index of the last one, 0 for only
    # one image, or -1 for all further images.
    first, last = to_int(command.param2), to_int(command.param3)
    if first < 0:
        return list(camera.captures.images)
    return camera.captures.between(first, None if last == _TO_THE_END else max(first, last))


def _streams(camera: CameraDevice, number: int) -> list[m.VideoStreamInformation]:
    return [
        m.VideoStreamInformation(
            **_stream_fields(camera, stream), count=len(camera.streams),
            type=VideoStreamType.RTSP if uri.startswith("rtsp") else VideoStreamType.RTPUDP, name=f"Stream {stream}",
            uri=uri, encoding=VideoStreamEncoding.H264,
        )
        for stream, uri in enumerate(camera.streams, start=1)
        if number in (0, stream)
    ]  # fmt: skip


def _stream_status(camera: CameraDevice, number: int) -> list[m.VideoStreamStatus]:
    streams = range(1, len(camera.streams) + 1)
    return [m.VideoStreamStatus(**_stream_fields(camera, stream)) for stream in streams if number in (0, stream)]


def _stream_fields(camera: CameraDevice, stream: int) -> dict[str, Any]:
    width, height = camera.stream_size
    return {
        "stream_id": stream,
        "flags": _flags(camera, stream),
        "framerate": camera.stream_hz,
        "resolution_h": width,
        "resolution_v": height,
        "bitrate": camera.stream_bits_s,
        "rotation": 0,
        "hfov": _field_of_view(camera),
    }


def _flags(camera: CameraDevice, stream: int) -> int:
    flags: int = VideoStreamStatusFlags.RUNNING if stream in camera.running_streams else 0
    is_thermal = camera.thermal_celsius is not None and stream == _thermal_stream(camera)
    if is_thermal:
        flags |= VideoStreamStatusFlags.THERMAL | VideoStreamStatusFlags.THERMAL_RANGE_ENABLED
    return flags


def _thermal_stream(camera: CameraDevice) -> int:
    return len(camera.streams)


def _thermal_range(camera: CameraDevice) -> list[m.CameraThermalRange]:
    if camera.thermal_celsius is None:
        return []
    coldest, hottest = camera.thermal_celsius
    return [
        m.CameraThermalRange(
            time_boot_ms=camera.host.time_boot_ms, stream_id=_thermal_stream(camera), camera_device_id=0, max=hottest,
            max_point_x=1.0, max_point_y=1.0, min=coldest, min_point_x=0.0, min_point_y=0.0,
        )
    ]  # fmt: skip


def _field_of_view(camera: CameraDevice) -> int:
    """Return the horizontal field of view in degrees. 0 means unknown."""
    sensor_width_mm, _ = camera.sensor_mm
    tangent = sensor_width_mm / 2 / camera.focal_length_mm
    return 0 if math.isnan(tangent) else round(math.degrees(2 * math.atan(tangent)))
