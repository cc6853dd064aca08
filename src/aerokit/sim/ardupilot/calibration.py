"""Sensor calibrations of a simulated ArduPilot: accelerometers, compasses, gyros and barometer."""

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
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.commands import CommandHandler, CommandProgress, ReceivedCommand, to_int

_MEASUREMENT_TIME_S, _REPEAT_INTERVAL_S = 1.3, 1.0
_LAST = AccelcalVehiclePos.BACK


class AccelerometerCalibration:
    """Calibration of the accelerometers in six positions.

    The vehicle broadcasts the requested position as a COMMAND_LONG every second. The client confirms each position with
    the same command. The result is broadcast every second until a reboot. Set ``is_held_wrong`` to let the calibration
    fail.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self.is_held_wrong = False  # If True, the calibration fails after the second position.
        self._run_number = 0  # increased by every start and reset, so that timers of earlier calibrations do nothing
        self._requested: int | None = None  # position or result that is sent repeatedly; None if nothing is sent

    @property
    def is_waiting(self) -> bool:
        return self._requested is not None and AccelcalVehiclePos.LEVEL <= self._requested <= _LAST

    def reset(self) -> None:
        self._run_number += 1
        self._requested = None

    def start(self) -> None:
        self._run_number += 1
        self._vehicle.send_text(MavSeverity.CRITICAL, "Place vehicle level and press any key.")
        self._announce(AccelcalVehiclePos.LEVEL)

    def confirm(self, command: ReceivedCommand) -> int:
        if not self.is_waiting or command.param1 != self._requested:
            return MavResult.FAILED
        self._requested = None
        run_number, position = self._run_number, to_int(command.param1)
        self._vehicle.call_later(_MEASUREMENT_TIME_S, lambda: self._on_measured(run_number, position))
        return MavResult.ACCEPTED

    def _on_measured(self, run_number: int, position: int) -> None:
        """Continue with the next position, or end the calibration, after the measurement in a position."""
        if run_number != self._run_number:  # The calibration was started again or cancelled.
            return
        is_first_position = position == AccelcalVehiclePos.LEVEL
        if self.is_held_wrong and not is_first_position:  # Only later positions can be wrong.
            self._end("Calibration FAILED", AccelcalVehiclePos.FAILED)
        elif position == _LAST:
            self._end("Calibration successful", AccelcalVehiclePos.SUCCESS)
        else:
            self._announce(position + 1)

    def _end(self, text: str, result: int) -> None:
        self._vehicle.send_text(MavSeverity.CRITICAL, text)
        self._announce(result)

    def _announce(self, position: int) -> None:
        """Send this position or result every second until it is confirmed."""
        self._requested = position
        self._send_until_confirmed(self._run_number, position)

    def _send_until_confirmed(self, run_number: int, position: int) -> None:
        if run_number != self._run_number or self._requested != position:
            return
        self._vehicle.send_command((0, 0), MavCmd.ACCELCAL_VEHICLE_POS, float(position))  # to all systems
        self._vehicle.call_later(_REPEAT_INTERVAL_S, lambda: self._send_until_confirmed(run_number, position))


_COMPASSES, _ALL_COMPASSES = 3, 0b111
_SETTLING_TIME_S = 1.0
_FITNESS = 5.0


class CompassCalibration:
    """Compass calibration, with the commands DO_START_MAG_CAL, DO_ACCEPT_MAG_CAL and DO_CANCEL_MAG_CAL.

    ``turning_time_s`` is the number of seconds after which the vehicle has been turned in all directions. With
    infinity, as in SITL, the progress stays at 0 % until the calibration is cancelled. The vehicle cannot be armed
    during a calibration.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self.turning_time_s: float = 30.0
        self._compass_mask = 0  # one bit for each compass whose result is not yet accepted or cancelled
        self._started_at = math.inf  # infinite before the start
        self._saves_at_once = False  # True if the result needs no DO_ACCEPT_MAG_CAL
        self._progress_compass = 0  # compass of the last progress message
        self._reported_compass = 0  # compass of the last result message

    def reset(self) -> None:
        self._compass_mask = 0
        self._started_at = math.inf

    @property
    def is_running(self) -> bool:
        """True from the start until the progress reaches 100 %."""
        return bool(self._compass_mask) and self.percent < 100

    @property
    def percent(self) -> int:
        if not self._compass_mask:
            return 0
        seconds = self._vehicle.now - self._started_at - _SETTLING_TIME_S
        return max(0, min(100, int(100.0 * seconds / self.turning_time_s)))

    def start(self, command: ReceivedCommand) -> int:
        if self._vehicle.motors.is_armed:
            self._vehicle.send_text(MavSeverity.NOTICE, "Disarm to allow compass calibration")
            return MavResult.FAILED
        requested = (to_int(command.param1) or _ALL_COMPASSES) & _ALL_COMPASSES  # Other bits are ignored.
        if not 0 <= command.param1 <= 255 or not requested:
            return MavResult.FAILED
        self._compass_mask = requested
        self._started_at = self._vehicle.now
        self._saves_at_once = command.param3 != 0.0
        return MavResult.ACCEPTED

    def accept(self, command: ReceivedCommand) -> int:
        if not 0 <= command.param1 <= 255 or not self._compass_mask or self.is_running:
            return MavResult.FAILED
        self.reset()
        return MavResult.ACCEPTED

    def cancel(self, command: ReceivedCommand) -> int:
        if not 0 <= command.param1 <= 255:
            return MavResult.FAILED
        cancelled = to_int(command.param1)
        self._compass_mask &= ~(_ALL_COMPASSES if cancelled == 0 else cancelled)
        return MavResult.ACCEPTED

    def progress(self) -> m.MagCalProgress | None:
        if not self.is_running:
            return None
        self._progress_compass = self._next_compass(self._progress_compass)
        percent = self.percent
        status = MagCalStatus.RUNNING_STEP_ONE if percent < 50 else MagCalStatus.RUNNING_STEP_TWO
        # The mask of ten bytes has one bit for each of 80 directions in which the vehicle can point.
        direction_count = percent * 80 // 100
        directions = ((1 << direction_count) - 1).to_bytes(10, "little")
        return m.MagCalProgress(
            compass_id=self._progress_compass, cal_mask=self._compass_mask, cal_status=status, attempt=1,
            completion_pct=percent, completion_mask=directions, direction_x=0.0, direction_y=0.0, direction_z=0.0,
        )  # fmt: skip

    def report(self) -> m.MagCalReport | None:
        if not self._compass_mask or self.is_running:
            return None
        self._reported_compass = self._next_compass(self._reported_compass)
        offsets = (5.0, 13.0, -18.0)
        diagonal = (1.0, 1.0, 1.0)
        off_diagonal = (0.0, 0.0, 0.0)
        saved = int(self._saves_at_once)
        status = MagCalStatus.SUCCESS
        return m.MagCalReport(
            self._reported_compass, self._compass_mask, status, saved, _FITNESS, *offsets, *diagonal, *off_diagonal
        )

    def _next_compass(self, compass: int) -> int:
        candidates = ((compass + step) % _COMPASSES for step in range(1, _COMPASSES + 1))
        return next(number for number in candidates if self._compass_mask & 1 << number)


