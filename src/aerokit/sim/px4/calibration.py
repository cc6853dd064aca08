"""PREFLIGHT_CALIBRATION on a simulated PX4: answered at once, told in ``[cal]`` texts.

https://docs.px4.io/main/en/config/. A vehicle that must be turned by hand for it (magnetometer, accelerometer) waits
for its second side until the calibration is cancelled: all params 0, or another sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavResult, MavSeverity

if TYPE_CHECKING:
    from aerokit.sim.commands import Command
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Calibration"]

_BY_ITSELF: dict[str, tuple[Sequence[int], float]] = {
    "gyro": (range(0, 101, 10), 0.3),
    "baro": ((), 0.5),
    "level": ((0, 20, 40, 60, 80, 100, 100), 0.5),
}
"""Sensor → percentages that are told, and seconds between them."""

_SIDES = (
    "pending: back front left right up down",
    "hold vehicle still on a pending side",
    "detected rest position, hold still...",
    "down orientation detected",
    "down orientation detected",
)
_ON_A_SIDE = {"mag": "Rotate vehicle", "accel": "Hold still, measuring down side"}
_SIDE_STEP_S = 0.8


class Calibration:
    """One at a time, on the ground."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self._sensor = ""
        self._number = 0

    @property
    def is_running(self) -> bool:
        """Whether a sensor is being calibrated; HEARTBEAT says so, and nobody can arm."""
        return bool(self._sensor)

    def command(self, command: Command) -> int:
        """What a client asks for; the MAV_RESULT."""
        sensor = _sensor_of(command)
        if self._px4.is_armed:
            return MavResult.TEMPORARILY_REJECTED
        if self.is_running:
            self._cancel()
            return MavResult.ACCEPTED if sensor == "" else MavResult.TEMPORARILY_REJECTED
        if sensor in _BY_ITSELF:
            self._start(sensor)
            self._measure(*_BY_ITSELF[sensor])
        elif sensor in _ON_A_SIDE:
            self._start(sensor)
            self._say_later([*_SIDES, _ON_A_SIDE[sensor]], _SIDE_STEP_S)
        elif sensor == "airspeed":
            self._start(sensor)
            self._px4.send_text(MavSeverity.CRITICAL, "[cal] Ensure sensor is not measuring wind")
        return MavResult.ACCEPTED

    def _start(self, sensor: str) -> None:
        self._sensor = sensor
        self._number += 1
        self._px4.info(f"[cal] calibration started: 2 {sensor}")

    def _measure(self, percents: Sequence[int], step_s: float) -> None:
        self._say_later([f"progress <{percent}>" for percent in percents], step_s)
        number = self._number
        self._px4.call_later((len(percents) + 1) * step_s, lambda: self._end(number))

    def _say_later(self, texts: Sequence[str], step_s: float) -> None:
        for place, text in enumerate(texts):
            self._px4.call_later(place * step_s, partial(self._say, text, self._number))

    def _say(self, text: str, number: int) -> None:
        if self.is_running and number == self._number:
            self._px4.info(f"[cal] {text}")

    def _end(self, number: int) -> None:
        if self.is_running and number == self._number:
            self._px4.info(f"[cal] calibration done: {self._sensor}")
            self._sensor = ""

    def _cancel(self) -> None:
        self._px4.send_text(MavSeverity.CRITICAL, "[cal] calibration cancelled")
        self._sensor = ""


def _sensor_of(command: Command) -> str:
    wanted = {
        "gyro": command.param1 == 1,
        "mag": command.param2 == 1,
        "baro": command.param3 == 1,
        "accel": command.x == 1,
        "level": command.x == 2,
        "airspeed": command.y == 1,
    }
    return next((sensor for sensor, asked in wanted.items() if asked), "")
