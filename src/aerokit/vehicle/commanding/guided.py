"""Guided set-points, streamed at a fixed rate while a program supplies them.

An autopilot stops by itself when set-points stop arriving (ArduCopter after 3 s, PX4 after 0.5 s). Resending the last
set-point without limit would defeat that. Here the stream ends, and aerokit orders the vehicle to hold, when the code
that supplies set-points ends, raises, is cancelled, stops supplying them or blocks the event loop, and when the vehicle
falls silent.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Generic, TypeVar

import anyio

from aerokit._internal.arguments import check_kind, check_range, checks_arguments
from aerokit.errors import (
    BusyError,
    NotSupported,
    OperationRejected,
    SetpointStreamStopped,
)
from aerokit.vehicle.commanding.progress import StallDetector
from aerokit.vehicle.commanding.setpoints import (
    AccelerationSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    SetpointEncoder,
    VelocitySetpoint,
    wants_motion,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order

__all__ = ["Guided", "SetpointStream"]

SetpointT = TypeVar("SetpointT")

# A position set-point that restarts the path is sent this many times at once, in case one is lost, then at this
# interval.
INITIAL_REPEATS, REPEAT_INTERVAL_S = 3, 5.0
# Seconds for which the initial set-point is streamed before OFFBOARD is requested: PX4 requires a running
# stream.
OFFBOARD_LEAD_TIME_S = 1.0


@checks_arguments
class Guided:
    """Opens set-point streams: ``async with vehicle.guided.velocity() as stream: stream.set(...)``.

    Every stream takes ``rate_hz`` (transmission rate of the latest set-point, 2 to 100), ``valid_for_s`` (how long a
    set-point may be resent without a new one) and ``max_lag_s`` (how late the event loop may be). NotSupported is
    raised for a kind that this type of vehicle does not support. Rates and seconds are in real time: a simulation at
    ten times the speed needs ten times the rate.
    """

    def __init__(self, context: VehicleContext) -> None:
        self._context = context
        self._encode = SetpointEncoder(context)

    def velocity(
        self,
        initial: VelocitySetpoint = VelocitySetpoint(),
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[VelocitySetpoint]:
        """Stream velocities over ground (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("velocity", self._encode.velocity, initial, rate_hz, valid_for_s, max_lag_s)

    def body_velocity(
        self,
        initial: BodyVelocitySetpoint = BodyVelocitySetpoint(),
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[BodyVelocitySetpoint]:
        """Stream velocities in the body frame (SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_BODY_NED)."""
        return self._stream("velocity", self._encode.body_velocity, initial, rate_hz, valid_for_s, max_lag_s)

    def acceleration(
        self,
        initial: AccelerationSetpoint = AccelerationSetpoint(),
        *,
        rate_hz: float = 20.0,
        valid_for_s: float = 0.5,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[AccelerationSetpoint]:
        """Stream accelerations (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("acceleration", self._encode.acceleration, initial, rate_hz, valid_for_s, max_lag_s)

    def local_position(
        self,
        initial: LocalPositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[LocalPositionSetpoint]:
        """Stream positions in the local frame (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("local position", self._encode.local_position, initial, rate_hz, valid_for_s, max_lag_s)

    def position(
        self,
        initial: PositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[PositionSetpoint]:
        """Stream global positions (SET_POSITION_TARGET_GLOBAL_INT)."""
        return self._stream("global position", self._encode.position, initial, rate_hz, valid_for_s, max_lag_s)

    def attitude(
        self,
        initial: AttitudeSetpoint,
        *,
        rate_hz: float = 50.0,
        valid_for_s: float = 0.3,
        max_lag_s: float = 0.3,
    ) -> SetpointStream[AttitudeSetpoint]:
        """Stream attitudes with thrust (SET_ATTITUDE_TARGET)."""
        return self._stream("attitude", self._encode.attitude, initial, rate_hz, valid_for_s, max_lag_s)

    def _stream(
        self, kind: str, encode: Callable[[SetpointT], Message], initial: SetpointT, *limits: float
    ) -> SetpointStream[SetpointT]:
        autopilot = self._context.session.autopilot
        if kind not in autopilot.setpoints.names:
            obeyed = ", ".join(autopilot.setpoints.names) or "none"
            raise NotSupported(f"{autopilot.firmware} does not support {kind} set-points; supported: {obeyed}")
        return SetpointStream(self._context, encode, initial, *limits)


@checks_arguments
class SetpointStream(Generic[SetpointT]):
    """Sends the latest set-point at a fixed rate while the ``async with`` block supplies set-points.

    Entering the block changes to the set-point mode (GUIDED, OFFBOARD) with the initial set-point. Leaving it in any
    way makes the vehicle hold. The stream stops by itself without a new set-point for ``valid_for_s``, if the event
    loop is late by ``max_lag_s``, if the vehicle leaves the mode, disarms or falls silent, and if it should move but
    stays in place for twelve seconds. Then ``set`` and leaving the block raise :class:`SetpointStreamStopped`. After a
    pilot or a failsafe has changed the mode, nothing more is sent to the vehicle.
    """

    def __init__(
        self,
        context: VehicleContext,
        encode: Callable[[SetpointT], Message],
        initial: SetpointT,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, 2, 100)
        check_range("valid_for_s", valid_for_s, 0, 60, above=True)
        check_range("max_lag_s", max_lag_s, 0, 60, above=True)
        self._context, self._session, self._flight_cleanup = (
            context,
            context.session,
            context.flight_cleanup,
        )
        self._encode = encode
        self._period_s, self._valid_for_s, self._max_lag_s = 1 / rate_hz, valid_for_s, max_lag_s
        self._setpoint = initial
        self._message: Message | None = None
        self._order: Order | None = None
        self._set_at = -math.inf
        self._mode: Mode | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._stopped: SetpointStreamStopped | None = None
        self._is_reported = self._was_entered = False
        self._is_entering = False
        is_place = isinstance(initial, (PositionSetpoint, LocalPositionSetpoint))
        self._is_costly = is_place and context.session.autopilot.setpoints.position_restarts_path
        self._left, self._sent_at = INITIAL_REPEATS, -math.inf
        self._stillness = StallDetector(context.session)

    @property
    def is_running(self) -> bool:
        """True while set-points are being sent."""
        return self._timer is not None

    def set(self, setpoint: SetpointT) -> None:
        """Replace the set-point; it is sent at the next tick and resent until ``valid_for_s`` has passed.

        Raises:
            InvalidArgument: a value is out of range; the previous set-point remains in force until it expires.
            SetpointStreamStopped: the stream has ended by itself, or the block was left.
        """
        check_kind("setpoint", setpoint, type(self._setpoint))
        self._raise_if_stopped()
        if self._timer is None:
            raise SetpointStreamStopped("this set-point stream is not running: use it inside its `async with` block")
        self._take(setpoint)

    async def fly(self, setpoint: SetpointT, duration_s: float) -> None:
        """Send one set-point for ``duration_s`` seconds.

        Raises:
            SetpointStreamStopped: the stream ended meanwhile.
        """
        check_kind("setpoint", setpoint, type(self._setpoint))
        until = self._now() + duration_s
        while (left := until - self._now()) > 0:
            self.set(setpoint)
            await anyio.sleep(min(left, self._valid_for_s / 3))
        self._raise_if_stopped()

    async def __aenter__(self) -> Self:
        if self._was_entered:
            raise SetpointStreamStopped("a set-point stream can be entered only once: open another one")
        self._take(self._setpoint)  # Raises for an invalid set-point before anything is sent.
        if self._flight_cleanup.stop_stream is not None:
            raise BusyError("another set-point stream is open: leave it first; nothing was sent")
        mode = self._context.sender.mode_for("a set-point stream", "setpoint")
        self._was_entered = True
        self._flight_cleanup.stop_stream = self._stop
        order = self._order = self._context.arbiter.order(mode)
        order.may_move = order.may_move or self._session.telemetry.is_in(mode)
        try:
            await self._enter(mode, order)
        except OperationRejected:  # The pilot or failsafe that took over keeps control.
            self._end()
            raise
        except BaseException:
            self._end()
            self._hold()
            raise
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._stopped is None and (reason := self._why_leave_alone()):
            self._stop(reason, hold=False)
        if self._stopped is None:
            self._end()
            self._stopped = SetpointStreamStopped("the block of this set-point stream was left")
            if exc is not None:
                self._hold()
            # There may have been a takeover that was not received yet.
            elif not self._context.arbiter.is_known:
                self._stop(f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s")
                raise self._stopped
            elif not self._session.telemetry.is_confirmed_disarmed:
                await self._flight_cleanup.hold()
        elif exc is None and not self._is_reported:
            raise self._stopped

    async def _enter(self, mode: Mode, order: Order) -> None:
        """Change the mode. ArduPilot takes set-points once it is in GUIDED; PX4 enters OFFBOARD once it receives
        set-points.
        """
        if self._session.autopilot.setpoints.stream_before_mode:
            self._prepare()
            await self.fly(self._setpoint, OFFBOARD_LEAD_TIME_S)
            await self._feeding_initial(mode, order)
        else:
            await self._context.sender.ensure_mode(mode, order)
            self._prepare()
        self._mode = mode

    async def _feeding_initial(self, mode: Mode, order: Order) -> None:
        """Stream the initial set-point during the mode change. Not a task group, so that exceptions reach the user
        unchanged.
        """
        self._is_entering = True
        try:
            await self._context.sender.ensure_mode(mode, order)
        finally:
            self._is_entering = False
            self._set_at = self._now()
        self._raise_if_stopped()

    # ---------------------------------------------------------------------------- the stream

    def _take(self, setpoint: SetpointT) -> None:
        """Encode the set-point completely, so that an invalid one is refused here."""
        message = self._encode(setpoint)
        message.encode()
        if setpoint != self._setpoint:
            self._left = INITIAL_REPEATS
        self._setpoint, self._message, self._set_at = setpoint, message, self._now()

    def _prepare(self) -> None:
        self._take(self._setpoint)
        self._tick(self._now())

    def _tick(self, due: float) -> None:
        """Send the set-point once more, or stop the stream."""
        self._timer = None
        if reason := self._why_leave_alone():
            self._stop(reason, hold=False)
            return
        if reason := self._why_stop(self._now() - due):
            self._stop(reason)
            return
        try:
            self._send()
        except Exception as error:
            self._stop(str(error))
            return
        due = max(due + self._period_s, self._now())
        self._timer = asyncio.get_running_loop().call_at(due, self._tick, due)

    def _send(self) -> None:
        assert self._message is not None
        if not self._is_costly or self._left > 0 or self._now() - self._sent_at >= REPEAT_INTERVAL_S:
            self._session.connection.send(self._message)
            self._left, self._sent_at = self._left - 1, self._now()

    def _why_stop(self, lag: float) -> str | None:
        age = 0.0 if self._is_entering else self._now() - self._set_at
        if lag > self._max_lag_s:
            return f"the event loop was blocked for {lag:.1f} s"
        if age > self._valid_for_s:
            return f"no new set-point was supplied for {age:.1f} s (valid_for_s = {self._valid_for_s:g})"
        # On a connection that has ended, sending raises the reason.
        if self._session.watch.is_silent and self._session.connection.is_open:
            return f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s"
        if self._mode is None or not wants_motion(self._setpoint, self._context):
            self._stillness = StallDetector(self._session)
            return None
        return self._stillness()

    def _why_leave_alone(self) -> str | None:
        """Return the reason if a pilot, a failsafe or another program took over, else None."""
        mode = self._session.telemetry.mode.latest
        if self._mode is not None and mode is not None and mode != self._mode:
            return f"the vehicle left {self._mode} for {mode}"
        if self._order is not None and self._order.end:
            return self._order.end
        return None

    def _stop(self, reason: str, *, hold: bool = True) -> None:
        """Stop the stream from inside; order the vehicle to hold unless there was a takeover."""
        self._end()
        is_confirmed = hold and self._hold()
        self._stopped = SetpointStreamStopped(
            f"the set-point stream has stopped: {reason}" + ("; a hold was ordered" if is_confirmed else "")
        )

    def _hold(self) -> bool:
        return self._order is not None and self._flight_cleanup.hold_in_background(self._order)

    def _end(self) -> None:
        self._cancel_timer()
        if self._flight_cleanup.stop_stream == self._stop:
            self._flight_cleanup.stop_stream = None

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _raise_if_stopped(self) -> None:
        if self._stopped is not None:
            self._is_reported = True
            raise self._stopped

    def _now(self) -> float:
        return self._session.connection.now()
