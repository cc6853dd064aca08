"""``Shows``: flying timed trajectories on a common clock, and measuring how well."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument, OperationRejected, StaleValueError
from aerokit.fleets.distances import Around, altitude_amsl
from aerokit.fleets.formation import follow_velocity
from aerokit.fleets.members import Member
from aerokit.fleets.separation import METRES_PER_DEGREE
from aerokit.fleets.shows.clocks import ClockOffset, measure_clock
from aerokit.fleets.shows.show import Show, ShowReport, error_between, state_at, track_error
from aerokit.fleets.travel import Travel
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.position import Position
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.connection.bus import Detach
    from aerokit.fleets.paths import Path, Place
    from aerokit.fleets.policy import FleetResult
    from aerokit.vehicle.vehicle import Vehicle

CLOCK_S = 1.0
"""A time since boot that is farther from when it came, by TIMESYNC, is of another clock."""

OLD_S = 2.0


class FlownTrack:
    """In its block each GLOBAL_POSITION_INT becomes a sample: seconds of the show, and metres from its origin.

    The time is the vehicle's own (``time_boot_ms``) by its measured clock, and where that makes no sense, when it came.
    """

    def __init__(
        self, vehicle: Vehicle, clock: ClockOffset, around: Around, begin: float, base_m: float
    ) -> None:
        self._vehicle, self._clock, self._begin, self._base_m = vehicle, clock, begin, base_m
        origin = around.position((0.0, 0.0, base_m))
        self._latitude, self._longitude = origin.latitude_deg, origin.longitude_deg
        self._north_m, self._east_m = _metres_per_degree(around, self._latitude, self._longitude)
        self.samples: list[tuple[float, Place]] = []
        """Seconds of the show, from its start on, and the place then."""
        self._latest: tuple[float, Place, Place] | None = None
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._vehicle.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._hear, system_id=self._vehicle.system_id)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._detach is not None:
            self._detach()

    @property
    def is_known(self) -> bool:
        """Whether it has told where it is since the block began."""
        return self._latest is not None

    def where_now(self) -> Place:
        """Where it is by now: what it told last, and how far it has flown since.

        Raises:
            StaleValueError: it has not told that for two seconds.
        """
        now = self._vehicle.connection.now()
        if self._latest is None or now - self._latest[0] > OLD_S:
            raise StaleValueError("it does not tell where it is (GLOBAL_POSITION_INT)")
        at, place, velocity = self._latest
        age = now - at
        return place[0] + age * velocity[0], place[1] + age * velocity[1], place[2] + age * velocity[2]

    def _hear(self, message: GlobalPositionInt) -> None:
        frame = message.received_frame
        if frame is None or frame.component_id != self._vehicle.component_id:
            return
        at = self._clock.to_ours(message.time_boot_ms / 1000)
        if abs(at - frame.received_at) > CLOCK_S:
            at = frame.received_at
        place = (
            (message.lat / 1e7 - self._latitude) * self._north_m,
            math.remainder(message.lon / 1e7 - self._longitude, 360.0) * self._east_m,
            message.alt / 1000 - self._base_m,
        )
        self._latest = at, place, (message.vx / 100, message.vy / 100, -message.vz / 100)
        if at >= self._begin:
            self.samples.append((at - self._begin, place))


def _metres_per_degree(around: Around, latitude: float, longitude: float) -> tuple[float, float]:
    """There, to the north and to the east: a show is flown within some hundred metres."""
    from aerokit.position import Position

    step = 1e-3
    north = around.place(Position(min(latitude + step, 90.0), longitude), 0.0)[0] / step
    east = around.place(Position(latitude, longitude + step), 0.0)[1] / step
    return north or METRES_PER_DEGREE, east


GAIN = 0.8

FASTER = 1.5, 1.0
"""To catch up, somebody may fly by so much faster than its track: times, and m/s more."""

SLACK_S = 0.5


@checks_arguments
class Shows(Travel):
    """Trajectories on one clock."""

    def show_starts(self, show: Show, origin: Position) -> dict[str, Position]:
        """Where each has to be at the start of a show.

        Args:
            show: the trajectories.
            origin: where its metres count from; without an altitude above the sea it is at the home of the first.

        Raises:
            InvalidArgument: a track is nobody's.
            ValueUnknownError: it is not known where the first of them is.
        """
        around, base_m = self._stage(show, origin)
        return {
            name: around.position(_raised(each.points[0].place, base_m)) for name, each in show.tracks.items()
        }

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
        """Fly a show: all to their first points, all off at one instant, each along its track; they hold at its end.

        They have to be in the air. The clock of each is measured by TIMESYNC, so that the report says where each was at
        which time of the show by its own clock, however late its telemetry came. When one fails, the others are told
        what the fleet's policy says, as in any common action.

        Args:
            show: member's name → track; :meth:`Show.renamed` gives tracks to members.
            origin: where its metres count from; without an altitude above the sea it is at the home of the first.
            rate_hz: set-points a second for each, 2 to 50.
            start_in_s: seconds from when all are at their first points to the start.
            lead_s: how much earlier each is told its velocity than the track has it: vehicles take a moment to obey,
                and ``lag_s`` in the report says how long. None: not at all.
            speed_m_s: ground speed on the way to the first points; None leaves it.

        Raises:
            InvalidArgument: a track is nobody's, or an argument is out of range. Nothing was sent.
            OperationRejected: tracks come nearer to each other than this fleet allows, or one of its members does not
                take part. Nothing was sent.
            FleetError: one of them did not answer TIMESYNC or did not get to its first point. The show was not begun.
            ValueUnknownError: it is not known where one of them is.
        """
        check_range("rate_hz", rate_hz, 2, 50)
        around, base_m = self._stage(show, origin)
        self._check_show(show)
        names = tuple(show.tracks)
        clocks: FleetResult = await self._run(
            "clocks", lambda member: measure_clock(member.vehicle), names=names
        )
        clocks.raise_for_errors()
        starts = {
            name: around.position(_raised(each.points[0].place, base_m)) for name, each in show.tracks.items()
        }
        arrived = await self.go_to(starts, speed_m_s=speed_m_s)
        arrived.raise_for_errors()
        begin = self._crew.now() + start_in_s
        with ExitStack() as stack:
            flown = {
                name: stack.enter_context(
                    FlownTrack(self.members[name].vehicle, clocks[name], around, begin, base_m)
                )
                for name in names
            }

            async def fly(member: Member) -> None:
                await _fly_track(
                    member, show.tracks[member.name], flown[member.name], begin, rate_hz, lead_s or 0.0
                )

            result = await self._run("show", fly, names=names)
        return _report(show, result, dict(clocks), {name: each.samples for name, each in flown.items()})

    # --------------------------------------------------------------------------------------- inside

    def _stage(self, show: Show, origin: Position) -> tuple[Around, float]:
        """Metres around the origin, and its height above the sea."""
        for name in show.tracks:
            if name not in self.members:
                raise InvalidArgument(f"show: {shown(name)} is not one of {', '.join(self.members)}")
        first = self.members[next(iter(show.tracks))]
        if origin.altitude_amsl_m is not None:
            return Around(origin), origin.altitude_amsl_m
        home = origin.replace(altitude_relative_m=origin.altitude_relative_m or 0.0)
        return Around(origin), altitude_amsl(first, home)

    def _check_show(self, show: Show) -> None:
        for name in show.tracks:
            member = self.members[name]
            member.look()
            if not member.takes_orders:
                why = f"{name} is {member.state.value}: {member.why}"
                raise OperationRejected(f"fly_show: {why}; nothing was sent")
        least_m = self._crew.min_distance_m
        conflicts = () if least_m is None else show.conflicts(least_m, slack_s=SLACK_S)
        if conflicts:
            one = conflicts[0]
            more = f", and so do {len(conflicts) - 1} more pairs" if len(conflicts) > 1 else ""
            raise OperationRejected(
                f"fly_show: {one.name} and {one.other} come within {one.distance_m:.1f} m of each other, nearer than"
                f" {least_m:g} m{more}; nothing was sent"
            )


async def _fly_track(
    member: Member, path: Path, flown: FlownTrack, begin: float, rate_hz: float, lead_s: float
) -> None:
    """By velocities: that of the track, and what brings it to where it should be."""
    vehicle, period_s = member.vehicle, 1 / rate_hz
    with vehicle._talk.streaming("position"):
        async with vehicle.guided.velocity(rate_hz=rate_hz) as stream:
            while (at_s := vehicle.connection.now() - begin) < path.ends_at_s:
                if at_s >= 0 or flown.is_known:
                    stream.set(_wanted(path, at_s, lead_s, flown.where_now()))
                else:
                    stream.set(VelocitySetpoint())
                await anyio.sleep(period_s)


def _wanted(path: Path, at_s: float, lead_s: float, here: Place) -> VelocitySetpoint:
    planned, velocity = state_at(path, at_s)[0], state_at(path, at_s + lead_s)[1]
    limit = max(FASTER[0] * _length(velocity), FASTER[1]) + FASTER[1]
    north, east, up = follow_velocity(
        (planned[0] - here[0], planned[1] - here[1], planned[2] - here[2]),
        velocity,
        gain=GAIN,
        max_speed_m_s=limit,
    )
    return VelocitySetpoint(north, east, -up)


def _report(
    show: Show,
    result: FleetResult,
    clocks: Mapping[str, Any],
    samples: Mapping[str, list[tuple[float, Place]]],
) -> ShowReport:
    tracks = {name: track_error(path, samples[name]) for name, path in show.tracks.items()}
    lags = [each.lag_s for each in tracks.values() if each.lag_s is not None]
    offsets = {name: each for name, each in clocks.items() if isinstance(each, ClockOffset)}
    spread_s = max(lags) - min(lags) if lags else None
    return ShowReport(result, tracks, offsets, spread_s, error_between(show.tracks, samples, show.duration_s))


def _raised(place: Place, by_m: float) -> Place:
    return place[0], place[1], place[2] + by_m


def _length(vector: Place) -> float:
    return float(sum(each * each for each in vector) ** 0.5)
