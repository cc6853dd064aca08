"""Memory card, lens and view of a simulated camera."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraZoomType, SetFocusType, StorageStatus, StorageType, StorageUsageFlag
from aerokit.mavlink.messages import StorageInformation
from aerokit.sim.components.component import SimulatedComponent, pose_of
from aerokit.sim.motion import GlobalPoint, LocalFrame, quaternion_from_euler
from aerokit.sim.vehicle import SimulatedVehicle

GREY_JPEG = base64.b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02B@n5)Ta&5)cv>6%-gAG9exu93DL^E+jHZKuk+VKt@GST61DhRc%&9Mr4R(ZFhTtf`Lw8jhBpl"
    "mUDiAeE+}z3kU!Z01yEI5di<h02KfM0RR910000000000000000{_GS6c7Ob00000000000000000030+5iXv0RR9$0DvF=*#"
)
"""A grey image of 16 × 16 pixels."""

Angles = tuple[float, float, float]

_READ_MIB_S, _WRITE_MIB_S = 90.0, 45.0
_STORAGE_ID = 1


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

    def format(self) -> None:
        self.used_mib = 0.0

    def information(self, camera: SimulatedComponent, number: int) -> list[StorageInformation]:
        if number not in (0, _STORAGE_ID):
            return []
        is_inserted = self.is_inserted
        return [
            StorageInformation(
                time_boot_ms=camera.time_boot_ms, storage_id=_STORAGE_ID, storage_count=1,
                status=StorageStatus.READY if is_inserted else StorageStatus.EMPTY,
                total_capacity=self.capacity_mib if is_inserted else 0.0,
                used_capacity=self.used_mib if is_inserted else 0.0, available_capacity=self.free_mib,
                read_speed=_READ_MIB_S, write_speed=_WRITE_MIB_S, type=StorageType.MICROSD, name="SD",
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]  # fmt: skip


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

    def step(self, steps: float) -> None:
        """Change the setting by ``steps`` tenths of its range."""
        self.set(self.percent + steps * _STEP_PERCENT)


class Lens:
    """Zoom (up to 10x) and focus of a camera. Automatic focus sets the focus to 50 percent."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.zoom: Axis = Axis(now)
        self.focus: Axis = Axis(now)

    @property
    def focal_length_mm(self) -> float:
        return FOCAL_LENGTH_MM * (1.0 + (_ZOOM_FACTOR - 1.0) * self.zoom.percent / 100.0)

    def set_zoom(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_ZOOM. Return False if the type or the value is not supported."""
        if kind == CameraZoomType.STEP:
            self.zoom.step(value)
        elif kind == CameraZoomType.CONTINUOUS:
            self.zoom.move(value)
        elif kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            self.zoom.set(value)
        elif kind == CameraZoomType.FOCAL_LENGTH and 1.0 <= value / FOCAL_LENGTH_MM <= _ZOOM_FACTOR:
            zoom_factor = value / FOCAL_LENGTH_MM
            self.zoom.set((zoom_factor - 1.0) / (_ZOOM_FACTOR - 1.0) * 100.0)
        else:
            return False
        return True

    def set_focus(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_FOCUS. Return False if the type or the value is not supported."""
        if kind == SetFocusType.STEP:
            self.focus.step(value)
        elif kind == SetFocusType.CONTINUOUS:
            self.focus.move(value)
        elif kind == SetFocusType.RANGE and 0.0 <= value <= 100.0:
            self.focus.set(value)
        elif kind == SetFocusType.METERS and value > 0.0:
            self.focus.set(100.0 * value / (value + _HALF_RANGE_FOCUS_M))  # 100 % is infinity.
        elif kind in _AUTO:
            self.focus.set(_SHARP_PERCENT)
        else:
            return False
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


# With a pitch above this limit, the optical axis meets the ground too far away or not at all.
_MAX_GROUND_PITCH_RAD = -math.radians(5)
_UNKNOWN, _ACCURACY_M = math.nan, 1.0


def tracked_place(component: SimulatedComponent, flags: int, angles: Angles | None) -> list[m.CameraTrackingGeoStatus]:
    """Return CAMERA_TRACKING_GEO_STATUS for the point where the optical axis meets the ground."""
    pose = pose_of(component.vehicle)
    if pose is None or angles is None:
        return []
    _, pitch, yaw = angles
    if pitch > _MAX_GROUND_PITCH_RAD:
        return []
    # The ground is level, at the altitude of home.
    distance = pose.height_m / math.tan(-pitch)
    place = LocalFrame(pose.place).to_global(distance * math.cos(yaw), distance * math.sin(yaw), pose.height_m)
    return [
        m.CameraTrackingGeoStatus(
            tracking_status=flags, lat=place.latitude_e7, lon=place.longitude_e7, alt=place.altitude_m,
            h_acc=_ACCURACY_M, v_acc=_ACCURACY_M, vel_n=0.0, vel_e=0.0, vel_d=0.0, vel_acc=_UNKNOWN,
            dist=math.hypot(distance, pose.height_m), hdg=_UNKNOWN, hdg_acc=_UNKNOWN,
        )
    ]  # fmt: skip
