"""What ArduCopter checks before arming besides what every ArduPilot does: radio, ground station, battery, fence."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.sim.ardupilot.arming import Arming

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter import SimulatedCopter

__all__ = ["CopterArming"]

_BATTERY_LEVELS = (("LOW", "low"), ("CRT", "critical"))


class CopterArming(Arming):
    """The fence may be switched on and off with the motors (FENCE_AUTOENABLE)."""

    def __init__(self, copter: SimulatedCopter) -> None:
        super().__init__(copter)
        self._copter = copter

    def reasons(self) -> list[str]:
        """Why it cannot be armed now, as the firmware words it; empty when it can."""
        copter = self._copter
        reasons = super().reasons()
        if not copter.is_initialised:
            return reasons
        if copter.failsafes.radio:
            reasons.append("Radio failsafe on")
        if copter.failsafes.ground_station:
            reasons.append("GCS failsafe on")
        of_battery = None if any(r.startswith("Battery 1") for r in reasons) else self._battery_reason()
        reasons += [r for r in (of_battery, copter.fence.reason_not_to_arm()) if r is not None]
        return reasons

    def _battery_reason(self) -> str | None:
        for name, word in _BATTERY_LEVELS:
            for is_below, what in zip(
                self._copter.copter_failsafes.battery_is_below(name), ("voltage", "capacity"), strict=True
            ):
                if is_below:
                    return f"Battery 1 {word} {what} failsafe"
        return None

    def arm(self, *, force: bool = False) -> bool:
        """Arm if the checks allow it; says why not."""
        done = super().arm(force=force)
        if done:
            self._copter.fence.armed()
        return done

    def disarm(self, *, force: bool = True) -> bool:
        """Stop the motors; without ``force`` not in the air."""
        was_armed = self._copter.is_armed
        done = super().disarm(force=force)
        if done and was_armed:
            self._copter.fence.disarmed()
        return done
