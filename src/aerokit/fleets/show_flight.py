"""``Shows``: flies the trajectories of a show on a common clock, and reports the deviations.

The clocks of the vehicles are measured with TIMESYNC (https://mavlink.io/en/services/timesync.html).
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.values import Snapshot
from aerokit.errors import OperationRejected, OperationTimeout, StaleValueError
from aerokit.fleets.distances import LocalOrigin, altitude_amsl
from aerokit.fleets.formation import follow_velocity
from aerokit.fleets.members import Member
from aerokit.fleets.paths import Path, vector_between
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import METRES_PER_DEGREE, find_conflicts, resting_paths
from aerokit.fleets.show import Show, state_at
from aerokit.fleets.travel import Travel, stationary_members
from aerokit.mavlink.messages import GlobalPositionInt, Timesync
from aerokit.position import Position
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.state.movement import valid_coordinates

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from typing_extensions import Self

    from aerokit.connection.bus import Detach
    from aerokit.fleets.paths import LocalPoint
    from aerokit.vehicle.vehicle import Vehicle

    TrackSample = tuple[float, LocalPoint]  # seconds since the start of the show, and metres north, east and up

__all__ = ["ClockOffset", "ShowReport", "TrackDeviation", "max_relative_error", "measure_clock", "track_deviation"]

# Speed of the correction towards the track, per metre of deviation, in 1/s.
TRACK_GAIN = 0.8

# The speed limit is max(CATCH_UP_M_S, CATCH_UP_FACTOR * speed of the track) + CATCH_UP_M_S. A member can
# therefore catch up even where the track rests.
CATCH_UP_FACTOR, CATCH_UP_M_S = 1.5, 1.0

# Maximum delay of a member that joins its track. The comparison of the tracks allows for this delay.
CONFLICT_SLACK_S = 0.5

POSITION_MAX_AGE_S = 2.0


# ------------------------------------------------------------------------------------------ clocks

TIMESYNC_INTERVAL_S = 0.1
TIMESYNC_TIMEOUT_S = 2.0

# TIMESYNC gives the offset by which `time_boot_ms` is converted to the event loop's time. If the converted time differs
# by more than this from the time of arrival, the vehicle uses different clocks for `time_boot_ms` and TIMESYNC.
MAX_CLOCK_ERROR_S = 1.0


class ClockOffset(Snapshot):
    """The offset of a vehicle's clock: its time minus that of the event loop's clock.

    The offset is accurate to half of ``round_trip_s``, the shortest round trip. ``answers`` is the number of answers.
    """

    offset_s: float
    round_trip_s: float
    answers: int

    def to_local_time(self, vehicle_time_s: float) -> float:
        """Convert a time on the vehicle's clock to the event loop's clock."""
        return vehicle_time_s - self.offset_s


async def measure_clock(vehicle: Vehicle, *, requests: int = 8) -> ClockOffset:
    """Measure the offset of a vehicle's clock by TIMESYNC. The request with the shortest round trip counts.

    Raises:
        OperationTimeout: no request was answered.
        ConnectionClosed, LinkLost: the connection ended.
    """
    connection = vehicle.connection
    sent_at_by_timestamp: dict[int, float] = {}
    measurements: list[tuple[float, float]] = []  # pairs of round trip and offset, in seconds

    def on_timesync(message: Timesync) -> None:
        frame = message.received_frame
        is_answer = message.tc1 != 0
        # Other components of the vehicle answer the same requests, by their own clocks.
        if frame is None or not is_answer or frame.component_id != vehicle.component_id:
            return
        sent_at = sent_at_by_timestamp.pop(message.ts1, None)
        if sent_at is None:
            return
        round_trip_s = frame.received_at - sent_at
        answered_at = sent_at + round_trip_s / 2  # Both directions are assumed to take the same time.
        offset_s = message.tc1 / 1e9 - answered_at
        measurements.append((round_trip_s, offset_s))

    detach = connection.bus.attach(Timesync, on_timesync, system_id=vehicle.system_id)
    try:
        for _ in range(requests):
            now = connection.now()
            timestamp = int(now * 1e9) | 1  # odd, so that it usually differs from that of a `LinkProbes` request
            sent_at_by_timestamp[timestamp] = now
            connection.send(Timesync(tc1=0, ts1=timestamp), to=vehicle.system_id)
            await anyio.sleep(TIMESYNC_INTERVAL_S)
        deadline = connection.now() + TIMESYNC_TIMEOUT_S
        while sent_at_by_timestamp and not measurements and connection.now() < deadline:
            connection.raise_if_ended()
            await anyio.sleep(TIMESYNC_INTERVAL_S)
    finally:
        detach()
    if not measurements:
        raise OperationTimeout(f"the vehicle did not answer TIMESYNC; {vehicle.describe_link()}")
    round_trip_s, offset_s = min(measurements)  # the measurement with the shortest round trip is the most accurate
    return ClockOffset(offset_s, round_trip_s, answers=len(measurements))


# ------------------------------------------------------------------------------------------ report

# A member's lag behind its track is computed from faster legs only. On slower legs, it looks like a position error.
MIN_LAG_SPEED_M_S = 0.3

RELATIVE_ERROR_SAMPLES = 60


class TrackDeviation(Snapshot):
    """Deviation of one member from its track: maximum and root mean square in metres, and lag in seconds.

    ``lag_s`` is the delay that explains most of the deviation (negative: early); None if the member hardly moved.
    """

    max_m: float
    rms_m: float
    lag_s: float | None
    samples: int


class ShowReport(Snapshot):
    """Result of a show. Positions were timed by the vehicles' own clocks; ``clocks`` has the offsets of these clocks.

    ``lag_spread_s`` is the difference between the largest and the smallest ``lag_s`` of the tracks, None if unknown.
    ``max_relative_error_m`` is the largest difference between the actual and the planned vector from one member to
    another, None if unknown.
    """

    result: FleetResult
    tracks: Mapping[str, TrackDeviation]
    clocks: Mapping[str, ClockOffset]
    lag_spread_s: float | None
    max_relative_error_m: float | None


def track_deviation(path: Path, samples: Sequence[TrackSample]) -> TrackDeviation:
    """Compare a path with measured positions.

    The lag is the time by which the path must be delayed to fit the samples best (least squares along the track).
    """
    errors: list[float] = []
    # A lag causes an error vector of lag × velocity. The lag that fits best is sum(error · velocity) / sum(velocity²).
    error_times_velocity = 0.0
    velocity_squared = 0.0
    for at_s, point in samples:
        planned, velocity = state_at(path, at_s)
        error = vector_between(point, planned)
        errors.append(math.hypot(*error))
        if math.hypot(*velocity) >= MIN_LAG_SPEED_M_S:
            error_times_velocity += sum(e * v for e, v in zip(error, velocity, strict=True))
            velocity_squared += sum(v * v for v in velocity)
    if not errors:
        return TrackDeviation(max_m=math.nan, rms_m=math.nan, lag_s=None, samples=0)
    rms = math.sqrt(sum(error * error for error in errors) / len(errors))
    lag_s = error_times_velocity / velocity_squared if velocity_squared else None
    return TrackDeviation(max_m=max(errors), rms_m=rms, lag_s=lag_s, samples=len(errors))


def max_relative_error(
    paths: Mapping[str, Path], samples: Mapping[str, Sequence[TrackSample]], duration_s: float
) -> float | None:
    """Return the largest difference, in metres, between the planned and the flown vector from one vehicle to another.

    Positions are compared at 61 moments of the show, interpolated between samples. Return None if no two vehicles have
    samples around the same moment.
    """
    largest_m: float | None = None
    for index in range(RELATIVE_ERROR_SAMPLES + 1):
        at_s = duration_s * index / RELATIVE_ERROR_SAMPLES
        errors: list[LocalPoint] = []
        for name, path in paths.items():
            point = _interpolate(samples.get(name, ()), at_s)
            if point is not None:
                errors.append(vector_between(point, state_at(path, at_s).place))
        if len(errors) > 1:
            relative_errors = (math.dist(first, second) for first, second in combinations(errors, 2))
            largest_m = max(largest_m or 0.0, *relative_errors)
    return largest_m


def _interpolate(samples: Sequence[TrackSample], at_s: float) -> LocalPoint | None:
    """Return the position at a time between two samples; None if there are no such samples."""
    for (start_s, start), (end_s, end) in pairwise(samples):
        if start_s <= at_s <= end_s:
            fraction = 0.0 if end_s == start_s else (at_s - start_s) / (end_s - start_s)
            north, east, up = (a + fraction * (b - a) for a, b in zip(start, end, strict=True))
            return north, east, up
    return None


# ------------------------------------------------------------------------------------------ flight


class TrackRecorder:
    """Records a vehicle's track while the recorder's ``with`` block runs, from GLOBAL_POSITION_INT.

    Times are ``time_boot_ms``, converted by the clock offset that TIMESYNC has measured. If TIMESYNC turns out to use
    another clock than ``time_boot_ms``, the times at which the messages arrived are used instead.
    """

    def __init__(self, vehicle: Vehicle, clock: ClockOffset, origin: LocalOrigin, begin_at: float) -> None:
        self._vehicle, self._clock, self._begin_at = vehicle, clock, begin_at
        position = origin.to_position((0.0, 0.0, 0.0))
        self._latitude, self._longitude = position.latitude_deg, position.longitude_deg
        self._altitude_amsl_m = position.altitude_amsl_m or 0.0
        metres_per_degree = _metres_per_degree(origin, self._latitude, self._longitude)
        self._metres_per_latitude_degree, self._metres_per_longitude_degree = metres_per_degree
        self.samples: list[TrackSample] = []
        self._latest: tuple[float, LocalPoint, LocalPoint] | None = None  # time, position and velocity
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._vehicle.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._on_message, system_id=self._vehicle.system_id)
        return self

    def __exit__(self, *_: object) -> None:
        if self._detach is not None:
            self._detach()

    @property
    def has_position(self) -> bool:
        return self._latest is not None

    def extrapolated_position(self) -> LocalPoint:
        """Return the latest position, extrapolated to now by its velocity.

        Raises StaleValueError if no position was received in the last two seconds.
        """
        if self._latest is not None:
            measured_at, (north, east, up), (north_m_s, east_m_s, up_m_s) = self._latest
            age = self._vehicle.connection.now() - measured_at
            if age <= POSITION_MAX_AGE_S:
                return north + age * north_m_s, east + age * east_m_s, up + age * up_m_s
        raise StaleValueError(f"no GLOBAL_POSITION_INT was received in the last {POSITION_MAX_AGE_S:g} s")

    def _on_message(self, message: GlobalPositionInt) -> None:
        frame = message.received_frame
        if frame is None or frame.component_id != self._vehicle.component_id:
            return
        coordinates = valid_coordinates(message.lat, message.lon)
        if coordinates is None:  # A member that lost its position must not fly towards its track from 0°N 0°E.
            return
        latitude, longitude = coordinates
        measured_at = self._clock.to_local_time(message.time_boot_ms / 1000)
        if abs(measured_at - frame.received_at) > MAX_CLOCK_ERROR_S:  # TIMESYNC uses another clock of the vehicle.
            measured_at = frame.received_at
        place = (
            (latitude - self._latitude) * self._metres_per_latitude_degree,
            math.remainder(longitude - self._longitude, 360.0) * self._metres_per_longitude_degree,
            message.alt / 1000 - self._altitude_amsl_m,
        )
        self._latest = measured_at, place, (message.vx / 100, message.vy / 100, -message.vz / 100)
        if measured_at >= self._begin_at:
            self.samples.append((measured_at - self._begin_at, place))


def _metres_per_degree(origin: LocalOrigin, latitude: float, longitude: float) -> tuple[float, float]:
    """Return the metres per degree of latitude and of longitude near a place."""
    step = 1e-3
    north_m, _, _ = origin.to_local(Position(min(latitude + step, 90.0), longitude), 0.0)
    _, east_m, _ = origin.to_local(Position(latitude, longitude + step), 0.0)
    # At the north pole, a step north has no length.
    return north_m / step or METRES_PER_DEGREE, east_m / step


@checks_arguments
class Shows(Travel):
    """Actions with which a fleet flies shows."""

    def show_start_positions(self, show: Show, origin: Position) -> dict[str, Position]:
        """Return the position of each member at the start of a show.

        Args:
            show: the trajectories.
            origin: position of the show's zero point. Its altitude is ``altitude_amsl_m`` or, if that is None,
                ``altitude_relative_m`` (default 0) above the first member's home.

        Raises:
            InvalidArgument: the name of a track is not that of a member.
            ValueUnknownError: the position of the first member is unknown.
        """
        return self._start_positions(show, self._local_origin(show, origin))

    async def fly_show(
        self,
        show: Show,
        origin: Position,
        *,
        rate_hz: float = 5.0,
        start_in_s: float = 5.0,
        lead_s: float | None = 0.3,
        speed_m_s: float | None = None,
    ) -> ShowReport:
        """Fly a show: all members fly to their first points, start at the same instant, and hold at the end.

        The members have to be in the air. Their clocks are measured with TIMESYNC, so that the report does not count
        the delay of telemetry as a deviation. If a member fails, the fleet's policy decides about the others.

        A fleet with a ``min_distance_m`` compares the tracks first. A member that would join its track more than half a
        second late, for example because the event loop was blocked, fails and holds.

        Args:
            show: tracks with the names of members; :meth:`Show.renamed` assigns tracks to members.
            origin: position of the show's zero point. Its altitude is ``altitude_amsl_m`` or, if that is None,
                ``altitude_relative_m`` (default 0) above the first member's home.
            rate_hz: set-points per second for each member, 2 to 50.
            start_in_s: seconds from the arrival of the last member at its first point to the start, 0 to 3600.
            lead_s: seconds by which velocities are sent early, to compensate for the vehicles' reaction time (``lag_s``
                in the report), 0 to 10; None: 0.
            speed_m_s: ground speed to the first points in m/s; None: unchanged.

        Raises:
            InvalidArgument: a track has no member, or an argument is out of range. Nothing was sent.
            OperationRejected: tracks come too close to each other or to a member without a track, or a member is
                unavailable; nothing was sent. Or a member became unavailable or got another order before all were at
                their first points; the show was not started.
            FleetError: a member did not answer TIMESYNC or did not reach its first point. The show was not started.
            ValueUnknownError: the position of a member is unknown.
        """
        check_range("rate_hz", rate_hz, 2, 50)
        check_range("start_in_s", start_in_s, 0, 3600)
        check_range("lead_s", lead_s or 0.0, 0, 10)
        local_origin = self._local_origin(show, origin)
        self._check_show(show, local_origin)
        names = tuple(show.tracks)
        orders_before = {name: self._context.newest_orders(self.members[name]) for name in names}
        clocks: FleetResult = await self._run("clocks", lambda member: measure_clock(member.vehicle), names=names)
        clocks.raise_for_errors()
        self._check_not_ordered_since(orders_before, "fly_show", "the show was not started")
        start_positions = self._start_positions(show, local_origin)
        arrived = await self.go_to(start_positions, speed_m_s=speed_m_s)
        arrived.raise_for_errors()
        for name in names:
            self._check_available(self.members[name], "fly_show", "the show was not started")
        self._check_not_ordered_since(arrived._final_orders, "fly_show", "the show was not started")
        begin_at = self._context.now() + start_in_s
        max_late_s = math.inf if self._context.min_distance_m is None else CONFLICT_SLACK_S
        recorders: dict[str, TrackRecorder] = {}
        with ExitStack() as stack:
            for name in names:
                vehicle = self.members[name].vehicle
                recorder = TrackRecorder(vehicle, clocks[name], local_origin, begin_at)
                recorders[name] = stack.enter_context(recorder)

            async def fly(member: Member) -> None:
                track, recorder = show.tracks[member.name], recorders[member.name]
                await _fly_track(
                    member, track, recorder, begin_at, rate_hz=rate_hz, lead_s=lead_s or 0.0, max_late_s=max_late_s
                )

            result = await self._run("show", fly, names=names)
        return _report(show, result, clocks, {name: recorder.samples for name, recorder in recorders.items()})

    # --------------------------------------------------------------------------------------- private

    def _local_origin(self, show: Show, origin: Position) -> LocalOrigin:
        self._check_members("show", show.tracks)
        if origin.altitude_amsl_m is not None:
            return LocalOrigin(origin, origin.altitude_amsl_m)
        first_member = self.members[next(iter(show.tracks))]  # its home defines the altitude
        above_home = origin.replace(altitude_relative_m=origin.altitude_relative_m or 0.0)
        return LocalOrigin(origin, altitude_amsl(first_member, above_home))

    @staticmethod
    def _start_positions(show: Show, origin: LocalOrigin) -> dict[str, Position]:
        return {name: origin.to_position(track.points[0].place) for name, track in show.tracks.items()}

    def _check_show(self, show: Show, origin: LocalOrigin) -> None:
        for name in show.tracks:
            self._check_available(self.members[name], "fly_show", "nothing was sent")
        min_m = self._context.min_distance_m
        if min_m is None:
            return
        stationary = stationary_members(self._context.members, origin, moving=show.tracks)
        tracks = [track.replace(name=name) for name, track in show.tracks.items()]
        paths = [*tracks, *resting_paths(stationary)]
        conflicts = [
            conflict
            for conflict in find_conflicts(paths, min_m, slack_s=CONFLICT_SLACK_S)
            if conflict.name not in stationary  # Two members that stay where they are need no check.
        ]
        if conflicts:
            conflict = conflicts[0]
            more = f" (and {len(conflicts) - 1} more pairs)" if len(conflicts) > 1 else ""
            raise OperationRejected(
                f"fly_show: {conflict.name} and {conflict.other} come within {conflict.distance_m:.1f} m of each"
                f" other{more}, closer than the minimum of {min_m:g} m; nothing was sent"
            )


def _report(
    show: Show, result: FleetResult, clocks: FleetResult, samples: Mapping[str, Sequence[TrackSample]]
) -> ShowReport:
    tracks = {name: track_deviation(path, samples[name]) for name, path in show.tracks.items()}
    lags = [track.lag_s for track in tracks.values() if track.lag_s is not None]
    return ShowReport(
        result=result,
        tracks=tracks,
        clocks={name: offset for name, offset in clocks.items() if isinstance(offset, ClockOffset)},
        lag_spread_s=max(lags) - min(lags) if lags else None,
        max_relative_error_m=max_relative_error(show.tracks, samples, show.duration_s),
    )


async def _fly_track(
    member: Member,
    path: Path,
    recorder: TrackRecorder,
    begin_at: float,
    *,
    rate_hz: float,
    lead_s: float,
    max_late_s: float,
) -> None:
    vehicle, period_s = member.vehicle, 1 / rate_hz
    with vehicle._session.streaming("position"):
        async with vehicle.guided.velocity(rate_hz=rate_hz) as stream:
            late_s = vehicle.connection.now() - begin_at - path.begins_at_s
            # A late member would fly to its track on a way that was not compared with the other tracks.
            if late_s > max_late_s:
                raise OperationRejected(f"show: {member.name} would join its track {late_s:.1f} s late, so it holds")
            # Later delays are not checked here: if the event loop is blocked, the stream stops by itself.
            while (at_s := vehicle.connection.now() - begin_at) < path.ends_at_s:
                # Before the start, a member waits for its first position. Later, a missing position is an error.
                if at_s < 0 and not recorder.has_position:
                    stream.set(VelocitySetpoint())
                else:
                    stream.set(_setpoint(path, at_s, lead_s, recorder.extrapolated_position()))
                await anyio.sleep(period_s)


def _setpoint(path: Path, at_s: float, lead_s: float, position: LocalPoint) -> VelocitySetpoint:
    """Return the velocity of the path at ``at_s + lead_s``, corrected for the deviation at ``at_s``."""
    velocity = state_at(path, at_s + lead_s).velocity
    speed = math.hypot(*velocity)
    north, east, up = follow_velocity(
        vector_between(position, state_at(path, at_s).place),
        velocity,
        gain=TRACK_GAIN,
        max_speed_m_s=max(CATCH_UP_FACTOR * speed, CATCH_UP_M_S) + CATCH_UP_M_S,
    )
    return VelocitySetpoint(north, east, -up)
