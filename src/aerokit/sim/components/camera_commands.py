"""The commands (MAV_CMD) that a simulated camera knows, and its answers."""

from __future__ import annotations

import math
from dataclasses import replace

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, CameraMode, CameraSource, MavCmd, MavResult
from aerokit.parameters import SettingValue
from aerokit.sim.commands import Command, CommandHandler, Progress, whole
from aerokit.sim.components.camera_body import CameraBody
from aerokit.sim.components.camera_messages import camera_settings
from aerokit.sim.components.extended_parameters import ExtendedParameters

MODE, EXPOSURE, ISO, SHUTTER = "CAM_MODE", "CAM_EXPMODE", "CAM_ISO", "CAM_SHUTTER"
AUTO, AUTO_ISO, AUTO_SHUTTER_S = 0, 200, 0.002
MOST_IN_VIDEO = 400


class CameraParameters(ExtendedParameters):
    """Set while a picture is taken or a video recorded, the mode is FAILED."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera
        super().__init__(camera, camera.definition)

    def refresh(self) -> None:
        """The mode may have been set by a command."""
        values, camera = self.values, self._camera
        if MODE in values:
            values[MODE] = int(camera.mode)
        if values.get(EXPOSURE) == AUTO and {ISO, SHUTTER} <= values.keys():
            values[ISO], values[SHUTTER] = AUTO_ISO, AUTO_SHUTTER_S
        iso = values.get(ISO)
        if camera.mode == CameraMode.VIDEO and isinstance(iso, int) and iso > MOST_IN_VIDEO:
            values[ISO] = MOST_IN_VIDEO

    def can_set(self, name: str) -> bool:
        captures = self._camera.captures
        return name != MODE or not (captures.is_busy or captures.is_recording)

    def has_set(self, name: str, value: SettingValue) -> None:
        if name == MODE and isinstance(value, int) and value != self._camera.mode:
            self._camera.mode = value
            self._camera.send(camera_settings(self._camera))


_FORMAT_S, _FORMAT_PERCENTS = 0.5, (0, 25, 50, 75)
_CAN_ALWAYS_CAPTURE = CameraCapFlags.CAN_CAPTURE_IMAGE_IN_VIDEO_MODE
_CAN_ALWAYS_RECORD = CameraCapFlags.CAN_CAPTURE_VIDEO_IN_IMAGE_MODE


def camera_commands(camera: CameraBody) -> dict[int, CommandHandler]:
    """MAV_CMD → handler, those of before REQUEST_MESSAGE too."""
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
        **_requests_of_old(camera),
    }


def _requests_of_old(camera: CameraBody) -> dict[int, CommandHandler]:
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
    """Single ones, series, and the card."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera
        self._last_number = 0

    def start(self, command: Command) -> int:
        """Param 1 0 or 1 is this camera; one picture with the number (param 4) of the last order is not taken again."""
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

    def stop(self, command: Command) -> int:
        if command.param1 not in (0.0, 1.0):
            return MavResult.DENIED
        self._camera.captures.stop()
        return MavResult.ACCEPTED

    def control(self, command: Command) -> int:
        """Of the protocol before this one; param 5 1 takes a picture."""
        if command.x == 1:
            self._camera.captures.take()
        return MavResult.ACCEPTED

    def format(self, command: Command) -> int | Progress:
        """Takes two seconds; param 3 1 clears the log of pictures, too."""
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

        return Progress(_FORMAT_PERCENTS, _FORMAT_S, finish=finish)


class _Videos:
    """Recorded and streamed ones."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera

    def start(self, command: Command) -> int:
        """Param 2 is how often CAMERA_CAPTURE_STATUS comes meanwhile, in Hz."""
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

    def stop(self, _: Command) -> int:
        self._camera.captures.stop_recording()
        return MavResult.ACCEPTED

    def stream(self, command: Command, *, runs: bool) -> int:
        """Param 1 is the stream, 0 is all."""
        camera, number = self._camera, whole(command.param1)
        there = range(1, len(camera.streams) + 1)
        if not there or number not in (0, *there):
            return MavResult.DENIED if there else MavResult.UNSUPPORTED
        chosen = set(there) if number == 0 else {number}
        if runs:
            camera.running_streams |= chosen
        else:
            camera.running_streams -= chosen
        return MavResult.ACCEPTED


class _Settings:
    """Mode, zoom, focus; each change is told by CAMERA_SETTINGS."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera

    def set_mode(self, command: Command) -> int:
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
        return self._told()

    def set_zoom(self, command: Command) -> int:
        camera = self._camera
        if not camera.can(CameraCapFlags.HAS_BASIC_ZOOM):
            return MavResult.UNSUPPORTED
        if not camera.lens.set_zoom(whole(command.param1), command.param2):
            return MavResult.DENIED
        return self._told()

    def set_focus(self, command: Command) -> int:
        camera = self._camera
        if not camera.can(CameraCapFlags.HAS_BASIC_FOCUS):
            return MavResult.UNSUPPORTED
        if not camera.lens.set_focus(whole(command.param1), command.param2):
            return MavResult.DENIED
        return self._told()

    def set_source(self, command: Command) -> int:
        """Light, and warmth of a thermal one."""
        source = whole(command.param2)
        here = {CameraSource.DEFAULT, CameraSource.IR if self._camera.thermal_celsius else CameraSource.RGB}
        if source not in here | {CameraSource.RGB}:
            return MavResult.DENIED
        self._camera.source = source
        return MavResult.ACCEPTED

    def reset(self, command: Command) -> int:
        if command.param1 == 1.0:
            self._camera.reset_settings()
            self._camera.parameters.reset()
        return self._told()

    def _told(self) -> int:
        self._camera.send(camera_settings(self._camera))
        return MavResult.ACCEPTED


def _has_wrong_mode(camera: CameraBody, wrong: int, unless: int) -> bool:
    return camera.can(CameraCapFlags.HAS_MODES) and camera.mode == wrong and not camera.can(unless)
