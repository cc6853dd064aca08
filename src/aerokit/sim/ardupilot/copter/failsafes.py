"""ArduCopter's failsafes: radio, ground station, battery and estimator, and motors that idle for too long."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import CopterMode, MavSeverity
from aerokit.sim.ardupilot.failsafes import Failsafes

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter.vehicle import SimulatedCopter

__all__ = ["CopterFailsafes"]

_NONE, _LAND, _RTL, _SMART_RTL, _SMART_RTL_OR_LAND, _TERMINATE, _AUTO, _BRAKE = range(8)
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
_PULSES_TO_BELIEVE_S = 0.2
_ESTIMATOR_PATIENCE_S = 1.0


class CopterFailsafes(Failsafes):
    """All that its parameters can choose.

    Terrain, vibration and dead reckoning are not watched. A landing sequence in the mission (action 6) is not
    looked for.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (
        _TERMINATE, _LAND, _RTL, _SMART_RTL_OR_LAND, _SMART_RTL, _NONE,
    )  # fmt: skip

    def __init__(self, copter: SimulatedCopter) -> None:
        super().__init__(copter)
        self._copter = copter
        self._radio_good_at = math.nan
        self._bad_since = math.nan
        self._had_position = self._acted_on_estimator = False
        self._idle_since = math.nan

    def watch(self) -> None:
        """Everything once."""
        self.battery.update()
        self._check_ground_station()
        self._check_estimator()
        self._check_idling()
        self._check_radio()
        self._copter.fence.update()

    # ---------------------------------------------------------------------------------------- radio

    def _check_radio(self) -> None:
        """No pulses for RC_FS_TIMEOUT, or a throttle below FS_THR_VALUE."""
        copter, parameters = self._copter, self._copter.parameters
        hears = copter.rc.is_heard
        if hears:
            self.radio_heard_at: float = copter.now
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
        if math.isnan(self.radio_heard_at):
            return
        silent = copter.now - self.radio_heard_at >= parameters["RC_FS_TIMEOUT"]
        self._radio_good_at = math.nan
        if (hears and low) or silent:
            self._set_radio(True)

    def _set_radio(self, lost: bool) -> None:
        if lost == self.radio:
            return
        self.radio = lost
        if not lost:
            self.say("Radio Failsafe Cleared")
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
        self.say("Radio Failsafe")
        return action

    # ------------------------------------------------------------------------------- ground station

    def _check_ground_station(self) -> None:
        copter, parameters = self._copter, self._copter.parameters
        if not parameters["FS_GCS_ENABLE"] or math.isnan(self.ground_station_seen_at):
            return
        lost = self.ground_station_silence > parameters["FS_GCS_TIMEOUT"]
        if lost == self.ground_station:
            return
        self.ground_station = lost
        if not lost:
            self.say("GCS Failsafe Cleared")
            return
        copter.rc.release_overrides()
        action = _BY_LINK_PARAMETER.get(int(parameters["FS_GCS_ENABLE"]), _RTL)
        self._do(self._ground_station_action(action))

    def _ground_station_action(self, action: int) -> int:
        mode = self._copter.mode
        if not self._copter.is_armed:
            self.say("GCS Failsafe")
            return _NONE
        if self._disarms("GCS"):
            return _NONE
        if (kept := self._keeps_landing("GCS")) is not None:
            return kept
        if mode.name == "AUTO" and self._option(_GCS_IN_AUTO):
            return self._goes_on("GCS", "Continuing Auto Mode")
        if mode.name in _PILOTED and self._option(_GCS_IF_PILOTED):
            return self._goes_on("GCS", "Continuing Pilot Control")
        self.say("GCS Failsafe")
        return action

    # ------------------------------------------------------------------------- battery and estimator

    def act_on_battery(self, action: int) -> None:
        """On the ground it is disarmed whatever the action; a landing may go on."""
        self._do(self._battery_action(action))

    def _battery_action(self, action: int) -> int:
        if self._disarms("Battery"):
            return _NONE
        if self._copter.mode.is_landing and self._option(_IF_LANDING) and action != _NONE:
            return self._goes_on("Battery", "Continuing Landing", _LAND)
        self.say("Battery Failsafe")
        return action

    def _check_estimator(self) -> None:
        """Only a position that was good before can be lost; a disarmed vehicle says so and does nothing."""
        copter = self._copter
        if copter.navigation.has_position:
            self._had_position, self._bad_since = True, math.nan
            if self.estimator and self._acted_on_estimator:
                self.say("EKF Failsafe Cleared", MavSeverity.CRITICAL)
            self.estimator = self._acted_on_estimator = False
        elif self._had_position and not self.estimator:
            if math.isnan(self._bad_since):
                self._bad_since = copter.now
            elif copter.now - self._bad_since >= _ESTIMATOR_PATIENCE_S:
                self._lose_estimator()

    def _lose_estimator(self) -> None:
        copter = self._copter
        self.say("EKF variance", MavSeverity.CRITICAL)
        self.estimator: bool = True
        self._acted_on_estimator = copter.is_armed
        if not copter.is_armed:
            return
        if not copter.mode.needs_position:
            self.say("EKF Failsafe", MavSeverity.CRITICAL)
            return
        copter.set_mode(CopterMode.LAND)
        self.say(f"EKF Failsafe: changed to {copter.mode.name} Mode", MavSeverity.CRITICAL)

    def _check_idling(self) -> None:
        """DISARM_DELAY: an armed vehicle that idles on the ground is disarmed."""
        copter, delay = self._copter, self._copter.parameters["DISARM_DELAY"]
        idles = copter.is_armed and copter.is_landed and copter.motors.is_idle
        if not idles or delay <= 0:
            self._idle_since = math.nan
        elif math.isnan(self._idle_since):
            self._idle_since = copter.now
        elif copter.now - self._idle_since >= delay:
            copter.arming.disarm()

    # ------------------------------------------------------------------------------ what all share

    def _option(self, bit: int) -> bool:
        return bool(int(self._copter.parameters["FS_OPTIONS"]) & bit)

    def _goes_on(self, name: str, how: str, action: int = _NONE) -> int:
        self.say(f"{name} Failsafe - {how}")
        return action

    def _disarms(self, name: str) -> bool:
        """On the ground the motors stop, whatever the action is; the text comes after that of disarming."""
        copter = self._copter
        if not copter.is_landed or (copter.mode.needs_mission and not copter.motors.is_idle):
            return False
        if name == "Radio":
            self.say("Radio Failsafe - Disarming")
        copter.arming.disarm()
        if name != "Radio":
            self.say(f"{name} Failsafe - Disarming")
        return True

    def _keeps_landing(self, name: str) -> int | None:
        if not self._copter.mode.is_landing:
            return None
        if self.battery_is_low and self.battery.priority <= self.BATTERY_PRIORITIES.index(_LAND):
            return self._goes_on(f"{name} + Battery", "Continuing Landing", _LAND)
        return self._goes_on(name, "Continuing Landing", _LAND) if self._option(_IF_LANDING) else None

    def _do(self, action: int) -> None:
        if action == _TERMINATE:
            self._copter.arming.disarm()
        if action == _AUTO:
            self.say("Unable to start landing sequence")
            self.say("Mode change to AUTO RTL failed: No return path or landing sequence found")
            self.say("Trying RTL Mode")
        for attempt, mode in enumerate(_MODES.get(action, ())):
            if attempt and (text := _INSTEAD.get((action, attempt))):
                self.say(text)
            if self._copter.set_mode(mode):
                return
