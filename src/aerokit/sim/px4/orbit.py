"""DO_ORBIT: a simulated PX4 multicopter flies a circle and looks at its middle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Orbit"]

_RADII_M = (1.0, 100.0)
_BACK_TO_CIRCLE_PER_S = 0.5


class Orbit:
    """The circle: its middle, its height, how wide and how fast; a negative radius is anticlockwise."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self.middle: tuple[float, float] = (0.0, 0.0)
        self.down: float = 0.0
        self.radius_m: float = 20.0
        self.speed_m_s: float = 1.0

    def plan(self, radius_m: float, speed_m_s: float, place: tuple[float, float], down: float) -> bool:
        """Take a new circle; False, and the old one stays, when its radius is out of limits."""
        if not _RADII_M[0] <= abs(radius_m) <= _RADII_M[1]:
            return False
        self.radius_m = radius_m
        self.speed_m_s = speed_m_s
        self.middle = place
        self.down = down
        return True

    def update(self) -> None:
        """Tell the motion what to do until the next tick."""
        motion = self._px4.motion
        north, east = motion.north - self.middle[0], motion.east - self.middle[1]
        angle, distance = math.atan2(east, north), math.hypot(north, east)
        turning = math.copysign(1.0, self.radius_m)
        along = angle + turning * math.pi / 2
        outwards = max(
            -self.speed_m_s, min(self.speed_m_s, _BACK_TO_CIRCLE_PER_S * (abs(self.radius_m) - distance))
        )
        motion.seek_velocity(
            self.speed_m_s * math.cos(along) + outwards * math.cos(angle),
            self.speed_m_s * math.sin(along) + outwards * math.sin(angle),
            max(-1.0, min(1.0, self.down - motion.down)),
        )
        motion.face(angle + math.pi)

    def status(self) -> m.OrbitExecutionStatus:
        """ORBIT_EXECUTION_STATUS, sent while it goes on."""
        px4 = self._px4
        place = px4.frame.to_global(*self.middle, self.down)
        return m.OrbitExecutionStatus(
            px4.time_boot_us, self.radius_m, 0, place.latitude_e7, place.longitude_e7, place.altitude_m
        )
