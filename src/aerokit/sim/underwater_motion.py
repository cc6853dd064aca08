"""How a simulated submarine moves: a point mass in still water below a level surface.

What it does: limits of speed, acceleration and turn rate; drag of the water, buoyancy that lifts it when nothing
holds it down, the surface above and the bottom below. What it does not: thrusters, currents, waves, leaning.
"""

from __future__ import annotations

import math
import random

from aerokit.sim.motion import Motion, MotionLimits

__all__ = ["UnderwaterMotion"]

_DRAG_PER_S = 1.0
_LIMITS = MotionLimits(
    acceleration_m_s2=1.0, vertical_acceleration_m_s2=1.0, turn_rate_rad_s=math.radians(60.0), lean_rad=0.0
)


class UnderwaterMotion(Motion):
    """``down`` is the depth; ``bottom_down`` is where the bottom is, ``ground_down`` is the water's surface.

    ``buoyancy_m_s2`` is what lifts it when no thruster holds it.
    """

    def __init__(self, rng: random.Random, *, bottom_down: float = 200.0, buoyancy_m_s2: float = 0.1) -> None:
        super().__init__(rng, limits=_LIMITS)
        self.bottom_down = bottom_down
        self.buoyancy_m_s2 = buoyancy_m_s2
        self._is_floating = False

    @property
    def is_on_ground(self) -> bool:
        """Never: there is water below."""
        return False

    @property
    def is_at_surface(self) -> bool:
        """Whether it touches the air."""
        return self.down <= self.ground_down

    @property
    def is_still(self) -> bool:
        """Whether it floats at the surface and does not move."""
        speed = math.hypot(self.velocity_north, self.velocity_east, self.velocity_down)
        return self.is_at_surface and speed < 0.01

    @property
    def airspeed_m_s(self) -> float:
        """Speed through the water is what the telemetry says here."""
        return math.hypot(self.velocity_north, self.velocity_east)

    def seek_velocity(self, north: float, east: float, down: float) -> None:
        """Move at this velocity."""
        super().seek_velocity(north, east, down)
        self._is_floating = False

    def push(self, north: float, east: float) -> None:
        """Move at this horizontal velocity and leave the depth to the buoyancy."""
        super().seek_velocity(north, east, 0.0)
        self._is_floating = True

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Move on by ``dt`` seconds; without power it drifts upwards."""
        lift = -self.buoyancy_m_s2 - _DRAG_PER_S * self.velocity_down
        if powered:
            north, east, down = self._commanded_acceleration()
            down = lift if self._is_floating else down
        else:
            north, east, down = -_DRAG_PER_S * self.velocity_north, -_DRAG_PER_S * self.velocity_east, lift
        self._integrate(north, east, down, dt)
        self._turn(dt, powered=powered)

    def _integrate(self, north: float, east: float, down: float, dt: float) -> None:
        super()._integrate(north, east, down, dt)
        if self.down < self.ground_down:
            self.down, self.velocity_down = self.ground_down, max(0.0, self.velocity_down)
        elif self.down > self.bottom_down:
            self.down: float = self.bottom_down
            self.velocity_down: float = min(0.0, self.velocity_down)
