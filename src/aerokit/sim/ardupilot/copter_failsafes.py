"""ArduCopter's failsafes of radio, ground station and battery, with every action that can be configured."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CopterMode, MavSeverity
from aerokit.sim.ardupilot.failsafes import Failsafes

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter import SimulatedCopter

__all__ = ["CopterFailsafes"]

_NONE, _LAND, _RTL, _SMART_RTL, _SMART_RTL_OR_LAND, _TERMINATE, _AUTO, _BRAKE = range(8)
_PRIORITIES = (_TERMINATE, _LAND, _RTL, _SMART_RTL_OR_LAND, _SMART_RTL, _NONE)
"""Battery actions, the gravest first."""
_BY_LINK_PARAMETER = {
    0: _NONE,
    1: _RTL,
    2: _RTL,
    3: _SMART_RTL,
    4: _SMART_RTL_OR_LAND,
    5: _LAND,
    6: _AUTO,
    7: _BRAKE,
}
"""FS_THR_ENABLE and FS_GCS_ENABLE → action."""
_MODES: dict[int, tuple[int, ...]] = {
    _LAND: (CopterMode.LAND,),
    _RTL: (CopterMode.RTL, CopterMode.LAND),
    _SMART_RTL: (CopterMode.SMART_RTL, CopterMode.RTL, CopterMode.LAND),
    _SMART_RTL_OR_LAND: (CopterMode.SMART_RTL, CopterMode.LAND),
    _AUTO: (CopterMode.RTL, CopterMode.LAND),
    _BRAKE: (CopterMode.BRAKE, CopterMode.LAND),
}
_INSTEAD = {
    (_SMART_RTL, 1): "SmartRTL Unavailable, Trying RTL Mode",
    (_SMART_RTL_OR_LAND, 1): "SmartRTL Unavailable, Using Land Mode",
    (_BRAKE, 1): "Trying Land Mode",
}
_RADIO_IN_AUTO, _GCS_IN_AUTO, _RADIO_IN_GUIDED, _IF_LANDING, _GCS_IF_PILOTED = 1, 2, 4, 8, 16
"""Bits of FS_OPTIONS: what goes on in spite of a failsafe."""
_PILOTED = frozenset({"STABILIZE", "ALT_HOLD", "LOITER", "POSHOLD"})
_OK, _LOW, _CRITICAL = 0, 1, 2
_PULSES_TO_BELIEVE_S = 0.2


class CopterFailsafes(Failsafes):
    """What is common is checked in the base class; here is what ArduCopter's parameters can choose.

    Terrain and dead reckoning are not watched. A landing sequence in the mission (action 6) is not looked for.
    """

    def __init__(self, copter: SimulatedCopter) -> None:
        super().__init__(copter)
        self._copter = copter
        self.battery_level = _OK
        """0 as it should be, 1 low, 2 critical; it never goes back."""
        self._battery_priority = len(_PRIORITIES)
        self._below_since = {_LOW: math.nan, _CRITICAL: math.nan}
        self._radio_heard_at = math.nan
        self._radio_good_at = math.nan

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state."""
        return self.radio or super().is_any_active

    def _check(self) -> None:
        super()._check()
        self._check_radio()
        self._copter.fence.update()

    # ---------------------------------------------------------------------------------------- radio

    def _check_radio(self) -> None:
        """No pulses for RC_FS_TIMEOUT, or a throttle below FS_THR_VALUE."""
        copter, parameters = self._copter, self._copter.parameters
        hears = copter.rc.is_heard
        if hears:
            self._radio_heard_at = copter.now
        if not parameters["FS_THR_ENABLE"]:
            self._set_radio(False)
            return
        low = copter.rc[2] < parameters["FS_THR_VALUE"]
        if hears and not low:
            if math.isnan(self._radio_good_at):
                self._radio_good_at = copter.now
            if copter.now - self._radio_good_at >= _PULSES_TO_BELIEVE_S:
                self._set_radio(False)
            return
        if math.isnan(self._radio_heard_at):
            return
        silent = copter.now - self._radio_heard_at >= parameters["RC_FS_TIMEOUT"]
        self._radio_good_at = math.nan
        if (hears and low) or silent:
            self._set_radio(True)

    def _set_radio(self, lost: bool) -> None:
        if lost == self.radio:
            return
        self.radio = lost
        if not lost:
            self._say("Radio Failsafe Cleared")
            return
        action = _BY_LINK_PARAMETER.get(int(self._copter.parameters["FS_THR_ENABLE"]), _LAND)
        self._do(self._radio_action(action))

    def _radio_action(self, action: int) -> int:
        mode = self._copter.mode
        if self._disarms("Radio"):
            return _NONE
        if (kept := self._keeps_landing("Radio")) is not None:
            return kept
        if mode.name == "AUTO" and self._option(_RADIO_IN_AUTO):
            return self._goes_on("Radio", "Continuing Auto")
        if mode.name == "GUIDED" and self._option(_RADIO_IN_GUIDED):
            return self._goes_on("Radio", "Continuing Guided Mode")
        self._say("Radio Failsafe")
        return action

    # ------------------------------------------------------------------------------- ground station

    def _check_ground_station(self) -> None:
        copter, parameters = self._copter, self._copter.parameters
        if not parameters["FS_GCS_ENABLE"] or math.isnan(self.ground_station_seen_at):
            return
        lost = copter.now - self.ground_station_seen_at > parameters["FS_GCS_TIMEOUT"]
        if lost == self.ground_station:
            return
        self.ground_station = lost
        if not lost:
            self._say("GCS Failsafe Cleared")
            return
        copter.rc.release_overrides()
        action = _BY_LINK_PARAMETER.get(int(parameters["FS_GCS_ENABLE"]), _RTL)
        self._do(self._ground_station_action(action))

    def _ground_station_action(self, action: int) -> int:
        mode = self._copter.mode
        if not self._copter.is_armed:
            self._say("GCS Failsafe")
            return _NONE
        if self._disarms("GCS"):
            return _NONE
        if (kept := self._keeps_landing("GCS")) is not None:
            return kept
        if mode.name == "AUTO" and self._option(_GCS_IN_AUTO):
            return self._goes_on("GCS", "Continuing Auto Mode")
        if mode.name in _PILOTED and self._option(_GCS_IF_PILOTED):
            return self._goes_on("GCS", "Continuing Pilot Control")
        self._say("GCS Failsafe")
        return action

    # -------------------------------------------------------------------------------------- battery

    def _check_battery(self) -> None:
        """Only while armed; the voltage must stay low for BATT_LOW_TIMER, charge counts at once."""
        copter = self._copter
        if not copter.is_armed:
            return
        level = max(level for level in (_OK, _LOW, _CRITICAL) if level == _OK or self._is_below(level))
        if level <= self.battery_level:
            return
        self.battery_level, self.battery_is_low = level, True
        self.battery_is_critical = level == _CRITICAL
        battery, word = copter.battery, "low" if level == _LOW else "critical"
        self._say(f"Battery 1 is {word} {battery.voltage_v:.2f}V used {battery.consumed_mah:.0f} mAh")
        action = int(copter.parameters["BATT_FS_LOW_ACT" if level == _LOW else "BATT_FS_CRT_ACT"])
        priority = _PRIORITIES.index(action) if action in _PRIORITIES else len(_PRIORITIES)
        if priority <= self._battery_priority:
            self._battery_priority = priority
            self._do(self._battery_action(action))

    def _is_below(self, level: int) -> bool:
        copter, parameters = self._copter, self._copter.parameters
        name = "LOW" if level == _LOW else "CRT"
        volts, charge = self.battery_is_below(name)
        if not volts:
            self._below_since[level] = math.nan
        elif math.isnan(self._below_since[level]):
            self._below_since[level] = copter.now
        timer = parameters["BATT_LOW_TIMER"]
        return charge or (timer > 0 and copter.now - self._below_since[level] > timer)

    def battery_is_below(self, name: str) -> tuple[bool, bool]:
        """Whether voltage and charge are below their limits; ``name`` is LOW or CRT, as in the parameters."""
        battery, parameters = self._copter.battery, self._copter.parameters
        volts, charge = parameters[f"BATT_{name}_VOLT"], parameters[f"BATT_{name}_MAH"]
        left = parameters["BATT_CAPACITY"] - battery.consumed_mah
        return volts > 0 and battery.voltage_v < volts, charge > 0 and left < charge

    def _battery_action(self, action: int) -> int:
        if self._disarms("Battery"):
            return _NONE
        if self._copter.mode.is_landing and self._option(_IF_LANDING) and action != _NONE:
            return self._goes_on("Battery", "Continuing Landing", _LAND)
        self._say("Battery Failsafe")
        return action

    # ------------------------------------------------------------------------------ what all share

    def _option(self, bit: int) -> bool:
        return bool(int(self._copter.parameters["FS_OPTIONS"]) & bit)

    def _say(self, text: str) -> None:
        self._copter.send_text(MavSeverity.WARNING, text)

    def _goes_on(self, name: str, how: str, action: int = _NONE) -> int:
        self._say(f"{name} Failsafe - {how}")
        return action

    def _disarms(self, name: str) -> bool:
        """On the ground the motors stop, whatever the action is; the text comes after that of disarming."""
        copter = self._copter
        if not copter.is_landed or (copter.mode.needs_mission and not copter.motors.is_idle):
            return False
        if name == "Radio":
            self._say("Radio Failsafe - Disarming")
        copter.arming.disarm()
        if name != "Radio":
            self._say(f"{name} Failsafe - Disarming")
        return True

    def _keeps_landing(self, name: str) -> int | None:
        if not self._copter.mode.is_landing:
            return None
        if self.battery_level and self._battery_priority <= _PRIORITIES.index(_LAND):
            return self._goes_on(f"{name} + Battery", "Continuing Landing", _LAND)
        return self._goes_on(name, "Continuing Landing", _LAND) if self._option(_IF_LANDING) else None

    def _do(self, action: int) -> None:
        if action == _TERMINATE:
            self._copter.arming.disarm()
        if action == _AUTO:
            self._say("Unable to start landing sequence")
            self._say("Mode change to AUTO RTL failed: No return path or landing sequence found")
            self._say("Trying RTL Mode")
        for attempt, mode in enumerate(_MODES.get(action, ())):
            if attempt and (text := _INSTEAD.get((action, attempt))):
                self._say(text)
            if self._copter.set_mode(mode):
                return
