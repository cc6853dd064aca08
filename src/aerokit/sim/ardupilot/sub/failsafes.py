"""ArduSub's failsafes: ground station, pilot, radio, battery, leaks, and what is measured inside the hull."""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink.enums import MavSeverity, SubMode
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.sub.host import SubHost

_BUTTONS = range(16)
_SHIFT, _ARM_TOGGLE, _DISARM = 1, 2, 4
"""BTNn_FUNCTION."""
_DISARMS = frozenset({_ARM_TOGGLE, _DISARM})


class SubArming(Arming):
    """Radio and battery only by default (ARMING_CHECK 448), a position never; a joystick button must disarm it."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        self._sub = sub

    def reasons(self) -> list[str]:
        if self._sub.is_initialised and not self._has_disarm_button():
            return ["Must assign a disarm or arm_toggle button or disarm aux function"]
        return super().reasons()

    def disarm(self, *, force: bool = True) -> bool:
        return super().disarm(force=True)

    def _has_disarm_button(self) -> bool:
        parameters = self._sub.parameters
        names = [f"BTN{number}_" for number in _BUTTONS if f"BTN{number}_FUNCTION" in parameters]
        plain = {int(parameters[f"{name}FUNCTION"]) for name in names}
        if not names or plain & _DISARMS:
            return True
        return _SHIFT in plain and any(int(parameters[f"{name}SFUNCTION"]) in _DISARMS for name in names)


_FAILSAFE_DISARM, _HOLD, _SURFACE = 2, 3, 4
"""FS_GCS_ENABLE; 1 only warns."""
_BATTERY_DISARM, _BATTERY_SURFACE = 2, 3
_PILOT_DISARM, _LEAK_SURFACE, _RADIO_SURFACE = 2, 2, 2
_GCS_WARNING_S, _LEAK_WARNING_S, _HULL_WARNING_S = 30.0, 20.0, 30.0
_HULL_PATIENCE_S = 2.0
_SILENT_S = 1.0
_STICKS, _STICK_MIDDLE = 6, 1500


class SubFailsafes(Failsafes):
    """Most act only while it is armed. Terrain, estimator and crash are not watched."""

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (_BATTERY_DISARM, _BATTERY_SURFACE, 1, 0)

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        self._sub = sub
        self.pilot: bool = False
        """Whether nobody steers: neither pulses nor MANUAL_CONTROL for FS_PILOT_TIMEOUT."""
        self.leak: bool = False
        self.pressure: _HullLimit = _HullLimit("pressure", "FS_PRESS")
        self.temperature: _HullLimit = _HullLimit("temperature", "FS_TEMP")
        self._gcs_warned_at = self._leak_warned_at = -math.inf

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state; the radio alone is none."""
        hull = self.pressure.is_exceeded or self.temperature.is_exceeded
        return self.pilot or self.battery_is_low or self.ground_station or self.leak or hull

    def watch(self) -> None:
        self._watch_radio()
        self._watch_pilot()
        self._watch_ground_station()
        self._watch_leak()
        inside = self._sub.hull_pressure_pa, self._sub.hull_temperature_c
        for limit, value in zip((self.pressure, self.temperature), inside, strict=True):
            limit.watch(self._sub, value)
        super().watch()

    def _watch_radio(self) -> None:
        """FS_THR_ENABLE: 1 warns, 2 surfaces."""
        sub, enabled = self._sub, int(self._sub.parameters["FS_THR_ENABLE"])
        hears = sub.rc.is_heard
        if hears:
            self.radio_heard_at: float = sub.now
        low = hears and sub.rc[2] < sub.parameters["FS_THR_VALUE"]
        lost = low or sub.now - self.radio_heard_at >= _SILENT_S
        if not enabled:
            lost = False
        elif not hears and not lost:
            return
        if lost == self.radio:
            return
        self.radio = lost
        self.say("RC Failsafe" if lost else "Radio Failsafe Cleared")
        if lost and enabled == _RADIO_SURFACE:
            sub.set_mode(SubMode.SURFACE)

    def _watch_pilot(self) -> None:
        sub, enabled = self._sub, int(self._sub.parameters["FS_PILOT_INPUT"])
        silence = sub.now - self.radio_heard_at
        if not enabled or not silence >= sub.parameters["FS_PILOT_TIMEOUT"]:
            self.pilot = False
            return
        if self.pilot:
            return
        self.pilot = True
        self.say("Lost manual control", MavSeverity.CRITICAL)
        for index in range(_STICKS):
            sub.rc[index] = _STICK_MIDDLE
        if enabled == _PILOT_DISARM:
            sub.arming.disarm()

    def _watch_ground_station(self) -> None:
        sub, action = self._sub, int(self._sub.parameters["FS_GCS_ENABLE"])
        if not action or math.isnan(self.ground_station_seen_at):
            return
        if self.ground_station_silence < sub.parameters["FS_GCS_TIMEOUT"]:
            if self.ground_station:
                self.ground_station = False
                self.say("GCS Failsafe Cleared")
            return
        if sub.now - self._gcs_warned_at > _GCS_WARNING_S:
            self._gcs_warned_at = sub.now
            self.say(f"MYGCS: {int(sub.parameters['MAV_GCS_SYSID'])}, heartbeat lost")
        if self.ground_station or not sub.is_armed:
            return
        self.ground_station: bool = True
        modes = {_HOLD: SubMode.ALT_HOLD, _SURFACE: SubMode.SURFACE}
        if action == _FAILSAFE_DISARM or (action in modes and not sub.set_mode(modes[action])):
            sub.arming.disarm()

    def act_on_battery(self, action: int) -> None:
        if action == _BATTERY_SURFACE:
            self._sub.set_mode(SubMode.SURFACE)
        elif action == _BATTERY_DISARM:
            self._sub.arming.disarm()

    def _watch_leak(self) -> None:
        sub, action = self._sub, int(self._sub.parameters["FS_LEAK_ENABLE"])
        if not sub.faults.leak or not action:
            self.leak = False
            return
        if sub.now - self._leak_warned_at > _LEAK_WARNING_S:
            self._leak_warned_at = sub.now
            self.say("Leak Detected", MavSeverity.CRITICAL)
        if not self.leak:
            self.leak = True
            if action == _LEAK_SURFACE and sub.is_armed:
                sub.set_mode(SubMode.SURFACE)


class _HullLimit:
    """Two seconds above FS_PRESS_MAX (Pa) or FS_TEMP_MAX (°C) are too much; it is told every 30 s."""

    def __init__(self, what: str, prefix: str) -> None:
        self.is_exceeded: bool = False
        self._what, self._prefix = what, prefix
        self._good_at = self._warned_at = 0.0

    def watch(self, sub: SubHost, value: float) -> None:
        if not sub.parameters[f"{self._prefix}_ENABLE"]:
            return
        if value < sub.parameters[f"{self._prefix}_MAX"]:
            self._good_at = self._warned_at = sub.now
            self.is_exceeded = False
            return
        if sub.now - self._good_at > _HULL_PATIENCE_S:
            self.is_exceeded = True
        if self.is_exceeded and sub.now - self._warned_at > _HULL_WARNING_S:
            self._warned_at = sub.now
            sub.send_text(MavSeverity.WARNING, f"Internal {self._what} critical!")
