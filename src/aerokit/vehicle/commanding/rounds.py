"""`RoundFlight`: flies around a place, by a firmware command or by set-points, and counts the rounds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit._internal import geo
from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout, SetpointStreamStopped
from aerokit.mavlink.messages import OrbitExecutionStatus
from aerokit.vehicle.commanding.closed_paths import PathFlight
from aerokit.vehicle.commanding.guided import Guided
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S, StallDetector, await_progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Mode
    from aerokit.position import Position
    from aerokit.vehicle.commanding.closed_paths import ClosedPath, LobeCounter, TurnCounter, Vector
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.guided import SetpointStream
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.commanding.setpoints import TrajectorySetpoint

SETPOINT_INTERVAL_S, SETPOINT_RATE_HZ, VALID_FOR_S = 0.1, 20.0, 1.0
RADIUS_ERROR_M, CIRCLE_REPORT_S = 0.5, 2.0
"""Deviation from which the radius counts as wrong, and seconds for which PX4 may still report the previous circle."""
LAG_ROUNDS = 0.02
"""Fraction of a round that the count may lack although the vehicle is at the end of its path."""
END_TIMEOUT_S = 15.0
"""Seconds to reach the end of a path after its last set-point."""
FRAME_TIMEOUT_S = 5.0
"""Seconds to wait for the local position, because set-points are in the local frame."""


class RoundFlight:
    """One flight around a place, or to it if there is no ``counter``. Without ``rounds`` it goes on until cancelled.

    ``limits`` are max_distance_m, timeout and max_silence_s. The constructor raises if the vehicle cannot fly there.
    """

    def __init__(
        self,
        context: VehicleContext,
        what: str,
        center: Position,
        counter: TurnCounter | LobeCounter | None,
        rounds: float | None,
        limits: tuple[float, float | None, float | None],
    ) -> None:
        self._context, self._session, self._telemetry = context, context.session, context.session.telemetry
        self._what, self._center, self._counter = what, center, counter
        self._rounds = math.inf if rounds is None else rounds
        max_distance_m, self._timeout, self._max_silence_s = limits
        self._wrong_circle = ""
        position = context.vehicle_position
        self._place = position.command_place(center)
        position.check_reach("center", [center], max_distance_m)
        position.check_flying(what)

    @property
    def bearing_rad(self) -> float:
        """Bearing from the center to the vehicle."""
        north, east = self._offset(self._telemetry.position.fresh(POSITION_MAX_AGE_S))
        return math.atan2(east, north)

    # ------------------------------------------------------------------- by a command of the firmware

    async def by_command(
        self,
        command: int,
        params: tuple[float, ...],
        mode: Mode,
        *,
        is_held: bool,
        stay_s: float = 0.0,
        circle_m: float = 0.0,
    ) -> None:
        """Send the command, and wait until the rounds are flown and another ``stay_s`` seconds have passed.

        At the end, the vehicle holds if ``is_held``, or goes on with a circle of radius ``circle_m``.
        """
        context, cleanup = self._context, self._context.flight_cleanup
        hold = context.sender.mode_for(self._what, "hold")
        order = context.arbiter.order(mode, hold)
        try:
            with context.arbiter.changing_mode():
                send = self._session.commands.send_int
                await context.sender.run_command(order, send, command, *params, modes=(mode,), **self._place)
            with cleanup.flying(order), self._session.streaming("position"):
                await self._await_rounds(order, mode, stay_s, circle_m)
            if is_held:
                await cleanup.stop_in(hold, order)
            elif circle_m:
                context.vehicle_position.note_circle(circle_m)
        # The vehicle may have received the command.
        except (anyio.get_cancelled_exc_class(), OperationTimeout):
            cleanup.hold_in_background(order)
            raise
        except OperationRejected:
            if self._wrong_circle:
                cleanup.hold_in_background(order)
            raise

    async def _await_rounds(self, order: Order, mode: Mode, stay_s: float, circle_m: float) -> None:
        session, started = self._session, self._session.connection.now()
        stall, stays = StallDetector(session), self._context.sender.stays_in(order, mode)

        def on_status(status: OrbitExecutionStatus) -> None:
            """Recognise a wrong radius: PX4 accepts a radius above its limit, but flies another one."""
            flown_m = abs(status.radius)
            is_wrong = circle_m and abs(flown_m - circle_m) > RADIUS_ERROR_M
            self._wrong_circle = (
                f"the vehicle flies a circle of {flown_m:.1f} m instead of {circle_m:g} m" if is_wrong else ""
            )

        def trouble() -> str | None:
            refusals = filter(session.autopilot.is_refusal, session.texts_since(order.given_at))
            if refusal := next(refusals, ""):
                self._wrong_circle = refusal
            is_late = session.connection.now() > started + CIRCLE_REPORT_S
            return stays() or refusal or (self._wrong_circle if is_late else None) or None

        detach = session.connection.bus.attach(OrbitExecutionStatus, on_status, system_id=session.system_id)
        try:
            await await_progress(
                session,
                self._what,
                is_done=lambda: self._is_flown_since(started) and not order.end,
                trouble=trouble,
                describe=self._describe,
                timeout=self._timeout,
                max_silence_s=self._max_silence_s,
                held_for=stay_s,
                stillness=lambda: None if not self._rounds and self._is_there else stall(),
            )
        finally:
            detach()

    def _is_flown_since(self, started: float) -> bool:
        is_known = self._context.vehicle_position.is_known_since(started)
        return is_known and self._count() >= self._rounds and (self._rounds > 0 or self._is_there)

    @property
    def _is_there(self) -> bool:
        position = self._context.vehicle_position
        if self._counter is not None:
            return self._counter.is_there
        return position.remaining_distance(self._center) <= position.arrival_radius_m

    def _count(self) -> float:
        here = self._telemetry.position.latest
        if self._counter is None or here is None:
            return 0.0
        self._counter.add(*self._offset(here))
        return self._counter.rounds

    def _describe(self) -> str:
        away_m = self._context.vehicle_position.remaining_distance(self._center)
        done = "" if self._counter is None else f"{self._counter.rounds:.2f} of {self._rounds:g} rounds were flown, "
        return f"{done}the vehicle is {away_m:.1f} m from the place"

    def _offset(self, place: Position) -> Vector:
        center = self._center
        return geo.north_east_m(center.latitude_deg, center.longitude_deg, place.latitude_deg, place.longitude_deg)

    # ------------------------------------------------------------------------------ by set-points

    async def by_setpoints(self, path: ClosedPath, speed_m_s: float, facing: str) -> None:
        """Stream the set-points of a path; leaving the stream makes the vehicle hold."""
        try:
            with self._session.streaming("position", "local_position"), anyio.move_on_after(self._timeout) as scope:
                mode = self._context.sender.mode_for(self._what, "setpoint")
                with self._context.flight_cleanup.preparing(mode) as order:
                    flight = await self._path_flight(path, speed_m_s, facing)
                await self._stream(flight, order)
        except SetpointStreamStopped as error:
            kind = HeartbeatTimeout if self._session.watch.is_silent else OperationRejected
            raise kind(f"{self._what}: {error}") from error
        if scope.cancelled_caught:
            raise OperationTimeout(f"{self._what}: not done within {self._timeout:g} s; {self._describe()}")

    async def _path_flight(self, path: ClosedPath, speed_m_s: float, facing: str) -> PathFlight:
        """Convert the center to the local frame, by the vehicle's present position in both frames."""
        local, since = self._telemetry.local_position, self._session.connection.now()
        place = await local.wait_until(lambda _: local.updated_at >= since, timeout=FRAME_TIMEOUT_S)
        here = self._telemetry.position.fresh(POSITION_MAX_AGE_S)
        north, east = self._offset(here)
        up = self._context.vehicle_position.height_above(here, self._center)
        centre = (place.north_m - north, place.east_m - east, place.down_m + up)
        heading = self._heading(facing)
        return PathFlight(path, self._rounds, speed_m_s, (north, east, -up), centre, heading)

    def _heading(self, facing: str) -> Callable[[Vector, Vector], float | None]:
        initial = self._telemetry.heading_deg.latest

        def heading(place: Vector, velocity: Vector) -> float | None:
            if facing == "center":
                return math.degrees(math.atan2(-place[1], -place[0])) % 360
            if facing == "ahead" and math.hypot(*velocity) > 0:
                return math.degrees(math.atan2(velocity[1], velocity[0])) % 360
            return initial if facing == "initial" else None

        return heading

    async def _stream(self, flight: PathFlight, order: Order) -> None:
        first, limits = flight.advance(0.0), {"valid_for_s": VALID_FOR_S, "max_lag_s": VALID_FOR_S}
        stream = Guided(self._context).trajectory(first, rate_hz=SETPOINT_RATE_HZ, **limits)
        stream._prepared_order = order
        async with stream:
            while not flight.is_complete:
                await self._next(stream, flight.advance(SETPOINT_INTERVAL_S))
                if flight.is_on_path:
                    self._count()
            ends_at = self._session.connection.now() + END_TIMEOUT_S
            while self._count() < self._rounds - LAG_ROUNDS:
                if self._session.connection.now() > ends_at:
                    raise OperationTimeout(
                        f"{self._what}: the vehicle did not follow its set-points; {self._describe()}"
                    )
                await self._next(stream, flight.advance(0.0))

    async def _next(self, stream: SetpointStream[TrajectorySetpoint], setpoint: TrajectorySetpoint) -> None:
        stream.set(setpoint)
        await anyio.sleep(SETPOINT_INTERVAL_S)
