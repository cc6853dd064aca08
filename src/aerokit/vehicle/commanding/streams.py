"""`ValueStream`: sends the latest value that the program supplies at a fixed rate, and stops with the program.

`SteeringStream` is the base class of streams that fly the vehicle: it adds the mode, takeovers, and a hold at the end.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Generic, TypeVar

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import (
    AerokitError,
    OperationRejected,
    OperationTimeout,
    ParameterTimeout,
    SetpointStreamStopped,
)
from aerokit.parameters import Parameter
from aerokit.vehicle.commanding.arbiter import STEERING
from aerokit.vehicle.commanding.order import SUPERSEDED

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.ground import ImpactDetector
    from aerokit.vehicle.commanding.order import Order

    Probe = Callable[..., Awaitable[Mapping[str, object]]]
    """Type of ``Parameters.probe``, because this package must not import `Parameters`."""

__all__ = ["MAX_RATE_HZ", "SteeringStream", "TakeoverCheck", "ValueStream", "known_values"]

ValueT = TypeVar("ValueT")

MIN_RATE_HZ, MAX_RATE_HZ = 2, 400
# Seconds for which the initial value is streamed before the mode is requested, if the autopilot requires a running
# stream (PX4).
LEAD_TIME_S = 1.0


@checks_arguments
class ValueStream(Generic[ValueT]):
    """Sends the latest value at a fixed rate.

    The stream stops when the program no longer supplies values, blocks the event loop, or leaves the block, and
    when the vehicle falls silent.

    Subclasses implement entering and leaving the block, and what happens when the stream stops by itself.
    """

    _NAME, _VALUE = "stream", "value"  # Nouns for the stream and its value in error texts.

    def __init__(
        self,
        context: VehicleContext,
        encode: Callable[[ValueT], Message],
        initial: ValueT,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        check_range("valid_for_s", valid_for_s, 0, 60, above=True)
        check_range("max_lag_s", max_lag_s, 0, 60, above=True)
        self._context, self._session = context, context.session
        self._encode = encode
        self._period_s, self._valid_for_s, self._max_lag_s = 1 / rate_hz, valid_for_s, max_lag_s
        self._value = initial
        self._message: Message | None = None
        self._set_at = -math.inf
        self._timer: asyncio.TimerHandle | None = None
        self._stopped: AerokitError | None = None
        self._is_reported = self._was_entered = self._is_entering = False

    @property
    def is_running(self) -> bool:
        """True while values are being sent."""
        return self._timer is not None

    def _set(self, value: ValueT) -> None:
        self._raise_if_stopped()
        if self._timer is None:
            raise SetpointStreamStopped(f"this {self._NAME} is not running: use it inside its `async with` block")
        self._take(value)

    async def _feed(self, value: ValueT, duration_s: float) -> None:
        until = self._now() + duration_s
        while (left := until - self._now()) > 0:
            self._set(value)
            await anyio.sleep(min(left, self._valid_for_s / 3))
        self._raise_if_stopped()

    def _raise_if_entered(self) -> None:
        if self._was_entered:
            raise SetpointStreamStopped(f"a {self._NAME} can be entered only once: open another one")

    # ---------------------------------------------------------------------------- the stream

    def _take(self, value: ValueT) -> None:
        """Encode the value completely, so that an invalid value is refused here and not when it is sent."""
        message = self._encode(value)
        message.encode()
        self._value, self._message, self._set_at = value, message, self._now()

    def _begin_sending(self) -> None:
        self._take(self._value)
        self._tick(self._now())

    def _tick(self, due: float) -> None:
        """Send the value once more, or stop the stream."""
        self._timer = None
        if reason := self._takeover():
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
        self._session.connection.send(self._message)

    def _takeover(self) -> str | None:
        """Return a clause if a pilot, a failsafe or another program took over, else None."""
        return None

    def _why_stop(self, lag: float) -> str | None:
        age = 0.0 if self._is_entering else self._now() - self._set_at
        if lag > self._max_lag_s:
            return f"the event loop was blocked for {lag:.1f} s"
        if age > self._valid_for_s:
            return f"no new {self._VALUE} was supplied for {age:.1f} s (valid_for_s = {self._valid_for_s:g})"
        # If the connection has ended, the next transmission raises the error of the connection.
        if self._session.watch.is_silent and self._session.connection.is_open:
            return f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s"
        return None

    def _stop(self, reason: str, *, hold: bool = True) -> None:
        """Stop the stream by itself; order the vehicle to hold unless there was a takeover."""
        self._end()
        is_confirmed = hold and self._hold()
        self._release()
        self._stopped = SetpointStreamStopped(
            f"the {self._NAME} has stopped: {reason}" + ("; a hold was ordered" if is_confirmed else "")
        )

    def _hold(self) -> bool:
        """Order the vehicle to hold, without waiting; return True if the order was sent."""
        return False

    def _release(self) -> None:
        """End the effect of the last value, if the vehicle would otherwise keep executing it."""

    def _end(self) -> None:
        """Stop sending."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _raise_if_stopped(self) -> None:
        if self._stopped is not None:
            self._is_reported = True
            raise self._stopped

    def _now(self) -> float:
        return self._session.connection.now()


