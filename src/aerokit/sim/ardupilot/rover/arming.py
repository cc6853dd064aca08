"""What ArduRover checks before arming besides what every ArduPilot does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit.sim.ardupilot.arming import Arming, Check

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.rover.vehicle import SimulatedRover

__all__ = ["RoverArming"]

_NEEDS_LOCATION = 1


class RoverArming(Arming):
    """A position only in the modes that drive by it, or always with ARMING_NEED_LOC."""

    def __init__(self, rover: SimulatedRover) -> None:
        super().__init__(rover)
        self._rover = rover

    def ahrs_reasons(self) -> Sequence[str]:
        """Comes after GPS, and only where a position is needed."""
        return ()

    def position_reasons(self) -> Sequence[str]:
        """GPS, then estimator and its position."""
        rover = self._rover
        if not rover.mode.needs_position and rover.parameters["ARMING_NEED_LOC"] != _NEEDS_LOCATION:
            return ()
        if reasons := super().position_reasons() or super().ahrs_reasons():
            return reasons
        if rover.failsafes.estimator:
            return ("EKF failsafe",)
        return () if rover.navigation.has_position else ("Need Position Estimate",)

    def own_reasons(self) -> list[str]:
        """Speed and mode."""
        reasons = []
        if self.is_checked(Check.PARAMETERS) and not self._rover.parameters["WP_SPEED"] > 0:
            reasons.append("WP_SPEED too low")
        return reasons + ([] if self._rover.mode.can_arm else ["Mode not armable"])

    def arm(self, *, force: bool = False) -> bool:
        """The way back begins here."""
        done = super().arm(force=force)
        if done:
            self._rover.path.begin()
        return done

    def disarm(self, *, force: bool = True) -> bool:
        """At any time; where it is disarmed is home, unless somebody has set it."""
        rover, was_armed = self._rover, self._rover.is_armed
        if not super().disarm(force=True):
            return False
        if was_armed and rover.navigation.home is not None and not rover.navigation.home_is_locked:
            rover.navigation.set_home((rover.motion.north, rover.motion.east, rover.motion.down), lock=False)
        return True
