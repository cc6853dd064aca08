"""Closed paths in a plane: set-points along them, and counting of rounds from reported positions. No I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from aerokit.vehicle.commanding.setpoints import TrajectorySetpoint

if TYPE_CHECKING:
    from collections.abc import Callable

ACCELERATION_M_S2 = 1.0
"""Acceleration along the path at its start, and deceleration at its end."""
MIN_SPEED_M_S = 0.1
"""Minimum speed while slowing down, so that the set-point reaches the end."""

MIN_TOLERANCE_M, TOLERANCE_SHARE = 5.0, 0.3
"""A vehicle is on its circle if it is nearer to it than TOLERANCE_SHARE of the radius, or than MIN_TOLERANCE_M."""

Vector = tuple[float, float]
"""Metres north and east."""


class CurvePoint(NamedTuple):
    """Place relative to the center of a path, and its first and second derivative by the phase."""

    place: Vector
    tangent: Vector
    second_derivative: Vector


class Circle:
    """A circle; the phase is the bearing from its center in radians."""

    def __init__(self, radius_m: float, *, clockwise: bool, first_phase: float) -> None:
        self._radius_m = radius_m
        self._direction = 1 if clockwise else -1
        self.first_phase: float = first_phase

    def at(self, phase: float) -> CurvePoint:
        bearing = self.first_phase + self._direction * (phase - self.first_phase)
        north, east = self._radius_m * math.cos(bearing), self._radius_m * math.sin(bearing)
        return CurvePoint((north, east), (-self._direction * east, self._direction * north), (-north, -east))


class Eight:
    """A lemniscate along an axis; it begins and ends at its center."""

    first_phase: float = 0.0

    def __init__(self, major_m: float, minor_m: float, axis_deg: float, *, clockwise: bool) -> None:
        self._major_m, self._axis = major_m, math.radians(axis_deg)
        self._minor_m = minor_m if clockwise else -minor_m

    def at(self, phase: float) -> CurvePoint:
        major_m, minor_m = self._major_m, self._minor_m
        return CurvePoint(
            self._to_north_east(major_m * math.sin(phase), -minor_m * math.sin(2 * phase)),
            self._to_north_east(major_m * math.cos(phase), -2 * minor_m * math.cos(2 * phase)),
            self._to_north_east(-major_m * math.sin(phase), 4 * minor_m * math.sin(2 * phase)),
        )

    def _to_north_east(self, along: float, across: float) -> Vector:
        """Convert the components along the axis and across it (positive to the right) to north and east."""
        cos, sin = math.cos(self._axis), math.sin(self._axis)
        return along * cos - across * sin, along * sin + across * cos


ClosedPath: TypeAlias = Circle | Eight
"""A closed curve around a center, with a phase that increases by 2π each round."""


class PathSetpoints:
    """Moves a set-point straight to the start of a path, stops it there, and then moves it along the path to its end.

    ``initial_offset`` is the vehicle's position when the flight begins, relative to the center of the path (north,
    east, down). ``center`` is the position of the center in the local frame. ``heading`` returns the heading in degrees
    for a place relative to the center and a velocity; if it returns None, the autopilot chooses the heading.
    """

    def __init__(
        self,
        path: ClosedPath,
        rounds: float,
        speed_m_s: float,
        initial_offset: tuple[float, float, float],
        center: tuple[float, float, float],
        heading: Callable[[Vector, Vector], float | None],
    ) -> None:
        self._path = path
        self._speed_m_s = speed_m_s
        self._center = center
        self._heading = heading
        self._initial_offset = initial_offset
        # Phase of the set-point, and phase at the end of the path.
        self._phase = path.first_phase
        self._last_phase = path.first_phase + 2 * math.pi * rounds
        # How far the set-point has moved on the straight line to the path.
        self._flown_m = 0.0
        self._present_speed_m_s = 0.0
        self.is_on_path: bool = False
        """True once the set-point has reached the path."""

    @property
    def is_complete(self) -> bool:
        return self._phase >= self._last_phase

    def advance(self, seconds: float) -> TrajectorySetpoint:
        return self._advance_on_path(seconds) if self.is_on_path else self._advance_to_path(seconds)

    def _advance_to_path(self, seconds: float) -> TrajectorySetpoint:
        path_north, path_east = self._path.at(self._path.first_phase).place
        start_north, start_east, start_down = self._initial_offset
        to_path = (path_north - start_north, path_east - start_east, -start_down)  # The path is at down = 0.
        length_m = math.hypot(*to_path)
        self._change_speed(seconds, remaining_m=length_m - self._flown_m)
        self._flown_m += self._present_speed_m_s * seconds
        if self._flown_m >= length_m:
            self.is_on_path = True
            self._flown_m = length_m
            self._present_speed_m_s = 0.0
        # The unit vector towards the path; zero if the set-point begins on the path.
        to_north, to_east, to_down = (component / length_m if length_m else 0.0 for component in to_path)
        flown_m, speed = self._flown_m, self._present_speed_m_s
        place = (start_north + flown_m * to_north, start_east + flown_m * to_east)
        velocity = (speed * to_north, speed * to_east, speed * to_down)
        return self._setpoint(place, start_down + flown_m * to_down, velocity, acceleration=(0.0, 0.0))

    def _advance_on_path(self, seconds: float) -> TrajectorySetpoint:
        metres_per_radian = math.hypot(*self._path.at(self._phase).tangent)
        self._change_speed(seconds, remaining_m=(self._last_phase - self._phase) * metres_per_radian)
        self._phase = min(self._phase + self._present_speed_m_s * seconds / metres_per_radian, self._last_phase)
        if self.is_complete:
            self._present_speed_m_s = 0.0
        place, tangent, second_derivative = self._path.at(self._phase)
        phase_rate = self._present_speed_m_s / math.hypot(*tangent)
        # The acceleration must not change the speed, so the part of the second derivative that is parallel to the path
        # is subtracted.
        tangent_north, tangent_east = tangent
        curve_north, curve_east = second_derivative
        tangent_squared = tangent_north**2 + tangent_east**2
        parallel_factor = (curve_north * tangent_north + curve_east * tangent_east) / tangent_squared
        centripetal = (
            (curve_north - parallel_factor * tangent_north) * phase_rate**2,
            (curve_east - parallel_factor * tangent_east) * phase_rate**2,
        )
        velocity = (tangent_north * phase_rate, tangent_east * phase_rate, 0.0)
        return self._setpoint(place, down=0.0, velocity=velocity, acceleration=centripetal)

    def _change_speed(self, seconds: float, remaining_m: float) -> None:
        """Accelerate to the ordered speed, or brake so that the set-point can stop after ``remaining_m``."""
        max_to_stop = math.sqrt(2 * ACCELERATION_M_S2 * max(0.0, remaining_m))
        accelerated = self._present_speed_m_s + ACCELERATION_M_S2 * seconds
        self._present_speed_m_s = min(accelerated, self._speed_m_s, max(max_to_stop, MIN_SPEED_M_S))

    def _setpoint(
        self, place: Vector, down: float, velocity: tuple[float, float, float], acceleration: Vector
    ) -> TrajectorySetpoint:
        """Convert a place relative to the center to a set-point in the local frame."""
        center_north, center_east, center_down = self._center
        north, east = place
        position = (center_north + north, center_east + east, center_down + down)
        yaw_deg = self._heading(place, velocity[:2])
        return TrajectorySetpoint(*position, *velocity, *acceleration, yaw_deg=yaw_deg)


class TurnCounter:
    """Counts turns around a center while the vehicle is near the circle.

    Turns in the wrong direction are subtracted.
    """

    def __init__(self, radius_m: float, *, clockwise: bool) -> None:
        self._radius_m = radius_m
        self._direction = 1 if clockwise else -1
        self._tolerance_m = max(MIN_TOLERANCE_M, TOLERANCE_SHARE * radius_m)
        # Bearing from the center to the vehicle in radians; None while the vehicle is not near the circle.
        self._bearing: float | None = None
        self.rounds: float = 0.0
        self.is_on_path: bool = False
        """True while the vehicle is near the circle."""

    def add(self, north_m: float, east_m: float) -> None:
        """Process a position of the vehicle, in metres from the center."""
        self.is_on_path = abs(math.hypot(north_m, east_m) - self._radius_m) <= self._tolerance_m
        bearing_before = self._bearing
        self._bearing = math.atan2(east_m, north_m) if self.is_on_path else None
        if bearing_before is not None and self._bearing is not None:
            turned = math.remainder(self._bearing - bearing_before, 2 * math.pi)
            self.rounds += self._direction * turned / (2 * math.pi)


class LobeCounter:
    """Counts figure eights: each change to the other lobe counts as half a figure."""

    def __init__(self, major_m: float, axis_deg: float) -> None:
        # A vehicle is in a lobe if it is farther than this from the center along the axis.
        self._min_along_m = major_m / 2
        self._axis = math.radians(axis_deg)
        self._lobe = 0  # number of the lobe in which the vehicle was last, 1 or -1; 0 if it was in none yet
        self.rounds: float = 0.0
        self.is_on_path: bool = False
        """True while the vehicle is in one of the lobes, far enough from the crossing to tell them apart."""

    def add(self, north_m: float, east_m: float) -> None:
        """Process a position of the vehicle, in metres from the center."""
        along = north_m * math.cos(self._axis) + east_m * math.sin(self._axis)
        self.is_on_path = abs(along) > self._min_along_m
        lobe = 1 if along > 0 else -1
        # Each new lobe counts as half a figure, including the first one that the vehicle reaches.
        if self.is_on_path and lobe != self._lobe:
            self._lobe = lobe
            self.rounds += 0.5
