"""What a simulated camera tracks: it stays where it was in the picture, until it is lost."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, CameraTrackingMode, MavResult
from aerokit.mavlink.enums import CameraTrackingStatusFlags as Flags
from aerokit.mavlink.enums import CameraTrackingTargetData as Target
from aerokit.sim.components.pose import pose_of
from aerokit.sim.local_frame import LocalFrame

if TYPE_CHECKING:
    from aerokit.sim.commands import Command
    from aerokit.sim.components.camera import SimulatedCamera

__all__ = ["Tracking"]

_STEEPEST = -math.radians(5)
"""A camera that looks up, or nearly to the horizon, sees no place on the ground."""
_NOT_KNOWN, _ACCURACY_M = math.nan, 1.0


class Tracking:
    """A point or a rectangle; ``lose()`` has it lost."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self._camera = camera
        self.reset()

    def reset(self) -> None:
        """Nothing is tracked."""
        self.mode: CameraTrackingMode = CameraTrackingMode.NONE
        self.place: tuple[float, ...] = ()
        """x, y, radius; or left, top, right, bottom."""
        self.is_lost: bool = False

    def lose(self) -> None:
        """What is tracked has gone out of the picture."""
        self.is_lost = True

    # ------------------------------------------------------------------------------------- commands

    def track_point(self, command: Command) -> int:
        """MAV_CMD_CAMERA_TRACK_POINT."""
        place = (command.param1, command.param2, command.param3)
        return self._track(CameraCapFlags.HAS_TRACKING_POINT, CameraTrackingMode.POINT, place)

    def track_rectangle(self, command: Command) -> int:
        """MAV_CMD_CAMERA_TRACK_RECTANGLE."""
        place = (command.param1, command.param2, command.param3, command.param4)
        return self._track(CameraCapFlags.HAS_TRACKING_RECTANGLE, CameraTrackingMode.RECTANGLE, place)

    def _track(self, capability: int, mode: CameraTrackingMode, place: tuple[float, ...]) -> int:
        if not self._camera.can(capability):
            return MavResult.UNSUPPORTED
        if not all(0.0 <= each <= 1.0 for each in place):
            return MavResult.DENIED
        self.mode = mode
        self.place = place
        self.is_lost = False
        return MavResult.ACCEPTED

    def stop(self, _: Command) -> int:
        """MAV_CMD_CAMERA_STOP_TRACKING."""
        if not self._camera.can(CameraCapFlags.HAS_TRACKING_POINT, CameraCapFlags.HAS_TRACKING_RECTANGLE):
            return MavResult.UNSUPPORTED
        self.reset()
        return MavResult.ACCEPTED

    # ------------------------------------------------------------------------------------- messages

    @property
    def _flags(self) -> int:
        if self.mode == CameraTrackingMode.NONE:
            return 0
        return Flags.ERROR if self.is_lost else Flags.ACTIVE

    def image_status(self) -> m.CameraTrackingImageStatus:
        """CAMERA_TRACKING_IMAGE_STATUS."""
        is_point = self.mode == CameraTrackingMode.POINT
        x, y, radius = self.place if is_point else (_NOT_KNOWN,) * 3
        is_rectangle = self.mode == CameraTrackingMode.RECTANGLE
        left, top, right, bottom = self.place if is_rectangle else (_NOT_KNOWN,) * 4
        mode = int(self.mode)
        return m.CameraTrackingImageStatus(
            self._flags, mode, Target.IN_STATUS, x, y, radius, left, top, right, bottom
        )

    def geo_status(self) -> list[m.CameraTrackingGeoStatus]:
        """CAMERA_TRACKING_GEO_STATUS: where the camera's axis meets the ground of home's height."""
        pose, angles = pose_of(self._camera.vehicle), self._camera.angles()
        if pose is None or angles is None or angles[1] > _STEEPEST:
            return []
        _, pitch, yaw = angles
        away = pose.height_m / math.tan(-pitch)
        place = LocalFrame(pose.place).to_global(away * math.cos(yaw), away * math.sin(yaw), pose.height_m)
        return [
            m.CameraTrackingGeoStatus(
                self._flags,
                place.latitude_e7,
                place.longitude_e7,
                place.altitude_m,
                _ACCURACY_M,
                _ACCURACY_M,
                0.0,
                0.0,
                0.0,
                _NOT_KNOWN,
                math.hypot(away, pose.height_m),
                _NOT_KNOWN,
                _NOT_KNOWN,
            )
        ]
