"""Arming: the checks, their texts, and what happens when it works."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import GpsFixType, MavSeverity

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter import SimulatedCopter

__all__ = ["Arming"]

_CHECK_PERIOD_S = 1.0
_REPORT_PERIOD_S = 30.0
_STICK_CENTRE, _STICK_LOW, _DEADZONE = 1500, 1050, 100


class Arming:
    """Runs the checks once a second, reports failures every 30 s while disarmed, arms and disarms."""

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter
        self.passes = False
        """What SYS_STATUS says of the pre-arm checks."""
        self._reported_at = -math.inf

    def start(self) -> None:
        """Begin the periodic checks."""
        self._reported_at = self._copter.now
        self._copter.every(_CHECK_PERIOD_S, self._check)

    # --------------------------------------------------------------------------------------- checks

    def reasons(self) -> list[str]:
        """Why it cannot be armed now, as the firmware words it; empty when it can."""
        copter, nav = self._copter, self._copter.navigation
        if not copter.is_initialised:
            return ["System not initialised"]
        reasons = list(copter.faults.prearm_failures)
        if copter.calibrations.of_compasses:
            reasons.append("Compass calibration running")
        if copter.battery.voltage_v < copter.parameters["BATT_ARM_VOLT"]:
            reasons.append("Battery 1 below minimum arming voltage")
        if copter.failsafes.battery_is_low:
            reasons.append("Battery failsafe")
        if copter.mode.needs_mission and not copter.mission.is_present:
            reasons.append("Mode requires mission")
        if copter.mode.needs_position and (reason := self._gps_reason()):
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
        nav = self._copter.navigation
        if nav.fix_type < GpsFixType.TYPE_3D_FIX:
            return "GPS 1: Bad fix" if nav.is_gps_detected else "GPS 1: not healthy"
        return "AHRS: waiting for home" if nav.home is None else None

    def _mandatory_reasons(self) -> list[str]:
        """What even a forced arming insists on."""
        copter, nav = self._copter, self._copter.navigation
        reasons = []
        if copter.mode.needs_position and not (nav.has_position and not copter.failsafes.estimator):
            reasons.append("Need Position Estimate")
        if not copter.mode.has_manual_throttle and not nav.has_altitude:
            reasons.append("Need Alt Estimate")
        return reasons

    def _final_reasons(self) -> list[str]:
        copter, mode = self._copter, self._copter.mode
        if not mode.can_arm:
            return [f"{mode.name} mode not armable"]
        high = _STICK_LOW if mode.has_manual_throttle else _STICK_CENTRE + _DEADZONE
        if not mode.arms_with_raised_throttle and copter.rc[2] > high:
            return ["Throttle too high"]
        return []

    def _check(self) -> None:
        if self._copter.motors.is_armed:
            self.passes = True
            return
        reasons = self.reasons()
        self.passes = not reasons
        if self._copter.now - self._reported_at >= _REPORT_PERIOD_S:
            self._reported_at = self._copter.now
            self._say("PreArm", reasons)

    def report(self) -> None:
        """Run the checks now and say what fails, as MAV_CMD_RUN_PREARM_CHECKS wants."""
        reasons = self.reasons()
        self.passes = not reasons
        self._say("PreArm", reasons)

    def _say(self, prefix: str, reasons: list[str]) -> None:
        for reason in reasons:
            self._copter.send_text(MavSeverity.CRITICAL, f"{prefix}: {reason}")

    # ------------------------------------------------------------------------------- arm and disarm

    def arm(self, *, force: bool = False) -> bool:
        """Arm if the checks allow it; says why not."""
        copter = self._copter
        reasons = self._mandatory_reasons() if force else self.reasons()
        if not reasons and not force:
            reasons = self._final_reasons()
        if not copter.is_initialised:
            reasons = ["System not initialised"]
        if reasons:
            self._say("Arm", reasons)
            return False
        if copter.navigation.home is not None and not copter.navigation.home_is_locked:
            motion = copter.motion
            copter.navigation.set_home((motion.north, motion.east, motion.down), lock=False)
        copter.info("Arming motors")
        copter.motors.set_armed(True, copter.now)
        copter.mode.enter(force=False)
        copter.set_ticking(True)
        return True

    def disarm(self, *, force: bool = True) -> bool:
        """Stop the motors; without ``force`` not in the air."""
        copter = self._copter
        if not copter.motors.is_armed:
            return True
        if not force and not copter.is_landed:
            return False
        copter.info("Disarming motors")
        copter.motors.set_armed(False, copter.now)
        copter.mission.reset()
        copter.call_later(0.0, copter.auto.disarmed)
        return True
