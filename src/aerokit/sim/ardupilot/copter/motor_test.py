"""DO_MOTOR_TEST on a simulated ArduCopter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavResult, MavSeverity, MotorTestThrottleType
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter.vehicle import SimulatedCopter
    from aerokit.sim.commands import Command

__all__ = ["MotorTest"]

_MAX_S = 600.0
_PAUSE_SHARE = 0.5
"""Between two motors, of the time for each."""
_MIN_PWM, _MAX_PWM = 800, 2200


class MotorTest:
    """Only on the ground; HEARTBEAT says "armed" while a motor turns, and afterwards the vehicle is disarmed."""

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter
        self.is_running: bool = False
        self._number = 0

    def command(self, command: Command) -> int:
        """Begin, or go on with other motors; how it ends is told by a text."""
        if not self.is_running and (reason := self._refusal()):
            self._copter.send_text(MavSeverity.CRITICAL, f"Motor Test: {reason}")
            return MavResult.FAILED
        if not self.is_running:
            self._copter.info("starting motor test")
        self.is_running = True
        self._number += 1
        self._copter.call_later(self._duration_s(command), lambda number=self._number: self._stop(number))  # type: ignore[misc]
        return MavResult.ACCEPTED

    def _refusal(self) -> str:
        if not self._copter.is_initialised:
            return "Board initialising"
        return "" if self._copter.is_landed else "vehicle not landed"

    def _duration_s(self, command: Command) -> float:
        """A throttle that is none ends it at once."""
        kind, throttle = command.param2, command.param3
        is_valid = kind == MotorTestThrottleType.THROTTLE_PILOT or (
            throttle <= 100.0
            if kind in (MotorTestThrottleType.THROTTLE_PERCENT, MotorTestThrottleType.COMPASS_CAL)
            else kind == MotorTestThrottleType.THROTTLE_PWM and _MIN_PWM <= throttle <= _MAX_PWM
        )
        each, motors = max(0.0, min(command.param4, _MAX_S)), max(1, whole(command.x))
        return each * (motors + (motors - 1) * _PAUSE_SHARE) if is_valid else 0.0

    def _stop(self, number: int) -> None:
        if number == self._number:
            self.is_running = False
            self._copter.info("finished motor test")
            self._copter.motors.set_armed(False, self._copter.now)
