"""What the parts of a simulated ArduRover use of it beside what every ArduPilot has."""

from __future__ import annotations

import math

from aerokit.sim.ardupilot.level import LevelVehicle
from aerokit.sim.ardupilot.smart_path import SmartPath
from aerokit.sim.ground_motion import GroundMotion
from aerokit.sim.motion import wrap_pi

_ARRIVED_M, _STANDING_M_S = 0.3, 0.1


class RoverHost(LevelVehicle):
    """A rover, as its modes and failsafes see it."""

    motion: GroundMotion  # pyright: ignore[reportIncompatibleVariableOverride]

    def reset_controllers(self) -> None:
        """The throttle stick rests in the middle, and the way back of SMART_RTL is forgotten."""
        super().reset_controllers()
        self.path: SmartPath = SmartPath(self, only_armed=False)

    def _become_ready(self) -> None:
        super()._become_ready()
        self.path.start()

    @property
    def top_speed(self) -> float:
        """In m/s: SPEED_MAX, or what CRUISE_SPEED at CRUISE_THROTTLE leads to."""
        parameters = self.parameters
        return parameters["SPEED_MAX"] or 100.0 * parameters["CRUISE_SPEED"] / parameters["CRUISE_THROTTLE"]

    def has_arrived(self, place: tuple[float, float, float]) -> bool:
        """At a place where it is to stop, or past it."""
        motion = self.motion
        north, east = place[0] - motion.north, place[1] - motion.east
        away = math.hypot(north, east)
        behind = abs(wrap_pi(math.atan2(east, north) - motion.yaw)) > math.pi / 2
        near = self.parameters["WP_RADIUS"] / 2.0
        return away <= _ARRIVED_M or (behind and away <= near and motion.ground_speed_m_s > _STANDING_M_S)
