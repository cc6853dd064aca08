"""Memory card and lens of a simulated camera, and CAMERA_IMAGE_CAPTURED."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraZoomType, SetFocusType
from aerokit.sim.components.component import pose_of
from aerokit.sim.motion import GlobalPoint, quaternion_from_euler
from aerokit.sim.vehicle import SimulatedVehicle

GREY_JPEG = base64.b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02B@n5)Ta&5)cv>6%-gAG9exu93DL^E+jHZKuk+VKt@GST61DhRc%&9Mr4R(ZFhTtf`Lw8jhBpl"
    "mUDiAeE+}z3kU!Z01yEI5di<h02KfM0RR910000000000000000{_GS6c7Ob00000000000000000030+5iXv0RR9$0DvF=*#"
)
"""A grey image of 16 × 16 pixels."""

Angles = tuple[float, float, float]


class MemoryCard:
    """A memory card with sizes in MiB. Set ``is_inserted`` to False to remove the card, ``used_mib`` to fill it."""

    def __init__(self, capacity_mib: float) -> None:
        self.capacity_mib = capacity_mib
        self.used_mib: float = 0.0
        self.is_inserted = True

    @property
    def free_mib(self) -> float:
        return max(0.0, self.capacity_mib - self.used_mib) if self.is_inserted else 0.0

    def store(self, size_mib: float) -> bool:
        """Store data of this size. Return False if there is no card or not enough free space."""
        if size_mib > self.free_mib:
            return False
        self.used_mib += size_mib
        return True


FOCAL_LENGTH_MM = 4.5
"""Focal length without zoom."""
_ZOOM_FACTOR = 10.0
_STEP_PERCENT, _MAX_SPEED_PERCENT_S = 10.0, 20.0
_HALF_RANGE_FOCUS_M = 10.0
_SHARP_PERCENT = 50.0
_AUTO = (SetFocusType.AUTO, SetFocusType.AUTO_SINGLE, SetFocusType.AUTO_CONTINUOUS)


class Axis:
    """A lens setting from 0 to 100 percent, which rests or changes at a constant speed."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        # The setting had `_start_percent` at the time `_start_at`, and changes by `_speed` percent per second.
        self._start_percent = self._start_at = self._speed = 0.0

    @property
    def percent(self) -> float:
        moved = (self._now() - self._start_at) * self._speed if self._speed else 0.0
        return max(0.0, min(100.0, self._start_percent + moved))

    def set(self, percent: float) -> None:
        self._start_percent = max(0.0, min(100.0, percent))
        self._speed = 0.0

    def move(self, speed: float) -> None:
        """Move at this speed, from -1 to 1. 0 stops the movement."""
        self._start_percent = self.percent
        self._start_at = self._now()
        self._speed = max(-1.0, min(1.0, speed)) * _MAX_SPEED_PERCENT_S

    def adjust(self, kind: int, value: float) -> bool:
        """Apply a CAMERA_ZOOM_TYPE, or the SET_FOCUS_TYPE with the same number. Return False for other numbers."""
        if kind == CameraZoomType.STEP:  # The value is in tenths of the range.
            self.set(self.percent + value * _STEP_PERCENT)
        elif kind == CameraZoomType.CONTINUOUS:
            self.move(value)
        elif kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            self.set(value)
        else:
            return False
        return True


class Lens:
    """Zoom (up to 10x) and focus of a camera. Automatic focus sets the focus to 50 percent."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.zoom: Axis = Axis(now)
        self.focus: Axis = Axis(now)

    @property
    def focal_length_mm(self) -> float:
        return FOCAL_LENGTH_MM * (1.0 + (_ZOOM_FACTOR - 1.0) * self.zoom.percent / 100.0)

    def set_zoom(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_ZOOM. Return False if ``kind`` (CAMERA_ZOOM_TYPE) or ``value`` is not supported."""
        zoom_factor = value / FOCAL_LENGTH_MM
        if kind != CameraZoomType.FOCAL_LENGTH or not 1.0 <= zoom_factor <= _ZOOM_FACTOR:
            return self.zoom.adjust(kind, value)
        self.zoom.set((zoom_factor - 1.0) / (_ZOOM_FACTOR - 1.0) * 100.0)
        return True

    def set_focus(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_FOCUS. Return False if ``kind`` (SET_FOCUS_TYPE) or ``value`` is not supported."""
        if kind == SetFocusType.METERS and value > 0.0:
            self.focus.set(100.0 * value / (value + _HALF_RANGE_FOCUS_M))  # A focus of 100 % is infinity.
        elif kind in _AUTO:
            self.focus.set(_SHARP_PERCENT)
        else:
            return self.focus.adjust(kind, value)
        return True


_UNKNOWN_ATTITUDE = (math.nan,) * 4


def captured_image(
    vehicle: SimulatedVehicle,
    time_boot_ms: int,
    angles: Angles | None,
    *,
    camera_id: int = 0,
    index: int = 0,
    result: int = 0,
) -> m.CameraImageCaptured:
    """Return CAMERA_IMAGE_CAPTURED with the true position of a vehicle. ``angles`` are those of the camera."""
    pose = pose_of(vehicle)
    place = GlobalPoint(0, 0, 0.0) if pose is None else pose.place
    return m.CameraImageCaptured(
        time_boot_ms=time_boot_ms, time_utc=round(getattr(vehicle, "unix_time", 0.0) * 1e6), camera_id=camera_id,
        lat=place.latitude_e7, lon=place.longitude_e7, alt=round(place.altitude_m * 1000),
        relative_alt=0 if pose is None else round(pose.height_m * 1000),
        q=_UNKNOWN_ATTITUDE if angles is None else quaternion_from_euler(*angles), image_index=index,
        capture_result=result, file_url="",
    )  # fmt: skip
