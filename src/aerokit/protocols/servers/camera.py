"""Messages and commands of the camera protocol (https://mavlink.io/en/services/camera.html)."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from dataclasses import replace
from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    MavCmd,
    MavResult,
    VideoStreamEncoding,
    VideoStreamStatusFlags,
    VideoStreamType,
)
from aerokit.mavlink.message import Message
from aerokit.protocols.servers.camera_device import CameraDevice
from aerokit.protocols.servers.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.protocols.servers.host import ComponentIds
from aerokit.protocols.servers.intervals import Builder, MessageStreams

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
    # `command` is None for a STORAGE_INFORMATION or VIDEO_STREAM_STATUS that is streamed, not requested.
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
    """Return the images that the command requests, or the last image if ``command`` is None (periodic message)."""
    if command is None:
        return camera.captures.images[-1:]
    # REQUEST_MESSAGE for CAMERA_IMAGE_CAPTURED: param 2 is the index of the first image, or -1 for all images. Param 3
    # is the index of the last one, 0 for only one image, or -1 for all further images.
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
    """Return the number of the stream with the thermal image, which is the last one."""
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


_CAN_ALWAYS_CAPTURE = CameraCapFlags.CAN_CAPTURE_IMAGE_IN_VIDEO_MODE
_CAN_ALWAYS_RECORD = CameraCapFlags.CAN_CAPTURE_VIDEO_IN_IMAGE_MODE


def camera_commands(camera: CameraDevice) -> dict[int, AsyncHandler]:
    commands = _CameraCommands(camera)
    return {
        MavCmd.IMAGE_START_CAPTURE: commands.start_images,
        MavCmd.IMAGE_STOP_CAPTURE: commands.stop_images,
        MavCmd.DO_DIGICAM_CONTROL: commands.digicam_control,
        MavCmd.STORAGE_FORMAT: commands.format_storage,
        MavCmd.VIDEO_START_CAPTURE: commands.start_video,
        MavCmd.VIDEO_STOP_CAPTURE: commands.stop_video,
        MavCmd.VIDEO_START_STREAMING: lambda command: commands.switch_stream(command, on=True),
        MavCmd.VIDEO_STOP_STREAMING: lambda command: commands.switch_stream(command, on=False),
        MavCmd.SET_CAMERA_MODE: commands.set_mode,
        MavCmd.SET_CAMERA_ZOOM: commands.set_zoom,
        MavCmd.SET_CAMERA_FOCUS: commands.set_focus,
        MavCmd.SET_CAMERA_SOURCE: commands.set_source,
        MavCmd.RESET_CAMERA_SETTINGS: commands.reset_settings,
        MavCmd.CAMERA_TRACK_POINT: camera.tracking.track_point,
        MavCmd.CAMERA_TRACK_RECTANGLE: camera.tracking.track_rectangle,
        MavCmd.CAMERA_STOP_TRACKING: camera.tracking.stop,
    }


def legacy_requests(streams: MessageStreams) -> dict[int, CommandHandler]:
    message_ids: dict[int, int] = {
        MavCmd.REQUEST_CAMERA_INFORMATION: m.CameraInformation.ID,
        MavCmd.REQUEST_CAMERA_SETTINGS: m.CameraSettings.ID,
        MavCmd.REQUEST_CAMERA_CAPTURE_STATUS: m.CameraCaptureStatus.ID,
        MavCmd.REQUEST_STORAGE_INFORMATION: m.StorageInformation.ID,
        MavCmd.REQUEST_VIDEO_STREAM_INFORMATION: m.VideoStreamInformation.ID,
        MavCmd.REQUEST_VIDEO_STREAM_STATUS: m.VideoStreamStatus.ID,
        MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE: m.CameraImageCaptured.ID,
    }

    def handler(message_id: int) -> CommandHandler:
        # The number of a storage or stream is in param 1 of the older requests, but in param 2 of REQUEST_MESSAGE.
        return lambda command: streams.answer_with(message_id, replace(command, param2=command.param1))

    return {command: handler(message_id) for command, message_id in message_ids.items()}


class _CameraCommands:
    """Handlers of the commands for images and the memory card, for videos and streams, and for settings."""

    def __init__(self, camera: CameraDevice) -> None:
        self._camera = camera
        self._last_single: tuple[ComponentIds, int] | None = None  # sender and sequence number of the last single image
        self._must_stop_video = False  # True from a command to stop until the next command to start
        self._was_cancelled = False  # True if the start of a video was cancelled, so that the camera may be recording

    async def start_images(self, command: ReceivedCommand) -> int:
        camera, captures = self._camera, self._camera.captures
        interval_s = command.param2 if math.isfinite(command.param2) else 0.0
        count = to_int(command.param3)
        sequence = to_int(command.param4)
        in_wrong_mode = _has_wrong_mode(camera, wrong_mode=CameraMode.VIDEO, unless_can=_CAN_ALWAYS_CAPTURE)
        if not camera.can(CameraCapFlags.CAPTURE_IMAGE):
            return MavResult.UNSUPPORTED
        has_valid_params = _selects_this_camera(command.param1) and interval_s >= 0 and count >= 0
        if not has_valid_params or in_wrong_mode:
            return MavResult.DENIED
        single = (command.sender, sequence) if count == 1 and sequence > 0 else None
        # A single image with the same sender and sequence number is not taken again.
        is_repeated = single is not None and single == self._last_single
        if is_repeated:
            return MavResult.ACCEPTED
        if captures.is_busy:
            return MavResult.TEMPORARILY_REJECTED
        if not camera.has_space():
            return MavResult.FAILED
        self._last_single = single
        captures.take_series(interval_s, count)
        return MavResult.ACCEPTED

    async def stop_images(self, command: ReceivedCommand) -> int:
        if not _selects_this_camera(command.param1):
            return MavResult.DENIED
        self._camera.captures.stop()
        return MavResult.ACCEPTED

    async def digicam_control(self, command: ReceivedCommand) -> int:
        if command.x != 1:  # Param 5 of DO_DIGICAM_CONTROL is 1 to take an image.
            return MavResult.ACCEPTED
        return await self.start_images(replace(command, param1=0.0, param2=0.0, param3=1.0, param4=0.0))

    async def format_storage(self, command: ReceivedCommand) -> int:
        camera, captures = self._camera, self._camera.captures
        if not _selects_this_camera(command.param1):
            return MavResult.DENIED
        if captures.is_busy or captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED
        # Param 2 of STORAGE_FORMAT is 1 to format the storage, param 3 is 1 to reset the image log.
        if command.param2 == 1.0:
            await camera.format_storage()
        if command.param3 == 1.0:
            captures.clear()
        return MavResult.ACCEPTED

    async def start_video(self, command: ReceivedCommand) -> int:
        camera, captures = self._camera, self._camera.captures
        if not camera.can(CameraCapFlags.CAPTURE_VIDEO):
            return MavResult.UNSUPPORTED
        in_wrong_mode = _has_wrong_mode(camera, wrong_mode=CameraMode.IMAGE, unless_can=_CAN_ALWAYS_RECORD)
        if in_wrong_mode or command.param2 < 0:
            return MavResult.DENIED
        if captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED
        if camera.free_mib <= 0:
            return MavResult.FAILED
        self._must_stop_video = False
        try:
            await camera.start_video()
        except BaseException as error:
            self._was_cancelled = not isinstance(error, Exception)  # CancelledError is no subclass of Exception.
            raise
        # Param 2 of VIDEO_START_CAPTURE is the rate of CAMERA_CAPTURE_STATUS in Hz; 0 requests no status.
        status_interval_s = 1.0 / command.param2 if command.param2 else 0.0
        captures.record(status_interval_s)
        if self._must_stop_video:  # The command to stop arrived while the camera was starting.
            await self._stop_recording()
        return MavResult.ACCEPTED

    async def stop_video(self, _: ReceivedCommand) -> int:
        self._must_stop_video = True
        await self._stop_recording()
        return MavResult.ACCEPTED

    async def _stop_recording(self) -> None:
        if self._camera.captures.is_recording or self._was_cancelled:
            await self._camera.stop_video()
            self._was_cancelled = False
            self._camera.captures.stop_recording()
            self._camera.host.send(self._camera.captures.status())

    async def switch_stream(self, command: ReceivedCommand, *, on: bool) -> int:
        camera, number = self._camera, to_int(command.param1)
        available = range(1, len(camera.streams) + 1)
        if not available:
            return MavResult.UNSUPPORTED
        if number not in (0, *available):
            return MavResult.DENIED
        selected = set(available) if number == 0 else {number}
        await camera.switch_stream(selected, on=on)
        if on:
            camera.running_streams |= selected
        else:
            camera.running_streams -= selected
        return MavResult.ACCEPTED

    async def set_mode(self, command: ReceivedCommand) -> int:
        camera, mode = self._camera, to_int(command.param2)
        if not camera.can(CameraCapFlags.HAS_MODES):
            return MavResult.UNSUPPORTED
        needed_capabilities = {
            CameraMode.IMAGE: CameraCapFlags.CAPTURE_IMAGE,
            CameraMode.VIDEO: CameraCapFlags.CAPTURE_VIDEO,
            CameraMode.IMAGE_SURVEY: CameraCapFlags.HAS_IMAGE_SURVEY_MODE,
        }
        if mode not in needed_capabilities or not camera.can(needed_capabilities[CameraMode(mode)]):
            return MavResult.DENIED
        if camera.captures.is_busy or camera.captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED
        await camera.set_mode(mode)
        camera.mode = mode
        return self._send_settings()

    async def set_zoom(self, command: ReceivedCommand) -> int:
        return await self._adjust(CameraCapFlags.HAS_BASIC_ZOOM, self._camera.set_zoom, command)

    async def set_focus(self, command: ReceivedCommand) -> int:
        return await self._adjust(CameraCapFlags.HAS_BASIC_FOCUS, self._camera.set_focus, command)

    async def _adjust(
        self, needed_capability: int, adjust: Callable[[int, float], Awaitable[bool]], command: ReceivedCommand
    ) -> int:
        if not self._camera.can(needed_capability):
            return MavResult.UNSUPPORTED
        is_supported = await adjust(to_int(command.param1), command.param2)
        return self._send_settings() if is_supported else MavResult.DENIED

    async def set_source(self, command: ReceivedCommand) -> int:
        source = to_int(command.param2)
        if not await self._camera.set_source(source):
            return MavResult.DENIED
        self._camera.source = source
        return MavResult.ACCEPTED

    async def reset_settings(self, command: ReceivedCommand) -> int:
        if command.param1 == 1.0:  # Param 1 of RESET_CAMERA_SETTINGS is 1 to reset all settings.
            await self._camera.reset_settings()
        return self._send_settings()

    def _send_settings(self) -> int:
        self._camera.host.send(camera_settings(self._camera))
        return MavResult.ACCEPTED


def _selects_this_camera(target_camera: float) -> bool:
    # In a camera command, the number 0 selects all cameras, 1 the first one. MAVSDK sends NaN.
    return math.isnan(target_camera) or target_camera in (0.0, 1.0)


def _has_wrong_mode(camera: CameraDevice, *, wrong_mode: int, unless_can: int) -> bool:
    """Return True if the camera is in ``wrong_mode`` and has none of the capabilities ``unless_can``."""
    return camera.can(CameraCapFlags.HAS_MODES) and camera.mode == wrong_mode and not camera.can(unless_can)
