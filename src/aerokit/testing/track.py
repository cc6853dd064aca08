"""`Track`: the true positions of a simulated vehicle, with a picture and assertions.

```python
track = record_track(copter)
...
track.save("flight.svg")
track.assert_reached_altitude(20)
track.assert_passed(bridge, within_m=5)
track.assert_landed_near(within_m=3)
```

Altitudes are metres above home, where the vehicle was switched on. Times are simulated seconds.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from os import PathLike
from typing import Any, cast, overload

from aerokit.autopilots import autopilot_for
from aerokit.errors import InvalidArgument
from aerokit.mavlink.messages import Heartbeat
from aerokit.position import Position
from aerokit.sim.ardupilot.fence import PolygonZone
from aerokit.sim.motion import true_place
from aerokit.sim.vehicle import SimulatedVehicle
from aerokit.testing.picture import save_picture
from aerokit.testing.track_points import TrackFailure, TrackPoint, metres_from

_ON_GROUND_M = 0.3


class Track(Sequence[TrackPoint]):
    """True points of a flight, oldest first. The track grows while the vehicle runs.

    Assertions raise AssertionError; all of them fail on an empty track.
    """

    def __init__(self, home: Position, points: Sequence[TrackPoint] = (), *, name: str = "track") -> None:
        self.home = home
        """Position where the vehicle was switched on."""
        self.name = name
        """Name in the legend of a picture."""
        self.failure: TrackFailure | None = None
        """Details of the last failed assertion."""
        self._points = list(points)
        self._refresh: Callable[[], None] | None = None

    def __len__(self) -> int:
        return len(self._refreshed())

    def __iter__(self) -> Iterator[TrackPoint]:
        return iter(tuple(self._refreshed()))

    @overload
    def __getitem__(self, index: int) -> TrackPoint: ...
    @overload
    def __getitem__(self, index: slice) -> list[TrackPoint]: ...
    def __getitem__(self, index: int | slice) -> TrackPoint | list[TrackPoint]:
        return self._refreshed()[index]

    def append(self, point: TrackPoint) -> None:
        """Append a point. If its time is not later than that of the last point, replace the last point."""
        if self._points and self._points[-1].time_s >= point.time_s:
            self._points.pop()
        self._points.append(point)

    def refresh_with(self, refresh: Callable[[], None] | None) -> None:
        """Set a function that appends recent points before each read of the track; None removes the function."""
        self._refresh = refresh

    def _refreshed(self) -> list[TrackPoint]:
        if self._refresh is not None:
            self._refresh()
        return self._points

    @property
    def end(self) -> TrackPoint:
        """The latest point; AssertionError if there is none."""
        points = self._refreshed()
        assert points, "nothing was recorded: was the flight opened?"
        return points[-1]

    @property
    def max_altitude_m(self) -> float:
        """Maximum altitude above home."""
        return self._highest().altitude_m

    @property
    def max_distance_m(self) -> float:
        """Maximum distance from home, along the ground."""
        return self._farthest(self.home)[0]

    @property
    def modes(self) -> list[str]:
        """Modes in order, without repetitions."""
        modes: list[str] = []
        for point in self:
            if not modes or modes[-1] != point.mode:
                modes.append(point.mode)
        return modes

    @property
    def armed_s(self) -> float:
        """Simulated seconds for which the vehicle was armed."""
        return sum(after.time_s - before.time_s for before, after in pairwise(self) if before.armed)

    @property
    def max_speed_m_s(self) -> float:
        """Maximum ground speed."""
        return self._fastest().speed_m_s

    @property
    def battery_used_percent(self) -> float:
        """Battery use in percent of a full battery; negative if the battery was charged."""
        return self[0].battery_percent - self.end.battery_percent if self else 0.0

    @property
    def length_m(self) -> float:
        """Length of the path, including climbs."""
        return sum(math.dist(one, other) for one, other in pairwise(self.local()))

    def local(self, origin: Position | None = None) -> list[tuple[float, float, float]]:
        """Return metres north and east of ``origin`` (default: home), and metres above home."""
        plane = metres_from(self.home if origin is None else origin)
        return [(*plane(point), point.altitude_m) for point in self]

    def snapshot(self) -> Track:
        """Return a copy that does not grow."""
        track = Track(self.home, tuple(self), name=self.name)
        track.failure = self.failure
        return track

    def save(self, path: str | PathLike[str]) -> None:
        """Draw the track as .svg or .png; see `aerokit.testing.picture.save_picture`."""
        save_picture([self], path)

    def nearest_m(self, place: Position) -> float:
        """Return the minimum distance to a position: along the ground, or in space if it has an altitude above home."""
        return self._nearest(place)[0]

    def assert_reached_altitude(self, altitude_m: float, *, within_m: float = 1.0) -> None:
        """Assert that the vehicle was at least ``altitude_m - within_m`` metres above home at some time."""
        __tracebackhide__ = True
        highest = self._highest()
        reached = highest.altitude_m >= altitude_m - within_m
        self._record_failure(reached, TrackFailure(highest, altitude_m=altitude_m))
        assert reached, f"the vehicle did not reach {altitude_m:g} m: the highest point was {highest}"

    def assert_stayed_below(self, altitude_m: float) -> None:
        """Assert that the vehicle was never more than ``altitude_m`` metres above home."""
        __tracebackhide__ = True
        highest = self._highest()
        self._record_failure(highest.altitude_m <= altitude_m, TrackFailure(highest, altitude_m=altitude_m))
        assert highest.altitude_m <= altitude_m, f"the vehicle rose above {altitude_m:g} m: {highest}"

    def assert_passed(self, place: Position, *, within_m: float = 2.0) -> None:
        """Assert that the vehicle came this near to a position: along the ground, or in space if the position has an
        ``altitude_relative_m``.
        """
        __tracebackhide__ = True
        distance, point = self._nearest(place)
        self._record_failure(distance <= within_m, TrackFailure(point, (place, within_m)))
        assert distance <= within_m, (
            f"the vehicle did not pass within {within_m:g} m of {_text(place)}: the minimum distance was"
            f" {distance:.1f} m, {point}"
        )

    def assert_stayed_within(self, radius_m: float, *, of: Position | None = None) -> None:
        """Assert that the horizontal distance from home, or from the position ``of``, was never above ``radius_m``."""
        __tracebackhide__ = True
        centre = self.home if of is None else of
        distance, point = self._farthest(centre)
        name = "home" if of is None else _text(of)
        self._record_failure(distance <= radius_m, TrackFailure(point, (centre, radius_m)))
        assert distance <= radius_m, f"the vehicle left the {radius_m:g} m around {name}: {distance:.1f} m away {point}"

    def assert_stayed_inside(self, polygon: Sequence[Position]) -> None:
        """Assert that the vehicle never left a polygon of at least three corners."""
        __tracebackhide__ = True
        assert len(polygon) >= 3, f"a polygon needs at least three positions, not {len(polygon)}"
        _ = self.end
        plane = metres_from(self.home)
        border = PolygonZone([plane(corner) for corner in polygon])
        outside = [point for point in self if border.outside_m(plane(point)) > 0]
        self._record_failure(not outside, TrackFailure(outside[0] if outside else self.end, polygon=polygon))
        assert not outside, (
            f"the vehicle left the polygon: {len(outside)} of {len(self)} points are outside, the first {outside[0]}"
        )

    def assert_stayed_slower_than(self, speed_m_s: float) -> None:
        """Assert that the ground speed was never above this, in m/s."""
        __tracebackhide__ = True
        fastest = self._fastest()
        self._record_failure(fastest.speed_m_s <= speed_m_s, TrackFailure(fastest))
        assert fastest.speed_m_s <= speed_m_s, (
            f"the vehicle was faster than {speed_m_s:g} m/s: {fastest.speed_m_s:.1f} m/s {fastest}"
        )

    def assert_landed_near(self, place: Position | None = None, *, within_m: float = 2.0) -> None:
        """Assert that the vehicle flew, and ended on the ground near home, or near a position."""
        __tracebackhide__ = True
        end, target = self.end, self.home if place is None else place
        self._record_failure(self.max_altitude_m > _ON_GROUND_M, TrackFailure(end))
        assert self.max_altitude_m > _ON_GROUND_M, f"the vehicle never took off: the track ends {end}"
        self._record_failure(abs(end.altitude_m) <= _ON_GROUND_M, TrackFailure(end, (target, within_m)))
        assert abs(end.altitude_m) <= _ON_GROUND_M, f"the vehicle is not on the ground: the track ends {end}"
        distance = target.distance_to(end.position)
        name = "home" if place is None else _text(place)
        self._record_failure(distance <= within_m, TrackFailure(end, (target, within_m)))
        assert distance <= within_m, (
            f"the vehicle landed {distance:.1f} m from {name}, not within {within_m:g} m: {end}"
        )

    def assert_armed_at_end(self) -> None:
        """Assert that the vehicle is armed at the end."""
        __tracebackhide__ = True
        self._record_failure(self.end.armed, TrackFailure(self.end))
        assert self.end.armed, f"the vehicle is disarmed at the end, {self.end}"

    def assert_disarmed_at_end(self) -> None:
        """Assert that the vehicle is disarmed at the end."""
        __tracebackhide__ = True
        self._record_failure(not self.end.armed, TrackFailure(self.end))
        assert not self.end.armed, f"the vehicle is armed at the end, {self.end}"

    def assert_modes(self, *names: str) -> None:
        """Assert that the vehicle was in these modes in this order; other modes in between are allowed."""
        __tracebackhide__ = True
        modes = iter(self.modes)
        for name in names:
            assert name in modes, f"{name} is missing in {' → '.join(names)}: the modes were {' → '.join(self.modes)}"

    def _record_failure(self, holds: bool, failure: TrackFailure) -> None:
        """Keep the details of an assertion that fails."""
        if not holds:
            self.failure = failure

    def _highest(self) -> TrackPoint:
        _ = self.end
        return max(self, key=lambda point: point.altitude_m)

    def _fastest(self) -> TrackPoint:
        _ = self.end
        return max(self, key=lambda point: point.speed_m_s)

    def _farthest(self, centre: Position) -> tuple[float, TrackPoint]:
        _ = self.end
        plane = metres_from(centre)
        point = max(self, key=lambda point: math.hypot(*plane(point)))
        return math.hypot(*plane(point)), point

    def _nearest(self, place: Position) -> tuple[float, TrackPoint]:
        _ = self.end
        plane, altitude = metres_from(place), place.altitude_relative_m
        nearest, point, before = math.inf, self._points[0], None
        for candidate in self:
            up = 0.0 if altitude is None else candidate.altitude_m - altitude
            here = (*plane(candidate), up)
            distance = _distance_of_origin(here if before is None else before, here)
            if distance < nearest:
                nearest, point = distance, candidate
            before = here
        return nearest, point


def true_point(vehicle: SimulatedVehicle) -> TrackPoint:
    """Return the current true state of a vehicle.

    Raises InvalidArgument if the vehicle has no true position.
    """
    place, flown = true_place(vehicle), cast("Any", vehicle)
    return TrackPoint(
        vehicle.now,
        place.latitude_e7 * 1e-7,
        place.longitude_e7 * 1e-7,
        place.altitude_m - flown.frame.origin.altitude_m,
        flown.is_armed,
        _mode_name(vehicle),
        math.hypot(flown.motion.velocity_north, flown.motion.velocity_east),
        flown.battery.percent,
    )


def record_track(vehicle: SimulatedVehicle, *, interval_s: float = 0.1) -> Track:
    """Record the true position of a vehicle every ``interval_s`` simulated seconds, also after reboots.

    Recording uses the vehicle's timers, and changes neither its messages nor its random numbers. Raises InvalidArgument
    for a vehicle without a true position, and for an interval that is not positive.
    """
    if not interval_s > 0:
        raise InvalidArgument(f"interval_s = {interval_s!r} must be above 0")
    true_place(vehicle)
    origin = cast("Any", vehicle).frame.origin
    home = Position(origin.latitude_e7 * 1e-7, origin.longitude_e7 * 1e-7, origin.altitude_m)
    track = Track(home, name=f"system {vehicle.system_id}")

    def note() -> None:
        track.append(true_point(vehicle))

    def begin() -> None:
        note()
        vehicle.every(interval_s, note)

    vehicle.on_power_on(begin)
    return track


def min_distance_m(one: Track, other: Track) -> tuple[float, float]:
    """Return the minimum distance between two vehicles in space, and its time.

    Returns (infinity, 0) if the vehicles never ran at the same time.
    """
    ups = one.home.altitude_amsl_m or 0.0, other.home.altitude_amsl_m or 0.0
    way = [
        (point.time_s, (north, east, up + ups[1]))
        for point, (north, east, up) in zip(other, other.local(one.home), strict=True)
    ]
    times = [time for time, _ in way]
    nearest = math.inf, 0.0
    for point, (north, east, up) in zip(one, one.local(), strict=True):
        index = bisect_right(times, point.time_s)
        if index == 0 or (index == len(way) and times[-1] < point.time_s):
            continue
        there = _between(way[index - 1], way[min(index, len(way) - 1)], point.time_s)
        nearest = min(nearest, (math.dist((north, east, up + ups[0]), there), point.time_s))
    return nearest


Moment = tuple[float, tuple[float, float, float]]


def _between(before: Moment, after: Moment, time_s: float) -> tuple[float, float, float]:
    span = after[0] - before[0]
    share = (time_s - before[0]) / span if span > 0 else 0.0
    north, east, up = (a + share * (b - a) for a, b in zip(before[1], after[1], strict=True))
    return north, east, up


def _mode_name(vehicle: SimulatedVehicle) -> str:
    heartbeat = vehicle.build(Heartbeat.ID)
    assert isinstance(heartbeat, Heartbeat)
    return autopilot_for(heartbeat).mode_of(heartbeat).name


def _text(place: Position) -> str:
    above = place.altitude_relative_m
    height = "" if above is None else f" at {above:.1f} m above home"
    return f"{place.latitude_deg:.6f}, {place.longitude_deg:.6f}{height}"


def _distance_of_origin(start: tuple[float, float, float], end: tuple[float, float, float]) -> float:
    """Return the distance from the origin to a line segment."""
    way = [b - a for a, b in zip(start, end, strict=True)]
    square = sum(part * part for part in way)
    share = 0.0 if square == 0.0 else -sum(a * part for a, part in zip(start, way, strict=True)) / square
    share = max(0.0, min(1.0, share))
    return math.hypot(*(a + share * part for a, part in zip(start, way, strict=True)))
