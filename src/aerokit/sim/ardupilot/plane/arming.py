"""What ArduPlane checks before arming besides what every ArduPilot does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.sim.ardupilot.arming import Arming

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane

__all__ = ["PlaneArming"]

_SHORT_DISABLED = 3
_SMALLEST_ANGLE_DEG, _SLOWEST_M_S = 3.0, 5


class PlaneArming(Arming):
    """GPS in every mode, limits that make sense, and a mode that starts on the ground."""

    def __init__(self, plane: SimulatedPlane) -> None:
        super().__init__(plane)
        self._plane = plane

    def own_reasons(self) -> list[str]:
        """Failsafes, limits and mode."""
        mode = self._plane.mode
        return self._bad_limits() + ([] if mode.can_arm else [f"{mode.name} mode not armable"])

    def _bad_limits(self) -> list[str]:
        parameters = self._plane.parameters
        roll, up, down = (
            parameters[name] for name in ("ROLL_LIMIT_DEG", "PTCH_LIM_MAX_DEG", "PTCH_LIM_MIN_DEG")
        )
        slowest = int(parameters["AIRSPEED_MIN"])
        too_short = parameters["FS_LONG_TIMEOUT"] < parameters["FS_SHORT_TIMEOUT"]
        checks = (
            (
                too_short and parameters["FS_SHORT_ACTN"] != _SHORT_DISABLED,
                "FS_LONG_TIMEOUT < FS_SHORT_TIMEOUT",
            ),
            (roll < _SMALLEST_ANGLE_DEG, f"ROLL_LIMIT_DEG too small ({roll:.1f})"),
            (up < _SMALLEST_ANGLE_DEG, f"PTCH_LIM_MAX_DEG too small ({up:.1f})"),
            (down > -_SMALLEST_ANGLE_DEG, f"PTCH_LIM_MIN_DEG too large ({down:.1f})"),
            (slowest < _SLOWEST_M_S, f"AIRSPEED_MIN too low ({slowest} < {_SLOWEST_M_S})"),
        )
        return [text for failed, text in checks if failed]
