"""ArduCopter's arming checks, failsafes and fence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from aerokit.mavlink.enums import CopterMode, FenceMitigate, FenceType, MavSeverity
from aerokit.sim.ardupilot.copter_modes import CopterHost
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes, ArmingCheck
from aerokit.sim.ardupilot.fence import REPORT_ONLY, ArduPilotFence
from aerokit.sim.ardupilot.host import RC_THROTTLE, ArduPilotMode, ConditionTimer

_STICK_CENTER, _STICK_LOW, _DEADZONE = 1500, 1050, 100


class CopterArming(ArduPilotArming[CopterHost]):
    """ArduCopter's arming checks."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def ahrs_reasons(self) -> Sequence[str]:
        return ()  # `position_reasons` includes these checks, because ArduCopter runs them after the GPS checks.

    def position_reasons(self) -> Sequence[str]:
        needs_gps = self.vehicle.mode.needs_position or self._fence_needs_position
        gps_reasons = super().position_reasons() if needs_gps else ()
        return gps_reasons or self.mandatory_reasons()

    def own_reasons(self) -> list[str]:
        reasons = []
        if self.vehicle.failsafes.is_ground_station_lost:
            reasons.append("GCS failsafe on")
        if self.vehicle.failsafes.battery_is_low:
            reasons.append("Battery failsafe")
        return reasons

    def mandatory_reasons(self) -> list[str]:
        copter, nav = self.vehicle, self.vehicle.navigation
        reasons = list(super().ahrs_reasons())
        is_position_usable = nav.has_position and not copter.failsafes.has_estimator_failed
        if not reasons and not is_position_usable:
            if copter.mode.needs_position:
                reasons.append("Need Position Estimate")
            elif self._fence_needs_position:
                reasons.append("Fence enabled, need position estimate")
        if not copter.mode.has_manual_throttle and not nav.has_altitude:
            reasons.append("Need Alt Estimate")
        return reasons

    @property
    def _fence_needs_position(self) -> bool:
        return bool(self.vehicle.fence.active & (FenceType.CIRCLE | FenceType.POLYGON))

    def on_armed(self) -> None:
        self.vehicle.path.reset()

    def final_reasons(self) -> list[str]:
        mode = self.vehicle.mode
        if not mode.can_arm:
            return [f"{mode.name} mode not armable"]
        # In modes without manual throttle, the stick sets a climb rate, and its center holds the altitude.
        max_throttle = _STICK_LOW if mode.has_manual_throttle else _STICK_CENTER + _DEADZONE
        is_throttle_high = self.vehicle.rc[RC_THROTTLE] > max_throttle
        is_throttle_checked = self.is_checked(ArmingCheck.RC) and not mode.arms_with_raised_throttle
        return ["Throttle too high"] if is_throttle_checked and is_throttle_high else []


_NONE, _LAND, _RTL, _SMART_RTL, _SMART_RTL_OR_LAND, _TERMINATE, _AUTO, _BRAKE = range(8)
# Actions of FS_THR_ENABLE and FS_GCS_ENABLE, by parameter value.
_LINK_ACTIONS = (_NONE, _RTL, _RTL, _SMART_RTL, _SMART_RTL_OR_LAND, _LAND, _AUTO, _BRAKE)
_MODES: dict[int, tuple[int, ...]] = {
    _LAND: (CopterMode.LAND,),
    _RTL: (CopterMode.RTL, CopterMode.LAND),
    _SMART_RTL: (CopterMode.SMART_RTL, CopterMode.RTL, CopterMode.LAND),
    _SMART_RTL_OR_LAND: (CopterMode.SMART_RTL, CopterMode.LAND),
    _AUTO: (CopterMode.RTL, CopterMode.LAND),
    _BRAKE: (CopterMode.BRAKE, CopterMode.LAND),
}
# Texts that are sent if the first mode of an action is refused.
_FALLBACK_TEXTS = {
    _SMART_RTL: "SmartRTL Unavailable, Trying RTL Mode",
    _SMART_RTL_OR_LAND: "SmartRTL Unavailable, Using Land Mode",
    _BRAKE: "Trying Land Mode",
}


class _ContinueOption(NamedTuple):
    """Bit of FS_OPTIONS that lets a flight in one of the modes continue in spite of a failsafe, and the status text."""

    modes: frozenset[str]
    bit: int
    text: str


_CONTINUES_LANDING = 8  # bit of FS_OPTIONS
_RADIO_OPTIONS = (
    _ContinueOption(frozenset({"AUTO"}), 1, "Continuing Auto"),
    _ContinueOption(frozenset({"GUIDED"}), 4, "Continuing Guided Mode"),
)
_GCS_OPTIONS = (
    _ContinueOption(frozenset({"AUTO"}), 2, "Continuing Auto Mode"),
    _ContinueOption(frozenset({"STABILIZE", "ALT_HOLD", "LOITER", "POSHOLD"}), 16, "Continuing Pilot Control"),
)
_MIN_GOOD_S = 0.2
_ESTIMATOR_TIMEOUT_S = 1.0


