"""What ArduCopter checks before arming."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from aerokit.sim.ardupilot.arming import Arming

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter.vehicle import SimulatedCopter

__all__ = ["CopterArming"]

_STICK_CENTRE, _STICK_LOW, _DEADZONE = 1500, 1050, 100


class CopterArming(Arming):
    """A position is needed only in the modes that fly by it, and a throttle that is low or in the middle."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, copter: SimulatedCopter) -> None:
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
        """Ground station, and a battery that was low before."""
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
        """The way back begins here."""
        done = super().arm(force=force)
        if done:
            self._copter.path.begin()
        return done

    def final_reasons(self) -> list[str]:
        """Mode and throttle."""
        mode = self._copter.mode
        if not mode.can_arm:
            return [f"{mode.name} mode not armable"]
        high = _STICK_LOW if mode.has_manual_throttle else _STICK_CENTRE + _DEADZONE
        if not mode.arms_with_raised_throttle and self._copter.rc[2] > high:
            return ["Throttle too high"]
        return []
