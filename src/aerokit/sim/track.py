"""`Track`: where a simulated vehicle truly was, whatever it said; its picture, and assertions that tell what was flown.

```python
track = record_track(copter)
...
track.save("flight.svg")
track.assert_reached_altitude(20)
track.assert_passed(bridge, within_m=5)
track.assert_landed_near(within_m=3)
```

Altitudes are metres above home; home is where the vehicle was switched on. Times are simulated seconds.
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
from aerokit.sim.local_frame import true_place
from aerokit.sim.picture import save_picture
from aerokit.sim.track_points import Failure, TrackPoint, metres_from
from aerokit.sim.vehicle import SimulatedVehicle

_ON_GROUND_M = 0.3


class Track(Sequence[TrackPoint]):
    """What was flown, oldest first; it grows while the vehicle lives.

    Assertions raise AssertionError; a track without a point fails them all.
    """

    def __init__(self, home: Position, points: Sequence[TrackPoint] = (), *, name: str = "track") -> None:
        self.home = home
        """Where it was switched on."""
        self.name = name
        """In the legend of a picture."""
        self.failure: Failure | None = None
        """Of the last assertion that failed."""
        self._points = list(points)
        self._catch_up: Callable[[], None] | None = None

    def __len__(self) -> int:
        return len(self._until_now())

    def __iter__(self) -> Iterator[TrackPoint]:
        return iter(tuple(self._until_now()))

    @overload
    def __getitem__(self, index: int) -> TrackPoint: ...
    @overload
    def __getitem__(self, index: slice) -> list[TrackPoint]: ...
    def __getitem__(self, index: int | slice) -> TrackPoint | list[TrackPoint]:
        return self._until_now()[index]

    def append(self, point: TrackPoint) -> None:
        """Add the next point, in the place of the last one if it is of the same time."""
        if self._points and self._points[-1].time_s >= point.time_s:
            self._points.pop()
        self._points.append(point)

    def follow(self, catch_up: Callable[[], None] | None) -> None:
        """Call this before the track is read: it appends what happened up to now. None: nothing more happens."""
        self._catch_up = catch_up

    def _until_now(self) -> list[TrackPoint]:
        if self._catch_up is not None:
            self._catch_up()
        return self._points

    @property
    def end(self) -> TrackPoint:
        """The latest point; AssertionError without any."""
        points = self._until_now()
        assert points, "nothing was recorded: was the flight opened?"
        return points[-1]

    @property
    def max_altitude_m(self) -> float:
        """The highest that it was above home."""
        return self._highest().altitude_m

    @property
    def max_distance_m(self) -> float:
        """The farthest that it was from home, along the ground."""
        return self._farthest(self.home)[0]

    @property
    def modes(self) -> list[str]:
        """The modes in their order, each change once."""
        modes: list[str] = []
        for point in self:
            if not modes or modes[-1] != point.mode:
                modes.append(point.mode)
        return modes

    @property
    def armed_s(self) -> float:
        """For how many simulated seconds it was armed."""
        return sum(after.time_s - before.time_s for before, after in pairwise(self) if before.armed)

    @property
    def max_speed_m_s(self) -> float:
        """The fastest that it was over the ground."""
        return self._fastest().speed_m_s

    @property
    def battery_used_percent(self) -> float:
        """Of a full battery; below 0 if it was charged."""
        return self[0].battery_percent - self.end.battery_percent if self else 0.0

    @property
    def length_m(self) -> float:
        """The way that was covered, climbs included."""
        return sum(math.dist(one, other) for one, other in pairwise(self.local()))

    def local(self, origin: Position | None = None) -> list[tuple[float, float, float]]:
        """Metres north and east of a place, of home without one, and up from its own home."""
        plane = metres_from(self.home if origin is None else origin)
        return [(*plane(point), point.altitude_m) for point in self]

    def as_it_is(self) -> Track:
        """A copy that does not grow."""
        track = Track(self.home, tuple(self), name=self.name)
        track.failure = self.failure
        return track

    def save(self, path: str | PathLike[str]) -> None:
        """Draw it: an .svg file, or a .png one; see `aerokit.sim.picture.save_picture`."""
        save_picture([self], path)

    def nearest_m(self, place: Position) -> float:
        """How near it came to a place: along the ground, or in space if the place has an altitude above home."""
        return self._nearest(place)[0]

    def assert_reached_altitude(self, altitude_m: float, *, within_m: float = 1.0) -> None:
        """It was at least ``altitude_m - within_m`` metres above home once."""
        __tracebackhide__ = True
        highest = self._highest()
        reached = highest.altitude_m >= altitude_m - within_m
        self._note(reached, Failure(highest, altitude_m=altitude_m))
        assert reached, f"it did not reach {altitude_m:g} m: the highest point was {highest}"

    def assert_stayed_below(self, altitude_m: float) -> None:
        """It never was more than ``altitude_m`` metres above home."""
        __tracebackhide__ = True
        highest = self._highest()
        self._note(highest.altitude_m <= altitude_m, Failure(highest, altitude_m=altitude_m))
        assert highest.altitude_m <= altitude_m, f"it rose above {altitude_m:g} m: {highest}"

    def assert_passed(self, place: Position, *, within_m: float = 2.0) -> None:
        """It came this near to a place; in space if the place has an ``altitude_relative_m``."""
        __tracebackhide__ = True
        distance, point = self._nearest(place)
        self._note(distance <= within_m, Failure(point, (place, within_m)))
        assert distance <= within_m, (
            f"it did not pass within {within_m:g} m of {_text(place)}: the nearest was {distance:.1f} m, {point}"
        )

    def assert_stayed_within(self, radius_m: float, *, of: Position | None = None) -> None:
        """It was never farther than this from home, or from a place, along the ground."""
        __tracebackhide__ = True
        centre = self.home if of is None else of
        distance, point = self._farthest(centre)
        name = "home" if of is None else _text(of)
        self._note(distance <= radius_m, Failure(point, (centre, radius_m)))
        assert distance <= radius_m, (
            f"it left the {radius_m:g} m around {name}: {distance:.1f} m away {point}"
        )

    def assert_stayed_inside(self, polygon: Sequence[Position]) -> None:
        """It never left a polygon of three places or more; the last is connected with the first."""
        __tracebackhide__ = True
        assert len(polygon) >= 3, f"a polygon has three places or more, not {len(polygon)}"
        _ = self.end
        plane = metres_from(self.home)
        border = PolygonZone([plane(corner) for corner in polygon])
        outside = [point for point in self if border.outside_m(plane(point)) > 0]
        self._note(not outside, Failure(outside[0] if outside else self.end, polygon=polygon))
        assert not outside, (
            f"it left the polygon, {len(outside)} of {len(self)} points are outside; first {outside[0]}"
        )

    def assert_stayed_slower_than(self, speed_m_s: float) -> None:
        """It never was faster than this over the ground."""
        __tracebackhide__ = True
        fastest = self._fastest()
        self._note(fastest.speed_m_s <= speed_m_s, Failure(fastest))
        assert fastest.speed_m_s <= speed_m_s, (
            f"it was faster than {speed_m_s:g} m/s: {fastest.speed_m_s:.1f} m/s {fastest}"
        )

    def assert_landed_near(self, place: Position | None = None, *, within_m: float = 2.0) -> None:
        """It flew, and at the end it stands on the ground near home, or near a place."""
        __tracebackhide__ = True
        end, target = self.end, self.home if place is None else place
        self._note(self.max_altitude_m > _ON_GROUND_M, Failure(end))
        assert self.max_altitude_m > _ON_GROUND_M, f"it never took off: it ended {end}"
        self._note(abs(end.altitude_m) <= _ON_GROUND_M, Failure(end, (target, within_m)))
        assert abs(end.altitude_m) <= _ON_GROUND_M, f"it is not on the ground: it ended {end}"
        distance = target.distance_to(end.position)
        name = "home" if place is None else _text(place)
        self._note(distance <= within_m, Failure(end, (target, within_m)))
        assert distance <= within_m, (
            f"it landed {distance:.1f} m from {name}, not within {within_m:g} m: {end}"
        )

    def assert_armed_at_end(self) -> None:
        """Its motors were armed at the end."""
        __tracebackhide__ = True
        self._note(self.end.armed, Failure(self.end))
        assert self.end.armed, f"it ended disarmed, {self.end}"

    def assert_disarmed_at_end(self) -> None:
        """Its motors were disarmed at the end."""
        __tracebackhide__ = True
        self._note(not self.end.armed, Failure(self.end))
        assert not self.end.armed, f"it ended armed, {self.end}"

    def assert_modes(self, *names: str) -> None:
        """It went through these modes in this order; there may have been others between them."""
        __tracebackhide__ = True
        modes = iter(self.modes)
        for name in names:
            assert name in modes, (
                f"{name} is missing in {' → '.join(names)}: the modes were {' → '.join(self.modes)}"
            )

    def _note(self, holds: bool, failure: Failure) -> None:
        """Keep what the assertion that comes next fails on, if it does."""
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
    """Where a vehicle really is now, and how it is; InvalidArgument for one that has no such place."""
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
    """Note from now on where a vehicle is, every ``interval_s`` simulated seconds; reboots do not end it.

    The vehicle's own timers do it; neither its bytes nor its noise change by that. Raises InvalidArgument for a
    vehicle that has no true place, and for an interval that is not above 0.
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

    vehicle.when_powered_on(begin)
    return track


def least_distance_m(one: Track, other: Track) -> tuple[float, float]:
    """How near two vehicles came to each other, in space, and at which simulated second; (infinity, 0) if they never
    lived at the same time.
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
    """From the origin to the line between two points."""
    way = [b - a for a, b in zip(start, end, strict=True)]
    square = sum(part * part for part in way)
    share = 0.0 if square == 0.0 else -sum(a * part for a, part in zip(start, way, strict=True)) / square
    share = max(0.0, min(1.0, share))
    return math.hypot(*(a + share * part for a, part in zip(start, way, strict=True)))
