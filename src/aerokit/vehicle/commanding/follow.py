"""`FollowStream`: keeps a vehicle at a fixed offset from a moving target."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterable, Callable
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.connection.tasks import Cancellation
from aerokit.errors import InvalidArgument, NotSupported, OperationRejected, OperationTimeout
from aerokit.position import Position
from aerokit.vehicle.commanding.follow_target import FollowTarget, HasTelemetry
from aerokit.vehicle.commanding.ground import ImpactDetector
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S, VehiclePosition
from aerokit.vehicle.commanding.setpoints import ZERO, PositionSetpoint, SetpointEncoder
from aerokit.vehicle.commanding.streams import SteeringStream

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["FollowStream"]

# The rate of set-points in Hz, and the delay of the event loop in seconds above which the stream stops.
RATE_HZ, MAX_LAG_S = 10.0, 1.0
# Largest distance from the target, and largest height above or below it, at which the vehicle can be ordered to follow.
MAX_DISTANCE_M = 1000.0
MIN_COURSE_SPEED_M_S = 0.5
"""Minimum ground speed at which the course of the target is used."""
MIN_INTERVAL_S = 0.05
"""Minimum seconds between two positions to compute a velocity from them."""
OVERDUE_INTERVALS = 1.5
"""Multiple of the last interval between positions after which a target without a new position counts as stopped."""
MAX_TARGET_SPEED_M_S = 100.0
"""A higher speed between two positions counts as a jump of the target's position."""
POLL_INTERVAL_S = 0.1


class FollowPlace(Snapshot):
    """The follower's place relative to its target; see :meth:`aerokit.Vehicle.follow`."""

    distance_m: float
    bearing_deg: float | None
    from_course: bool
    height_m: float | None
    face_target: bool

    def _check(self) -> None:
        check_range("distance_m", self.distance_m, 0, MAX_DISTANCE_M)
        if self.bearing_deg is not None:
            check_range("bearing_deg", self.bearing_deg, 0, 360)
        if self.height_m is not None:
            check_range("height_m", self.height_m, -MAX_DISTANCE_M, MAX_DISTANCE_M)


class TargetState(Snapshot):
    """Position of the target with its velocity (north, east, down in m/s).

    The same position may be reported several times: first at ``first_reported_at``, and last at ``reported_at``.
    """

    position: Position
    velocity: tuple[float, float, float]
    reported_at: float
    first_reported_at: float


class FollowedTarget:
    """Latest position and velocity of the target. The velocity is reported, or computed from two positions."""

    def __init__(self, target: FollowTarget, now: Callable[[], float]) -> None:
        self._target, self._now = target, now
        self.latest: TargetState | None = None
        # Seconds between the last two different positions.
        self._interval_s = 0.0

    def read(self) -> TargetState | None:
        if isinstance(self._target, HasTelemetry):
            self._read_vehicle(self._target.telemetry)
        elif not isinstance(self._target, AsyncIterable):
            position = self._target()
            if position is not None:
                self.add(position)
        return self.latest

    def _read_vehicle(self, telemetry: Any) -> None:
        position, velocity = telemetry.position, telemetry.velocity.latest
        if position.latest is None or not math.isfinite(position.age):
            return
        # `position.updated_at` is on the clock of the target's connection, which may differ from ours, so the time is
        # computed from the age of the position.
        received_at = self._now() - position.age
        speeds = ZERO
        if velocity is not None and telemetry.velocity.age <= POSITION_MAX_AGE_S:
            speeds = (velocity.north_m_s, velocity.east_m_s, velocity.down_m_s)
        # The altitude above the target's home is left out, because the follower's home may be higher or lower.
        place = position.latest.replace(altitude_relative_m=None)
        self.latest = TargetState(place, speeds, reported_at=received_at, first_reported_at=received_at)

    def add(self, position: object) -> None:
        """Process a position that the program supplied. Raises InvalidArgument if it is not a `Position`."""
        if not isinstance(position, Position):
            raise InvalidArgument(f"position = {short_repr(position)} is not allowed: it must be a Position")
        latest, now = self.latest, self._now()
        if latest is not None and now - latest.reported_at < MIN_INTERVAL_S:
            return  # A velocity computed from two positions in such quick succession would be inexact.
        if latest is None:
            self.latest = TargetState(position, ZERO, reported_at=now, first_reported_at=now)
        elif position == latest.position:  # The program may report the same position several times.
            is_change_overdue = now - latest.first_reported_at > OVERDUE_INTERVALS * self._interval_s
            # If the position should have changed by now, the target has stopped.
            velocity = ZERO if is_change_overdue else latest.velocity
            self.latest = latest.replace(velocity=velocity, reported_at=now)
        else:
            self._interval_s = now - latest.first_reported_at
            velocity = _mean_velocity(latest.position, position, self._interval_s)
            if math.hypot(*velocity) > MAX_TARGET_SPEED_M_S:  # The position has jumped.
                velocity = ZERO
            self.latest = TargetState(position, velocity, reported_at=now, first_reported_at=now)


