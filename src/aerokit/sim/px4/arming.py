"""Arming, disarming and calibration of a simulated PX4."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from functools import partial

from aerokit.mavlink.enums import MavCmd, MavComponent, MavResult, MavSeverity, ParachuteAction
from aerokit.sim.commands import ReceivedCommand
from aerokit.sim.px4 import modes
from aerokit.sim.px4.host import Px4Host

# Percentages that each sensor's calibration reports, and the seconds between two reports.
_AUTOMATIC_CALIBRATIONS: dict[str, tuple[Sequence[int], float]] = {
    "gyro": (range(0, 101, 10), 0.3),
    "baro": ((), 0.5),
    "level": ((0, 20, 40, 60, 80, 100, 100), 0.5),
}

_SIDES = ("back", "front", "left", "right", "up", "down")
_SIDE_INSTRUCTIONS = {"mag": "Rotate vehicle", "accel": "Hold still, measuring {side} side"}
_SIDE_INTERVAL_S = 0.8
_PERCENT_PER_SIDE = 17


def _side_texts(sensor: str, sides_done: int) -> list[str]:
    """Return the texts that PX4 sends before it measures the next side."""
    side = _SIDES[-1 - sides_done]  # The simulated user rotates the vehicle to the last side first.
    return [
        f"pending: {' '.join(_SIDES[: len(_SIDES) - sides_done])}",
        "hold vehicle still on a pending side",
        "detected rest position, hold still...",
        f"{side} orientation detected",
        f"{side} orientation detected",  # PX4 sends this text twice.
        _SIDE_INSTRUCTIONS[sensor].format(side=side),
    ]


class Px4Calibration:
    """Sensor calibration on the ground. Only one calibration runs at a time.

    ``side_s``: seconds that the measurement of each of the six poses takes. With infinity, as in SIH, the measurement
    of the first pose never ends.
    """

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.side_s: float = math.inf
        self._sensor = ""  # sensor that is being calibrated; empty if none is
        self._run_number = 0  # increased by every start, so that timers of earlier calibrations do nothing

    @property
    def is_running(self) -> bool:
        return bool(self._sensor)

    def command(self, command: ReceivedCommand) -> int:
        sensor = _sensor_of(command)
        if self._px4.is_armed:
            return MavResult.TEMPORARILY_REJECTED
        if self.is_running:
            # A request without a sensor cancels the calibration. A request with a sensor is refused
            # (calibration_routines.cpp, calibrate_cancel_check).
            if sensor:
                self._px4.send_text(MavSeverity.CRITICAL, f"command denied during calibration: {command.command}")
                return MavResult.TEMPORARILY_REJECTED
            self._cancel()
            return MavResult.ACCEPTED
        if sensor in _AUTOMATIC_CALIBRATIONS:
            self._start(sensor)
            self._measure(*_AUTOMATIC_CALIBRATIONS[sensor])
        elif sensor in _SIDE_INSTRUCTIONS:
            self._start(sensor)
            self._begin_side(0)
        elif sensor == "esc":
            # PX4 requires a disconnected battery, but the simulated battery is always connected (esc_calibration.cpp,
            # check_battery_disconnected).
            self._px4.send_text(MavSeverity.CRITICAL, "[cal] calibration failed: Disconnect battery and try again")
            return MavResult.DENIED
        elif sensor == "airspeed":
            # The simulation blows no air at the sensor, so the calibration ends only when it is cancelled. Real PX4
            # gives up after 90 s.
            self._start(sensor)
            self._px4.send_text(MavSeverity.CRITICAL, "[cal] Ensure sensor is not measuring wind")
        return MavResult.ACCEPTED

    def _start(self, sensor: str) -> None:
        self._sensor = sensor
        self._run_number += 1
        self._px4.info(f"[cal] calibration started: 2 {sensor}")

    def _later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Run an action after ``delay_s``, unless this calibration has ended by then."""
        run_number = self._run_number

        def run() -> None:
            if self.is_running and run_number == self._run_number:
                action()

        self._px4.call_later(delay_s, run)

    def _measure(self, percents: Sequence[int], step_s: float) -> None:
        self._send_later([f"progress <{percent}>" for percent in percents], step_s)
        self._later((len(percents) + 1) * step_s, self._end)

    def _send_later(self, texts: Sequence[str], step_s: float) -> None:
        for index, text in enumerate(texts):
            self._later(index * step_s, partial(self._px4.info, f"[cal] {text}"))

    def _begin_side(self, sides_done: int) -> None:
        if sides_done == len(_SIDES):
            self._end()
            return
        texts = _side_texts(self._sensor, sides_done)
        self._send_later(texts, _SIDE_INTERVAL_S)
        if math.isfinite(self.side_s):  # With an infinite `side_s`, the measurement of a side never ends.
            self._later(len(texts) * _SIDE_INTERVAL_S + self.side_s, lambda: self._end_side(sides_done))

    def _end_side(self, sides_done: int) -> None:
        done = f"{_SIDES[-1 - sides_done]} side done, rotate to a different side"
        percent = min(100, _PERCENT_PER_SIDE * (sides_done + 1))
        self._send_later([f"progress <{percent}>", done, done], 0.02)
        self._later(0.2, lambda: self._begin_side(sides_done + 1))

    def _end(self) -> None:
        self._px4.info(f"[cal] calibration done: {self._sensor}")
        self._sensor = ""

    def _cancel(self) -> None:
        self._px4.send_text(MavSeverity.CRITICAL, "[cal] calibration cancelled")
        self._sensor = ""


