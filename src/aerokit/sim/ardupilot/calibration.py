"""Calibrations of a simulated ArduPilot's sensors: how long they take, what they say, what they forbid."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    AccelcalVehiclePos,
    MagCalStatus,
    MavCmd,
    MavResult,
    MavSeverity,
    PreflightCalibrationAccelerometer,
)
from aerokit.mavlink.messages import CommandLong
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.commands import Command, CommandHandler, Progress, whole

_SAMPLE_S, _AGAIN_S = 1.3, 1.0
_LAST = AccelcalVehiclePos.BACK


class AccelerometerCalibration:
    """It asks for a position each second with a COMMAND_LONG to everybody, and is told by the same when it is taken.

    Whoever holds the vehicle does it right, unless ``is_held_wrong``. After the end it tells the result each second
    until a reboot.
    """

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.is_held_wrong = False
        """Then it fails after the second position."""
        self._run = 0
        self._asked: int | None = None

    @property
    def is_waiting(self) -> bool:
        return self._asked is not None and AccelcalVehiclePos.LEVEL <= self._asked <= _LAST

    def reset(self) -> None:
        self._run += 1
        self._asked = None

    def start(self) -> None:
        self._run += 1
        self._vehicle.send_text(MavSeverity.CRITICAL, "Place vehicle level and press any key.")
        self._ask(self._run, AccelcalVehiclePos.LEVEL)

    def take(self, command: Command) -> int:
        """MAV_CMD_ACCELCAL_VEHICLE_POS from the client: the vehicle lies as it was asked."""
        if not self.is_waiting or command.param1 != self._asked:
            return MavResult.FAILED
        self._asked, run, position = None, self._run, whole(command.param1)
        self._vehicle.call_later(_SAMPLE_S, lambda: self._sampled(run, position))
        return MavResult.ACCEPTED

    def _sampled(self, run: int, position: int) -> None:
        if run != self._run:
            return
        if self.is_held_wrong and position > AccelcalVehiclePos.LEVEL:
            self._end("Calibration FAILED", AccelcalVehiclePos.FAILED)
        elif position == _LAST:
            self._end("Calibration successful", AccelcalVehiclePos.SUCCESS)
        else:
            self._ask(run, position + 1)

    def _end(self, text: str, result: int) -> None:
        self._vehicle.send_text(MavSeverity.CRITICAL, text)
        self._ask(self._run, result)

    def _ask(self, run: int, position: int) -> None:
        self._asked = position

        def ask() -> None:
            if run == self._run and self._asked == position:
                request = CommandLong(0, 0, MavCmd.ACCELCAL_VEHICLE_POS, 0, float(position), 0, 0, 0, 0, 0, 0)
                self._vehicle.send(request)
                self._vehicle.call_later(_AGAIN_S, ask)

        ask()


_COMPASSES, _ALL = 3, 0b111
_SETTLING_S = 1.0
_FITNESS = 5.0


class CompassCalibration:
    """DO_START_MAG_CAL, …_ACCEPT… and …_CANCEL…; MAG_CAL_PROGRESS and MAG_CAL_REPORT follow from it.

    ``turns_s``: seconds that whoever turns the vehicle needs; infinity, as in a simulator of the firmware's own, leaves
    it at 0 % until it is cancelled. While it runs the vehicle cannot be armed.
    """

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.turns_s: float = 30.0
        self._mask = 0
        self._started_at = math.inf
        self._saves = False
        self._next = 0
        self._reported = 0

    def reset(self) -> None:
        self._mask, self._started_at = 0, math.inf

    @property
    def is_running(self) -> bool:
        """Whether somebody is at it; one that waits to be accepted is done."""
        return bool(self._mask) and self.percent < 100

    @property
    def percent(self) -> int:
        if not self._mask:
            return 0
        seconds = self._vehicle.now - self._started_at - _SETTLING_S
        return max(0, min(100, int(100.0 * seconds / self.turns_s)))

    @property
    def commands(self) -> dict[int, CommandHandler]:
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
        return next(
            each
            for step in range(1, _COMPASSES + 1)
            if self._mask & 1 << (each := (compass + step) % _COMPASSES)
        )


_GYROS_S, _TRIM_S, _ACCELEROMETERS_S = 0.5, 1.0, 1.0
_ACCELEROMETERS_AGAIN_S = 5.0
_FORCED = 76
_Accelerometers = PreflightCalibrationAccelerometer


class Calibrations:
    """PREFLIGHT_CALIBRATION answers when it is done, or when the first position is asked for.

    ``compasses`` and ``accelerometers`` are the two that somebody has to turn the vehicle for.
    """

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.compasses: CompassCalibration = CompassCalibration(vehicle)
        self.accelerometers: AccelerometerCalibration = AccelerometerCalibration(vehicle)
        self._accelerometers_at = -math.inf

    def reset(self) -> None:
        """Give up what is running, as a reboot does."""
        self.compasses.reset()
        self.accelerometers.reset()

    @property
    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.PREFLIGHT_CALIBRATION: self._calibrate,
            MavCmd.ACCELCAL_VEHICLE_POS: self.accelerometers.take,
            **self.compasses.commands,
        }

    def _calibrate(self, command: Command) -> int | Progress:
        vehicle = self._vehicle
        if vehicle.motors.is_armed:
            vehicle.send_text(MavSeverity.NOTICE, "Disarm to allow calibration")
            return MavResult.FAILED
        if command.param1 == 1.0:
            vehicle.info("Initialising ArduPilot")
            return Progress((), _GYROS_S)
        if command.param3 == 1.0:
            vehicle.info("Updating barometer calibration")
            vehicle.info("Barometer calibration complete")
            return MavResult.ACCEPTED
        return self._calibrate_accelerometers(command)

    def _calibrate_accelerometers(self, command: Command) -> int | Progress:
        vehicle = self._vehicle
        if command.x == _Accelerometers.FULL:
            vehicle.info("Initialising ArduPilot")
            return Progress((), _GYROS_S, finish=self.accelerometers.start)
        if command.x == _Accelerometers.TRIM:
            vehicle.info("Initialising ArduPilot")
            return Progress(
                (), _TRIM_S, finish=lambda: vehicle.info("Trim OK: roll=0.00 pitch=0.00 yaw=0.00")
            )
        if command.x == _Accelerometers.SIMPLE:
            if vehicle.now - self._accelerometers_at < _ACCELEROMETERS_AGAIN_S:
                return MavResult.TEMPORARILY_REJECTED
            self._accelerometers_at = vehicle.now
            vehicle.info("Initialising ArduPilot")
            return Progress((), _ACCELEROMETERS_S)
        is_forced = _FORCED in (command.x, command.param2)
        return MavResult.ACCEPTED if is_forced else MavResult.UNSUPPORTED
