"""`SimulatedCamera`: a camera component that implements the MAVLink camera protocol.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, CameraMode, CameraSource, MavCmd, MavResult
from aerokit.parameters import SettingValue
from aerokit.sim.commands import CommandHandler, CommandProgress, ReceivedCommand, whole
from aerokit.sim.components.camera_body import CAPABILITIES, CameraBody, camera_settings
from aerokit.sim.components.component import ExtendedParameters, serve_files

MODE, EXPOSURE, ISO, SHUTTER = "CAM_MODE", "CAM_EXPMODE", "CAM_ISO", "CAM_SHUTTER"
AUTO, AUTO_ISO, AUTO_SHUTTER_S = 0, 200, 0.002
MAX_VIDEO_ISO = 400


class CameraParameters(ExtendedParameters):
    """Camera settings (PARAM_EXT). Setting the mode during a capture or recording fails."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera
        super().__init__(camera, camera.definition)

    def refresh(self) -> None:
        """Update values that commands or automatic exposure change."""
        values, camera = self.values, self._camera
        if MODE in values:
            values[MODE] = int(camera.mode)
        if values.get(EXPOSURE) == AUTO and {ISO, SHUTTER} <= values.keys():
            values[ISO], values[SHUTTER] = AUTO_ISO, AUTO_SHUTTER_S
        iso = values.get(ISO)
        if camera.mode == CameraMode.VIDEO and isinstance(iso, int) and iso > MAX_VIDEO_ISO:
            values[ISO] = MAX_VIDEO_ISO

    def can_set(self, name: str) -> bool:
        captures = self._camera.captures
        return name != MODE or not (captures.is_busy or captures.is_recording)

    def on_set(self, name: str, value: SettingValue) -> None:
        if name == MODE and isinstance(value, int) and value != self._camera.mode:
            self._camera.mode = value
            self._camera.send(camera_settings(self._camera))


_FORMAT_S, _FORMAT_PERCENTS = 0.5, (0, 25, 50, 75)
_CAN_ALWAYS_CAPTURE = CameraCapFlags.CAN_CAPTURE_IMAGE_IN_VIDEO_MODE
_CAN_ALWAYS_RECORD = CameraCapFlags.CAN_CAPTURE_VIDEO_IN_IMAGE_MODE


def camera_commands(camera: CameraBody) -> dict[int, CommandHandler]:
    """Return handlers by MAV_CMD, including the older requests that REQUEST_MESSAGE supersedes."""
    pictures, videos, settings = _Pictures(camera), _Videos(camera), _Settings(camera)
    return {
        MavCmd.IMAGE_START_CAPTURE: pictures.start,
        MavCmd.IMAGE_STOP_CAPTURE: pictures.stop,
        MavCmd.DO_DIGICAM_CONTROL: pictures.control,
        MavCmd.STORAGE_FORMAT: pictures.format,
        MavCmd.VIDEO_START_CAPTURE: videos.start,
        MavCmd.VIDEO_STOP_CAPTURE: videos.stop,
        MavCmd.VIDEO_START_STREAMING: lambda command: videos.stream(command, runs=True),
        MavCmd.VIDEO_STOP_STREAMING: lambda command: videos.stream(command, runs=False),
        MavCmd.SET_CAMERA_MODE: settings.set_mode,
        MavCmd.SET_CAMERA_ZOOM: settings.set_zoom,
        MavCmd.SET_CAMERA_FOCUS: settings.set_focus,
        MavCmd.SET_CAMERA_SOURCE: settings.set_source,
        MavCmd.RESET_CAMERA_SETTINGS: settings.reset,
        MavCmd.CAMERA_TRACK_POINT: lambda command: camera.tracking.track_point(command),
        MavCmd.CAMERA_TRACK_RECTANGLE: lambda command: camera.tracking.track_rectangle(command),
        MavCmd.CAMERA_STOP_TRACKING: lambda command: camera.tracking.stop(command),
        **_legacy_requests(camera),
    }


def _legacy_requests(camera: CameraBody) -> dict[int, CommandHandler]:
    wanted: dict[int, int] = {
        MavCmd.REQUEST_CAMERA_INFORMATION: m.CameraInformation.ID,
        MavCmd.REQUEST_CAMERA_SETTINGS: m.CameraSettings.ID,
        MavCmd.REQUEST_CAMERA_CAPTURE_STATUS: m.CameraCaptureStatus.ID,
        MavCmd.REQUEST_STORAGE_INFORMATION: m.StorageInformation.ID,
        MavCmd.REQUEST_VIDEO_STREAM_INFORMATION: m.VideoStreamInformation.ID,
        MavCmd.REQUEST_VIDEO_STREAM_STATUS: m.VideoStreamStatus.ID,
        MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE: m.CameraImageCaptured.ID,
    }

    def handler(message_id: int) -> CommandHandler:
        return lambda command: camera.answer_with(message_id, replace(command, param2=command.param1))

    return {command: handler(message_id) for command, message_id in wanted.items()}


