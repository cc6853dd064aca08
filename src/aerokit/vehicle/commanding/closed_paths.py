"""Closed paths in a plane, set-points along them, and counters of rounds by reported positions. No I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.setpoints import TrajectorySetpoint

if TYPE_CHECKING:
    from collections.abc import Callable

ACCELERATION_M_S2 = 1.0
"""Acceleration along the path, at its start and at its end."""
MIN_SPEED_M_S = 0.1
"""Minimum speed while slowing down, so that the set-point arrives."""

MIN_TOLERANCE_M, TOLERANCE_SHARE = 5.0, 0.3
"""Tolerance to count a vehicle as on its circle: this fraction of the radius, and at least this many metres."""

Vector = tuple[float, float]
"""Metres north and east."""


class ClosedPath:
    """A closed curve around a centre. ``at(phase)`` returns a place and its first two derivatives; a round is 2π."""

    first_phase: float = 0.0

    def at(self, phase: float) -> tuple[Vector, Vector, Vector]:
        raise NotImplementedError


class Circle(ClosedPath):
    """A circle; the phase is the bearing from its centre in radians."""

    def __init__(self, radius_m: float, *, clockwise: bool, first_phase: float) -> None:
        self._radius_m, self._way = radius_m, 1 if clockwise else -1
        self.first_phase: float = first_phase

    def at(self, phase: float) -> tuple[Vector, Vector, Vector]:
        angle = self.first_phase + self._way * (phase - self.first_phase)
        north, east = self._radius_m * math.cos(angle), self._radius_m * math.sin(angle)
        return (north, east), (-self._way * east, self._way * north), (-north, -east)


class Eight(ClosedPath):
    """A lemniscate along an axis; it begins and ends at its centre."""

    def __init__(self, major_m: float, minor_m: float, axis_deg: float, *, clockwise: bool) -> None:
        self._major_m, self._minor_m, self._axis = major_m, minor_m if clockwise else -minor_m, math.radians(axis_deg)

    def at(self, phase: float) -> tuple[Vector, Vector, Vector]:
        a, b = self._major_m, self._minor_m
        return (
            self._turned(a * math.sin(phase), -b * math.sin(2 * phase)),
            self._turned(a * math.cos(phase), -2 * b * math.cos(2 * phase)),
            self._turned(-a * math.sin(phase), 4 * b * math.sin(2 * phase)),
        )

    def _turned(self, along: float, across: float) -> Vector:
        cos, sin = math.cos(self._axis), math.sin(self._axis)
        return along * cos - across * sin, along * sin + across * cos


class PathFlight:
    """Moves a set-point straight to the start of a path, stops it there, and moves it along the path to a stop.

    ``start`` is the vehicle's position relative to the centre of the path (north, east, down). ``centre`` is the
    position of the centre in the local frame.
    """

    def __init__(
        self,
        path: ClosedPath,
        rounds: float,
        speed_m_s: float,
        start: tuple[float, float, float],
        centre: tuple[float, float, float],
        heading: Callable[[Vector, Vector], float | None],
    ) -> None:
        self._path, self._speed_m_s, self._centre, self._heading = path, speed_m_s, centre, heading
        self._from = start
        self._phase, self._last_phase = path.first_phase, path.first_phase + 2 * math.pi * rounds
        self._flown_m = self._speed = 0.0
        self.is_on_path: bool = False
        """True once the set-point has reached the path."""

    @property
    def is_complete(self) -> bool:
        """True once the set-point has stopped at the end."""
        return self._phase >= self._last_phase

    def advance(self, seconds: float) -> TrajectorySetpoint:
        """Move the set-point on by this time, and return it."""
        return self._advance_on_path(seconds) if self.is_on_path else self._advance_to_path(seconds)

    def _advance_to_path(self, seconds: float) -> TrajectorySetpoint:
        (north, east), _, _ = self._path.at(self._path.first_phase)
        way = (north - self._from[0], east - self._from[1], -self._from[2])
        length = math.hypot(*way)
        self._accelerate(seconds, length - self._flown_m)
        self._flown_m += self._speed * seconds
        if self._flown_m >= length:
            self.is_on_path, self._speed, self._flown_m = True, 0.0, length
        share = self._flown_m / length if length else 1.0
        north, east, down = (begin + share * part for begin, part in zip(self._from, way, strict=True))
        north_m_s, east_m_s, down_m_s = (self._speed * part / length if length else 0.0 for part in way)
        return self._setpoint((north, east), down, (north_m_s, east_m_s, down_m_s), (0.0, 0.0))

    def _advance_on_path(self, seconds: float) -> TrajectorySetpoint:
        _, tangent, _ = self._path.at(self._phase)
        metres_per_radian = math.hypot(*tangent)
        self._accelerate(seconds, (self._last_phase - self._phase) * metres_per_radian)
        self._phase = min(self._phase + self._speed * seconds / metres_per_radian, self._last_phase)
        if self.is_complete:
            self._speed = 0.0
        place, tangent, second = self._path.at(self._phase)
        rate = self._speed / math.hypot(*tangent)
        along = (second[0] * tangent[0] + second[1] * tangent[1]) / (tangent[0] ** 2 + tangent[1] ** 2)
        centripetal = ((second[0] - along * tangent[0]) * rate**2, (second[1] - along * tangent[1]) * rate**2)
        return self._setpoint(place, 0.0, (tangent[0] * rate, tangent[1] * rate, 0.0), centripetal)

    def _accelerate(self, seconds: float, left_m: float) -> None:
        braking = math.sqrt(2 * ACCELERATION_M_S2 * max(0.0, left_m))
        self._speed = min(self._speed + ACCELERATION_M_S2 * seconds, self._speed_m_s, max(braking, MIN_SPEED_M_S))

    def _setpoint(
        self, place: Vector, down: float, velocity: tuple[float, float, float], acceleration: Vector
    ) -> TrajectorySetpoint:
        north, east, centre_down = self._centre
        where, yaw_deg = (north + place[0], east + place[1], centre_down + down), self._heading(place, velocity[:2])
        return TrajectorySetpoint(*where, *velocity, *acceleration, yaw_deg=yaw_deg)


class TurnCounter:
    """Counts turns around a centre, while the vehicle is near the circle and flies in the right direction."""

    def __init__(self, radius_m: float, *, clockwise: bool) -> None:
        self._radius_m, self._way = radius_m, 1 if clockwise else -1
        self._tolerance_m = max(MIN_TOLERANCE_M, TOLERANCE_SHARE * radius_m)
        self._bearing: float | None = None
        self.rounds: float = 0.0
        self.is_there: bool = False
        """True while the vehicle is near the circle."""

    def add(self, north_m: float, east_m: float) -> None:
        """Process a place relative to the centre."""
        self.is_there = abs(math.hypot(north_m, east_m) - self._radius_m) <= self._tolerance_m
        before, self._bearing = self._bearing, math.atan2(east_m, north_m) if self.is_there else None
        if before is not None and self._bearing is not None:
            self.rounds += self._way * math.remainder(self._bearing - before, 2 * math.pi) / (2 * math.pi)


class LobeCounter:
    """Counts figure eights: two different lobes in a row are one figure."""

    def __init__(self, major_m: float, axis_deg: float) -> None:
        self._half_m, self._axis = major_m / 2, math.radians(axis_deg)
        self._lobe = 0
        self.rounds: float = 0.0
        self.is_there: bool = False
        """True while the vehicle is in one of the lobes."""

    def add(self, north_m: float, east_m: float) -> None:
        """Process a place relative to the centre."""
        along = north_m * math.cos(self._axis) + east_m * math.sin(self._axis)
        self.is_there = abs(along) > self._half_m
        lobe = int(math.copysign(1, along)) if self.is_there else 0
        if lobe not in (0, self._lobe):
            self._lobe = lobe
            self.rounds += 0.5