@checks_arguments
class SteeringStream(ValueStream[ValueT]):
    """Flies the vehicle by values that the ``async with`` block supplies, in the flight mode for such values.

    Entering the block changes to the mode. Leaving it in any way orders the vehicle to hold. If the stream stops by
    itself, supplying a value and leaving the block raise :class:`SetpointStreamStopped`. If it stopped because a pilot
    or a failsafe changed the mode, no hold is ordered.
    """

    _prepared_order: Order | None = None
    """The steering order, if it was already given before the block is entered; see `FlightCleanup.preparing`."""
    _order: Order | None = None
    _mode: Mode | None = None
    _impact: ImpactDetector | None = None
    """Ends the stream when the vehicle hits the ground; None if the values determine the thrust, so that the vehicle
    may brake as suddenly in the air.
    """

    @property
    def _is_stream_before_mode(self) -> bool:
        """True if the autopilot enters the mode only while values arrive."""
        return self._session.autopilot.setpoints.stream_before_mode

    def _wanted_mode(self) -> Mode:
        """Return the mode in which the vehicle executes the values; raise NotSupported if there is no such mode."""
        raise NotImplementedError

    async def _check_support(self) -> None:
        """Raise if the vehicle would ignore the values, before anything is sent."""

    async def __aenter__(self) -> Self:
        self._raise_if_entered()
        self._take(self._value)  # Raises for an invalid value before anything is sent.
        cleanup = self._context.flight_cleanup
        cleanup.check_no_stream()
        mode = self._wanted_mode()
        self._was_entered = True
        cleanup.stop_stream = self._stop
        check = TakeoverCheck(self._context, mode)
        try:
            await self._check_support()
            check.raise_if_changed(self._NAME)
        except BaseException:
            self._end()
            raise
        order = self._order = self._prepared_order or self._context.arbiter.order(mode)
        order.may_move = order.may_move or self._session.telemetry.is_in(mode)
        try:
            await self._enter(mode, order)
        except BaseException as error:
            self._end()
            if not isinstance(error, OperationRejected):  # The pilot or failsafe that took over keeps control.
                self._hold()
            self._release()
            raise
        return self

    async def __aexit__(self, exc_type: object, exc: BaseException | None, traceback: object) -> None:
        if self._stopped is None and (reason := self._takeover()):
            self._stop(reason, hold=False)
        if self._stopped is None:
            try:
                await self._leave(exc)
            finally:
                self._release()
        elif exc is None and not self._is_reported:
            raise self._stopped

    async def _leave(self, exc: BaseException | None) -> None:
        """Leave the block while the stream is running."""
        self._end()
        self._stopped = SetpointStreamStopped(f"the block of this {self._NAME} was left")
        if exc is not None:
            self._hold()
        # There may have been a takeover whose report was not received yet.
        elif not self._context.arbiter.is_known:
            self._stop(f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s")
            raise self._stopped
        elif not self._session.telemetry.is_confirmed_disarmed:
            cleanup, mode = self._context.flight_cleanup, self._context.sender.mode_for("hold", "hold")
            order = self._context.arbiter.order(mode)
            try:
                await cleanup.stop_in(mode, order)
            except (anyio.get_cancelled_exc_class(), OperationTimeout):  # The hold may have been lost.
                cleanup.hold_in_background(order)
                raise

    async def _enter(self, mode: Mode, order: Order) -> None:
        """Change the mode. ArduPilot accepts values once it is in the mode; PX4 enters the mode once it receives
        values.
        """
        if self._is_stream_before_mode:
            self._begin_sending()
            await self._feed(self._value, LEAD_TIME_S)
            self._is_entering = True
            try:
                await self._context.sender.ensure_mode(mode, order)
            finally:
                self._is_entering = False
                self._set_at = self._now()
            self._raise_if_stopped()
        else:
            await self._context.sender.ensure_mode(mode, order)
            self._begin_sending()
        self._mode = mode

    def _takeover(self) -> str | None:
        mode = self._session.telemetry.mode.latest
        if self._mode is not None and mode is not None and mode != self._mode:
            return f"the vehicle left {self._mode} for {mode}"
        if self._order is not None and self._order.end:
            return self._order.end
        return None

    def _why_stop(self, lag: float) -> str | None:
        if self._impact is not None:
            self._impact.update()
            if reason := self._impact.text():
                return reason
        return super()._why_stop(lag)

    def _hold(self) -> bool:
        return self._order is not None and self._context.flight_cleanup.hold_in_background(self._order)

    def _end(self) -> None:
        super()._end()
        if self._context.flight_cleanup.stop_stream == self._stop:
            self._context.flight_cleanup.stop_stream = None


class TakeoverCheck:
    """Refuses a mode change that a newer event has overtaken.

    Such events, since the creation of this object, are a mode change by another party and another order of the program.
    """

    def __init__(self, context: VehicleContext, wanted: Mode) -> None:
        session = context.session
        self._telemetry, self._wanted = session.telemetry, wanted
        self._before = session.telemetry.mode.latest
        self._arbiter, self._order = context.arbiter, context.arbiter.latest(STEERING)
        is_vtol = session.telemetry.is_vtol
        self._take_off, self._hold = (session.autopilot.mode_for(p, is_vtol=is_vtol) for p in ("take_off", "hold"))

    def raise_if_changed(self, what: str) -> None:
        """Raise OperationRejected if an order was given, or if the mode was changed other than by the end of a
        take-off.
        """
        if self._arbiter.latest(STEERING) is not self._order:
            raise OperationRejected(f"{what}: {SUPERSEDED} before anything was ordered")
        before, mode = self._before, self._telemetry.mode.latest
        if before is None or mode in (before, self._wanted) or (before, mode) == (self._take_off, self._hold):
            return
        raise OperationRejected(f"{what}: the mode changed from {before} to {mode} before anything was ordered")


async def known_values(probe: Probe, *names: str) -> dict[str, float]:
    """Return the values of those parameters that the vehicle has; raise ParameterTimeout if it does not answer."""
    answers = await probe(*names)
    for answer in answers.values():
        if isinstance(answer, ParameterTimeout):
            raise answer
    return {name: float(answer.value) for name, answer in answers.items() if isinstance(answer, Parameter)}