class _Pictures:
    """Commands for images, series of images and the memory card."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera
        self._last_number = 0

    def start(self, command: ReceivedCommand) -> int:
        """Take images if param 1 is 0 or 1 (this camera). A repeated sequence number (param 4) takes no image."""
        camera, captures = self._camera, self._camera.captures
        interval = command.param2 if math.isfinite(command.param2) else 0.0
        count, number = whole(command.param3), whole(command.param4)
        in_wrong_mode = _has_wrong_mode(camera, CameraMode.VIDEO, _CAN_ALWAYS_CAPTURE)
        if not camera.can(CameraCapFlags.CAPTURE_IMAGE):
            return MavResult.UNSUPPORTED
        if command.param1 not in (0.0, 1.0) or interval < 0 or count < 0 or in_wrong_mode:
            return MavResult.DENIED
        if count == 1 and number > 0 and number == self._last_number:
            return MavResult.ACCEPTED
        if captures.is_busy:
            return MavResult.TEMPORARILY_REJECTED
        if camera.card.free_mib < camera.image_mib:
            return MavResult.FAILED
        self._last_number = number if count == 1 else 0
        captures.take_series(interval, count)
        return MavResult.ACCEPTED

    def stop(self, command: ReceivedCommand) -> int:
        if command.param1 not in (0.0, 1.0):
            return MavResult.DENIED
        self._camera.captures.stop()
        return MavResult.ACCEPTED

    def control(self, command: ReceivedCommand) -> int:
        """DO_DIGICAM_CONTROL of the older protocol; param 5 is 1 to take an image."""
        if command.x == 1:
            self._camera.captures.take()
        return MavResult.ACCEPTED

    def format(self, command: ReceivedCommand) -> int | CommandProgress:
        """Takes two seconds; param 3 is 1 to reset the image log."""
        camera, captures = self._camera, self._camera.captures
        if command.param1 not in (0.0, 1.0) or not camera.card.is_inserted:
            return MavResult.DENIED
        if captures.is_busy or captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED

        def finish() -> None:
            if command.param2 == 1.0:
                camera.card.format()
                camera.clear_files()
            if command.param3 == 1.0:
                captures.clear()

        return CommandProgress(_FORMAT_PERCENTS, _FORMAT_S, finish=finish)


class _Videos:
    """Commands for recording and streaming."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera

    def start(self, command: ReceivedCommand) -> int:
        """Param 2 is the rate of CAMERA_CAPTURE_STATUS during the recording, in Hz."""
        camera, captures = self._camera, self._camera.captures
        if not camera.can(CameraCapFlags.CAPTURE_VIDEO):
            return MavResult.UNSUPPORTED
        if _has_wrong_mode(camera, CameraMode.IMAGE, _CAN_ALWAYS_RECORD) or command.param2 < 0:
            return MavResult.DENIED
        if captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED
        if camera.card.free_mib <= 0:
            return MavResult.FAILED
        captures.record(1.0 / command.param2 if command.param2 else 0.0)
        return MavResult.ACCEPTED

    def stop(self, _: ReceivedCommand) -> int:
        self._camera.captures.stop_recording()
        return MavResult.ACCEPTED

    def stream(self, command: ReceivedCommand, *, runs: bool) -> int:
        """Param 1 is the stream; 0 selects all."""
        camera, number = self._camera, whole(command.param1)
        available = range(1, len(camera.streams) + 1)
        if not available or number not in (0, *available):
            return MavResult.DENIED if available else MavResult.UNSUPPORTED
        chosen = set(available) if number == 0 else {number}
        if runs:
            camera.running_streams |= chosen
        else:
            camera.running_streams -= chosen
        return MavResult.ACCEPTED


