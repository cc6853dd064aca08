"""Arming checks and failsafes that all simulated ArduPilots share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntFlag
from typing import Any, ClassVar, Generic

from aerokit.mavlink.enums import GpsFixType, MavSeverity
from aerokit.sim.ardupilot.calibration import CompassCalibration
from aerokit.sim.ardupilot.host import RC_THROTTLE, ArduPilotHost, ConditionTimer, HostT

_OK, _LOW, _CRITICAL = 0, 1, 2
_NAMES_IN_PARAMETERS = {_LOW: "LOW", _CRITICAL: "CRT"}
_NAMES_IN_TEXTS = {_LOW: "low", _CRITICAL: "critical"}
_PERIOD_S = 0.1


class BatteryFailsafe:
    """Checks voltage and remaining charge while the vehicle is armed.

    ``priorities`` lists the actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, from the most to the least severe. An
    action is not executed if a more severe action was executed before.
    """

    def __init__(self, vehicle: ArduPilotHost, priorities: Sequence[int], act: Callable[[int], None]) -> None:
        self._vehicle = vehicle
        self._priorities = tuple(priorities)
        self._act = act
        self._voltage_low = {_LOW: ConditionTimer(), _CRITICAL: ConditionTimer()}
        self.level: int = _OK  # 0 is OK, 1 low, 2 critical. The level never decreases.
        self.priority: int = len(self._priorities)
        """Index in ``priorities`` of the most severe action executed so far."""

    def update(self) -> None:
        if not self._vehicle.motors.is_armed:
            return
        level = max(self._level_if_below(_LOW), self._level_if_below(_CRITICAL))
        if level <= self.level:
            return
        self.level = level
        battery = self._vehicle.battery
        used = f"{battery.voltage_v:.2f}V used {battery.consumed_mah:.0f} mAh"
        self._vehicle.send_text(MavSeverity.WARNING, f"Battery 1 is {_NAMES_IN_TEXTS[level]} {used}")
        action = int(self._vehicle.parameters[f"BATT_FS_{_NAMES_IN_PARAMETERS[level]}_ACT"])
        priority = self._priorities.index(action) if action in self._priorities else len(self._priorities)
        is_at_least_as_severe = priority <= self.priority  # The most severe action has the index 0.
        if is_at_least_as_severe:
            self.priority = priority
            self._act(action)

    def reason_not_to_arm(self) -> str | None:
        battery, parameters = self._vehicle.battery, self._vehicle.parameters
        if battery.voltage_v < parameters["BATT_ARM_VOLT"]:
            return "Battery 1 below minimum arming voltage"
        if self._remaining_mah() < parameters["BATT_ARM_MAH"]:
            return "Battery 1 below minimum arming capacity"
        for level, word in _NAMES_IN_TEXTS.items():
            is_voltage_low, is_charge_low = self._low_quantities(level)
            if is_voltage_low:
                return f"Battery 1 {word} voltage failsafe"
            if is_charge_low:
                return f"Battery 1 {word} capacity failsafe"
        for name, quantity in (("MAH", "capacity"), ("VOLT", "voltage")):
            if 0.0 < parameters[f"BATT_LOW_{name}"] <= parameters[f"BATT_CRT_{name}"]:
                return f"Battery 1 {quantity} failsafe critical >= low"
        return None

    def _level_if_below(self, level: int) -> int:
        """Return ``level`` if the charge or the voltage is low, otherwise 0."""
        is_voltage_low, is_charge_low = self._low_quantities(level)
        voltage_low_for = self._voltage_low[level].seconds(is_voltage_low, self._vehicle.now)
        timeout = self._vehicle.parameters["BATT_LOW_TIMER"]  # 0 ignores a low voltage.
        is_voltage_low_for_long = 0 < timeout < voltage_low_for
        return level if is_charge_low or is_voltage_low_for_long else _OK

    def _low_quantities(self, level: int) -> tuple[bool, bool]:
        """Return (voltage is low, charge is low)."""
        prefix, parameters = f"BATT_{_NAMES_IN_PARAMETERS[level]}", self._vehicle.parameters
        # The value 0 of these parameters means that there is no limit.
        min_volts, min_mah = parameters[f"{prefix}_VOLT"], parameters[f"{prefix}_MAH"]
        is_voltage_low = min_volts > 0 and self._vehicle.battery.voltage_v < min_volts
        is_charge_low = min_mah > 0 and self._remaining_mah() < min_mah
        return is_voltage_low, is_charge_low

    def _remaining_mah(self) -> float:
        return self._vehicle.parameters["BATT_CAPACITY"] - self._vehicle.battery.consumed_mah


class ArduPilotFailsafes(Generic[HostT]):
    """Base of the failsafes. They are checked ten times a second. When one triggers, it acts once and sends a text.

    A subclass overrides `update` with the checks of its firmware and `act_on_battery` with the battery actions.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = ()
    """Actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, from the most to the least severe."""

    def __init__(self, vehicle: HostT) -> None:
        self.vehicle = vehicle
        self.battery: BatteryFailsafe = BatteryFailsafe(vehicle, self.BATTERY_PRIORITIES, self.act_on_battery)
        self.is_ground_station_lost = False
        self.has_estimator_failed = False
        self.is_radio_lost = False  # A lost radio also prevents arming.
        self.radio_received_at: float = math.nan  # Time of the last RC pulses or overrides.

    def start(self) -> None:
        self.vehicle.every(_PERIOD_S, self.update)

    @property
    def battery_is_low(self) -> bool:
        return self.battery.level >= _LOW

    @property
    def battery_is_critical(self) -> bool:
        return self.battery.level >= _CRITICAL

    @property
    def is_any_active(self) -> bool:
        return self.battery_is_low or self.is_ground_station_lost or self.has_estimator_failed or self.is_radio_lost

    @property
    def is_radio_healthy(self) -> bool:
        return not self.is_radio_lost

    @property
    def ground_station_silence(self) -> float:
        """Seconds since the ground station was last received. NaN before the first time."""
        return self.vehicle.now - self.vehicle.ground_station_seen_at

    def update(self) -> None:
        self.battery.update()
        self.vehicle.fence.update()

    def act_on_battery(self, action: int) -> None:
        raise NotImplementedError

    def warn(self, text: str, severity: int = MavSeverity.WARNING) -> None:
        self.vehicle.send_text(severity, text)


