"""The battery failsafe of every simulated ArduPilot: when it is low or critical, and which action goes first."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavSeverity

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["BatteryFailsafe"]

_OK, _LOW, _CRITICAL = 0, 1, 2
_NAMES = {_LOW: "LOW", _CRITICAL: "CRT"}
_WORDS = {_LOW: "low", _CRITICAL: "critical"}


class BatteryFailsafe:
    """Looks at voltage and charge while the vehicle is armed, says what it sees and has the kind act on it.

    ``priorities`` are the actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, the gravest first: one that is less grave
    than what has been done already is not done.
    """

    def __init__(
        self, vehicle: ArduPilotVehicle, priorities: Sequence[int], act: Callable[[int], None]
    ) -> None:
        self._vehicle = vehicle
        self._priorities = tuple(priorities)
        self._act = act
        self._below_since = {_LOW: math.nan, _CRITICAL: math.nan}
        self.level: int = _OK
        """0 as it should be, 1 low, 2 critical; it never goes back."""
        self.priority: int = len(self._priorities)
        """Place of the gravest action so far among the priorities; their number before the first."""

    def update(self) -> None:
        """Look now. The voltage must stay low for BATT_LOW_TIMER, charge counts at once."""
        if not self._vehicle.motors.is_armed:
            return
        level = max(self._below(_LOW), self._below(_CRITICAL))
        if level <= self.level:
            return
        self.level = level
        battery = self._vehicle.battery
        used = f"{battery.voltage_v:.2f}V used {battery.consumed_mah:.0f} mAh"
        self._vehicle.send_text(MavSeverity.WARNING, f"Battery 1 is {_WORDS[level]} {used}")
        action = int(self._vehicle.parameters[f"BATT_FS_{_NAMES[level]}_ACT"])
        priority = self._priorities.index(action) if action in self._priorities else len(self._priorities)
        if priority <= self.priority:
            self.priority = priority
            self._act(action)

    def reason_not_to_arm(self) -> str | None:
        """What the arming checks say of the battery; None when they say nothing."""
        battery, parameters = self._vehicle.battery, self._vehicle.parameters
        if battery.voltage_v < parameters["BATT_ARM_VOLT"]:
            return "Battery 1 below minimum arming voltage"
        if self._left_mah() < parameters["BATT_ARM_MAH"]:
            return "Battery 1 below minimum arming capacity"
        for level, word in _WORDS.items():
            for is_below, what in zip(self._is_below(level), ("voltage", "capacity"), strict=True):
                if is_below:
                    return f"Battery 1 {word} {what} failsafe"
        for name, what in (("MAH", "capacity"), ("VOLT", "voltage")):
            if 0.0 < parameters[f"BATT_LOW_{name}"] <= parameters[f"BATT_CRT_{name}"]:
                return f"Battery 1 {what} failsafe critical >= low"
        return None

    def _below(self, level: int) -> int:
        """The level if it has been reached for long enough, else 0."""
        vehicle, since = self._vehicle, self._below_since
        volts, charge = self._is_below(level)
        if not volts:
            since[level] = math.nan
        elif math.isnan(since[level]):
            since[level] = vehicle.now
        timer = vehicle.parameters["BATT_LOW_TIMER"]
        return level if charge or (timer > 0 and vehicle.now - since[level] > timer) else _OK

    def _is_below(self, level: int) -> tuple[bool, bool]:
        """Whether voltage and charge are below their limits now."""
        parameters, name = self._vehicle.parameters, _NAMES[level]
        volts, charge = parameters[f"BATT_{name}_VOLT"], parameters[f"BATT_{name}_MAH"]
        return volts > 0 and self._vehicle.battery.voltage_v < volts, charge > 0 and self._left_mah() < charge

    def _left_mah(self) -> float:
        return self._vehicle.parameters["BATT_CAPACITY"] - self._vehicle.battery.consumed_mah
