"""PX4's camera trigger, and its geotags: an output that opens a shutter, where TRIG_MODE says that there is one."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.components.component import pose_of
from aerokit.sim.motion import quaternion_from_euler
from aerokit.sim.px4.host import Px4Host

_FIRST_CAMERA = 1
_MIN_INTERVAL_S = 0.04
_TO_GEOTAG_S = 0.02


class CameraTrigger:
    """Tells each picture twice: CAMERA_TRIGGER, and CAMERA_IMAGE_CAPTURED with the place if ``tells_places``.

    Without it nobody answers its commands, as on the real vehicle.
    """

    sequence: int

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.sequence = 0
        """The number of the next picture."""
        self.interval_s: float = 1.0
        """Between the pictures of a series."""
        self.tells_places = True
        """Whether the part that makes geotags runs, too."""
        self._is_enabled = False
        self._is_paused = False
        self._series = 0
        self._last_at = -math.inf

    @property
    def is_fitted(self) -> bool:
        """Whether TRIG_MODE is not 0."""
        return int(self._px4.parameters.get("TRIG_MODE", 0)) != 0

    @property
    def is_running(self) -> bool:
        return self._is_enabled and not self._is_paused

    def restart(self) -> None:
        self.sequence, self._is_enabled, self._is_paused = 0, False, False
        self._series += 1

    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.DO_DIGICAM_CONTROL: self._control,
            MavCmd.DO_TRIGGER_CONTROL: self._switch,
            MavCmd.DO_SET_CAM_TRIGG_INTERVAL: self._set_interval,
        }

    def _control(self, command: Command) -> int | None:
        if not self.is_fitted:
            return None
        if self._px4.now - self._last_at < _MIN_INTERVAL_S:
            return MavResult.TEMPORARILY_REJECTED
        if command.x == 1:
            self.shoot()
        return MavResult.ACCEPTED

    def _switch(self, command: Command) -> int | None:
        """Param 1 enables, 2 counts from 0 again, 3 pauses; -1 leaves each as it is."""
        if not self.is_fitted:
            return None
        was_running = self.is_running
        if whole(command.param3) in (0, 1):
            self._is_paused = whole(command.param3) == 1
        if whole(command.param2) == 1:
            self.sequence = 0
        if whole(command.param1) in (0, 1):
            self._is_enabled = whole(command.param1) == 1
        if self.is_running and not was_running:
            self._series += 1
            self._take_next(self._series)
        return MavResult.ACCEPTED

    def _set_interval(self, command: Command) -> int | None:
        if not self.is_fitted:
            return None
        if command.param1 > 0.0:
            self.interval_s = command.param1 / 1000.0
        return MavResult.ACCEPTED

    def _take_next(self, series: int) -> None:
        if series == self._series and self.is_running:
            self.shoot()
            self._px4.call_later(self.interval_s, lambda: self._take_next(series))

    def shoot(self) -> None:
        px4, number = self._px4, self.sequence
        self.sequence += 1
        self._last_at = px4.now
        px4.send(m.CameraTrigger(round(px4.now * 1e6), number))
        if self.tells_places:
            px4.call_later(_TO_GEOTAG_S, lambda: self._tell(number))

    def _tell(self, number: int) -> None:
        px4, pose = self._px4, pose_of(self._px4)
        if pose is not None:
            place = pose.place
            px4.send(
                m.CameraImageCaptured(
                    px4.time_boot_ms,
                    round(px4.unix_time * 1e6),
                    _FIRST_CAMERA,
                    place.latitude_e7,
                    place.longitude_e7,
                    round(place.altitude_m * 1000),
                    round(pose.height_m * 1000),
                    quaternion_from_euler(pose.roll, pose.pitch, pose.yaw),
                    number,
                    1,
                    "",
                )
            )
