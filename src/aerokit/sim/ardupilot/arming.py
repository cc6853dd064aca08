"""Arming: the checks, their texts, and what happens when it works."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import GpsFixType, MavSeverity

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["Arming"]

_CHECK_PERIOD_S = 1.0
_REPORT_PERIOD_S = 30.0
_STICK_CENTRE, _STICK_LOW, _DEADZONE = 1500, 1050, 100


class Arming:
    """Runs the checks once a second, reports failures every 30 s while disarmed, arms and disarms."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.passes = False
        """What SYS_STATUS says of the pre-arm checks."""
        self._reported_at = -math.inf

    def start(self) -> None:
        """Begin the periodic checks."""
        self._reported_at = self._vehicle.now
        self._vehicle.every(_CHECK_PERIOD_S, self._check)

    # --------------------------------------------------------------------------------------- checks

    def reasons(self) -> list[str]:
        """Why it cannot be armed now, as the firmware words it; empty when it can."""
        vehicle, nav = self._vehicle, self._vehicle.navigation
        if not vehicle.is_initialised:
            return ["System not initialised"]
        reasons = list(vehicle.faults.prearm_failures)
        if vehicle.calibrations.of_compasses:
            reasons.append("Compass calibration running")
        if vehicle.battery.voltage_v < vehicle.parameters["BATT_ARM_VOLT"]:
            reasons.append("Battery 1 below minimum arming voltage")
        if vehicle.failsafes.battery_is_low:
            reasons.append("Battery failsafe")
        if vehicle.mode.needs_mission and not vehicle.mission.is_present:
            reasons.append("Mode requires mission")
        if vehicle.mode.needs_position and (reason := self._gps_reason()):
            return [*reasons, reason]
        if nav.flags is None or not nav.has_attitude:
            return [
                *reasons,
                "AHRS: EKF3 still initialising" if nav.flags is not None else "AHRS: EKF3 not started",
            ]
        if not nav.is_healthy:
            return [*reasons, "AHRS: Not healthy"]
        return reasons + self._mandatory_reasons()

    def _gps_reason(self) -> str | None:
        nav = self._vehicle.navigation
        if nav.fix_type < GpsFixType.TYPE_3D_FIX:
            return "GPS 1: Bad fix" if nav.is_gps_detected else "GPS 1: not healthy"
        return "AHRS: waiting for home" if nav.home is None else None

    def _mandatory_reasons(self) -> list[str]:
        """What even a forced arming insists on."""
        vehicle, nav = self._vehicle, self._vehicle.navigation
        reasons = []
        if vehicle.mode.needs_position and not (nav.has_position and not vehicle.failsafes.estimator):
            reasons.append("Need Position Estimate")
        if not vehicle.mode.has_manual_throttle and not nav.has_altitude:
            reasons.append("Need Alt Estimate")
        return reasons

    def _final_reasons(self) -> list[str]:
        vehicle, mode = self._vehicle, self._vehicle.mode
        if not mode.can_arm:
            return [f"{mode.name} mode not armable"]
        high = _STICK_LOW if mode.has_manual_throttle else _STICK_CENTRE + _DEADZONE
        if not mode.arms_with_raised_throttle and vehicle.rc[2] > high:
            return ["Throttle too high"]
        return []

    def _check(self) -> None:
        if self._vehicle.motors.is_armed:
            self.passes = True
            return
        reasons = self.reasons()
        self.passes = not reasons
        if self._vehicle.now - self._reported_at >= _REPORT_PERIOD_S:
            self._reported_at = self._vehicle.now
            self._say("PreArm", reasons)

    def report(self) -> None:
        """Run the checks now and say what fails, as MAV_CMD_RUN_PREARM_CHECKS wants."""
        reasons = self.reasons()
        self.passes = not reasons
        self._say("PreArm", reasons)

    def _say(self, prefix: str, reasons: list[str]) -> None:
        for reason in reasons:
            self._vehicle.send_text(MavSeverity.CRITICAL, f"{prefix}: {reason}")

    # ------------------------------------------------------------------------------- arm and disarm

    def arm(self, *, force: bool = False) -> bool:
        """Arm if the checks allow it; says why not."""
        vehicle = self._vehicle
        reasons = self._mandatory_reasons() if force else self.reasons()
        if not reasons and not force:
            reasons = self._final_reasons()
        if not vehicle.is_initialised:
            reasons = ["System not initialised"]
        if reasons:
            self._say("Arm", reasons)
            return False
        if vehicle.navigation.home is not None and not vehicle.navigation.home_is_locked:
            motion = vehicle.motion
            vehicle.navigation.set_home((motion.north, motion.east, motion.down), lock=False)
        vehicle.info(self.ARMED_TEXT)
        vehicle.motors.set_armed(True, vehicle.now)
        vehicle.mode.enter(force=False)
        vehicle.set_ticking(True)
        return True

    def disarm(self, *, force: bool = True) -> bool:
        """Stop the motors; without ``force`` not in the air."""
        vehicle = self._vehicle
        if not vehicle.motors.is_armed:
            return True
        if not force and not vehicle.is_landed:
            return False
        vehicle.info(self.DISARMED_TEXT)
        vehicle.motors.set_armed(False, vehicle.now)
        vehicle.mission.reset()
        vehicle.call_later(0.0, vehicle.auto.disarmed)
        return True
