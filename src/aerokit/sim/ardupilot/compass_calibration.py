"""The calibration of the compasses on board: somebody turns the vehicle about, and it tells how far it is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MagCalStatus, MavCmd, MavResult, MavSeverity
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["CompassCalibration"]

_COMPASSES, _ALL = 3, 0b111
_SETTLING_S = 1.0
_FITNESS = 5.0


class CompassCalibration:
    """DO_START_MAG_CAL, …_ACCEPT… and …_CANCEL…; MAG_CAL_PROGRESS and MAG_CAL_REPORT follow from it.

    ``turns_s``: seconds that whoever turns the vehicle needs; infinity, as in a simulator of the firmware's own, leaves
    it at 0 % until it is cancelled. While it runs the vehicle cannot be armed.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.turns_s: float = 30.0
        self._mask = 0
        self._started_at = math.inf
        self._saves = False
        self._next = 0
        self._reported = 0

    def reset(self) -> None:
        """Give up, as a reboot does."""
        self._mask, self._started_at = 0, math.inf

    @property
    def is_running(self) -> bool:
        """Whether somebody is at it; one that waits to be accepted is done."""
        return bool(self._mask) and self.percent < 100

    @property
    def percent(self) -> int:
        """How far it is."""
        if not self._mask:
            return 0
        seconds = self._vehicle.now - self._started_at - _SETTLING_S
        return max(0, min(100, int(100.0 * seconds / self.turns_s)))

    @property
    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler."""
        return {
            MavCmd.DO_START_MAG_CAL: self._start,
            MavCmd.DO_ACCEPT_MAG_CAL: self._accept,
            MavCmd.DO_CANCEL_MAG_CAL: self._cancel,
            MavCmd.FIXED_MAG_CAL_YAW: lambda _: MavResult.ACCEPTED,
        }

    def _start(self, command: Command) -> int:
        """Param 1 is a mask of compasses, 0 for all; param 3 saves it without being accepted."""
        if self._vehicle.motors.is_armed:
            self._vehicle.send_text(MavSeverity.NOTICE, "Disarm to allow compass calibration")
            return MavResult.FAILED
        if not 0 <= command.param1 <= 255:
            return MavResult.FAILED
        self._mask = whole(command.param1) & _ALL or _ALL
        self._started_at, self._saves = self._vehicle.now, command.param3 != 0.0
        return MavResult.ACCEPTED

    def _accept(self, command: Command) -> int:
        if not 0 <= command.param1 <= 255 or not self._mask or self.is_running:
            return MavResult.FAILED
        self.reset()
        return MavResult.ACCEPTED

    def _cancel(self, command: Command) -> int:
        if not 0 <= command.param1 <= 255:
            return MavResult.FAILED
        self._mask &= ~(whole(command.param1) or _ALL)
        return MavResult.ACCEPTED

    # ------------------------------------------------------------------------------------- messages

    def progress(self) -> m.MagCalProgress | None:
        """Of one compass after the other; None when nothing runs."""
        if not self.is_running:
            return None
        self._next = self._following(self._next)
        percent = self.percent
        status = MagCalStatus.RUNNING_STEP_ONE if percent < 50 else MagCalStatus.RUNNING_STEP_TWO
        seen = percent * 80 // 100
        return m.MagCalProgress(
            compass_id=self._next,
            cal_mask=self._mask,
            cal_status=status,
            attempt=1,
            completion_pct=percent,
            completion_mask=((1 << seen) - 1).to_bytes(10, "little"),
            direction_x=0.0,
            direction_y=0.0,
            direction_z=0.0,
        )

    def report(self) -> m.MagCalReport | None:
        """Again and again once it is done, until it is accepted or cancelled."""
        if not self._mask or self.is_running:
            return None
        self._reported = self._following(self._reported)
        return m.MagCalReport(
            compass_id=self._reported,
            cal_mask=self._mask,
            cal_status=MagCalStatus.SUCCESS,
            autosaved=int(self._saves),
            fitness=_FITNESS,
            ofs_x=5.0,
            ofs_y=13.0,
            ofs_z=-18.0,
            diag_x=1.0,
            diag_y=1.0,
            diag_z=1.0,
            offdiag_x=0.0,
            offdiag_y=0.0,
            offdiag_z=0.0,
        )

    def _following(self, compass: int) -> int:
        """The next one that takes part."""
        return next(
            each
            for step in range(1, _COMPASSES + 1)
            if self._mask & 1 << (each := (compass + step) % _COMPASSES)
        )
