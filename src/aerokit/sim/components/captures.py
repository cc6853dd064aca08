"""Captures of a simulated camera: images and videos, memory card, lens, tracking."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from functools import partial

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraTrackingMode,
    CameraZoomType,
    MavResult,
    SetFocusType,
    StorageStatus,
    StorageType,
    StorageUsageFlag,
)
from aerokit.mavlink.enums import CameraTrackingStatusFlags as Flags
from aerokit.mavlink.enums import CameraTrackingTargetData as Target
from aerokit.mavlink.messages import CameraCaptureStatus, CameraImageCaptured, StorageInformation
from aerokit.sim.commands import ReceivedCommand
from aerokit.sim.components.component import SimulatedComponent, pose_of
from aerokit.sim.motion import LocalFrame, quaternion_from_euler

GREY_JPEG = base64.b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02B@n5)Ta&5)cv>6%-gAG9exu93DL^E+jHZKuk+VKt@GST61DhRc%&9Mr4R(ZFhTtf`Lw8jhBpl"
    "mUDiAeE+}z3kU!Z01yEI5di<h02KfM0RR910000000000000000{_GS6c7Ob00000000000000000030+5iXv0RR9$0DvF=*#"
)
"""A grey image of 16 × 16 pixels."""

_READ_MIB_S, _WRITE_MIB_S = 90.0, 45.0
_NUMBER = 1


class MemoryCard:
    """A memory card; sizes are in MiB. Set ``is_inserted`` to False to remove it, assign ``used_mib`` to fill it."""

    def __init__(self, capacity_mib: float) -> None:
        self.capacity_mib = capacity_mib
        self.used_mib: float = 0.0
        self.is_inserted = True

    @property
    def free_mib(self) -> float:
        """Free space; 0 without a card."""
        return max(0.0, self.capacity_mib - self.used_mib) if self.is_inserted else 0.0

    def store(self, size_mib: float) -> bool:
        """Store data; return False if it does not fit or there is no card."""
        if size_mib > self.free_mib:
            return False
        self.used_mib += size_mib
        return True

    def format(self) -> None:
        self.used_mib = 0.0

    def information(self, camera: SimulatedComponent, number: int) -> list[StorageInformation]:
        """Return STORAGE_INFORMATION of the card with this number; 0 selects all cards."""
        if number not in (0, _NUMBER):
            return []
        is_inserted = self.is_inserted
        return [
            StorageInformation(
                time_boot_ms=camera.time_boot_ms,
                storage_id=_NUMBER,
                storage_count=1,
                status=StorageStatus.READY if is_inserted else StorageStatus.EMPTY,
                total_capacity=self.capacity_mib if is_inserted else 0.0,
                used_capacity=self.used_mib if is_inserted else 0.0,
                available_capacity=self.free_mib,
                read_speed=_READ_MIB_S,
                write_speed=_WRITE_MIB_S,
                type=StorageType.MICROSD,
                name="SD",
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]


class CameraHost(SimulatedComponent):
    """Interface of a camera that its captures and its tracking use."""

    capabilities: int
    card: MemoryCard
    image_mib: float
    video_mib_s: float
    shutter_s: float

    def can(self, *flags: int) -> bool:
        """Return True if the camera has one of these CAMERA_CAP_FLAGS."""
        return any(self.capabilities & flag for flag in flags)

    def angles(self) -> tuple[float, float, float] | None:
        """Return roll, pitch and yaw (from north) of the view in radians; None if unknown."""
        raise NotImplementedError

    def store_image(self, image: CameraImageCaptured) -> str:
        """Write the file of an image and return its URL."""
        raise NotImplementedError


_IDLE, _CAPTURING, _WAITING, _WAITING_AND_CAPTURING = 0, 1, 2, 3
_UNLIMITED = -1
_NOWHERE = (math.nan, math.nan, math.nan, math.nan)


class Captures:
    """Takes images and videos. CAMERA_IMAGE_CAPTURED follows ``shutter_s`` after an image is taken."""

    def __init__(self, camera: CameraHost) -> None:
        self._camera = camera
        self.images: list[CameraImageCaptured] = []
        """Images since the image log was last cleared, by image index."""
        self.interval_s: float = 0.0
        """Interval of the series."""
        self._remaining = 0
        self._is_open = False
        self._series = 0
        self._recording_since = math.nan

    def switch_off(self) -> None:
        """Abort everything, as a power cut does; images stay."""
        self._remaining, self._is_open, self._recording_since = 0, False, math.nan
        self._series += 1

    @property
    def is_busy(self) -> bool:
        """True while an image is being taken or a series runs."""
        return self._is_open or self._remaining != 0

    @property
    def is_recording(self) -> bool:
        return not math.isnan(self._recording_since)

    def take(self) -> None:
        self.take_series(0.0, 1)

    def take_series(self, interval_s: float, count: int) -> None:
        """Take an image every ``interval_s`` seconds, the first at once; ``count`` 0 continues until `stop`."""
        self.interval_s = interval_s if count != 1 else 0.0
        self._remaining = count or _UNLIMITED
        self._series += 1
        self._open(self._series)

    def stop(self) -> None:
        """End a series; the current image is completed."""
        self._remaining = 0

    def clear(self) -> None:
        """Clear the image log; the next index is 0."""
        self.images.clear()

    def _open(self, series: int) -> None:
        camera = self._camera
        if series != self._series or self._remaining == 0:
            return
        self._remaining = max(_UNLIMITED, self._remaining - 1) if self._remaining > 0 else _UNLIMITED
        self._is_open = True
        shot = self._shoot()
        camera.call_later(camera.shutter_s, lambda: self._finish(series, shot))
        if self._remaining:
            wait = max(self.interval_s, camera.shutter_s)
            camera.call_later(wait, lambda: self._open(series))

    def _finish(self, series: int, shot: partial[CameraImageCaptured]) -> None:
        if series != self._series:
            return
        self._is_open = False
        camera = self._camera
        is_stored = camera.card.store(camera.image_mib)
        image = shot(image_index=len(self.images), capture_result=int(is_stored))
        if is_stored:
            image = shot(image_index=len(self.images), capture_result=1, file_url=camera.store_image(image))
            self.images.append(image)
        else:
            self.stop()
        camera.send(image)
        if not self._remaining:
            camera.send(self.status())

    def _shoot(self) -> partial[CameraImageCaptured]:
        """Return CAMERA_IMAGE_CAPTURED with time, position and attitude, still without index and result."""
        camera, pose = self._camera, pose_of(self._camera.vehicle)
        place = None if pose is None else pose.place
        angles = camera.angles()
        return partial(
            CameraImageCaptured,
            camera.time_boot_ms,
            round(getattr(camera.vehicle, "unix_time", 0.0) * 1e6),
            0,
            0 if place is None else place.latitude_e7,
            0 if place is None else place.longitude_e7,
            0 if place is None else round(place.altitude_m * 1000),
            0 if pose is None else round(pose.height_m * 1000),
            _NOWHERE if angles is None else quaternion_from_euler(*angles),
            file_url="",
        )

    def record(self, status_interval_s: float) -> None:
        """Start a video; sends CAMERA_CAPTURE_STATUS at this interval, or never for 0."""
        self._recording_since = self._camera.now
        self._camera.send(self.status())
        if 0.0 < status_interval_s < math.inf:
            self._send_status_every(self._recording_since, status_interval_s)

    def stop_recording(self) -> None:
        """End the video and store it."""
        if self.is_recording:
            seconds = self._camera.now - self._recording_since
            self._recording_since = math.nan
            card = self._camera.card
            card.store(min(card.free_mib, seconds * self._camera.video_mib_s))
            self._camera.send(self.status())

    def _send_status_every(self, recording: float, interval_s: float) -> None:
        def send_status() -> None:
            if self._recording_since == recording:
                self._camera.send(self.status())
                self._send_status_every(recording, interval_s)

        self._camera.call_later(interval_s, send_status)

    def status(self) -> CameraCaptureStatus:
        camera = self._camera
        is_series = self._remaining != 0 and self.interval_s > 0.0
        busy = (_WAITING_AND_CAPTURING if self._is_open else _WAITING) if is_series else int(self._is_open)
        recording_s = camera.now - self._recording_since if self.is_recording else 0.0
        return CameraCaptureStatus(
            time_boot_ms=camera.time_boot_ms,
            image_status=busy,
            video_status=int(self.is_recording),
            image_interval=self.interval_s if is_series else 0.0,
            recording_time_ms=round(recording_s * 1000),
            available_capacity=camera.card.free_mib,
            image_count=len(self.images),
        )


FOCAL_LENGTH_MM = 4.5
"""Focal length without zoom."""
_ZOOM_FACTOR = 10.0
_STEP_PERCENT, _PERCENT_S = 10.0, 20.0
_HALF_RANGE_FOCUS_M = 10.0
_SHARP_PERCENT = 50.0
_AUTO = (SetFocusType.AUTO, SetFocusType.AUTO_SINGLE, SetFocusType.AUTO_CONTINUOUS)


class Axis:
    """A lens setting from 0 to 100 percent, at rest or moving at constant speed."""

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
        """Move at this speed, -1 to 1; 0 stops."""
        self._from, self._since = self.percent, self._now()
        self._speed = max(-1.0, min(1.0, speed)) * _PERCENT_S

    def step(self, steps: float) -> None:
        """Move by ``steps`` tenths of the range."""
        self.set(self.percent + steps * _STEP_PERCENT)


class Lens:
    """Zoom (up to ten times) and focus of a camera; automatic focus sets 50 percent."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.zoom: Axis = Axis(now)
        self.focus: Axis = Axis(now)

    @property
    def focal_length_mm(self) -> float:
        """Focal length at the current zoom."""
        return FOCAL_LENGTH_MM * (1.0 + (_ZOOM_FACTOR - 1.0) * self.zoom.percent / 100.0)

    def set_zoom(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_ZOOM; return False if type or value is not supported."""
        if kind == CameraZoomType.STEP:
            self.zoom.step(value)
        elif kind == CameraZoomType.CONTINUOUS:
            self.zoom.move(value)
        elif kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            self.zoom.set(value)
        elif kind == CameraZoomType.FOCAL_LENGTH and 1.0 <= value / FOCAL_LENGTH_MM <= _ZOOM_FACTOR:
            self.zoom.set((value / FOCAL_LENGTH_MM - 1.0) / (_ZOOM_FACTOR - 1.0) * 100.0)
        else:
            return False
        return True

    def set_focus(self, kind: int, value: float) -> bool:
        """Apply SET_CAMERA_FOCUS; return False if type or value is not supported."""
        if kind == SetFocusType.STEP:
            self.focus.step(value)
        elif kind == SetFocusType.CONTINUOUS:
            self.focus.move(value)
        elif kind == SetFocusType.RANGE and 0.0 <= value <= 100.0:
            self.focus.set(value)
        elif kind == SetFocusType.METERS and value > 0.0:
            self.focus.set(100.0 * value / (value + _HALF_RANGE_FOCUS_M))
        elif kind in _AUTO:
            self.focus.set(_SHARP_PERCENT)
        else:
            return False
        return True


# Above this pitch the optical axis meets the ground too far away, or never.
_MAX_GROUND_PITCH_RAD = -math.radians(5)
_UNKNOWN, _ACCURACY_M = math.nan, 1.0


class Tracking:
    """Tracking of a point or a rectangle in the image; call ``lose()`` to lose the target."""

    def __init__(self, camera: CameraHost) -> None:
        self._camera = camera
        self.reset()

    def reset(self) -> None:
        self.mode: CameraTrackingMode = CameraTrackingMode.NONE
        self.place: tuple[float, ...] = ()
        """x, y and radius of a point; or left, top, right and bottom of a rectangle; shares of the image."""
        self.is_lost: bool = False

    def lose(self) -> None:
        """Lose the target."""
        self.is_lost = True

    def track_point(self, command: ReceivedCommand) -> int:
        place = (command.param1, command.param2, command.param3)
        return self._track(CameraCapFlags.HAS_TRACKING_POINT, CameraTrackingMode.POINT, place)

    def track_rectangle(self, command: ReceivedCommand) -> int:
        place = (command.param1, command.param2, command.param3, command.param4)
        return self._track(CameraCapFlags.HAS_TRACKING_RECTANGLE, CameraTrackingMode.RECTANGLE, place)

    def _track(self, capability: int, mode: CameraTrackingMode, place: tuple[float, ...]) -> int:
        if not self._camera.can(capability):
            return MavResult.UNSUPPORTED
        if not all(0.0 <= share <= 1.0 for share in place):
            return MavResult.DENIED
        self.mode = mode
        self.place = place
        self.is_lost = False
        return MavResult.ACCEPTED

    def stop(self, _: ReceivedCommand) -> int:
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
        is_point = self.mode == CameraTrackingMode.POINT
        x, y, radius = self.place if is_point else (_UNKNOWN,) * 3
        is_rectangle = self.mode == CameraTrackingMode.RECTANGLE
        left, top, right, bottom = self.place if is_rectangle else (_UNKNOWN,) * 4
        mode = int(self.mode)
        return m.CameraTrackingImageStatus(self._flags, mode, Target.IN_STATUS, x, y, radius, left, top, right, bottom)

    def geo_status(self) -> list[m.CameraTrackingGeoStatus]:
        """Return CAMERA_TRACKING_GEO_STATUS with the intersection of optical axis and ground at home altitude."""
        pose, angles = pose_of(self._camera.vehicle), self._camera.angles()
        if pose is None or angles is None or angles[1] > _MAX_GROUND_PITCH_RAD:
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
                _UNKNOWN,
                math.hypot(away, pose.height_m),
                _UNKNOWN,
                _UNKNOWN,
            )
        ]
