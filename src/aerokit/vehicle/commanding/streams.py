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
    CommandRejected,
    OperationRejected,
    ParameterTimeout,
    SetpointStreamStopped,
)
from aerokit.parameters import Parameter
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S, STEERING
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

    The stream stops when the program no longer supplies values, blocks the event loop, or leaves the `async with`
    block, and when the vehicle falls silent.

    Subclasses implement `__aenter__`, `__aexit__`, and what happens when the stream stops by itself.
    """

    # Nouns for the stream and its value in error texts.
    _NAME, _VALUE = "stream", "value"

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
        self._context = context
        self._session = context.session
        self._encode = encode
        self._period_s = 1 / rate_hz
        self._valid_for_s = valid_for_s
        # Maximum delay of a tick; a longer delay means that the event loop was blocked.
        self._max_lag_s = max_lag_s
        # The latest value, its message (None before `__aenter__`), and the time at which it was supplied.
        self._value = initial
        self._message: Message | None = None
        self._set_at = -math.inf
        # Calls `_tick`; None while nothing is sent.
        self._timer: asyncio.TimerHandle | None = None
        # Set once the stream has stopped. The next call, or `__aexit__`, raises the error.
        self._stop_error: AerokitError | None = None
        self._has_raised_stop = False
        self._was_entered = False
        self._is_changing_mode = False
        self._began_sending_at = math.inf  # infinite before anything is sent

    @property
    def is_running(self) -> bool:
        """True while values are being sent."""
        return self._timer is not None

    def _set(self, value: ValueT) -> None:
        self._raise_if_stopped()
        if self._timer is None:
            raise SetpointStreamStopped(f"this {self._NAME} is not running: use it inside its `async with` block")
        self._replace_value(value)

    async def _supply_for(self, value: ValueT, duration_s: float) -> None:
        """Supply the value for ``duration_s`` seconds, so that it does not expire in this time."""
        ends_at = self._now() + duration_s
        while (remaining_s := ends_at - self._now()) > 0:
            self._set(value)
            await anyio.sleep(min(remaining_s, self._valid_for_s / 3))
        self._raise_if_stopped()

    def _raise_if_entered(self) -> None:
        if self._was_entered:
            raise SetpointStreamStopped(f"a {self._NAME} can be entered only once: open another one")

    # ---------------------------------------------------------------------------- the stream

    def _replace_value(self, value: ValueT) -> None:
        message = self._encode(value)
        message.encode()  # An invalid value is refused here, and not when it is sent.
        self._value = value
        self._message = message
        self._set_at = self._now()

    def _begin_sending(self) -> None:
        self._replace_value(self._value)
        self._began_sending_at = self._now()
        self._tick(self._now())

    def _tick(self, due: float) -> None:
        """Send the value once more, or stop the stream. This call was scheduled for the time ``due``."""
        self._timer = None
        if reason := self._takeover_reason():
            self._stop(reason, hold=False)
            return
        if reason := self._stop_reason(self._now() - due):
            self._stop(reason)
            return
        try:
            # The reopened link may lead to another vehicle.
            if not self._session.is_held_back:
                self._send()
        except Exception as error:
            self._stop(str(error) or repr(error))
            assert self._stop_error is not None
            self._stop_error.__cause__ = error
            return
        due = max(due + self._period_s, self._now())  # Ticks that were missed during a delay are left out.
        self._timer = asyncio.get_running_loop().call_at(due, self._tick, due)

    def _send(self) -> None:
        assert self._message is not None
        self._session.connection.send(self._message)

    def _takeover_reason(self) -> str | None:
        """Return a text if another party took over."""
        return None

    def _stop_reason(self, lag: float) -> str | None:
        """Return a text if the stream must stop. ``lag`` is the delay of this tick in seconds."""
        # A value does not expire while the mode is changed, because the program cannot supply values then.
        age = 0.0 if self._is_changing_mode else self._now() - self._set_at
        slept_s = self._session.connection._slept_since(self._began_sending_at)
        if slept_s > self._max_lag_s:
            return f"the computer slept for {slept_s:.0f} s"
        if lag > self._max_lag_s:
            return f"the event loop was blocked for {lag:.1f} s"
        if age > self._valid_for_s:
            return f"no new {self._VALUE} was supplied for {age:.1f} s (valid_for_s = {self._valid_for_s:g})"
        # If the connection has ended, the next transmission raises the error of the connection.
        if self._session.watch.is_silent and self._session.connection.is_open:
            return f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s"
        return None

    def _stop(self, reason: str, *, hold: bool = True) -> None:
        """Stop sending. The next call, or the end of the block, raises ``_stop_error``, which this method sets."""
        self._end()
        is_state_recent = self._context.arbiter.is_state_recent
        hold_text = "a hold was ordered" if is_state_recent else "a hold will be ordered after the next HEARTBEAT"
        is_hold_ordered = hold and self._hold()
        self._release()
        self._stop_error = SetpointStreamStopped(
            f"the {self._NAME} has stopped: {reason}" + (f"; {hold_text}" if is_hold_ordered else "")
        )

    def _hold(self) -> bool:
        """Order the vehicle to hold, without waiting. Returns False if no hold was ordered."""
        return False

    def _release(self) -> None:
        """End the effect of the last value, if the vehicle would otherwise keep executing it."""

    def _end(self) -> None:
        """Stop sending."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _raise_if_stopped(self) -> None:
        if self._stop_error is not None:
            self._has_raised_stop = True
            raise self._stop_error

    def _now(self) -> float:
        return self._session.connection.now()


