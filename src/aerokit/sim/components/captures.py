"""Pictures and videos of a simulated camera, and the card that they are stored on."""

from __future__ import annotations

import base64
import math
from functools import partial

from aerokit.mavlink.enums import StorageStatus, StorageType, StorageUsageFlag
from aerokit.mavlink.messages import CameraCaptureStatus, CameraImageCaptured, StorageInformation
from aerokit.sim.components.component import SimulatedComponent, pose_of
from aerokit.sim.motion import quaternion_from_euler

GREY_JPEG = base64.b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02B@n5)Ta&5)cv>6%-gAG9exu93DL^E+jHZKuk+VKt@GST61DhRc%&9Mr4R(ZFhTtf`Lw8jhBpl"
    "mUDiAeE+}z3kU!Z01yEI5di<h02KfM0RR910000000000000000{_GS6c7Ob00000000000000000030+5iXv0RR9$0DvF=*#"
)
"""A picture of 16 × 16 pixels."""

_READ_MIB_S, _WRITE_MIB_S = 90.0, 45.0
_NUMBER = 1


class MemoryCard:
    """Sizes are in MiB. Take it out with ``is_inserted`` False, fill it up with ``used_mib``."""

    def __init__(self, capacity_mib: float) -> None:
        self.capacity_mib = capacity_mib
        self.used_mib: float = 0.0
        self.is_inserted = True

    @property
    def free_mib(self) -> float:
        """0 without a card."""
        return max(0.0, self.capacity_mib - self.used_mib) if self.is_inserted else 0.0

    def store(self, size_mib: float) -> bool:
        """Write so much; False when it does not fit, or there is no card."""
        if size_mib > self.free_mib:
            return False
        self.used_mib += size_mib
        return True

    def format(self) -> None:
        """Forget everything."""
        self.used_mib = 0.0

    def information(self, camera: SimulatedComponent, number: int) -> list[StorageInformation]:
        """STORAGE_INFORMATION of a card by its number; 0 is all, of which there is one."""
        if number not in (0, _NUMBER):
            return []
        here = self.is_inserted
        return [
            StorageInformation(
                time_boot_ms=camera.time_boot_ms,
                storage_id=_NUMBER,
                storage_count=1,
                status=StorageStatus.READY if here else StorageStatus.EMPTY,
                total_capacity=self.capacity_mib if here else 0.0,
                used_capacity=self.used_mib if here else 0.0,
                available_capacity=self.free_mib,
                read_speed=_READ_MIB_S,
                write_speed=_WRITE_MIB_S,
                type=StorageType.MICROSD,
                name="SD",
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]


class CameraHost(SimulatedComponent):
    """A camera, as its captures and its tracking see it."""

    capabilities: int
    card: MemoryCard
    image_mib: float
    video_mib_s: float
    shutter_s: float

    def can(self, *flags: int) -> bool:
        """Whether it has one of these CAMERA_CAP_FLAGS."""
        return any(self.capabilities & flag for flag in flags)

    def angles(self) -> tuple[float, float, float] | None:
        """Roll, pitch and yaw in radians of what it looks at, yaw from north; None when nobody knows."""
        raise NotImplementedError

    def keep(self, image: CameraImageCaptured) -> str:
        """Write the file of a picture; its URL."""
        raise NotImplementedError


_IDLE, _CAPTURING, _WAITING, _WAITING_AND_CAPTURING = 0, 1, 2, 3
_FOR_EVER = -1
_NOWHERE = (math.nan, math.nan, math.nan, math.nan)


class Captures:
    """The shutter opens at once and the picture is there ``shutter_s`` later, told by CAMERA_IMAGE_CAPTURED."""

    def __init__(self, camera: CameraHost) -> None:
        self._camera = camera
        self.images: list[CameraImageCaptured] = []
        """One for each picture since the log of pictures was last cleared; their indices count from 0."""
        self.interval_s: float = 0.0
        """Between the pictures of a series."""
        self._remaining = 0
        self._is_open = False
        self._series = 0
        self._recording_since = math.nan

    def switch_off(self) -> None:
        """End everything without a word, as a power cut does; pictures stay."""
        self._remaining, self._is_open, self._recording_since = 0, False, math.nan
        self._series += 1

    @property
    def is_busy(self) -> bool:
        """Whether a picture is being taken or a series is running."""
        return self._is_open or self._remaining != 0

    @property
    def is_recording(self) -> bool:
        """Whether a video is."""
        return not math.isnan(self._recording_since)

    def take(self) -> None:
        """One picture."""
        self.take_series(0.0, 1)

    def take_series(self, interval_s: float, count: int) -> None:
        """A picture every ``interval_s`` seconds, the first at once; ``count`` 0 goes on until `stop`."""
        self.interval_s = interval_s if count != 1 else 0.0
        self._remaining = count or _FOR_EVER
        self._series += 1
        self._open(self._series)

    def stop(self) -> None:
        """End a series; a picture that is being taken is still finished."""
        self._remaining = 0

    def clear(self) -> None:
        """Forget the pictures; the next one has index 0."""
        self.images.clear()

    def _open(self, series: int) -> None:
        camera = self._camera
        if series != self._series or self._remaining == 0:
            return
        self._remaining = max(_FOR_EVER, self._remaining - 1) if self._remaining > 0 else _FOR_EVER
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
            image = shot(image_index=len(self.images), capture_result=1, file_url=camera.keep(image))
            self.images.append(image)
        else:
            self.stop()
        camera.send(image)
        if not self._remaining:
            camera.send(self.status())

    def _shoot(self) -> partial[CameraImageCaptured]:
        """Of this moment; index and result come when it is on the card, or not."""
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
        """Begin a video; CAMERA_CAPTURE_STATUS every so many seconds, 0 is never."""
        self._recording_since = self._camera.now
        self._camera.send(self.status())
        if 0.0 < status_interval_s < math.inf:
            self._tell_again(self._recording_since, status_interval_s)

    def stop_recording(self) -> None:
        """End the video and put it on the card."""
        if self.is_recording:
            seconds = self._camera.now - self._recording_since
            self._recording_since = math.nan
            card = self._camera.card
            card.store(min(card.free_mib, seconds * self._camera.video_mib_s))
            self._camera.send(self.status())

    def _tell_again(self, recording: float, interval_s: float) -> None:
        def tell() -> None:
            if self._recording_since == recording:
                self._camera.send(self.status())
                self._tell_again(recording, interval_s)

        self._camera.call_later(interval_s, tell)

    def status(self) -> CameraCaptureStatus:
        """CAMERA_CAPTURE_STATUS."""
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
