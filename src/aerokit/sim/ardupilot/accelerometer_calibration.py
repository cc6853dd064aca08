"""The calibration of the accelerometers in six positions, as a ground station leads through it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import AccelcalVehiclePos, MavCmd, MavResult, MavSeverity
from aerokit.mavlink.messages import CommandLong
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command

__all__ = ["AccelerometerCalibration"]

_SAMPLE_S, _AGAIN_S = 1.3, 1.0
_LAST = AccelcalVehiclePos.BACK


class AccelerometerCalibration:
    """It asks for a position each second with a COMMAND_LONG to everybody, and is told by the same when it is taken.

    Whoever holds the vehicle does it right, unless ``is_held_wrong``. After the end it tells the result each second
    until a reboot.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.is_held_wrong = False
        """Then it fails after the second position."""
        self._run = 0
        self._asked: int | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether it asks for a position."""
        return self._asked is not None and AccelcalVehiclePos.LEVEL <= self._asked <= _LAST

    def reset(self) -> None:
        """Give up, as a reboot does."""
        self._run += 1
        self._asked = None

    def start(self) -> None:
        """Ask for the first position."""
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
