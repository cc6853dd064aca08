"""The path that SMART_RTL goes back on: recorded on the way, without bends that do not matter and without loops."""

from __future__ import annotations

import math
from collections.abc import Sequence

from aerokit.mavlink.enums import MavSeverity
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.local_frame import Ned

_PERIOD_S, _PATIENCE_S, _LOW_SPACE_PERIOD_S = 1.0 / 3.0, 15.0, 10.0
_CLEAN_UP_EVERY = 50
_LOW_SPACE = 9
_BEND, _LOOP = 0.5, 0.99
"""Shares of SRTL_ACCURACY: a bend that is smaller does not matter, parts that come closer to each other are joined."""


class SmartPath:
    """Points SRTL_ACCURACY metres apart, SRTL_POINTS at most, the first where it was armed or had its first position.

    Without a position for 15 s, and when there is no more room, the path is given up: SMART_RTL is refused then.
    ``update`` is called three times a second by `start`, while somebody else than SMART_RTL drives.
    """

    def __init__(self, vehicle: ArduPilotVehicle, *, only_armed: bool) -> None:
        self._vehicle = vehicle
        self._only_armed = only_armed
        self._points: list[Ned] = []
        self._cleaned = 0
        self._good_at = self._saved_at = -math.inf
        self._warned_at = -math.inf
        self._has_begun = False
        self.is_active: bool = False
        """Whether there is a way back."""

    def __len__(self) -> int:
        return len(self._points)

    def start(self) -> None:
        """Record from now on."""
        self._vehicle.every(_PERIOD_S, self.update)

    def begin(self) -> None:
        """Forget the path and begin here, as arming does; without a position there is none."""
        self._points.clear()
        self._cleaned, self.is_active, self._has_begun = 0, False, True
        if self._vehicle.parameters["SRTL_POINTS"] <= 0 or self._vehicle.parameters["SRTL_ACCURACY"] <= 0:
            return
        if self._vehicle.navigation.has_position:
            self._points.append(self._vehicle.motion.place)
            self._good_at = self._saved_at = self._vehicle.now
            self.is_active = True

    def take_all(self) -> list[Ned]:
        """The whole way back, cleaned up; the last is where it began. What is taken is recorded no more."""
        accuracy = self._vehicle.parameters["SRTL_ACCURACY"]
        way = prune(simplify(self._points, _BEND * accuracy), _LOOP * accuracy)
        self._points.clear()
        self._cleaned = 0
        return way[::-1]

    def put_back(self, way: Sequence[Ned]) -> None:
        """What `take_all` has given and was not reached."""
        self._points[:] = list(way)[::-1]
        self._cleaned = len(self._points)

    def update(self) -> None:
        """Look where the vehicle is and keep it, if it is far enough from the last point."""
        vehicle = self._vehicle
        if not self.is_active:
            if not self._has_begun and vehicle.navigation.has_position:
                self.begin()
            return
        if vehicle.mode.returns_on_path or (self._only_armed and not vehicle.motors.is_armed):
            return
        if not vehicle.navigation.has_position:
            if vehicle.now - self._good_at > _PATIENCE_S:
                self._give_up("bad position")
            return
        self._good_at = vehicle.now
        if self._add(self._vehicle.motion.place):
            self._saved_at = vehicle.now
        elif vehicle.now - self._saved_at > _PATIENCE_S:
            self._give_up("buffer full")

    def _add(self, place: Ned) -> bool:
        parameters = self._vehicle.parameters
        accuracy, most = parameters["SRTL_ACCURACY"], int(parameters["SRTL_POINTS"])
        if self._points and math.dist(self._points[-1], place) < accuracy:
            return True
        if len(self._points) - self._cleaned >= _CLEAN_UP_EVERY or len(self._points) >= most:
            self._points = simplify(self._points, _BEND * accuracy)
            if len(self._points) >= most - _LOW_SPACE:
                self._points = prune(self._points, _LOOP * accuracy)
            self._cleaned = len(self._points)
        if len(self._points) >= most - _LOW_SPACE:
            self._warn()
        if len(self._points) >= most:
            return False
        self._points.append(place)
        return True

    def _warn(self) -> None:
        if self._vehicle.now - self._warned_at > _LOW_SPACE_PERIOD_S:
            self._warned_at = self._vehicle.now
            self._vehicle.info("SmartRTL Low on space!")

    def _give_up(self, why: str) -> None:
        self.is_active = False
        self._vehicle.send_text(MavSeverity.WARNING, f"SmartRTL deactivated: {why}")


def simplify(path: Sequence[Ned], tolerance: float) -> list[Ned]:
    """The path without points that are nowhere farther than ``tolerance`` metres from the line without them."""
    if len(path) < 3:
        return list(path)
    distances = [_distance_to_line(point, path[0], path[-1]) for point in path[1:-1]]
    farthest = max(range(len(distances)), key=distances.__getitem__)
    if distances[farthest] <= tolerance:
        return [path[0], path[-1]]
    middle = farthest + 1
    return simplify(path[: middle + 1], tolerance)[:-1] + simplify(path[middle:], tolerance)


def prune(path: Sequence[Ned], tolerance: float) -> list[Ned]:
    """The path without loops: where two parts come closer than ``tolerance`` metres, it goes from one to the other.

    The earliest loop goes first, and of these the longest.
    """
    points = list(path)
    first = 0
    while first < len(points) - 3:
        for last in range(len(points) - 2, first + 1, -1):
            meeting = _meeting(points[first], points[first + 1], points[last], points[last + 1])
            if meeting is not None and meeting[0] < tolerance:
                points[first + 1 : last + 1] = [meeting[1]]
                break
        first += 1
    return points


def _minus(one: Ned, other: Ned) -> Ned:
    return (one[0] - other[0], one[1] - other[1], one[2] - other[2])


def _dot(one: Ned, other: Ned) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _along(start: Ned, line: Ned, share: float) -> Ned:
    return (start[0] + share * line[0], start[1] + share * line[1], start[2] + share * line[2])


def _distance_to_line(point: Ned, start: Ned, end: Ned) -> float:
    line = _minus(end, start)
    length2 = _dot(line, line)
    share = 0.0 if length2 == 0.0 else max(0.0, min(1.0, _dot(_minus(point, start), line) / length2))
    return math.dist(point, _along(start, line, share))


def _meeting(one: Ned, one_end: Ned, other: Ned, other_end: Ned) -> tuple[float, Ned] | None:
    """How close two straight parts come to each other, and the middle between; None when they are parallel."""
    line1, line2, between = _minus(one_end, one), _minus(other_end, other), _minus(one, other)
    a, b, c = _dot(line1, line1), _dot(line1, line2), _dot(line2, line2)
    d, e = _dot(line1, between), _dot(line2, between)
    determinant = a * c - b * b
    if determinant < 1e-6 * max(a * c, 1e-9):
        return None
    share1 = max(0.0, min(1.0, (b * e - c * d) / determinant))
    share2 = max(0.0, min(1.0, (b * share1 + e) / c))
    share1 = max(0.0, min(1.0, (b * share2 - d) / a))
    place1, place2 = _along(one, line1, share1), _along(other, line2, share2)
    middle = _along(place1, _minus(place2, place1), 0.5)
    return math.dist(place1, place2), middle
