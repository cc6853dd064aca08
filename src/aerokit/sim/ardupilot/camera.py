"""Camera of a simulated ArduPilot: a shutter on a servo output (CAM1_TYPE 1) and its captures."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraFeedbackFlags, MavCmd, MavResult, SetFocusType
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.gimbal import ArduPilotGimbal
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.commands import ReceivedCommand, to_int
from aerokit.sim.motion import Ned

_PERIOD_S, _DEFAULT_SHUTTER_S = 0.02, 0.1
_IDLE, _INTERVAL_SET = 0, 2
_UNLIMITED = -1


class ArduPilotCamera:
    """Takes images on command, by time or by distance. Each image is reported by CAMERA_FEEDBACK on every link.

    The camera belongs to the autopilot component (1). As in the firmware, there are neither CAMERA_IMAGE_CAPTURED nor
    heartbeats of the camera. CAM1_TYPE 0 disables the camera.
    """

    def __init__(self, vehicle: ArduPilotHost, gimbal: ArduPilotGimbal) -> None:
        self._vehicle, self._gimbal = vehicle, gimbal
        self.image_count: int = 0  # Number of images since power-on.
        self.interval_s: float = 0.0  # Seconds between two images of a series.
        self.remaining: int = 0  # Number of images that the series still has to take; -1 is unlimited.
        self.trigger_distance_m: float = 0.0  # Metres between two images triggered by distance; 0 is off.
        self._taken_at = -math.inf  # time of the last image
        self._taken_place: Ned | None = None  # place of the last image
        self._is_update_scheduled = False  # True while a call of `_update` is pending
        self.feedback: m.CameraFeedback = m.CameraFeedback(
            time_usec=0, target_system=0, cam_idx=0, img_idx=0, lat=0, lng=0, alt_msl=0.0, alt_rel=0.0, roll=0.0,
            pitch=0.0, yaw=0.0, foc_len=0.0, flags=0,
        )  # fmt: skip
        """CAMERA_FEEDBACK of the latest image; zeros before the first image."""

    @property
    def is_fitted(self) -> bool:
        return int(self._vehicle.parameters["CAM1_TYPE"]) != 0

    def take(self) -> bool:
        """Take an image. Return False without a camera, or while its shutter is still open."""
        shutter_s = self._vehicle.parameters.get("CAM1_DURATION", _DEFAULT_SHUTTER_S)
        if not self.is_fitted or self._vehicle.now - self._taken_at < shutter_s:
            return False
        self.image_count += 1
        self._taken_at = self._vehicle.now
        self._taken_place = self._vehicle.motion.place
        self.feedback = self._make_feedback()
        self._vehicle.send(self.feedback)
        return True

    def stop(self) -> None:
        self.interval_s = 0.0
        self.remaining = 0

    def _schedule_update(self) -> None:
        if not self._is_update_scheduled and (self.remaining or self.trigger_distance_m > 0):
            self._is_update_scheduled = True
            self._vehicle.call_later(_PERIOD_S, self._update)

    def _update(self) -> None:
        self._is_update_scheduled = False
        if self.remaining:
            is_due = self._vehicle.now - self._taken_at > self.interval_s
            is_taken = is_due and self.take()
            if is_taken and self.remaining > 0:  # An unlimited series (-1) is not counted down.
                self.remaining -= 1
        elif self.trigger_distance_m > 0.0:
            self._check_distance()
        self._schedule_update()

    def _check_distance(self) -> None:
        motion = self._vehicle.motion
        if self._taken_place is None:
            self._taken_place = motion.place
        elif motion.distance_to(self._taken_place) >= self.trigger_distance_m:
            self.take()

    def run(self, item: MissionItem) -> None:
        """Execute a camera command of a mission. Other commands are ignored."""
        if item.command == MavCmd.DO_DIGICAM_CONTROL:
            self.digicam_control(item)
        elif item.command == MavCmd.DO_SET_CAM_TRIGG_DIST:
            self.set_trigger_distance(item)
        elif item.command == MavCmd.IMAGE_START_CAPTURE:
            self._start(interval_s=item.param2, count=item.param3)
        elif item.command == MavCmd.IMAGE_STOP_CAPTURE:
            self.stop()

    def _start(self, *, interval_s: float, count: float) -> bool:
        """Take an image, or start a series. Return False without a camera."""
        is_single_image = count == 1.0 or (interval_s == 0.0 and count == 0.0)
        if is_single_image:
            return self.take()
        if not self.is_fitted:
            return False
        self.interval_s = interval_s if math.isfinite(interval_s) else 0.0
        self.remaining = to_int(count) or _UNLIMITED
        self._schedule_update()
        return True

    def start_capture(self, command: ReceivedCommand) -> int:
        # Param 1 of IMAGE_START_CAPTURE is the number of the camera. 0 selects all cameras.
        if command.param1 < 0.0:
            return MavResult.UNSUPPORTED
        if command.param1 > 1.0:
            return MavResult.FAILED
        is_started = self._start(interval_s=command.param2, count=command.param3)
        return MavResult.ACCEPTED if is_started else MavResult.FAILED

    def stop_capture(self, command: ReceivedCommand) -> int:
        is_supported = command.param1 == 0.0 or (command.param1 == 1.0 and self.is_fitted)
        if is_supported:
            self.stop()
        return MavResult.ACCEPTED if is_supported else MavResult.UNSUPPORTED

    def digicam_control(self, command: ReceivedCommand | MissionItem) -> int:
        takes_image = command.x == 1  # Param 5 of DO_DIGICAM_CONTROL.
        if takes_image:
            self.take()
        return MavResult.ACCEPTED

    def set_trigger_distance(self, command: ReceivedCommand | MissionItem) -> int:
        """Take an image each time the vehicle has moved by the distance. 0 turns this off."""
        self.trigger_distance_m = command.param1
        self._taken_place = None
        self._schedule_update()
        takes_first_image_now = command.param3 == 1.0
        if takes_first_image_now:
            self.take()
        return MavResult.ACCEPTED

    def zoom(self, command: ReceivedCommand) -> int:
        # No zoom is stored, because no message reports it.
        is_supported = self.is_fitted and command.param1 in (1.0, 2.0)
        return MavResult.ACCEPTED if is_supported else MavResult.UNSUPPORTED

    def focus(self, command: ReceivedCommand) -> int:
        kind = to_int(command.param1)
        # The firmware denies these types even without a camera (AP_Camera.cpp).
        is_denied = kind in (SetFocusType.STEP, SetFocusType.METERS)
        if is_denied or kind not in list(SetFocusType):
            return MavResult.DENIED
        if not self.is_fitted:
            return MavResult.FAILED
        is_autofocus = kind not in (SetFocusType.CONTINUOUS, SetFocusType.RANGE)
        return MavResult.UNSUPPORTED if is_autofocus else MavResult.ACCEPTED

    def _make_feedback(self) -> m.CameraFeedback:
        motion, nav = self._vehicle.motion, self._vehicle.navigation
        place = self._vehicle.frame.to_global(*motion.place)
        return m.CameraFeedback(
            time_usec=round(self._vehicle.unix_time * 1e6), target_system=0, cam_idx=0, img_idx=self.image_count,
            lat=place.latitude_e7, lng=place.longitude_e7, alt_msl=place.altitude_m, alt_rel=nav.altitude_above_home,
            roll=math.degrees(motion.roll), pitch=math.degrees(motion.pitch), yaw=math.degrees(motion.yaw) % 360.0,
            foc_len=0.0, flags=CameraFeedbackFlags.PHOTO, completed_captures=0,
        )  # fmt: skip

    def information(self) -> m.CameraInformation:
        return m.CameraInformation(
            time_boot_ms=self._vehicle.time_boot_ms, vendor_name=bytes(32), model_name=bytes(32), firmware_version=0,
            focal_length=0.0, sensor_size_h=0.0, sensor_size_v=0.0, resolution_h=0, resolution_v=0, lens_id=0, flags=0,
            cam_definition_version=0, cam_definition_uri="",
            gimbal_device_id=int(self._gimbal.is_fitted),
        )  # fmt: skip

    def settings(self) -> m.CameraSettings:
        return m.CameraSettings(self._vehicle.time_boot_ms, mode_id=0, zoomLevel=math.nan, focusLevel=math.nan)

    def capture_status(self) -> m.CameraCaptureStatus:
        # `remaining` is -1 during an unlimited series, which the firmware reports as idle (AP_Camera_Backend.cpp).
        is_series_reported = self.remaining > 0
        return m.CameraCaptureStatus(
            time_boot_ms=self._vehicle.time_boot_ms, image_status=_INTERVAL_SET if is_series_reported else _IDLE,
            video_status=0, image_interval=self.interval_s, recording_time_ms=0, available_capacity=math.nan,
            image_count=self.image_count,
        )  # fmt: skip
