"""Arming: the checks, their texts, and what happens when it works."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntFlag
from typing import ClassVar

from aerokit.mavlink.enums import GpsFixType, MavSeverity
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

_CHECK_PERIOD_S = 1.0
_REPORT_PERIOD_S, _SOONEST_REPORT_S = 30.0, 4.0
_CENTRED_STICKS = (("Roll", 1), ("Pitch", 2), ("Yaw", 4))
_CHECK_THROTTLE, _SKIP_STICKS = 1 << 5, 1 << 6
_NOT_REQUIRED = 0


class Check(IntFlag):
    """Bits of ARMING_CHECK."""

    ALL = 1
    COMPASS = 4
    GPS = 8
    INS = 16
    PARAMETERS = 32
    RC = 64
    VOLTAGE = 128
    BATTERY = 256
    MISSION = 16384


Look = Callable[[], Sequence[str]]


class Arming:
    """Runs the checks once a second, reports failures every 30 s while disarmed, arms and disarms.

    What is common to all kinds is `common_reasons`: when it is the first time that one of these fails, it is reported
    at once. A kind says in `own_reasons` and `final_reasons` what it checks besides.
    """

    ARMED_TEXT: ClassVar[str] = "Throttle armed"
    DISARMED_TEXT: ClassVar[str] = "Throttle disarmed"

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.passes: bool = False
        """What SYS_STATUS says of the pre-arm checks."""
        self._reported_at = -math.inf
        self._passed_common = self._is_news = False
        self._needs_no_arming = False

    def start(self) -> None:
        self._reported_at = self._vehicle.now
        self._vehicle.every(_CHECK_PERIOD_S, self._check)

    def is_checked(self, check: Check) -> bool:
        """Whether ARMING_CHECK wants it."""
        return bool(int(self._vehicle.parameters["ARMING_CHECK"]) & (Check.ALL | check))

    @property
    def checks_nothing(self) -> bool:
        """Whether ARMING_CHECK is 0."""
        return int(self._vehicle.parameters["ARMING_CHECK"]) == 0

    def reasons(self) -> list[str]:
        """Why it cannot be armed now, as the firmware words it; empty when it can."""
        if not self._vehicle.is_initialised:
            return ["System not initialised"]
        if self.checks_nothing:
            return self.mandatory_reasons()
        return [*self.common_reasons(), *self.own_reasons()]

    def common_reasons(self) -> list[str]:
        """What every kind checks, in the order of the firmware."""
        found = list(self._vehicle.faults.prearm_failures)
        if self._vehicle.calibrations.compasses.is_running:
            found.append("Compass calibration running")
        for check, look in self._looks():
            if check is None or self.is_checked(check):
                found += look()
        return found

    def _looks(self) -> tuple[tuple[Check | None, Look], ...]:
        return (
            (Check.INS, self.ahrs_reasons),
            (None, self.position_reasons),
            (Check.BATTERY, self.battery_reasons),
            (Check.RC, self.radio_reasons),
            (Check.MISSION, self.mission_reasons),
            (None, self.fence_reasons),
        )

    def own_reasons(self) -> list[str]:
        return []

    def mandatory_reasons(self) -> list[str]:
        """What even a forced arming insists on."""
        return []

    def final_reasons(self) -> list[str]:
        """What is looked at only when somebody arms: the sticks."""
        options = int(self._vehicle.parameters["RC_OPTIONS"])
        if not self.is_checked(Check.RC) or not self._vehicle.rc.is_heard:
            return []
        sticks = () if options & _SKIP_STICKS else _CENTRED_STICKS
        if options & _CHECK_THROTTLE:
            sticks = (*sticks, ("Throttle", 3))
        return [f"{name} (RC{number}) is not neutral" for name, number in sticks if self._is_moved(number)]

    def _is_moved(self, number: int) -> bool:
        parameters = self._vehicle.parameters
        middle, dead_zone = parameters[f"RC{number}_TRIM"], parameters[f"RC{number}_DZ"]
        return abs(self._vehicle.rc[number - 1] - middle) > dead_zone

    def ahrs_reasons(self) -> Sequence[str]:
        """The estimator."""
        nav = self._vehicle.navigation
        if nav.flags is None:
            return ("AHRS: EKF3 not started",)
        if not nav.has_attitude:
            return ("AHRS: EKF3 still initialising",)
        return () if nav.is_healthy else ("AHRS: Not healthy",)

    def gps_reasons(self) -> Sequence[str]:
        """The receiver, and home."""
        nav = self._vehicle.navigation
        if nav.fix_type < GpsFixType.TYPE_3D_FIX:
            return ("GPS 1: Bad fix" if nav.is_gps_detected else "GPS 1: not healthy",)
        return () if nav.home is not None else ("AHRS: waiting for home",)

    def position_reasons(self) -> Sequence[str]:
        """What needs GPS: here it does in every mode."""
        return self.gps_reasons() if self.is_checked(Check.GPS) else ()

    def battery_reasons(self) -> Sequence[str]:
        reason = self._vehicle.failsafes.battery.reason_not_to_arm()
        return () if reason is None else (reason,)

    def radio_reasons(self) -> Sequence[str]:
        return ("Radio failsafe on",) if self._vehicle.failsafes.radio else ()

    def mission_reasons(self) -> Sequence[str]:
        """AUTO without a mission."""
        missing = self._vehicle.mode.needs_mission and not self._vehicle.mission.is_present
        return ("Mode requires mission",) if missing else ()

    def fence_reasons(self) -> Sequence[str]:
        reason = self._vehicle.fence.reason_not_to_arm()
        return () if reason is None else (reason,)

    def _check(self) -> None:
        self._follow_requirement()
        vehicle = self._vehicle
        if vehicle.motors.is_armed:
            self.passes = True
            return
        reasons = self.reasons()
        passes_common = not self.common_reasons()
        self._is_news |= self._passed_common and not passes_common
        self._passed_common, self.passes = passes_common, not reasons
        waited = vehicle.now - self._reported_at
        if waited >= _REPORT_PERIOD_S or (self._is_news and waited > _SOONEST_REPORT_S):
            self._reported_at, self._is_news = vehicle.now, False
            self._say("PreArm", reasons)

    def report(self) -> None:
        """Run the checks now and say what fails, as MAV_CMD_RUN_PREARM_CHECKS wants."""
        reasons = self.reasons()
        self.passes = not reasons
        self._say("PreArm", reasons)

    def _say(self, prefix: str, reasons: Sequence[str]) -> None:
        for reason in reasons:
            self._vehicle.send_text(MavSeverity.CRITICAL, f"{prefix}: {reason}"[:50])

    @property
    def needs_arming(self) -> bool:
        """Whether ARMING_REQUIRE wants it; where it is 0 the vehicle is armed for ever, without a word."""
        parameters = self._vehicle.parameters
        return "ARMING_REQUIRE" not in parameters or parameters["ARMING_REQUIRE"] != _NOT_REQUIRED

    def _follow_requirement(self) -> None:
        vehicle, needs_none = self._vehicle, not self.needs_arming
        if needs_none != self._needs_no_arming:
            self._needs_no_arming = needs_none
            if needs_none != vehicle.motors.is_armed:
                vehicle.motors.set_armed(needs_none, vehicle.now)
                vehicle.set_ticking(True)

    def arm(self, *, force: bool = False) -> bool:
        """Arm if the checks allow it; says why not."""
        vehicle = self._vehicle
        reasons = self.mandatory_reasons() if force else self.reasons()
        if not reasons and not force and not self.checks_nothing:
            reasons = self.final_reasons()
        if not vehicle.is_initialised:
            reasons = ["System not initialised"]
        if reasons:
            self._say("Arm", reasons)
            return False
        if self.checks_nothing and not force:
            vehicle.send_text(MavSeverity.WARNING, "Warning: Arming Checks Disabled")
        vehicle.fence.armed()
        if vehicle.navigation.home is not None and not vehicle.navigation.home_is_locked:
            motion = vehicle.motion
            vehicle.navigation.set_home(motion.place, lock=False)
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
        if not self.needs_arming or (not force and not vehicle.is_landed):
            return False
        vehicle.fence.disarmed()
        vehicle.info(self.DISARMED_TEXT)
        vehicle.motors.set_armed(False, vehicle.now)
        vehicle.mission.reset()
        vehicle.call_later(0.0, vehicle.auto.disarmed)
        return True
