"""How a simulated ArduPlane lands: to the start of its approach, down the slope, flare, roll-out, disarming."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane

__all__ = ["Landing"]

_FLARE_SINK_M_S = 0.5
_APPROACH_SHARE = 0.85
_NEAR_M = 60.0
_LINED_UP_RAD = math.radians(25.0)
_LOOK_AHEAD_M = 80.0


class Landing:
    """Comes down on ``point``; with ``start`` it flies there first, to come in from there."""

    def __init__(self, plane: SimulatedPlane, point: Ned, start: Ned | None = None) -> None:
        self._plane = plane
        self.point: Ned = point
        self._start = start
        wing = plane.wing
        self._from: Ned = (wing.north, wing.east, wing.down)
        self._flares = self._is_told = False
        self._stopped_at = math.nan

    def update(self, dt: float) -> None:
        """One step."""
        plane, wing = self._plane, self._plane.wing
        if plane.is_landed:
            self._wait()
        elif wing.is_on_ground:
            wing.roll_out()
        elif self._start is not None:
            self._join(self._start)
        else:
            self._approach()

    def _join(self, start: Ned) -> None:
        wing = self._plane.wing
        distance = math.hypot(start[0] - wing.north, start[1] - wing.east)
        if distance < _NEAR_M and abs(wing.down - start[2]) < _NEAR_M / 4:
            self._from, self._start = (wing.north, wing.east, wing.down), None
            return
        wing.fly_to(*start, airspeed=self._plane.cruise_m_s)

    def _approach(self) -> None:
        plane, wing, (north, east, down) = self._plane, self._plane.wing, self.point
        height = down - wing.down
        left = self._left()
        if height < max(
            plane.parameters["LAND_FLARE_ALT"], wing.velocity_down * plane.parameters["LAND_FLARE_SEC"]
        ):
            self._flare(height, left)
        length = max(1.0, math.hypot(north - self._from[0], east - self._from[1]))
        wanted = down + (self._from[2] - down) * max(0.0, left) / length
        climb = -_FLARE_SINK_M_S if self._flares else -self._slope_sink(length) + wing.climb_to(wanted)
        speed = plane.wing.wing.airspeed_min_m_s if self._flares else _APPROACH_SHARE * plane.cruise_m_s
        course = math.atan2(east - self._from[1], north - self._from[0])
        wing.head(course + self._correction(course), speed, climb)

    def _slope_sink(self, length: float) -> float:
        return (self.point[2] - self._from[2]) * self._plane.wing.ground_speed_m_s / length

    def _left(self) -> float:
        """Metres to go along the approach; negative beyond the point."""
        wing, (north, east, _) = self._plane.wing, self.point
        course = math.atan2(east - self._from[1], north - self._from[0])
        return (north - wing.north) * math.cos(course) + (east - wing.east) * math.sin(course)

    def _correction(self, course: float) -> float:
        wing, (north, east, _) = self._plane.wing, self.point
        aside = (east - wing.east) * math.cos(course) - (north - wing.north) * math.sin(course)
        return math.atan2(aside, _LOOK_AHEAD_M)

    def _flare(self, height: float, left: float) -> None:
        if self._flares:
            return
        self._flares, wing = True, self._plane.wing
        speed, sink = wing.ground_speed_m_s, wing.velocity_down
        self._plane.info(f"Flare {height:.1f}m sink={sink:.2f} speed={speed:.1f} dist={left:.1f}")

    def _wait(self) -> None:
        """LAND_DISARMDELAY after it stands."""
        plane = self._plane
        if math.isnan(self._stopped_at):
            self._stopped_at = plane.now
        delay = plane.parameters["LAND_DISARMDELAY"]
        if plane.is_armed and delay > 0 and plane.now - self._stopped_at >= delay:
            plane.arming.disarm()
            plane.info("Auto disarmed")
            self._tell_distance()

    def _tell_distance(self) -> None:
        """Once."""
        if not self._is_told:
            wing, self._is_told = self._plane.wing, True
            aside = math.hypot(self.point[0] - wing.north, self.point[1] - wing.east)
            self._plane.info(f"Distance from LAND point={aside:.2f}m")
