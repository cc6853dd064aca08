"""`SimulatedCamera`: a camera component that implements the MAVLink camera protocol.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

from typing import ClassVar

from aerokit.mavlink.enums import CameraCapFlags, CameraMode, MavCmd, MavResult
from aerokit.parameters import SettingValue
from aerokit.protocols.servers.camera import AsyncHandler, camera_settings
from aerokit.protocols.servers.camera_commands import camera_commands, legacy_requests
from aerokit.protocols.servers.commands import CommandHandler, CommandProgress, ReceivedCommand
from aerokit.sim.components.camera_body import CAPABILITIES, CameraBody
from aerokit.sim.components.component import ExtendedParameters, serve_files

MODE, EXPOSURE, ISO, SHUTTER = "CAM_MODE", "CAM_EXPMODE", "CAM_ISO", "CAM_SHUTTER"
AUTO, AUTO_ISO, AUTO_SHUTTER_S = 0, 200, 0.002
MAX_VIDEO_ISO = 400


class CameraParameters(ExtendedParameters):
    """The settings of the camera (PARAM_EXT). During a capture or a recording, the mode cannot be set."""

    def __init__(self, camera: CameraBody) -> None:
        self._camera = camera
        super().__init__(camera, camera.definition)

    def refresh(self) -> None:
        values, camera = self.values, self._camera
        if MODE in values:
            values[MODE] = int(camera.mode)
        has_iso_and_shutter = {ISO, SHUTTER} <= values.keys()
        if values.get(EXPOSURE) == AUTO and has_iso_and_shutter:
            values[ISO] = AUTO_ISO
            values[SHUTTER] = AUTO_SHUTTER_S
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


_FORMAT_INTERVAL_S, _FORMAT_PERCENTS = 0.5, (0, 25, 50, 75)


def _format(camera: CameraBody, command: ReceivedCommand) -> int | CommandProgress:
    captures = camera.captures
    is_card_known = command.param1 in (0.0, 1.0)  # 0 selects all cards, and the camera has one card.
    if not is_card_known or not camera.card.is_inserted:
        return MavResult.DENIED
    if captures.is_busy or captures.is_recording:
        return MavResult.TEMPORARILY_REJECTED

    formats_card, resets_image_log = command.param2 == 1.0, command.param3 == 1.0

    def finish() -> None:
        if formats_card:
            camera.card.format()
            camera.clear_files()
        if resets_image_log:
            captures.clear()

    return CommandProgress(_FORMAT_PERCENTS, _FORMAT_INTERVAL_S, finish=finish)


def _synchronous(handler: AsyncHandler) -> CommandHandler:
    """Return a synchronous version of a handler that never has to wait."""

    def execute(command: ReceivedCommand) -> int:
        try:
            handler(command).send(None)  # runs the coroutine until it waits or returns
        except StopIteration as end:  # A coroutine returns its value by this exception.
            return int(end.value)
        raise AssertionError("a command handler of the simulated camera must not wait, but it did")

    return execute


class SimulatedCamera(CameraBody):
    """Camera component that takes images, series and videos, with the true position and attitude of each image.

    - ``component_id``: MAVLink reserves 100 to 105 for cameras; ``system_id``: None uses that of the vehicle
    - ``vendor``, ``model``, ``definition_uri``, ``capabilities`` (CAMERA_CAP_FLAGS), ``resolution`` (pixels):
      content of CAMERA_INFORMATION. Without HAS_MODES it takes images and videos at any time.
    - ``streams``: addresses of video streams, such as ``rtsp://192.168.0.10:8554/main``; no video is sent
    - ``thermal_celsius``: lowest and highest temperature in the image of a thermal camera; None for a visible-light
      camera. The last stream of a thermal camera is the thermal stream.
    - ``picture``: content of image files (JPEG), or a function that returns it for a `Capture`; the files are in
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
    """Value for ``capabilities`` that adds survey mode and tracking to the default."""

    def listen(self) -> None:
        """Serve files by MAVFTP and settings by PARAM_EXT."""
        serve_files(self, self.files)
        self.parameters: ExtendedParameters = CameraParameters(self)

    def commands(self) -> dict[int, CommandHandler]:
        return {
            **{command: _synchronous(handler) for command, handler in camera_commands(self).items()},
            MavCmd.STORAGE_FORMAT: lambda command: _format(self, command),
            **legacy_requests(self._streams),
        }
