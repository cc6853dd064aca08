"""What an ArduCopter checks before arming, and does by itself: radio, ground station, battery, estimator, fence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from aerokit.mavlink.enums import CopterMode, FenceMitigate, MavSeverity
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import REPORT_ONLY, Fence
from aerokit.sim.ardupilot.mode import VehicleMode

_STICK_CENTRE, _STICK_LOW, _DEADZONE = 1500, 1050, 100


class CopterArming(Arming):
    """A position is needed only in the modes that fly by it, and a throttle that is low or in the middle."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._copter = copter

    def ahrs_reasons(self) -> Sequence[str]:
        """Comes after GPS, which says it first."""
        return ()

    def position_reasons(self) -> Sequence[str]:
        """GPS and estimator; then even what a forced arming insists on."""
        if self._copter.mode.needs_position and (reasons := self.gps_reasons()):
            return reasons
        return super().ahrs_reasons() or self.mandatory_reasons()

    def own_reasons(self) -> list[str]:
        failsafes = self._copter.failsafes
        reasons = ["GCS failsafe on"] if failsafes.ground_station else []
        return [*reasons, "Battery failsafe"] if failsafes.battery_is_low else reasons

    def mandatory_reasons(self) -> list[str]:
        """What the mode needs of the estimator."""
        copter, nav = self._copter, self._copter.navigation
        reasons = []
        if copter.mode.needs_position and not (nav.has_position and not copter.failsafes.estimator):
            reasons.append("Need Position Estimate")
        if not copter.mode.has_manual_throttle and not nav.has_altitude:
            reasons.append("Need Alt Estimate")
        return reasons

    def arm(self, *, force: bool = False) -> bool:
        done = super().arm(force=force)
        if done:
            self._copter.path.begin()
        return done

    def final_reasons(self) -> list[str]:
        mode = self._copter.mode
        if not mode.can_arm:
            return [f"{mode.name} mode not armable"]
        high = _STICK_LOW if mode.has_manual_throttle else _STICK_CENTRE + _DEADZONE
        if not mode.arms_with_raised_throttle and self._copter.rc[2] > high:
            return ["Throttle too high"]
        return []


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

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._copter = copter
        self._radio_good_at = math.nan
        self._bad_since = math.nan
        self._had_position = self._acted_on_estimator = False
        self._idle_since = math.nan

    def watch(self) -> None:
        self.battery.update()
        self._check_ground_station()
        self._check_estimator()
        self._check_idling()
        self._check_radio()
        self._copter.fence.update()

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


_GIVE_UP_M = 100.0
_ACTIONS: dict[int, tuple[int, ...]] = {
    1: (CopterMode.RTL, CopterMode.LAND),
    2: (CopterMode.LAND,),
    3: (CopterMode.SMART_RTL, CopterMode.RTL, CopterMode.LAND),
    4: (CopterMode.BRAKE, CopterMode.LAND),
    5: (CopterMode.SMART_RTL, CopterMode.LAND),
}


class CopterFence(Fence):
    """FENCE_ACTION: nothing (0), RTL (1), LAND (2), SMART_RTL (3, 5), BRAKE (4); LAND if that fails or far out."""

    PERIOD_S: ClassVar[float] = 0.1
    WATCHES_DISARMED: ClassVar[bool] = True
    MITIGATION: ClassVar[int] = FenceMitigate.NONE

    def act(self, new: int) -> None:
        """On the ground the motors stop; in the air FENCE_ACTION follows."""
        vehicle = self._vehicle
        action = int(vehicle.parameters["FENCE_ACTION"])
        if vehicle.is_landed:
            if action != REPORT_ONLY:
                vehicle.arming.disarm()
            return
        self.tell("breached", new)
        if action == REPORT_ONLY:
            return
        modes = (CopterMode.LAND,) if self.beyond_m(new) > _GIVE_UP_M else _ACTIONS.get(action, _ACTIONS[1])
        self.caused_mode: bool = any(vehicle.set_mode(mode) for mode in modes)

    def cleared(self) -> None:
        if not self._vehicle.is_landed:
            self._vehicle.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: VehicleMode) -> tuple[int, str] | None:
        if not self.forbids_modes() or not self._vehicle.is_armed or self._vehicle.is_landed:
            return None
        return MavSeverity.WARNING, f"Mode change to {mode.name} failed: in fence recovery"

    def mode_changed(self) -> None:
        """Ten seconds for the pilot, unless the fence only reports."""
        super().mode_changed()
        if self._vehicle.parameters["FENCE_ACTION"] != REPORT_ONLY:
            self.recover_by_hand()