def _sensor_of(command: ReceivedCommand) -> str:
    """Return the sensor to calibrate, or an empty string. x, y and z are the params 5, 6 and 7 of the command."""
    requests = {
        "gyro": command.param1 == 1,
        "mag": command.param2 == 1,
        "baro": command.param3 == 1,
        "accel": command.x == 1,
        "level": command.x == 2,
        "airspeed": command.y in (1, 2),
        "esc": command.z == 1,
    }
    return next((sensor for sensor, is_requested in requests.items() if is_requested), "")


_LOW_THROTTLE, _CENTER_THROTTLE = -0.8, 0.2
_CLIMB_MODES = frozenset({modes.ALTITUDE, modes.POSITION, modes.POSITION_SLOW})
_MODES_ENDED_BY_DISARMING = frozenset({modes.TAKEOFF, modes.LAND, modes.PRECISION_LAND, modes.RTL})


class Px4Arming:
    """Arming and disarming, with the arming checks. Each arming starts a log."""

    def __init__(self, px4: Px4Host, calibration: Px4Calibration) -> None:
        self._px4 = px4
        self._calibration = calibration
        self.armed_at: float = -math.inf
        self.is_terminated: bool = False
        """True after a flight termination, which stops the motors until a restart."""
        self._is_logging = False
        self._reported_failures: list[str] = []

    def reasons(self) -> list[str]:
        """Return the texts of the failed arming checks."""
        px4 = self._px4
        reasons = list(px4.faults.prearm_failures)
        if not px4.is_ready:
            reasons.append("heading estimate invalid")
        elif not px4.has_position and modes.MODES[px4.mode].needs_position:
            reasons.append("No valid position estimate")
        if self.is_terminated:
            reasons.append("Flight termination active")
        return [f"Preflight Fail: {reason}" for reason in reasons] + px4.failsafes.arming_obstacles()

    def report_reasons(self) -> None:
        for reason in self.reasons():
            self._px4.send_text(MavSeverity.CRITICAL, reason)

    def report_changes(self) -> None:
        """Report the failed checks if ``prearm_failures`` of `Faults` has changed."""
        failures = list(self._px4.faults.prearm_failures)
        if self._px4.is_ready and not self._px4.is_armed and failures != self._reported_failures:
            self._reported_failures = failures
            self.report_reasons()

    @property
    def is_possible(self) -> bool:
        px4, mode = self._px4, self._px4.mode
        return px4.is_ready and modes.MODES[mode].can_arm and px4.can_run(mode) and not self.reasons()

    def arm(self, by: str = "external command") -> bool:
        """Arm and return True, or report the failed checks and return False."""
        px4 = self._px4
        if px4.is_armed:
            return True
        # Simulated failures are reported (below), even while PX4 is booting.
        is_booting = not px4.is_ready and not px4.faults.prearm_failures
        if is_booting:  # PX4 refuses without a text.
            return False
        if self._calibration.is_running:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: calibrating")
            return False
        if not self.is_possible:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: Resolve system health failures first")
            self.report_reasons()
            return False
        if not self._throttle_is_safe:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: throttle not in safe position")
            return False
        self.armed_at = px4.now
        px4.info(f"Armed by {by}")
        px4.on_armed()
        self.start_log()
        return True

    @property
    def _throttle_is_safe(self) -> bool:
        px4 = self._px4
        if px4.mode not in modes.STICK_MODES:
            return True
        if px4.mode in _CLIMB_MODES:  # A centered stick is safe where the throttle stick controls the climb rate.
            return px4.sticks.throttle <= _CENTER_THROTTLE
        return px4.sticks.throttle < _LOW_THROTTLE

    def disarm(self, by: str, *, force: bool = False) -> bool:
        """Stop the motors and return True. Without ``force``, a flying vehicle stays armed."""
        px4 = self._px4
        if not px4.is_armed:
            return True
        if not px4.is_landed and not force:
            px4.send_text(MavSeverity.CRITICAL, "Disarming denied: not landed")
            return False
        px4.info(f"Disarmed by {by}")
        self._is_logging = False
        px4.on_disarmed()
        if px4.mode in _MODES_ENDED_BY_DISARMING:
            px4.switch_to(px4.mode_after_landing)
        return True

    def terminate(self) -> None:
        """Stop the motors until a restart, and trigger the parachute."""
        px4 = self._px4
        self.is_terminated = True
        px4.is_in_failsafe = True
        px4.send_text(MavSeverity.CRITICAL, "Failsafe activated")
        px4.send_text(MavSeverity.CRITICAL, "Preflight Fail: Flight termination active")
        parachute = (px4.system_id, MavComponent.PARACHUTE)
        px4.send_command(parachute, MavCmd.DO_PARACHUTE, float(ParachuteAction.RELEASE))

    def start_log(self) -> None:
        if self._is_logging:
            return
        self._is_logging = True
        time = datetime.fromtimestamp(self._px4.unix_time, timezone.utc)
        self._px4.info(f"[logger] ./log/{time:%Y-%m-%d/%H_%M_%S}.ulg")
