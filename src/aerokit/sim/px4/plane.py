"""`SimulatedPx4Plane`: a PX4 fixed wing."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavType
from aerokit.sim.fixed_wing import FixedWing, WingLimits
from aerokit.sim.motion import Wind
from aerokit.sim.px4.modes import HOLD
from aerokit.sim.px4.plane_flight import PlaneFlight
from aerokit.sim.px4.plane_mission import PlaneMission
from aerokit.sim.px4.vehicle import SimulatedPx4

if TYPE_CHECKING:
    from aerokit.sim.motion import Motion
    from aerokit.sim.px4.flight import Flight
    from aerokit.sim.px4.mission import Mission

__all__ = ["SimulatedPx4Plane"]

_AMPERES_AT_FULL = 20.0


class SimulatedPx4Plane(SimulatedPx4):
    """As `SimulatedPx4`, but an aeroplane (MAV_TYPE 1, airframe 10041) that flies as `FixedWing` does.

    It takes off from a runway along its nose, circles at NAV_LOITER_RAD where a multicopter hovers, returns to a
    circle above home without landing (RTL_LAND_DELAY is -1), lands in circles (LAND) or at the end of a mission on a
    straight glide path, and demands a landing in a mission that is flown from the ground (MIS_TKO_LAND_REQ).
    Armed on the ground it stays armed. It has 978 parameters and an airspeed sensor.
    By hand it banks, climbs and changes its speed in every mode.
    Not simulated beyond what `SimulatedPx4` leaves out: launching by hand, stalls, aborted landings, figures of eight;
    OFFBOARD circles around a position.
    """

    VEHICLE_TYPE: ClassVar[int] = MavType.FIXED_WING
    PARAMETER_TABLE: ClassVar[str] = "airplane"

    flight: PlaneFlight  # pyright: ignore[reportIncompatibleVariableOverride]
    motion: FixedWing  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def airspeed_m_s(self) -> float:
        """What its sensor says."""
        return self.motion.airspeed_m_s

    def _make_motion(self, wind: Wind | None) -> Motion:
        values = self.parameters
        wing = WingLimits(
            airspeed_min_m_s=values["FW_AIRSPD_MIN"],
            airspeed_max_m_s=values["FW_AIRSPD_MAX"],
            climb_m_s=values["FW_T_CLMB_MAX"],
            sink_m_s=values["FW_T_SINK_MAX"],
        )
        return FixedWing(self.rng, wing, wind)

    def _make_flight(self) -> Flight:
        return PlaneFlight(self, self.motion)

    def _make_mission(self) -> Mission:
        return PlaneMission(self)

    def switch_to_hold(self) -> None:
        """The take-off is complete."""
        self.switch_to(HOLD)

    def _moves(self) -> bool:
        return super()._moves() or self.flight.is_rolling

    def _is_down(self) -> bool:
        return self.motion.is_at_rest

    def _run_motors(self, dt: float) -> None:
        self.throttle: float = self.motion.throttle if self.is_armed else 0.0
        self.battery.drain(self.throttle * _AMPERES_AT_FULL, dt)