class CopterFailsafes(ArduPilotFailsafes[CopterHost]):
    """Failsafes of radio, ground station, battery and estimator, and disarming after DISARM_DELAY.

    Not simulated: failsafes of terrain, vibration and dead reckoning, and the landing sequence of action 6 (AUTO).
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (
        _TERMINATE, _LAND, _RTL, _SMART_RTL_OR_LAND, _SMART_RTL, _NONE,
    )  # fmt: skip

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._radio_good_at = math.nan  # time since which the radio is good again; NaN while it is not
        self._position_lost = ConditionTimer()
        self._had_position = False  # True once the estimator has had a position
        self._acted_on_estimator = False  # True if the failsafe of the estimator began while armed
        self._idling = ConditionTimer()

    def update(self) -> None:
        self.battery.update()
        self._check_ground_station()
        self._check_estimator()
        self._check_idling()
        self._check_radio()
        self.vehicle.fence.update()

    def _check_radio(self) -> None:
        copter, parameters = self.vehicle, self.vehicle.parameters
        is_receiving = copter.rc.is_receiving
        if is_receiving:
            self.radio_received_at: float = copter.now
        if not parameters["FS_THR_ENABLE"]:
            self._set_radio_lost(is_lost=False)
            return
        is_throttle_low = copter.rc[RC_THROTTLE] < parameters["FS_THR_VALUE"]
        if is_receiving and not is_throttle_low:
            if math.isnan(self._radio_good_at):
                self._radio_good_at = copter.now
            if copter.now - self._radio_good_at >= _MIN_GOOD_S:
                self._set_radio_lost(is_lost=False)
            return
        if math.isnan(self.radio_received_at):  # A transmitter that was never received cannot be lost.
            return
        is_silent = copter.now - self.radio_received_at >= parameters["RC_FS_TIMEOUT"]
        self._radio_good_at = math.nan
        # A receiver reports a lost transmitter by a low throttle, or by sending no pulses (for RC_FS_TIMEOUT).
        if is_receiving or is_silent:
            self._set_radio_lost(is_lost=True)

    def _set_radio_lost(self, *, is_lost: bool) -> None:
        if is_lost == self.is_radio_lost:
            return
        self.is_radio_lost = is_lost
        if is_lost:
            action = self._configured_action("FS_THR_ENABLE", _LAND)
            self._execute(self._action_after_loss("Radio", action, _RADIO_OPTIONS))
        else:
            self.warn("Radio Failsafe Cleared")

    def _check_ground_station(self) -> None:
        copter, parameters = self.vehicle, self.vehicle.parameters
        if not parameters["FS_GCS_ENABLE"] or math.isnan(self.vehicle.ground_station_seen_at):
            return
        is_lost = self.ground_station_silence > parameters["FS_GCS_TIMEOUT"]
        if is_lost == self.is_ground_station_lost:
            return
        self.is_ground_station_lost = is_lost
        if not is_lost:
            self.warn("GCS Failsafe Cleared")
            return
        copter.rc.release_overrides()  # The pilot's radio takes over from the lost ground station.
        if copter.is_armed:
            action = self._configured_action("FS_GCS_ENABLE", _RTL)
            self._execute(self._action_after_loss("GCS", action, _GCS_OPTIONS))
        else:
            self.warn("GCS Failsafe")

    def _configured_action(self, parameter: str, default: int) -> int:
        value = int(self.vehicle.parameters[parameter])
        return _LINK_ACTIONS[value] if 0 <= value < len(_LINK_ACTIONS) else default

    def _action_after_loss(self, name: str, action: int, options: Sequence[_ContinueOption]) -> int:
        """Report the loss of the link ``name``. Return ``action``, or the action that replaces it in this situation."""
        mode = self.vehicle.mode
        if self._disarm_if_landed(name):
            return _NONE
        if mode.is_landing:
            # True for LAND and for the only action before it in `BATTERY_PRIORITIES`, TERMINATE.
            is_landing_for_battery = self.battery.priority <= self.BATTERY_PRIORITIES.index(_LAND)
            if self.battery_is_low and is_landing_for_battery:
                self.warn(f"{name} + Battery Failsafe - Continuing Landing")
                return _LAND
            if self._has_option(_CONTINUES_LANDING):
                self.warn(f"{name} Failsafe - Continuing Landing")
                return _LAND
        for option in options:
            if mode.name in option.modes and self._has_option(option.bit):
                self.warn(f"{name} Failsafe - {option.text}")
                return _NONE
        self.warn(f"{name} Failsafe")
        return action

    def act_on_battery(self, action: int) -> None:
        if self._disarm_if_landed("Battery"):
            return
        continues_landing = self.vehicle.mode.is_landing and self._has_option(_CONTINUES_LANDING)
        if continues_landing and action != _NONE:
            self.warn("Battery Failsafe - Continuing Landing")
            action = _LAND
        else:
            self.warn("Battery Failsafe")
        self._execute(action)

    def _check_estimator(self) -> None:
        copter = self.vehicle
        if copter.navigation.has_position:
            self._had_position = True
            self._position_lost.reset()
            if self.has_estimator_failed and self._acted_on_estimator:
                self.warn("EKF Failsafe Cleared", MavSeverity.CRITICAL)
            self.has_estimator_failed = self._acted_on_estimator = False
            return
        can_start = self._had_position and not self.has_estimator_failed
        if not can_start:
            return
        lost_for_s = self._position_lost.seconds(condition=True, now=copter.now)
        if lost_for_s >= _ESTIMATOR_TIMEOUT_S:
            self._start_estimator_failsafe()

    def _start_estimator_failsafe(self) -> None:
        copter = self.vehicle
        self.warn("EKF variance", MavSeverity.CRITICAL)
        self.has_estimator_failed: bool = True
        # The end of the failsafe is reported only if the copter was armed at its start.
        self._acted_on_estimator = copter.is_armed
        if not copter.is_armed:
            return
        if not copter.mode.needs_position:
            self.warn("EKF Failsafe", MavSeverity.CRITICAL)
            return
        copter.set_mode(CopterMode.LAND)
        self.warn(f"EKF Failsafe: changed to {copter.mode.name} Mode", MavSeverity.CRITICAL)

    def _check_idling(self) -> None:
        copter, delay = self.vehicle, self.vehicle.parameters["DISARM_DELAY"]
        is_idling = copter.is_armed and copter.is_landed and copter.motors.is_idle
        idling_for = self._idling.seconds(is_idling and delay > 0, copter.now)
        if 0 < delay <= idling_for:
            copter.arming.disarm()

    def _has_option(self, bit: int) -> bool:
        return bool(int(self.vehicle.parameters["FS_OPTIONS"]) & bit)

    def _disarm_if_landed(self, name: str) -> bool:
        copter = self.vehicle
        is_about_to_take_off = copter.mode.needs_mission and not copter.motors.is_idle
        if not copter.is_landed or is_about_to_take_off:
            return False
        if name == "Radio":  # The firmware reports this failsafe before disarming, all others after it.
            self.warn("Radio Failsafe - Disarming")
        copter.arming.disarm()
        if name != "Radio":
            self.warn(f"{name} Failsafe - Disarming")
        return True

    def _execute(self, action: int) -> None:
        if action == _TERMINATE:
            self.vehicle.arming.disarm()
        if action == _AUTO:  # Landing sequences are not simulated, so the firmware finds none.
            self.warn("Unable to start landing sequence")
            self.warn("Mode change to AUTO RTL failed: No return path or landing sequence found")
            self.warn("Trying RTL Mode")
        for attempt, mode in enumerate(_MODES.get(action, ())):
            was_first_mode_refused = attempt == 1
            if was_first_mode_refused and action in _FALLBACK_TEXTS:
                self.warn(_FALLBACK_TEXTS[action])
            is_accepted = self.vehicle.set_mode(mode)
            if is_accepted:
                return


_LAND_BEYOND_M = 100.0
_FENCE_RTL = 1
_FENCE_ACTIONS: dict[int, tuple[int, ...]] = {
    _FENCE_RTL: _MODES[_RTL],
    2: _MODES[_LAND],
    3: _MODES[_SMART_RTL],
    4: _MODES[_BRAKE],
    5: _MODES[_SMART_RTL_OR_LAND],
}


class CopterFence(ArduPilotFence[CopterHost]):
    """ArduCopter's fence. In flight, FENCE_ACTION selects the mode after a breach."""

    PERIOD_S: ClassVar[float] = 0.1
    MITIGATION: ClassVar[int] = FenceMitigate.NONE

    def act(self, new_breaches: int) -> None:
        if self.vehicle.is_landed:
            if self.action != REPORT_ONLY:
                self.vehicle.arming.disarm()
            return
        self.report("breached", new_breaches)
        if self.action == REPORT_ONLY:
            return
        # The firmware treats an unknown action as RTL (fence.cpp).
        modes = _FENCE_ACTIONS.get(self.action, _FENCE_ACTIONS[_FENCE_RTL])
        if self.beyond_m(new_breaches) > _LAND_BEYOND_M:
            modes = (CopterMode.LAND,)
        self.caused_mode: bool = self.vehicle.enter_first_accepted(*modes)

    def on_cleared(self) -> None:
        if not self.vehicle.is_landed:
            self.vehicle.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: ArduPilotMode) -> tuple[int, str] | None:
        is_flying = self.vehicle.is_armed and not self.vehicle.is_landed
        if not is_flying or not self.forbids_modes():
            return None
        return MavSeverity.WARNING, f"Mode change to {mode.name} failed: in fence recovery"