_CHECK_INTERVAL_S = 1.0
_REPORT_INTERVAL_S, _MIN_REPORT_INTERVAL_S = 30.0, 4.0
_CENTERED_STICKS = (("Roll", 1), ("Pitch", 2), ("Yaw", 4))
_CHECK_THROTTLE, _SKIP_STICKS = 1 << 5, 1 << 6
_NOT_REQUIRED = 0


class ArmingCheck(IntFlag):
    """Bits of ARMING_CHECK."""

    ALL = 1
    GPS = 8
    INS = 16
    PARAMETERS = 32
    RC = 64
    BATTERY = 256
    MISSION = 16384


class ArduPilotArming(Generic[HostT]):
    """Arms and disarms. While disarmed, runs the arming checks once a second and reports the failures every 30 s.

    `common_reasons` has the checks that all firmwares share. A new failure of these checks is reported within 5 s. A
    subclass adds its own checks in `own_reasons` and `final_reasons`.
    """

    ARMED_TEXT: ClassVar[str] = "Throttle armed"
    DISARMED_TEXT: ClassVar[str] = "Throttle disarmed"

    def __init__(self, vehicle: HostT, failsafes: ArduPilotFailsafes[Any], compasses: CompassCalibration) -> None:
        self.vehicle = vehicle
        self._failsafes, self._compasses = failsafes, compasses
        self.passes: bool = False  # True if the last pre-arm checks have passed, as SYS_STATUS reports.
        self._reported_at = -math.inf
        self._passed_common = False  # result of the common checks one second ago
        self._has_new_failure = False  # True until the failure is reported
        self._arming_was_not_required = False  # value at the last update

    def start(self) -> None:
        self._reported_at = self.vehicle.now
        self.vehicle.every(_CHECK_INTERVAL_S, self._check)

    def is_checked(self, check: ArmingCheck) -> bool:
        return bool(int(self.vehicle.parameters["ARMING_CHECK"]) & (ArmingCheck.ALL | check))

    @property
    def checks_nothing(self) -> bool:
        return int(self.vehicle.parameters["ARMING_CHECK"]) == 0

    def reasons(self) -> list[str]:
        """Return the firmware's texts of the failing checks."""
        if not self.vehicle.is_initialised:
            return ["System not initialised"]
        if self.checks_nothing:
            return self.mandatory_reasons()
        return [*self.common_reasons(), *self.own_reasons()]

    def common_reasons(self) -> list[str]:
        vehicle, check = self.vehicle, ArmingCheck
        reasons = list(vehicle.faults.prearm_failures)
        if self._compasses.is_running:
            reasons.append("Compass calibration running")
        if self.is_checked(check.INS):
            reasons += self.ahrs_reasons()
        reasons += self.position_reasons()
        if self.is_checked(check.BATTERY):
            reasons += _listed(self._failsafes.battery.reason_not_to_arm())
        if self.is_checked(check.RC) and self._failsafes.is_radio_lost:
            reasons.append("Radio failsafe on")
        if self.is_checked(check.MISSION) and vehicle.mode.needs_mission and not vehicle.mission.is_present:
            reasons.append("Mode requires mission")
        return reasons + _listed(vehicle.fence.reason_not_to_arm())

    def own_reasons(self) -> list[str]:
        return []

    def mandatory_reasons(self) -> list[str]:
        """Return the failures of the checks that a forced arming does not skip."""
        return []

    def final_reasons(self) -> list[str]:
        """Return the failures of the checks that run only on a request to arm."""
        options = int(self.vehicle.parameters["RC_OPTIONS"])
        if not self.is_checked(ArmingCheck.RC) or not self.vehicle.rc.is_receiving:
            return []
        sticks = () if options & _SKIP_STICKS else _CENTERED_STICKS
        if options & _CHECK_THROTTLE:
            sticks = (*sticks, ("Throttle", RC_THROTTLE + 1))  # The numbers of RC channels count from 1.
        return [f"{name} (RC{number}) is not neutral" for name, number in sticks if self._is_moved(number)]

    def _is_moved(self, number: int) -> bool:
        parameters = self.vehicle.parameters
        middle, dead_zone = parameters[f"RC{number}_TRIM"], parameters[f"RC{number}_DZ"]
        return abs(self.vehicle.rc[number - 1] - middle) > dead_zone

    def ahrs_reasons(self) -> Sequence[str]:
        nav = self.vehicle.navigation
        if nav.flags is None:
            return ("AHRS: EKF3 not started",)
        if not nav.has_attitude:
            return ("AHRS: EKF3 still initialising",)
        return () if nav.is_healthy else ("AHRS: Not healthy",)

    def gps_reasons(self) -> Sequence[str]:
        nav = self.vehicle.navigation
        flies_without_gps = nav.uses_external_navigation and not nav.is_gps_detected
        if nav.fix_type < GpsFixType.TYPE_3D_FIX and not flies_without_gps:
            return ("GPS 1: Bad fix" if nav.is_gps_detected else "GPS 1: not healthy",)
        return () if nav.home is not None else ("AHRS: waiting for home",)

    def position_reasons(self) -> Sequence[str]:
        return self.gps_reasons() if self.is_checked(ArmingCheck.GPS) else ()

    def _check(self) -> None:
        self._apply_requirement()
        vehicle = self.vehicle
        if vehicle.motors.is_armed:  # The checks run only while disarmed.
            self.passes = True
            return
        reasons = self.reasons()
        passes_common = not self.common_reasons()
        # After a new failure, the next report is due after `_MIN_REPORT_INTERVAL_S` instead of `_REPORT_INTERVAL_S`.
        self._has_new_failure |= self._passed_common and not passes_common
        self._passed_common = passes_common
        self.passes = not reasons
        waited = vehicle.now - self._reported_at
        if waited >= _REPORT_INTERVAL_S or (self._has_new_failure and waited > _MIN_REPORT_INTERVAL_S):
            self._reported_at = vehicle.now
            self._has_new_failure = False
            self._send_reasons("PreArm", reasons)

    def report(self) -> None:
        reasons = self.reasons()
        self.passes = not reasons
        self._send_reasons("PreArm", reasons)

    def _send_reasons(self, prefix: str, reasons: Sequence[str]) -> None:
        for reason in reasons:
            self.vehicle.send_text(MavSeverity.CRITICAL, f"{prefix}: {reason}"[:50])

    @property
    def needs_arming(self) -> bool:
        return self.vehicle.parameters.get("ARMING_REQUIRE", 1) != _NOT_REQUIRED

    def _apply_requirement(self) -> None:
        vehicle, is_always_armed = self.vehicle, not self.needs_arming
        if is_always_armed == self._arming_was_not_required:
            return
        self._arming_was_not_required = is_always_armed
        if is_always_armed != vehicle.motors.is_armed:
            vehicle.motors.set_armed(armed=is_always_armed)
            vehicle.set_ticking(True)

    def arm(self, *, force: bool = False) -> bool:
        """Arm and return True, or report the failing checks and return False."""
        vehicle = self.vehicle
        reasons = self._reasons_not_to_arm(force=force)
        if reasons:
            self._send_reasons("Arm", reasons)
            return False
        if self.checks_nothing and not force:
            vehicle.send_text(MavSeverity.WARNING, "Warning: Arming Checks Disabled")
        vehicle.fence.on_armed()
        # Arming moves home to the vehicle, unless a command has set home.
        if vehicle.navigation.home is not None and not vehicle.navigation.home_is_locked:
            vehicle.navigation.set_home(vehicle.motion.place, lock=False)
        vehicle.info(self.ARMED_TEXT)
        vehicle.motors.set_armed(armed=True)
        vehicle.mode.enter(force=False)  # starts the mode, which was entered while the vehicle was disarmed
        vehicle.set_ticking(True)
        self.on_armed()
        return True

    def on_armed(self) -> None: ...

    def on_disarmed(self) -> None: ...

    def _reasons_not_to_arm(self, *, force: bool) -> list[str]:
        if force and self.vehicle.is_initialised:
            return self.mandatory_reasons()
        return self.reasons() or self.final_reasons()

    def disarm(self, *, force: bool = True) -> bool:
        """Stop the motors, even in the air. With ``force=False``, a vehicle in the air stays armed."""
        vehicle = self.vehicle
        if not vehicle.motors.is_armed:
            return True
        if not self.needs_arming:  # ARMING_REQUIRE 0 keeps the vehicle armed for ever.
            return False
        may_be_flying = vehicle.KIND in ("copter", "plane") and not vehicle.is_landed
        if may_be_flying and not force:
            return False
        vehicle.fence.on_disarmed()
        vehicle.info(self.DISARMED_TEXT)
        vehicle.motors.set_armed(armed=False)
        vehicle.mission.on_disarmed()
        self.on_disarmed()
        return True


def _listed(reason: str | None) -> list[str]:
    return [] if reason is None else [reason]
