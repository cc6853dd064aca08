"""Calibrations of a simulated ArduPilot's sensors: how long they take, what they say, what they forbid."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity, PreflightCalibrationAccelerometer
from aerokit.sim.ardupilot.accelerometer_calibration import AccelerometerCalibration
from aerokit.sim.ardupilot.compass_calibration import CompassCalibration
from aerokit.sim.commands import Progress

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["CALIBRATION_BUILDERS", "Calibrations"]

_GYROS_S, _TRIM_S, _ACCELEROMETERS_S = 0.5, 1.0, 1.0
_ACCELEROMETERS_AGAIN_S = 5.0
_FORCED = 76
_Accelerometers = PreflightCalibrationAccelerometer


class Calibrations:
    """PREFLIGHT_CALIBRATION answers when it is done, or when the first position is asked for.

    ``compasses`` and ``accelerometers`` are the two that somebody has to turn the vehicle for.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
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
        """MAV_CMD → handler."""
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


CALIBRATION_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.MagCalProgress.ID: lambda vehicle: vehicle.calibrations.compasses.progress(),
    m.MagCalReport.ID: lambda vehicle: vehicle.calibrations.compasses.report(),
}
"""Message id → what to send now, or None."""
