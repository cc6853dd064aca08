"""Zoom, focus and tracking of a simulated camera."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraCapFlags, CameraTrackingMode, CameraZoomType, MavResult, SetFocusType
from aerokit.mavlink.enums import CameraTrackingStatusFlags as Flags
from aerokit.mavlink.enums import CameraTrackingTargetData as Target
from aerokit.sim.commands import Command
from aerokit.sim.components.captures import CameraHost
from aerokit.sim.components.component import pose_of
from aerokit.sim.local_frame import LocalFrame

FOCAL_LENGTH_MM = 4.5
"""Zoomed out."""
_TIMES = 10.0
_STEP_PERCENT, _PERCENT_S = 10.0, 20.0
_HALF_WAY_M = 10.0
_SHARP_PERCENT = 50.0
_AUTO = (SetFocusType.AUTO, SetFocusType.AUTO_SINGLE, SetFocusType.AUTO_CONTINUOUS)


class Axis:
    """Something from 0 to 100 percent that stands, or moves until it is stopped or at its end."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._from, self._since, self._speed = 0.0, 0.0, 0.0

    @property
    def percent(self) -> float:
        moved = (self._now() - self._since) * self._speed if self._speed else 0.0
        return max(0.0, min(100.0, self._from + moved))

    def set(self, percent: float) -> None:
        self._from, self._speed = max(0.0, min(100.0, percent)), 0.0

    def move(self, speed: float) -> None:
        """Go on at this speed, -1 to 1; 0 stops."""
        self._from, self._since = self.percent, self._now()
        self._speed = max(-1.0, min(1.0, speed)) * _PERCENT_S

    def step(self, steps: float) -> None:
        """So many tenths of the range."""
        self.set(self.percent + steps * _STEP_PERCENT)


class Lens:
    """Ten times zoom, and a focus that by itself is right in the middle."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.zoom: Axis = Axis(now)
        self.focus: Axis = Axis(now)

    @property
    def focal_length_mm(self) -> float:
        """As it is zoomed now."""
        return FOCAL_LENGTH_MM * (1.0 + (_TIMES - 1.0) * self.zoom.percent / 100.0)

    def set_zoom(self, kind: int, value: float) -> bool:
        """SET_CAMERA_ZOOM; False when it is not known so, or out of range."""
        if kind == CameraZoomType.STEP:
            self.zoom.step(value)
        elif kind == CameraZoomType.CONTINUOUS:
            self.zoom.move(value)
        elif kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            self.zoom.set(value)
        elif kind == CameraZoomType.FOCAL_LENGTH and 1.0 <= value / FOCAL_LENGTH_MM <= _TIMES:
            self.zoom.set((value / FOCAL_LENGTH_MM - 1.0) / (_TIMES - 1.0) * 100.0)
        else:
            return False
        return True

    def set_focus(self, kind: int, value: float) -> bool:
        """SET_CAMERA_FOCUS; False when it is not known so, or out of range."""
        if kind == SetFocusType.STEP:
            self.focus.step(value)
        elif kind == SetFocusType.CONTINUOUS:
            self.focus.move(value)
        elif kind == SetFocusType.RANGE and 0.0 <= value <= 100.0:
            self.focus.set(value)
        elif kind == SetFocusType.METERS and value > 0.0:
            self.focus.set(100.0 * value / (value + _HALF_WAY_M))
        elif kind in _AUTO:
            self.focus.set(_SHARP_PERCENT)
        else:
            return False
        return True


_STEEPEST = -math.radians(5)
"""A camera that looks up, or nearly to the horizon, sees no place on the ground."""
_NOT_KNOWN, _ACCURACY_M = math.nan, 1.0


class Tracking:
    """A point or a rectangle; ``lose()`` has it lost."""

    def __init__(self, camera: CameraHost) -> None:
        self._camera = camera
        self.reset()

    def reset(self) -> None:
        self.mode: CameraTrackingMode = CameraTrackingMode.NONE
        self.place: tuple[float, ...] = ()
        """x, y, radius; or left, top, right, bottom."""
        self.is_lost: bool = False

    def lose(self) -> None:
        """What is tracked has gone out of the picture."""
        self.is_lost = True

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
