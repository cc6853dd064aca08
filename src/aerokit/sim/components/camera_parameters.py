"""The settings of a simulated camera: its mode is one of them, and exposure that it chooses itself is its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CameraMode
from aerokit.sim.components.camera_messages import camera_settings
from aerokit.sim.components.extended_parameters import ExtendedParameters

if TYPE_CHECKING:
    from aerokit.parameters import SettingValue
    from aerokit.sim.components.camera import SimulatedCamera

__all__ = ["DEFINITION_PATH", "CameraParameters", "own_definition"]

DEFINITION_PATH = "/camera_definition.xml"
"""Where the camera serves its definition by MAVFTP."""
MODE, EXPOSURE, ISO, SHUTTER = "CAM_MODE", "CAM_EXPMODE", "CAM_ISO", "CAM_SHUTTER"
AUTO, AUTO_ISO, AUTO_SHUTTER_S = 0, 200, 0.002
MOST_IN_VIDEO = 400


def own_definition() -> bytes:
    """The file of cameras that were given no other."""
    return Path(__file__).with_name("camera_definition.xml").read_bytes()


class CameraParameters(ExtendedParameters):
    """Set while a picture is taken or a video recorded, the mode is FAILED."""

    def __init__(self, camera: SimulatedCamera) -> None:
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
        """Not everything at any time."""
        captures = self._camera.captures
        return name != MODE or not (captures.is_busy or captures.is_recording)

    def has_set(self, name: str, value: SettingValue) -> None:
        """The mode is the camera's."""
        if name == MODE and isinstance(value, int) and value != self._camera.mode:
            self._camera.mode = value
            self._camera.send(camera_settings(self._camera))