@checks_arguments
class SteeringStream(ValueStream[ValueT]):
    """Flies the vehicle by values that the ``async with`` block supplies, in the flight mode for such values.

    Entering the block changes to this mode. Leaving the block in any way orders the vehicle to hold, except after a
    newer order or a takeover. If the stream stops by itself, the next value, or else the end of the block, raises
    :class:`SetpointStreamStopped`.
    """

    _prepared_order: Order | None = None
    """The steering order, if it was given before the stream is entered; see `FlightCleanup.preparing_stream`."""
    _order: Order | None = None
    _mode: Mode | None = None
    _impact: ImpactDetector | None = None
    """Ends the stream when the vehicle hits the ground.

    None for values that determine the thrust: they may also stop the vehicle suddenly in the air.
    """

    @property
    def _needs_stream_before_mode(self) -> bool:
        """True if the autopilot enters the mode only while values arrive."""
        return self._session.autopilot.setpoints.stream_before_mode

    def _stream_mode(self) -> Mode:
        """Return the mode in which the vehicle executes the values. Raises NotSupported if there is none."""
        raise NotImplementedError

    async def _check_support(self) -> None:
        """Raise if the vehicle would ignore the values. Called before any value is sent."""

    async def __aenter__(self) -> Self:
        """Give the steering order, change to the stream's mode, and begin to send the initial value."""
        self._raise_if_entered()
        self._replace_value(self._value)  # Raises for an invalid value before anything is sent.
        cleanup = self._context.flight_cleanup
        cleanup.check_no_stream()
        mode = self._stream_mode()
        takeover_check = TakeoverCheck(self._context, mode)
        self._was_entered = True
        # The stream is registered before the first await, so that no second stream can begin meanwhile.
        cleanup.stop_stream = self._stop
        try:
            await self._check_support()
            takeover_check.raise_if_changed(self._NAME)
        except BaseException:
            self._end()  # Another stream may be entered from now on.
            raise
        order = self._prepared_order or self._context.arbiter.order(mode)
        self._order = order
        # A vehicle that is already in the stream's mode may execute the first value as soon as it is sent.
        order.may_move = order.may_move or self._session.telemetry.is_in(mode)
        try:
            await self._enter(mode, order)
        except BaseException as error:
            self._end()  # Nothing is sent from now on.
            # After a refusal, the vehicle continues its previous task. After all other errors, it is ordered to hold,
            # unless the order has ended, for example because a pilot took over.
            if not isinstance(error, CommandRejected):
                self._hold()
            self._release()
            raise
        return self

    async def __aexit__(self, exc_type: object, exc: BaseException | None, traceback: object) -> None:
        """Order a hold. If the stream has already stopped, raise its error instead, unless it was raised before."""
        takeover_reason = self._takeover_reason() if self._stop_error is None else None
        if takeover_reason:
            self._stop(takeover_reason, hold=False)  # This sets `_stop_error`.
        if self._stop_error is None:
            try:
                await self._leave(exc)
            finally:
                self._release()
        elif exc is None and not self._has_raised_stop:
            raise self._stop_error

    async def _leave(self, exc: BaseException | None) -> None:
        self._end()  # Nothing is sent from now on, except the hold.
        self._stop_error = SetpointStreamStopped(f"the async with block of this {self._NAME} was left")
        if exc is not None:  # An exception leaves the block at once, without waiting for the confirmation of the hold.
            self._hold()
        elif not self._context.arbiter.is_state_recent:
            # The vehicle is silent, so the report of a takeover may be missing. `_stop` therefore sends the hold in the
            # background, after the next HEARTBEAT and only if this HEARTBEAT shows no takeover.
            self._stop(f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s")
            raise self._stop_error  # `_stop` has set it to an error about the silence.
        elif not self._session.telemetry.is_confirmed_disarmed:
            await self._hold_and_wait()

    async def _hold_and_wait(self) -> None:
        cleanup, hold_mode = self._context.flight_cleanup, self._context.sender.mode_for("hold", "hold")
        order = self._context.arbiter.order(hold_mode)
        with cleanup.holding_if_abandoned(order):  # The order to hold may be lost.
            await cleanup.stop_in(hold_mode, order)

    async def _enter(self, mode: Mode, order: Order) -> None:
        if self._needs_stream_before_mode:  # PX4 enters the mode only while it receives values.
            self._begin_sending()
            await self._supply_for(self._value, LEAD_TIME_S)
            self._is_changing_mode = True
            try:
                await self._context.sender.ensure_mode(mode, order)
            finally:
                self._is_changing_mode = False
                self._set_at = self._now()
            self._raise_if_stopped()
        else:
            await self._context.sender.ensure_mode(mode, order)
            await self._context.sender.await_recent_state(order)
            self._begin_sending()
        self._mode = mode

    def _takeover_reason(self) -> str | None:
        if self._order is not None and not self._order.is_newest:
            return SUPERSEDED  # The order is checked before the mode, because a newer order may have changed the mode.
        mode = self._session.telemetry.mode.latest
        if self._mode is not None and mode is not None and mode != self._mode:
            return f"the vehicle left {self._mode} for {mode}"
        if self._order is not None and self._order.end:
            return self._order.end
        return None

    def _stop_reason(self, lag: float) -> str | None:
        if self._impact is not None:
            self._impact.update()
            if reason := self._impact.describe():
                return reason
        return super()._stop_reason(lag)

    def _hold(self) -> bool:
        return self._order is not None and self._context.flight_cleanup.hold_in_background(self._order)

    def _end(self) -> None:
        super()._end()
        if self._context.flight_cleanup.stop_stream == self._stop:
            self._context.flight_cleanup.stop_stream = None


class TakeoverCheck:
    """Refuses a mode change if the mode was changed, or another order was given, since the creation of this object."""

    def __init__(self, context: VehicleContext, next_mode: Mode) -> None:
        telemetry, autopilot = context.session.telemetry, context.session.autopilot
        self._telemetry = telemetry
        self._arbiter = context.arbiter
        self._next_mode = next_mode
        self._mode_before = telemetry.mode.latest
        self._order_before = context.arbiter.latest(STEERING)
        # True if the vehicle may still change to a mode of `_order_before`, such as the hold after an abandoned flight.
        was_taken_over = self._order_before is not None and bool(self._order_before.takeover_reason)
        may_change_late = context.arbiter.mode_is_in_doubt and not was_taken_over
        self._began_at = now = context.session.connection.now()
        self._late_until = max(now + MODE_GRACE_S, context.arbiter.mode_settles_at) if may_change_late else -math.inf
        # The mode change (before, after) by which a take-off ends.
        self._end_of_take_off = (
            autopilot.mode_for("take_off", is_vtol=telemetry.is_vtol),
            autopilot.mode_for("hold", is_vtol=telemetry.is_vtol),
        )

    def raise_if_changed(self, operation: str) -> None:
        """Raise OperationRejected if an order was given, or if the mode was changed."""
        if self._arbiter.latest(STEERING) is not self._order_before:
            raise OperationRejected(f"{operation}: {SUPERSEDED} meanwhile; this order was not sent")
        mode_before, mode = self._mode_before, self._telemetry.mode.latest
        changed_at = self._arbiter.mode_changed_at
        is_unchanged = mode_before is None or (mode == mode_before and changed_at <= self._began_at)
        # The end of a take-off, and a change to the mode that the caller wants to order, are not takeovers.
        is_end_of_take_off = (mode_before, mode) == self._end_of_take_off
        order = self._order_before
        is_mode_of_order = order is not None and mode is not None and order.may_cause(mode)
        is_late_effect = is_mode_of_order and changed_at < self._late_until
        if is_unchanged or mode == self._next_mode or is_end_of_take_off or is_late_effect:
            return
        change = f"from {mode_before} to {mode}" if mode != mode_before else f"and back to {mode}"
        raise OperationRejected(f"{operation}: the mode changed {change}; the order was not sent")


async def known_values(probe: Probe, *names: str) -> dict[str, float]:
    """Read these parameters by ``probe``, and return the values of those that the vehicle has.

    Raises ParameterTimeout if the vehicle does not answer.
    """
    answers = await probe(*names)
    for answer in answers.values():
        if isinstance(answer, ParameterTimeout):
            raise answer
    return {name: float(answer.value) for name, answer in answers.items() if isinstance(answer, Parameter)}