_GYRO_CALIBRATION_S, _TRIM_CALIBRATION_S, _ACCELEROMETER_CALIBRATION_S = 0.5, 1.0, 1.0
_MIN_ACCELEROMETERS_INTERVAL_S = 5.0
# A param with this value accepts the present calibration (GCS_Common.cpp, _handle_command_preflight_calibration).
_ACCEPTS_PRESENT_CALIBRATION = 76
_Accelerometers = PreflightCalibrationAccelerometer


class Calibrations:
    """Sensor calibrations. The vehicle must be turned by hand to calibrate compasses or accelerometers.

    PREFLIGHT_CALIBRATION is acknowledged at the end of the calibration. For the full calibration of the accelerometers,
    it is acknowledged when the first pose is requested.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self.compasses: CompassCalibration = CompassCalibration(vehicle)
        self.accelerometers: AccelerometerCalibration = AccelerometerCalibration(vehicle)
        self._simple_calibration_at = -math.inf

    def reset(self) -> None:
        self.compasses.reset()
        self.accelerometers.reset()

    @property
    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.PREFLIGHT_CALIBRATION: self._calibrate,
            MavCmd.ACCELCAL_VEHICLE_POS: self.accelerometers.confirm,
            MavCmd.DO_START_MAG_CAL: self.compasses.start,
            MavCmd.DO_ACCEPT_MAG_CAL: self.compasses.accept,
            MavCmd.DO_CANCEL_MAG_CAL: self.compasses.cancel,
        }

    def _calibrate(self, command: ReceivedCommand) -> int | CommandProgress:
        vehicle = self._vehicle
        if vehicle.motors.is_armed:
            vehicle.send_text(MavSeverity.NOTICE, "Disarm to allow calibration")
            return MavResult.FAILED
        # Only one kind of calibration is done, even if several are requested.
        is_gyro_requested = command.param1 == 1.0
        is_barometer_requested = command.param3 == 1.0
        if is_gyro_requested:
            vehicle.info("Initialising ArduPilot")
            # `percents` is empty, so the only acknowledgement is the final one.
            return CommandProgress(percents=(), interval_s=_GYRO_CALIBRATION_S)
        if is_barometer_requested:
            vehicle.info("Updating barometer calibration")
            vehicle.info("Barometer calibration complete")
            return MavResult.ACCEPTED
        return self._calibrate_accelerometers(command)

    def _calibrate_accelerometers(self, command: ReceivedCommand) -> int | CommandProgress:
        vehicle, kind = self._vehicle, command.x  # Param 5 of PREFLIGHT_CALIBRATION.
        if kind == _Accelerometers.FULL:
            vehicle.info("Initialising ArduPilot")
            # The gyros are calibrated first. Then the vehicle requests the first of the six positions.
            return CommandProgress(percents=(), interval_s=_GYRO_CALIBRATION_S, finish=self.accelerometers.start)
        if kind == _Accelerometers.TRIM:
            vehicle.info("Initialising ArduPilot")
            text = "Trim OK: roll=0.00 pitch=0.00 yaw=0.00"
            return CommandProgress(percents=(), interval_s=_TRIM_CALIBRATION_S, finish=lambda: vehicle.info(text))
        if kind == _Accelerometers.SIMPLE:
            if vehicle.now - self._simple_calibration_at < _MIN_ACCELEROMETERS_INTERVAL_S:
                return MavResult.TEMPORARILY_REJECTED
            self._simple_calibration_at = vehicle.now
            vehicle.info("Initialising ArduPilot")
            return CommandProgress(percents=(), interval_s=_ACCELEROMETER_CALIBRATION_S)
        keeps_accelerometers = kind == _ACCEPTS_PRESENT_CALIBRATION
        keeps_compasses = command.param2 == _ACCEPTS_PRESENT_CALIBRATION
        return MavResult.ACCEPTED if keeps_accelerometers or keeps_compasses else MavResult.UNSUPPORTED
