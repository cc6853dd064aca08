"""When a simulated PX4 lets itself be armed and disarmed, and what it says about it."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavComponent, MavSeverity
from aerokit.mavlink.messages import CommandLong
from aerokit.sim.px4.modes import (
    ALTITUDE,
    KNOWN,
    LAND,
    POSITION,
    POSITION_SLOW,
    PRECISION_LAND,
    RTL,
    STICK_MODES,
    TAKEOFF,
)

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Arming"]

_LOW_THROTTLE, _CENTRE_THROTTLE = -0.8, 0.2
_CLIMB_MODES = frozenset({ALTITUDE, POSITION, POSITION_SLOW})
_LEFT_AFTER_DISARMING = frozenset({TAKEOFF, LAND, PRECISION_LAND, RTL})


class Arming:
    """Checks, texts, and the log that begins with every arming."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self.since: float = -math.inf
        """When it was armed the last time."""
        self.is_terminated: bool = False
        """Whether DO_FLIGHTTERMINATION has stopped the motors; only a restart ends that."""
        self._is_logging = False

    # ---------------------------------------------------------------------------------------- checks

    def reasons(self) -> list[str]:
        """Why it cannot be armed, as the texts that tell it."""
        px4 = self._px4
        reasons = list(px4.faults.prearm_failures)
        if not px4.is_ready:
            reasons.append("heading estimate invalid")
        elif not px4.has_position and KNOWN[px4.mode].needs_position:
            reasons.append("No valid position estimate")
        if self.is_terminated:
            reasons.append("Flight termination active")
        return [f"Preflight Fail: {reason}" for reason in reasons] + px4.failsafes.arming_reasons()

    def report_reasons(self) -> None:
        """Say what fails."""
        for reason in self.reasons():
            self._px4.send_text(MavSeverity.CRITICAL, reason)

    @property
    def is_possible(self) -> bool:
        """What HEARTBEAT (STANDBY) and SYS_STATUS (the pre-arm bit) tell: all checks passed, the mode's too."""
        return self._px4.is_ready and self._mode_allows and not self.reasons()

    @property
    def _mode_allows(self) -> bool:
        """RETURN, LAND, ORBIT cannot be armed in, nor a mode that lacks sticks, set-points or a mission."""
        mode = self._px4.mode
        return KNOWN[mode].can_arm and self._px4.can_run(mode)

    # ----------------------------------------------------------------------------------------- doing

    def arm(self, by: str = "external command") -> bool:
        """Arm if the checks allow it."""
        px4 = self._px4
        if px4.is_armed:
            return True
        if not px4.is_ready and not px4.faults.prearm_failures:
            return False  # without a text, as seen
        if px4.calibration.is_running:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: calibrating")
            return False
        if not self.is_possible:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: Resolve system health failures first")
            self.report_reasons()
            return False
        if not self._throttle_is_safe:
            px4.send_text(MavSeverity.CRITICAL, "Arming denied: throttle not in safe position")
            return False
        self.since = px4.now
        px4.info(f"Armed by {by}")
        px4.armed()
        self._start_log()
        return True

    @property
    def _throttle_is_safe(self) -> bool:
        px4 = self._px4
        if px4.mode not in STICK_MODES:
            return True
        throttle = px4.sticks.throttle
        return throttle <= _CENTRE_THROTTLE if px4.mode in _CLIMB_MODES else throttle < _LOW_THROTTLE

    def disarm(self, by: str, *, force: bool = False) -> bool:
        """Stop the motors; in the air only by force."""
        px4 = self._px4
        if not px4.is_armed:
            return True
        if not px4.is_landed and not force:
            px4.send_text(MavSeverity.CRITICAL, "Disarming denied: not landed")
            return False
        px4.info(f"Disarmed by {by}")
        self._is_logging = False
        px4.disarmed()
        if px4.mode in _LEFT_AFTER_DISARMING:
            px4.switch_to(px4.mode_after_landing)
        return True

    def terminate(self) -> None:
        """Stop the motors for good, wherever it is, and call for the parachute."""
        px4 = self._px4
        self.is_terminated = True
        px4.is_in_failsafe = True
        px4.send_text(MavSeverity.CRITICAL, "Failsafe activated")
        px4.send_text(MavSeverity.CRITICAL, "Preflight Fail: Flight termination active")
        px4.send(CommandLong(px4.system_id, MavComponent.PARACHUTE, MavCmd.DO_PARACHUTE, 0, 2.0, *(0.0,) * 6))

    # ------------------------------------------------------------------------------------------- log

    def start_first_log(self) -> None:
        """A log begins at boot already; the first flight is written into it."""
        self._start_log()

    def _start_log(self) -> None:
        if self._is_logging:
            return
        self._is_logging = True
        time = datetime.fromtimestamp(self._px4.unix_time, timezone.utc)
        self._px4.info(f"[logger] ./log/{time:%Y-%m-%d/%H_%M_%S}.ulg")
