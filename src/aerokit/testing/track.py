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
from aerokit.sim.missions import PolygonZone
from aerokit.sim.motion import true_place
from aerokit.sim.vehicle import SimulatedVehicle
from aerokit.testing.picture import save_picture
from aerokit.testing.track_points import TrackFailure, TrackPoint, metres_from

_ON_GROUND_M = 0.3


class Track(Sequence[TrackPoint]):
    """Real states of a vehicle, from the oldest to the newest. The track grows while the vehicle runs.

    The states are those of the simulation, without the errors of the vehicle's sensors and estimator.

    Assertions raise AssertionError. All of them fail on an empty track.
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
        """Set a function that is called before each read of the track, to append recent points. None removes it."""
        self._refresh = refresh

    def _refreshed(self) -> list[TrackPoint]:
        if self._refresh is not None:
            self._refresh()
        return self._points

    @property
    def end(self) -> TrackPoint:
        """The latest point. Raises AssertionError if the track is empty."""
        points = self._refreshed()
        assert points, "the track is empty: was the flight opened?"
        return points[-1]

    def _check_not_empty(self) -> None:
        _ = self.end  # Reading `end` raises AssertionError for an empty track.

    @property
    def max_altitude_m(self) -> float:
        """Maximum altitude above home in metres."""
        return self._highest().altitude_m

    @property
    def max_distance_m(self) -> float:
        """Maximum distance from home in metres, along the ground."""
        distance_m, _ = self._farthest(self.home)
        return distance_m

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
        return sum(following.time_s - point.time_s for point, following in pairwise(self) if point.armed)

    @property
    def max_speed_m_s(self) -> float:
        """Maximum ground speed in m/s."""
        return self._fastest().speed_m_s

    @property
    def battery_used_percent(self) -> float:
        """Charge that the battery has lost, in percent of a full battery. Negative if the battery was charged."""
        return self[0].battery_percent - self.end.battery_percent if self else 0.0

    @property
    def length_m(self) -> float:
        """Length of the path in metres, including climbs."""
        return sum(math.dist(start, end) for start, end in pairwise(self.local()))

    def local(self, origin: Position | None = None) -> list[tuple[float, float, float]]:
        """Return each point as metres north and east of ``origin`` (default: home), and metres above home."""
        offset_of = metres_from(self.home if origin is None else origin)
        return [(*offset_of(point), point.altitude_m) for point in self]

    def snapshot(self) -> Track:
        """Return a copy that does not grow."""
        track = Track(self.home, tuple(self), name=self.name)
        track.failure = self.failure
        return track

    def save(self, path: str | PathLike[str]) -> None:
        """Draw the track as .svg or .png; see `aerokit.testing.picture.save_picture`."""
        save_picture([self], path)

    def nearest_m(self, place: Position) -> float:
        """Return the minimum distance to a position, in metres.

        The distance is in 3D if the position has an ``altitude_relative_m``, otherwise along the ground.
        """
        distance_m, _ = self._nearest(place)
        return distance_m

    def assert_reached_altitude(self, altitude_m: float, *, within_m: float = 1.0) -> None:
        """Assert that the vehicle was at least ``altitude_m - within_m`` metres above home at some time."""
        __tracebackhide__ = True
        highest = self._highest()
        reached = highest.altitude_m >= altitude_m - within_m
        self._record_failure_unless(reached, TrackFailure(highest, altitude_m=altitude_m))
        assert reached, f"the vehicle did not reach {altitude_m:g} m: the highest point was {highest}"

    def assert_stayed_below(self, altitude_m: float) -> None:
        """Assert that the vehicle was never more than ``altitude_m`` metres above home."""
        __tracebackhide__ = True
        highest = self._highest()
        self._record_failure_unless(highest.altitude_m <= altitude_m, TrackFailure(highest, altitude_m=altitude_m))
        assert highest.altitude_m <= altitude_m, f"the vehicle rose above {altitude_m:g} m: {highest}"

    def assert_passed(self, place: Position, *, within_m: float = 2.0) -> None:
        """Assert that the vehicle came within ``within_m`` metres of a position.

        The distance is in 3D if the position has an ``altitude_relative_m``, otherwise along the ground.
        """
        __tracebackhide__ = True
        distance, point = self._nearest(place)
        self._record_failure_unless(distance <= within_m, TrackFailure(point, circle=(place, within_m)))
        assert distance <= within_m, (
            f"the vehicle did not pass within {within_m:g} m of {_text(place)}: the minimum distance was"
            f" {distance:.1f} m, {point}"
        )

    def assert_stayed_within(self, radius_m: float, *, of: Position | None = None) -> None:
        """Assert that the horizontal distance from home, or from the position ``of``, was never above ``radius_m``."""
        __tracebackhide__ = True
        center = self.home if of is None else of
        distance, point = self._farthest(center)
        name = "home" if of is None else _text(of)
        self._record_failure_unless(distance <= radius_m, TrackFailure(point, circle=(center, radius_m)))
        assert distance <= radius_m, f"the vehicle left the {radius_m:g} m around {name}: {distance:.1f} m away {point}"

    def assert_stayed_inside(self, polygon: Sequence[Position]) -> None:
        """Assert that the vehicle never left a polygon of at least three corners."""
        __tracebackhide__ = True
        assert len(polygon) >= 3, f"a polygon needs at least three positions, not {len(polygon)}"
        self._check_not_empty()
        offset_of = metres_from(self.home)
        zone = PolygonZone([offset_of(corner) for corner in polygon])
        outside = [point for point in self if zone.outside_m(offset_of(point)) > 0]
        if outside:
            self.failure = TrackFailure(outside[0], polygon=polygon)
        assert not outside, (
            f"the vehicle left the polygon: {len(outside)} of {len(self)} points are outside, the first {outside[0]}"
        )

    def assert_stayed_slower_than(self, speed_m_s: float) -> None:
        """Assert that the ground speed was never above ``speed_m_s``."""
        __tracebackhide__ = True
        fastest = self._fastest()
        self._record_failure_unless(fastest.speed_m_s <= speed_m_s, TrackFailure(fastest))
        assert fastest.speed_m_s <= speed_m_s, (
            f"the vehicle was faster than {speed_m_s:g} m/s: {fastest.speed_m_s:.1f} m/s {fastest}"
        )

    def assert_landed_near(self, place: Position | None = None, *, within_m: float = 2.0) -> None:
        """Assert that the vehicle flew and landed within ``within_m`` metres of home, or of ``place`` if given."""
        __tracebackhide__ = True
        end = self.end
        target = self.home if place is None else place
        self._record_failure_unless(self.max_altitude_m > _ON_GROUND_M, TrackFailure(end))
        assert self.max_altitude_m > _ON_GROUND_M, f"the vehicle never took off: the track ends {end}"
        self._record_failure_unless(abs(end.altitude_m) <= _ON_GROUND_M, TrackFailure(end, circle=(target, within_m)))
        assert abs(end.altitude_m) <= _ON_GROUND_M, f"the vehicle is not on the ground: the track ends {end}"
        distance = target.distance_to(end.position)
        name = "home" if place is None else _text(place)
        self._record_failure_unless(distance <= within_m, TrackFailure(end, circle=(target, within_m)))
        assert distance <= within_m, (
            f"the vehicle landed {distance:.1f} m from {name}, not within {within_m:g} m: {end}"
        )

    def assert_armed_at_end(self) -> None:
        """Assert that the vehicle is armed at the end."""
        __tracebackhide__ = True
        self._record_failure_unless(self.end.armed, TrackFailure(self.end))
        assert self.end.armed, f"the vehicle is disarmed at the end, {self.end}"

    def assert_disarmed_at_end(self) -> None:
        """Assert that the vehicle is disarmed at the end."""
        __tracebackhide__ = True
        self._record_failure_unless(not self.end.armed, TrackFailure(self.end))
        assert not self.end.armed, f"the vehicle is armed at the end, {self.end}"

    def assert_modes(self, *names: str) -> None:
        """Assert that the vehicle was in these modes in this order. Other modes in between are allowed."""
        __tracebackhide__ = True
        modes = iter(self.modes)  # `in` consumes the modes up to the name, so the order of the names counts.
        for name in names:
            assert name in modes, f"{name} is missing in {' → '.join(names)}: the modes were {' → '.join(self.modes)}"

    def _record_failure_unless(self, passes: bool, failure: TrackFailure) -> None:
        if not passes:
            self.failure = failure

    def _highest(self) -> TrackPoint:
        self._check_not_empty()
        return max(self, key=lambda point: point.altitude_m)

    def _fastest(self) -> TrackPoint:
        self._check_not_empty()
        return max(self, key=lambda point: point.speed_m_s)

    def _farthest(self, center: Position) -> tuple[float, TrackPoint]:
        """Return the maximum horizontal distance from a position in metres, and the farthest point."""
        self._check_not_empty()
        offset_of = metres_from(center)
        farthest = max(self, key=lambda point: math.hypot(*offset_of(point)))
        return math.hypot(*offset_of(farthest)), farthest

    def _nearest(self, place: Position) -> tuple[float, TrackPoint]:
        """Return the minimum distance between a position and the track in metres, and the nearest point."""
        self._check_not_empty()
        offset_of = metres_from(place)
        altitude = place.altitude_relative_m
        min_distance = math.inf
        nearest = self._points[0]
        previous_offset = None
        for point in self:
            up = 0.0 if altitude is None else point.altitude_m - altitude
            offset = (*offset_of(point), up)
            # The line between the previous point and this one may be nearer to `place` than both points.
            distance = _distance_of_origin(offset if previous_offset is None else previous_offset, offset)
            if distance < min_distance:
                min_distance = distance
                nearest = point
            previous_offset = offset
        return min_distance, nearest


def true_point(vehicle: SimulatedVehicle) -> TrackPoint:
    """Return the current true state of a vehicle.

    Raises InvalidArgument if the vehicle has no true position.
    """
    place = true_place(vehicle)
    autopilot = cast("Any", vehicle)  # A vehicle with a true position also has the attributes that are read here.
    return TrackPoint(
        time_s=vehicle.now,
        latitude_deg=place.latitude_e7 * 1e-7,
        longitude_deg=place.longitude_e7 * 1e-7,
        altitude_m=place.altitude_m - autopilot.frame.origin.altitude_m,
        armed=autopilot.is_armed,
        mode=_mode_name(vehicle),
        speed_m_s=math.hypot(autopilot.motion.velocity_north, autopilot.motion.velocity_east),
        battery_percent=autopilot.battery.percent,
    )


def record_track(vehicle: SimulatedVehicle, *, interval_s: float = 0.1) -> Track:
    """Record the true position of a vehicle every ``interval_s`` simulated seconds, also after reboots.

    Raises InvalidArgument for a vehicle without a true position, and for an interval that is not positive.
    """
    if not interval_s > 0:
        raise InvalidArgument(f"interval_s = {interval_s!r} is not allowed: it must be above 0")
    true_place(vehicle)  # This call raises InvalidArgument for a vehicle without a true position.
    origin = cast("Any", vehicle).frame.origin
    home = Position(origin.latitude_e7 * 1e-7, origin.longitude_e7 * 1e-7, origin.altitude_m)
    track = Track(home, name=f"system {vehicle.system_id}")

    def append_point() -> None:
        track.append(true_point(vehicle))

    def start_recording() -> None:
        append_point()
        vehicle.every(interval_s, append_point)

    # Recording does not change the flight: it sends no messages, and draws none of the vehicle's random numbers.
    vehicle.on_power_on(start_recording)
    return track


def min_distance_m(first: Track, second: Track) -> tuple[float, float]:
    """Return the minimum 3D distance between two vehicles in metres, and its time.

    The result is (infinity, 0) if the two vehicles never ran at the same time.
    """
    first_home_m = first.home.altitude_amsl_m or 0.0
    second_home_m = second.home.altitude_amsl_m or 0.0
    # `local` returns north and east of the given origin, but heights above the track's own home.
    second_path = [
        (point.time_s, (north, east, up + second_home_m))
        for point, (north, east, up) in zip(second, second.local(first.home), strict=True)
    ]
    second_times = [time for time, _ in second_path]
    closest = math.inf, 0.0
    for point, (north, east, up) in zip(first, first.local(), strict=True):
        index = bisect_right(second_times, point.time_s)  # Number of points of the second track up to this time.
        has_not_started = index == 0
        has_ended = index == len(second_path) and second_times[-1] < point.time_s
        if has_not_started or has_ended:
            continue
        first_place = (north, east, up + first_home_m)
        earlier = second_path[index - 1]
        later = second_path[min(index, len(second_path) - 1)]
        second_place = _interpolated(earlier, later, point.time_s)
        closest = min(closest, (math.dist(first_place, second_place), point.time_s))
    return closest


# A time, and a place in metres north, east and up.
_TimedPlace = tuple[float, tuple[float, float, float]]


def _interpolated(earlier: _TimedPlace, later: _TimedPlace, time_s: float) -> tuple[float, float, float]:
    start_s, start = earlier
    end_s, end = later
    share = (time_s - start_s) / (end_s - start_s) if end_s > start_s else 0.0
    north, east, up = (from_ + share * (to - from_) for from_, to in zip(start, end, strict=True))
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
    segment = [to - from_ for from_, to in zip(start, end, strict=True)]
    squared_length = sum(component * component for component in segment)
    share = 0.0  # Point of the segment that is nearest to the origin: 0 is the start, 1 the end.
    if squared_length != 0.0:
        dot_product = sum(from_ * component for from_, component in zip(start, segment, strict=True))
        share = max(0.0, min(1.0, -dot_product / squared_length))
    return math.hypot(*(from_ + share * component for from_, component in zip(start, segment, strict=True)))
