"""What the parts of a simulated ArduSub use of it beside what every ArduPilot has."""

from __future__ import annotations

import math
from itertools import cycle

from aerokit.sim.ardupilot.level import LevelVehicle
from aerokit.sim.ground_motion import UnderwaterMotion
from aerokit.sim.local_frame import Ned

_LOOK_AHEAD_M = 1.0


class SubHost(LevelVehicle):
    """A submarine, as its modes and failsafes see it."""

    display_names: cycle[str]
    """Which of `DISPLAY_VALUES` is told next."""
    motion: UnderwaterMotion  # pyright: ignore[reportIncompatibleVariableOverride]
    hull_pressure_pa: float = 101_325.0
    """What the sensors inside measure."""
    hull_temperature_c: float = 28.0

    @property
    def is_at_surface(self) -> bool:
        """Within SURFACE_DEPTH of the air."""
        return self.motion.down <= max(0.0, -self.parameters["SURFACE_DEPTH"] / 100.0)

    @property
    def climb_speed(self) -> float:
        """In m/s, of a full stick."""
        return self.parameters["PILOT_SPEED_UP"] / 100.0

    def distance(self, place: Ned) -> float:
        """Metres to a point."""
        return math.dist(self._below(place), self.motion.place)

    def travel(self, place: Ned, speed: float, *, looks_ahead: bool = True) -> None:
        """Towards a point with this speed in m/s, up and down as WPNAV_SPEED_UP and …_DN allow."""
        motion, parameters = self.motion, self.parameters
        north, east, down = self._below(place)
        up, dn = parameters["WPNAV_SPEED_UP"] / 100.0, parameters["WPNAV_SPEED_DN"] / 100.0
        ahead = math.hypot(north - motion.north, east - motion.east)
        if looks_ahead and ahead > _LOOK_AHEAD_M:
            motion.face(math.atan2(east - motion.east, north - motion.north))
        slope = abs(down - motion.down)
        slower = speed * min(1.0, ahead / max(slope, 1e-3))
        depth = speed * min(1.0, slope / max(ahead, 1e-3))
        motion.seek_position(
            north, east, down, speed=max(slower, 0.05), climb=min(up, depth), descent=min(dn, depth)
        )

    def _below(self, place: Ned) -> Ned:
        return (place[0], place[1], max(place[2], self.motion.ground_down))