class _Settings:
    """Commands for mode, zoom and focus; each of them sends CAMERA_SETTINGS."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera

    def set_mode(self, command: ReceivedCommand) -> int:
        camera, mode = self._camera, whole(command.param2)
        if not camera.can(CameraCapFlags.HAS_MODES):
            return MavResult.UNSUPPORTED
        modes = {
            CameraMode.IMAGE: CameraCapFlags.CAPTURE_IMAGE,
            CameraMode.VIDEO: CameraCapFlags.CAPTURE_VIDEO,
            CameraMode.IMAGE_SURVEY: CameraCapFlags.HAS_IMAGE_SURVEY_MODE,
        }
        if mode not in modes or not camera.can(modes[CameraMode(mode)]):
            return MavResult.DENIED
        if camera.captures.is_busy or camera.captures.is_recording:
            return MavResult.TEMPORARILY_REJECTED
        camera.mode = mode
        return self._send_settings()

    def set_zoom(self, command: ReceivedCommand) -> int:
        camera = self._camera
        if not camera.can(CameraCapFlags.HAS_BASIC_ZOOM):
            return MavResult.UNSUPPORTED
        if not camera.lens.set_zoom(whole(command.param1), command.param2):
            return MavResult.DENIED
        return self._send_settings()

    def set_focus(self, command: ReceivedCommand) -> int:
        camera = self._camera
        if not camera.can(CameraCapFlags.HAS_BASIC_FOCUS):
            return MavResult.UNSUPPORTED
        if not camera.lens.set_focus(whole(command.param1), command.param2):
            return MavResult.DENIED
        return self._send_settings()

    def set_source(self, command: ReceivedCommand) -> int:
        """Accept RGB, and IR on a thermal camera (param 2)."""
        source = whole(command.param2)
        sources = {
            CameraSource.DEFAULT,
            CameraSource.IR if self._camera.thermal_celsius else CameraSource.RGB,
        }
        if source not in sources | {CameraSource.RGB}:
            return MavResult.DENIED
        self._camera.source = source
        return MavResult.ACCEPTED

    def reset(self, command: ReceivedCommand) -> int:
        if command.param1 == 1.0:
            self._camera.reset_settings()
            self._camera.parameters.reset()
        return self._send_settings()

    def _send_settings(self) -> int:
        self._camera.send(camera_settings(self._camera))
        return MavResult.ACCEPTED


def _has_wrong_mode(camera: CameraBody, wrong: int, unless: int) -> bool:
    return camera.can(CameraCapFlags.HAS_MODES) and camera.mode == wrong and not camera.can(unless)


class SimulatedCamera(CameraBody):
    """Camera component that takes images, series and videos, with the true position and attitude of each image.

    - ``component_id``: MAVLink reserves 100 to 105 for cameras; ``system_id``: None uses the vehicle's
    - ``vendor``, ``model``, ``definition_uri``, ``capabilities`` (CAMERA_CAP_FLAGS), ``resolution`` (pixels):
      content of CAMERA_INFORMATION. Without HAS_MODES it takes images and videos at any time.
    - ``streams``: addresses of video streams, such as ``rtsp://192.168.0.10:8554/main``; no video is sent
    - ``thermal_celsius``: lowest and highest temperature in the image, for a thermal camera whose last stream is the
      thermal one; None for a visible-light camera
    - ``picture``: content of image files (JPEG), or a function of the capture that returns it; the files are in
      ``/DCIM`` and served by MAVFTP
    - ``gimbal``: the gimbal that carries the camera and determines the direction of images
    - ``capacity_mib``, ``image_mib``, ``video_mib_s``: size of the card, of an image, of a second of video
    - ``shutter_s``: seconds until an image is available

    ``definition`` defines the settings (PARAM_EXT); the default is ``camera_definition.xml`` beside this file. The
    camera serves the definition by MAVFTP. ``definition_uri`` announces another location; "" announces none.

    Images, settings and files survive a reboot; modes and series do not. A tracked target is kept until
    ``tracking.lose()``.
    """

    ALL_CAPABILITIES: ClassVar[int] = (
        CAPABILITIES
        | CameraCapFlags.HAS_IMAGE_SURVEY_MODE
        | CameraCapFlags.HAS_TRACKING_POINT
        | CameraCapFlags.HAS_TRACKING_RECTANGLE
        | CameraCapFlags.HAS_TRACKING_GEO_STATUS
    )
    """Value for ``capabilities`` that adds survey mode and tracking."""

    def listen(self) -> None:
        """Serve files by MAVFTP and settings by PARAM_EXT."""
        serve_files(self, self.files)
        self.parameters: ExtendedParameters = CameraParameters(self)

    def commands(self) -> dict[int, CommandHandler]:
        return camera_commands(self)
