"""`RoundFlight`: flies around a place by a command to the firmware or by set-points, and counts the rounds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import anyio

from aerokit._internal import geo
from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout, SetpointStreamStopped
from aerokit.mavlink.messages import OrbitExecutionStatus
from aerokit.vehicle.commanding.closed_paths import PathSetpoints
from aerokit.vehicle.commanding.guided import Guided
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S, CircleDetector, StallDetector, await_progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Mode
    from aerokit.position import Position
    from aerokit.vehicle.commanding.closed_paths import ClosedPath, LobeCounter, TurnCounter, Vector
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order

# Seconds between computed set-points, rate in Hz at which the latest one is sent, and seconds for which it stays valid.
SETPOINT_INTERVAL_S, SETPOINT_RATE_HZ, VALID_FOR_S = 0.1, 20.0, 1.0
RADIUS_ERROR_M = 0.5
"""Deviation in metres from which a reported radius counts as wrong."""
CIRCLE_REPORT_S = 2.0
"""Seconds after the command in which PX4 may still report the previous circle, or refuse the new one by a text."""
LAG_ROUNDS = 0.02
"""Fraction of a round by which the count may lag although the vehicle is at the end of its path."""
END_TIMEOUT_S = 15.0
"""Seconds to reach the end of a path after its last set-point."""
FRAME_TIMEOUT_S = 5.0
"""Seconds to wait for a new position in each frame, because set-points are in the local frame."""


class FlightLimits(NamedTuple):
    """Limits of a flight; see :meth:`aerokit.Vehicle.orbit`."""

    max_distance_m: float
    timeout: float | None
    max_silence_s: float | None


class RoundFlight:
    """One flight to a place, and around it if there is a ``counter`` of rounds.

    The flight ends after ``rounds`` rounds; None: when it is cancelled. ``center_name`` is the name of the place for
    error texts. The constructor checks the place, and that the vehicle is flying.
    """

    def __init__(
        self,
        context: VehicleContext,
        operation: str,
        center: Position,
        counter: TurnCounter | LobeCounter | None,
        rounds: float | None,
        limits: FlightLimits,
        *,
        center_name: str = "center",
    ) -> None:
        self._context = context
        self._session = context.session
        self._telemetry = context.session.telemetry
        self._operation = operation
        self._counter = counter
        self._circle = CircleDetector(context.session)
        self._rounds = math.inf if rounds is None else rounds
        self._limits = limits
        # Error text if the vehicle flies another circle than the ordered one; `fly_by_command` then orders a hold.
        self._circle_problem = ""
        position = context.vehicle_position
        # The frame, x, y and z of a COMMAND_INT to the center.
        self._place_fields = position.command_int_place(center, center_name)
        self._center = position.with_sent_altitude(center)
        position.check_reach(center_name, [center], limits.max_distance_m)
        position.check_flying(operation)

    @property
    def bearing_rad(self) -> float:
        """Bearing from the center to the vehicle."""
        north, east = self._offset(self._telemetry.position.fresh(POSITION_MAX_AGE_S))
        return math.atan2(east, north)

    # ------------------------------------------------------------------- by a command of the firmware

    async def fly_by_command(
        self,
        command: int,
        params: tuple[float, ...],
        mode: Mode,
        *,
        holds_at_end: bool,
        stay_s: float = 0.0,
        radius_m: float = 0.0,
    ) -> None:
        """Send the command. Returns ``stay_s`` seconds after the last round; without rounds, after the arrival.

        With ``holds_at_end``, aerokit then orders a hold. Otherwise the vehicle stays, circling or hovering.
        ``radius_m`` is the ordered radius; 0 if the command has none.
        """
        context, cleanup = self._context, self._context.flight_cleanup
        hold_mode = context.sender.mode_for(self._operation, "hold")
        order = context.arbiter.order(mode, hold_mode)
        try:
            with cleanup.holding_if_abandoned(order):
                with context.arbiter.changing_mode():
                    send = self._session.commands.send_int
                    await context.sender.run_command(order, send, command, *params, modes=(mode,), **self._place_fields)
                self._center = context.vehicle_position.with_amsl_altitude(self._center)
                with self._session.streaming("position"):
                    await self._await_rounds(order, mode, stay_s, radius_m)
                if holds_at_end:
                    await cleanup.stop_in(hold_mode, order)
            if radius_m and not holds_at_end:
                context.vehicle_position.record_circle_radius(radius_m)
        except OperationRejected:
            if self._circle_problem:
                cleanup.hold_in_background(order)
            raise

    async def _await_rounds(self, order: Order, mode: Mode, stay_s: float, radius_m: float) -> None:
        session, started = self._session, self._session.connection.now()
        detect_stall, mode_failure = StallDetector(session), self._context.sender.mode_failure(order, mode)
        # Until this time, PX4 may still report the previous circle, or refuse the new one by a status text.
        report_due_at = started + CIRCLE_REPORT_S
        wrong_radius = ""  # error text about the last reported radius; empty if it is the ordered one

        def on_status(status: OrbitExecutionStatus) -> None:
            nonlocal wrong_radius
            flown_m = abs(status.radius)
            wrong_radius = ""
            # PX4 accepts a radius above its limit, but then flies another radius.
            if radius_m > 0 and abs(flown_m - radius_m) > RADIUS_ERROR_M:
                wrong_radius = f"the vehicle flies a circle of {flown_m:.1f} m instead of {radius_m:g} m"

        def failure_reason() -> str | None:
            if reason := mode_failure():
                return reason
            refusal = self._first_refusal(since=order.given_at, until=report_due_at)
            is_radius_reported = session.connection.now() > report_due_at
            reported_problem = refusal or (wrong_radius if is_radius_reported else "")
            self._circle_problem = reported_problem or self._flown_radius_problem(radius_m)
            return self._circle_problem or None

        def stall_reason() -> str | None:
            is_staying = self._rounds == 0 and self._is_in_place
            return None if is_staying else detect_stall()

        detach = session.connection.bus.attach(OrbitExecutionStatus, on_status, system_id=session.system_id)
        try:
            await await_progress(
                session,
                self._operation,
                is_done=lambda: self._are_rounds_flown(started) and not order.end,
                failure_reason=failure_reason,
                describe=self._describe,
                timeout=self._limits.timeout,
                max_silence_s=self._limits.max_silence_s,
                held_for=stay_s,
                stall_reason=stall_reason,
            )
        finally:
            detach()

    def _flown_radius_problem(self, radius_m: float) -> str:
        """Return a text if a plane circles the center, but not near the ordered circle; otherwise an empty one."""
        here = self._telemetry.position.latest
        is_endless = math.isinf(self._rounds)  # The call does not wait for rounds, so any circle will do.
        if self._counter is None or is_endless or radius_m <= 0 or here is None:
            return ""
        if self._counter.is_on_path:
            self._circle = CircleDetector(self._session)  # Only a half circle that never touches the path counts.
            return ""
        if not self._circle.circles(self._center):
            return ""
        # A plane cannot turn more tightly than its speed and its bank angle allow.
        return f"the vehicle flies a circle of {math.hypot(*self._offset(here)):.0f} m instead of {radius_m:g} m"

    def _first_refusal(self, since: float, until: float) -> str:
        """Return the first status text in this time that refuses the circle; empty if there is none."""
        # A later refusal is about something else, e.g. a mission that another ground station uploads.
        texts = [text.text for text in self._telemetry.texts_since(since) if text.at <= until]
        return next(filter(self._session.autopilot.is_refusal, texts), "")

    def _are_rounds_flown(self, started: float) -> bool:
        is_known = self._context.vehicle_position.was_received_since(started)
        if not is_known or self._count_rounds() < self._rounds:
            return False
        return self._rounds > 0 or self._is_in_place

    @property
    def _is_in_place(self) -> bool:
        position = self._context.vehicle_position
        if self._counter is not None:
            return self._counter.is_on_path
        return position.is_at(self._center, self._circle)

    def _count_rounds(self) -> float:
        here = self._telemetry.position.latest
        if self._counter is None or here is None:
            return 0.0
        self._counter.add(*self._offset(here))
        return self._counter.rounds

    def _describe(self) -> str:
        distance_m = self._context.vehicle_position.remaining_distance(self._center)
        flown = "" if self._counter is None else f"{self._counter.rounds:.2f} of {self._rounds:g} rounds were flown, "
        return f"{flown}the vehicle is {distance_m:.1f} m from the place"

    def _offset(self, place: Position) -> Vector:
        """Return how many metres the place is north and east of the center."""
        center = self._center
        return geo.north_east_m(center.latitude_deg, center.longitude_deg, place.latitude_deg, place.longitude_deg)

    # ------------------------------------------------------------------------------ by set-points

    async def fly_by_setpoints(self, path: ClosedPath, speed_m_s: float, facing: str) -> None:
        """Stream the set-points of a path. The end of the stream, or an error before it, orders the vehicle to hold."""
        try:
            with (
                self._session.streaming("position", "local_position"),
                anyio.move_on_after(self._limits.timeout) as scope,
            ):
                mode = self._context.sender.mode_for(self._operation, "setpoint")
                # The stream's order is created before the wait for positions, so that a takeover during it is noticed.
                with self._context.flight_cleanup.preparing_stream(mode) as order:
                    setpoints = await self._path_setpoints(path, speed_m_s, facing)
                await self._stream_to_end(setpoints, order)
        except SetpointStreamStopped as error:
            self._session.end.raise_if_ended()  # After the end, `is_silent` is true whatever stopped the stream.
            error_class = HeartbeatTimeout if self._session.watch.is_silent else OperationRejected
            raise error_class(f"{self._operation}: {error}") from error
        if scope.cancelled_caught:
            raise OperationTimeout(
                f"{self._operation}: not done within {self._limits.timeout:g} s; {self._describe()};"
                f" {self._session.describe_link()}"
            )

    async def _path_setpoints(self, path: ClosedPath, speed_m_s: float, facing: str) -> PathSetpoints:
        position, local_position = self._telemetry.position, self._telemetry.local_position
        # The vehicle's position is known in both frames, so the center can be converted from the global to the local
        # one. Both positions must be new: while the vehicle moves, older ones may belong to different places.
        since = self._session.connection.now()
        await position.wait_until(lambda _: position.updated_at >= since, timeout=FRAME_TIMEOUT_S)
        local = await local_position.wait_until(lambda _: local_position.updated_at >= since, timeout=FRAME_TIMEOUT_S)
        here = position.fresh(POSITION_MAX_AGE_S)
        north, east = self._offset(here)
        up = self._context.vehicle_position.height_above(here, self._center)
        return PathSetpoints(
            path,
            self._rounds,
            speed_m_s,
            initial_offset=(north, east, -up),
            center=(local.north_m - north, local.east_m - east, local.down_m + up),
            heading=self._heading_function(facing),
        )

    def _heading_function(self, facing: str) -> Callable[[Vector, Vector], float | None]:
        initial_deg = self._telemetry.heading_deg.latest

        def heading(place: Vector, velocity: Vector) -> float | None:
            north_m, east_m = place
            north_m_s, east_m_s = velocity
            if facing == "center":  # The place is relative to the center, so the center is in the opposite direction.
                return math.degrees(math.atan2(-east_m, -north_m)) % 360
            if facing == "ahead" and math.hypot(north_m_s, east_m_s) > 0:
                return math.degrees(math.atan2(east_m_s, north_m_s)) % 360
            return initial_deg if facing == "initial" else None

        return heading

    async def _stream_to_end(self, setpoints: PathSetpoints, order: Order) -> None:
        """Stream the set-points until the vehicle has flown all rounds. ``order`` is the stream's steering order."""
        stream = Guided(self._context).trajectory(
            setpoints.advance(seconds=0.0), rate_hz=SETPOINT_RATE_HZ, valid_for_s=VALID_FOR_S, max_lag_s=VALID_FOR_S
        )
        stream._prepared_order = order
        async with stream:
            while not setpoints.is_complete:
                await stream.fly(setpoints.advance(SETPOINT_INTERVAL_S), SETPOINT_INTERVAL_S)
                if setpoints.is_on_path:
                    self._count_rounds()
            # The vehicle follows the set-point with a delay, so it reaches the end later.
            give_up_at = self._session.connection.now() + END_TIMEOUT_S
            while self._count_rounds() < self._rounds - LAG_ROUNDS:
                if self._session.connection.now() > give_up_at:
                    raise OperationTimeout(
                        f"{self._operation}: the vehicle did not follow its set-points; {self._describe()};"
                        f" {self._session.describe_link()}"
                    )
                await stream.fly(setpoints.advance(seconds=0.0), SETPOINT_INTERVAL_S)  # the last set-point again
