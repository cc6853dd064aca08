"""What a simulated ArduPilot does by itself: the part that all kinds of vehicles share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.sim.ardupilot.host import Host

_OK, _LOW, _CRITICAL = 0, 1, 2
_NAMES = {_LOW: "LOW", _CRITICAL: "CRT"}
_WORDS = {_LOW: "low", _CRITICAL: "critical"}


class BatteryFailsafe:
    """Looks at voltage and charge while the vehicle is armed, says what it sees and has the kind act on it.

    ``priorities`` are the actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, the gravest first: one that is less grave
    than what has been done already is not done.
    """

    def __init__(self, vehicle: Host, priorities: Sequence[int], act: Callable[[int], None]) -> None:
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


_PERIOD_S = 0.1


class Failsafes:
    """`watch` is called ten times a second; each failsafe acts once when it starts and says so.

    A kind of vehicle says in `watch` what it looks at, and in `act_on_battery` what its numbers mean.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = ()
    """Actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, the gravest first."""

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.battery: BatteryFailsafe = BatteryFailsafe(vehicle, self.BATTERY_PRIORITIES, self.act_on_battery)
        self.ground_station = False
        self.estimator = False
        self.radio = False
        """Whether the pilot's radio counts as lost; it is not armed then."""
        self.ground_station_seen_at: float = math.nan
        """When the last heartbeat of the ground station MAV_GCS_SYSID came."""
        self.radio_heard_at: float = math.nan
        """When the last pulses of the radio came, or what RC_CHANNELS_OVERRIDE put in their place."""

    def start(self) -> None:
        """Watch from now on."""
        self._vehicle.every(_PERIOD_S, self.watch)

    @property
    def battery_is_low(self) -> bool:
        """Whether the battery was low, or worse, while the vehicle was armed."""
        return self.battery.level > 0

    @property
    def battery_is_critical(self) -> bool:
        """Whether the battery was critical while the vehicle was armed."""
        return self.battery.level > 1

    @property
    def is_any_active(self) -> bool:
        return self.battery_is_low or self.ground_station or self.estimator or self.radio

    @property
    def hears_radio(self) -> bool:
        """Whether SYS_STATUS calls the radio healthy."""
        return not self.radio

    @property
    def ground_station_silence(self) -> float:
        """Seconds since the ground station was heard last; NaN before the first time, which is more than nothing."""
        return self._vehicle.now - self.ground_station_seen_at

    def watch(self) -> None:
        """Look at everything once: here at battery and fence."""
        self.battery.update()
        self._vehicle.fence.update()

    def act_on_battery(self, action: int) -> None:
        """Do what BATT_FS_LOW_ACT or BATT_FS_CRT_ACT says."""
        raise NotImplementedError

    def say(self, text: str, severity: int = MavSeverity.WARNING) -> None:
        self._vehicle.send_text(severity, text)

    def change_to(self, *modes: int) -> bool:
        """Go into the first of these modes that can be entered; whether there is one."""
        return any(self._vehicle.set_mode(mode) for mode in modes)