def _mean_velocity(start: Position, end: Position, seconds: float) -> tuple[float, float, float]:
    """Return the components north, east and down in m/s."""
    distance_m, bearing = start.distance_to(end), math.radians(start.bearing_to(end))
    north_m, east_m = distance_m * math.cos(bearing), distance_m * math.sin(bearing)
    return north_m / seconds, east_m / seconds, VehiclePosition.height_above(start, end) / seconds


@checks_arguments
class FollowStream(SteeringStream[TargetState]):
    """Follows a target while its ``async with`` block runs; opened by :meth:`aerokit.Vehicle.follow`.

    Entering the block waits for the first position of the target, and changes the mode: to GUIDED on ArduPilot, to
    OFFBOARD on PX4. Leaving the block, also by an exception, orders the vehicle to hold. After a newer order, or a
    takeover by a pilot or a failsafe, the stream sends nothing more, not even the hold.

    The stream stops by itself for the same reasons as a :class:`SetpointStream`, except that the vehicle may stay in
    place. It also stops if no new position of the target arrives for ``valid_for_s``, if the source of positions ends
    or raises, or if the target is farther away than ``max_distance_m``. A stop orders the vehicle to hold. ``fly``, or
    else the end of the block, raises :class:`SetpointStreamStopped`.

    Entering raises:
        OperationRejected: the vehicle is not flying (nothing was sent), or its altitude is unknown.
        OperationTimeout: no position of the target was known within ``valid_for_s``.
        InvalidArgument: ``height_m`` was given, but the target has no altitude.

    After these errors, aerokit orders a flying vehicle to hold if it was still executing an earlier order of the
    program.
    """

    _NAME, _VALUE = "following", "position of the target"

    def __init__(
        self,
        context: VehicleContext,
        target: FollowTarget,
        place: FollowPlace,
        valid_for_s: float,
        max_distance_m: float,
    ) -> None:
        check_range("max_distance_m", max_distance_m, place.distance_m, math.inf)
        autopilot = context.session.autopilot
        if getattr(target, "telemetry", None) is context.session.telemetry:
            raise InvalidArgument("target is not allowed: a vehicle cannot follow itself")
        if not (autopilot.setpoints.global_position and autopilot.setpoints.velocity):
            raise NotSupported(
                f"follow: {autopilot.firmware} does not support global position set-points with a velocity;"
                " nothing was sent"
            )
        unknown = TargetState(Position(0.0, 0.0), ZERO, -math.inf, -math.inf)  # replaced when the stream is entered
        super().__init__(context, self._encode_place, unknown, RATE_HZ, valid_for_s=valid_for_s, max_lag_s=MAX_LAG_S)
        self._target = target
        self._tracker = FollowedTarget(target, self._now)
        self._encode_position = SetpointEncoder(context).position
        self._place = place
        self._max_distance_m = max_distance_m
        self._impact = ImpactDetector(context.session.telemetry)
        # Cancels the background task that reads the target, if there is one.
        self._reading: Cancellation | None = None
        # Text that explains why the source of positions ended or failed; empty while it works.
        self._end_reason = ""
        # Set by `__aenter__`: bearing from the target, course of the target, altitude of the follower.
        self._bearing_deg = 0.0
        self._course_deg = 0.0
        self._own_altitude_m = 0.0

    @property
    def target(self) -> Position | None:
        """The latest position of the target; None before the first one."""
        return None if self._tracker.latest is None else self._tracker.latest.position

    @property
    def distance_m(self) -> float:
        """Distance to the target along the ground in metres; infinite while it is unknown."""
        here, target = self._session.telemetry.position.latest, self.target
        return math.inf if here is None or target is None else here.distance_to(target)

    async def fly(self, duration_s: float | None = None) -> None:
        """Follow the target for ``duration_s`` seconds; None: until the stream stops by itself.

        Raises:
            SetpointStreamStopped: the stream has stopped; the error text has the reason.
        """
        ends_at = math.inf if duration_s is None else self._now() + duration_s
        while (remaining_s := ends_at - self._now()) > 0:
            self._raise_if_stopped()
            await anyio.sleep(min(remaining_s, POLL_INTERVAL_S))
        self._raise_if_stopped()

    # ------------------------------------------------------------------------- begin and end

    async def __aenter__(self) -> Self:
        """Wait for the first position of the target, and then begin the stream in the mode for set-points."""
        self._raise_if_entered()
        self._context.vehicle_position.check_flying("follow")
        mode = self._stream_mode()
        self._start_reading()
        try:
            # The base class uses `_prepared_order` to change the mode.
            with self._context.flight_cleanup.preparing_stream(mode) as self._prepared_order:
                self._value = await self._first_state()
                self._choose_place(self._value)
                self._replace_value(self._value)  # Raises for an invalid place before the mode changes.
            return await super().__aenter__()
        except BaseException:
            self._stop_reading()
            raise

    async def __aexit__(self, exc_type: object, exc: BaseException | None, traceback: object) -> None:
        self._stop_reading()
        await super().__aexit__(exc_type, exc, traceback)

    def _start_reading(self) -> None:
        target = self._target
        if isinstance(target, HasTelemetry) or not isinstance(target, AsyncIterable):
            return  # No task is needed: `_tick` reads this target.
        scope = Cancellation()
        self._reading = scope

        async def read() -> None:
            with scope:
                try:
                    positions = aiter(target)
                    try:
                        async for position in positions:
                            self._tracker.add(position)
                    finally:
                        # An invalid position stops the loop, but does not close the program's generator.
                        if isinstance(positions, AsyncGenerator):
                            await positions.aclose()
                    self._end_reason = "the positions of the target ended"
                except Exception as error:
                    self._end_reason = f"the positions of the target raised {error!r}"
                except asyncio.CancelledError:
                    # `_stop_reading` resets `_reading` before it cancels `scope`. If `_reading` is not reset, the
                    # iterator itself has raised CancelledError, because it awaits a cancelled task.
                    if self._reading is scope:
                        self._end_reason = "the reading of the target was cancelled"
                    raise

        self._session.background.start(read, "aerokit follow")

    def _stop_reading(self) -> None:
        if self._reading is not None:
            scope, self._reading = self._reading, None
            scope.cancel()

    async def _first_state(self) -> TargetState:
        deadline = self._now() + self._valid_for_s
        while True:
            self._session.end.raise_if_ended()
            state = self._tracker.read()
            if state is not None and self._now() - state.reported_at <= self._valid_for_s:
                return state
            if self._now() > deadline or self._end_reason:
                reason = self._end_reason or f"no position of the target was known within {self._valid_for_s:g} s"
                raise OperationTimeout(f"follow: {reason}; the stream was not started")
            await anyio.sleep(POLL_INTERVAL_S)

    def _choose_place(self, state: TargetState) -> None:
        """Take the present bearing and altitude where the caller gave none."""
        here, target = self._session.telemetry.position.fresh(POSITION_MAX_AGE_S), state.position
        # Until the target moves, its course is unknown: assume that it moves away from the vehicle.
        self._course_deg = here.bearing_to(target)
        present_bearing_deg = target.bearing_to(here) - self._zero_bearing_deg(state)
        self._bearing_deg = present_bearing_deg if self._place.bearing_deg is None else self._place.bearing_deg
        if self._place.height_m is None:
            if here.altitude_amsl_m is None:
                raise OperationRejected(
                    "follow: the vehicle's altitude above sea level is unknown; the stream was not started"
                )
            self._own_altitude_m = here.altitude_amsl_m
        elif target.altitude_amsl_m is None and target.altitude_relative_m is None:
            raise InvalidArgument(
                f"height_m = {self._place.height_m:g} is not allowed: the target has no altitude;"
                " the stream was not started"
            )

    # ------------------------------------------------------------------------------ the stream

    def _stream_mode(self) -> Mode:
        return self._context.sender.mode_for("follow", "setpoint")

    def _tick(self, due: float) -> None:
        state = None
        try:
            state = self._tracker.read()
        except (Exception, asyncio.CancelledError) as error:
            # The program's function raises CancelledError if it reads the result of a cancelled task.
            self._end_reason = f"the position of the target raised {error!r}"
        if state is not None:
            try:
                self._replace_value(state)
            except Exception as error:
                self._end_reason = f"the vehicle cannot follow the position of the target: {error}"
            else:
                self._set_at = state.reported_at  # A set-point is as old as the target's position.
        super()._tick(due)  # Sends the value, or stops the stream because of `_end_reason`.

    def _stop_reason(self, lag: float) -> str | None:
        if self._end_reason:
            return self._end_reason
        distance_m = self.distance_m  # infinite while it is unknown
        if self._max_distance_m < distance_m < math.inf:
            return f"the target is {distance_m:.0f} m away (max_distance_m = {self._max_distance_m:g})"
        return super()._stop_reason(lag)

    def _zero_bearing_deg(self, state: TargetState) -> float:
        """Return the direction from which bearings are measured: the target's course, or 0 (north)."""
        north_m_s, east_m_s, _ = state.velocity
        if math.hypot(north_m_s, east_m_s) >= MIN_COURSE_SPEED_M_S:
            self._course_deg = math.degrees(math.atan2(east_m_s, north_m_s))
        return self._course_deg if self._place.from_course else 0.0

    def _encode_place(self, state: TargetState) -> Message:
        # The target is assumed to keep its velocity between two positions.
        moved_for_s = max(0.0, min(self._now() - state.first_reported_at, self._valid_for_s))
        north_m_s, east_m_s, down_m_s = state.velocity
        bearing = math.radians(self._zero_bearing_deg(state) + self._bearing_deg)
        distance_m = self._place.distance_m
        goal = state.position.offset(
            north_m=distance_m * math.cos(bearing) + north_m_s * moved_for_s,
            east_m=distance_m * math.sin(bearing) + east_m_s * moved_for_s,
            up_m=(self._place.height_m or 0.0) - down_m_s * moved_for_s,
        )
        if self._place.height_m is None:
            goal = goal.replace(altitude_amsl_m=self._own_altitude_m, altitude_relative_m=None)
            down_m_s = 0.0
        elif goal.altitude_amsl_m is not None:  # The target's relative altitude may refer to another home.
            goal = goal.replace(altitude_relative_m=None)
        bearing_to_target = math.remainder(bearing + math.pi, 2 * math.pi)
        yaw_deg = math.degrees(bearing_to_target) if self._place.face_target else None
        return self._encode_position(PositionSetpoint(goal, yaw_deg), (north_m_s, east_m_s, down_m_s))
