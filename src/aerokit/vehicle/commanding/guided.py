"""Guided set-points, streamed at a rate and bound to the life of the code that feeds them.

An autopilot stops by itself when set-points stop coming (ArduCopter after 3 s, PX4 after 0.5 s). A library that
resends the last set-point for ever defeats that. Here the stream ends, and the vehicle is told to hold, when the code
that feeds it ends, raises, is cancelled, goes silent or blocks the event loop, and when the vehicle falls silent.
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
from aerokit.vehicle.commanding.progress import Stillness
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
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Order

__all__ = ["Guided", "SetpointStream"]

SetpointT = TypeVar("SetpointT")

AT_FIRST, AGAIN_S = 3, 5.0
"""A place that must not be sent without need is sent so often at once, lest one is lost, and again after so long."""
ENTRY_S = 1.0
"""How long the initial set-point is streamed before PX4 is asked for OFFBOARD: it wants to see a stream first."""


@checks_arguments
class Guided:
    """Opens set-point streams: ``async with vehicle.guided.velocity() as stream: stream.set(...)``.

    Every stream takes ``rate_hz`` (how often the latest set-point is sent, 2 to 100), ``valid_for_s`` (how long a
    set-point may be resent without a new one) and ``max_lag_s`` (how late the event loop may be). NotSupported is
    raised for a kind that this type of vehicle does not obey. Rates and seconds are ours: a simulation that runs ten
    times as fast, and does not wait longer for it, wants ten times as many set-points.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._encode = SetpointEncoder(bridge)

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
        """Stream velocities as seen from the vehicle (SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_BODY_NED)."""
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
        return self._stream(
            "acceleration", self._encode.acceleration, initial, rate_hz, valid_for_s, max_lag_s
        )

    def local_position(
        self,
        initial: LocalPositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[LocalPositionSetpoint]:
        """Stream places in the local frame (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream(
            "local position", self._encode.local_position, initial, rate_hz, valid_for_s, max_lag_s
        )

    def position(
        self,
        initial: PositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[PositionSetpoint]:
        """Stream places on the globe (SET_POSITION_TARGET_GLOBAL_INT)."""
        return self._stream(
            "global position", self._encode.position, initial, rate_hz, valid_for_s, max_lag_s
        )

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
        autopilot = self._bridge.talk.autopilot
        if kind not in autopilot.setpoints.names:
            obeyed = ", ".join(autopilot.setpoints.names) or "none"
            raise NotSupported(
                f"{autopilot.firmware} does not obey {kind} set-points; those it obeys: {obeyed}"
            )
        return SetpointStream(self._bridge, encode, initial, *limits)


@checks_arguments
class SetpointStream(Generic[SetpointT]):
    """Sends the latest set-point at a rate for as long as the ``async with`` block feeds it.

    Entering puts the vehicle into its mode for set-points (GUIDED, OFFBOARD) with the initial set-point. Leaving, in
    any way, tells it to hold. When the stream has stopped by itself, ``set`` and leaving the block raise
    :class:`SetpointStreamStopped`; a vehicle that should move and does not for twelve seconds stops it, too. When it
    stopped because the mode changed (a pilot, a failsafe), the vehicle is left to whoever changed it.
    """

    def __init__(
        self,
        bridge: Bridge,
        encode: Callable[[SetpointT], Message],
        initial: SetpointT,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, 2, 100)
        check_range("valid_for_s", valid_for_s, 0, 60, above=True)
        check_range("max_lag_s", max_lag_s, 0, 60, above=True)
        self._bridge, self._talk, self._holding = bridge, bridge.talk, bridge.holding
        self._encode = encode
        self._period_s, self._valid_for_s, self._max_lag_s = 1 / rate_hz, valid_for_s, max_lag_s
        self._setpoint = initial
        self._message: Message | None = None
        self._order: Order | None = None
        self._set_at = -math.inf
        self._mode: Mode | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._stopped: SetpointStreamStopped | None = None
        self._was_told = self._was_entered = False
        self._is_entering = False
        is_place = isinstance(initial, (PositionSetpoint, LocalPositionSetpoint))
        self._is_costly = is_place and bridge.talk.autopilot.setpoints.place_restarts_path
        self._left, self._sent_at = AT_FIRST, -math.inf
        self._stillness = Stillness(bridge.talk)

    @property
    def is_running(self) -> bool:
        """Whether set-points are being sent."""
        return self._timer is not None

    def set(self, setpoint: SetpointT) -> None:
        """Take a new set-point; it is sent at the next tick, and resent until ``valid_for_s`` has passed.

        Raises:
            InvalidArgument: a value is out of range; the one before stays in force until it is too old.
            SetpointStreamStopped: the stream has ended by itself, or the block was left.
        """
        check_kind("setpoint", setpoint, type(self._setpoint))
        self._raise_if_stopped()
        if self._timer is None:
            raise SetpointStreamStopped(
                "this set-point stream is not running: use it inside its `async with`"
            )
        self._take(setpoint)

    async def fly(self, setpoint: SetpointT, duration_s: float) -> None:
        """Feed one set-point for ``duration_s`` seconds.

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
            raise SetpointStreamStopped("a set-point stream is entered once: open another one")
        self._take(self._setpoint)  # refuse nonsense before anything is sent
        if self._holding.end_stream is not None:
            raise BusyError("another set-point stream is open: leave it first; nothing was sent")
        mode = self._bridge.sender.mode_for("a set-point stream", "setpoint")
        self._was_entered = True
        self._holding.end_stream = self._stop
        order = self._order = self._bridge.arbiter.order(mode)
        order.is_given = order.is_given or self._talk.telemetry.is_in(mode)
        try:
            await self._enter(mode, order)
        except OperationRejected:  # the vehicle stays with whoever steers it
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
            elif not self._bridge.arbiter.is_known:  # whoever steers by then is left alone
                self._stop(f"the vehicle has been silent for {self._talk.heartbeat_age:.1f} s")
                raise self._stopped
            elif not self._talk.telemetry.is_surely_disarmed:
                await self._holding.hold()
        elif exc is None and not self._was_told:
            raise self._stopped

    async def _enter(self, mode: Mode, order: Order) -> None:
        """ArduPilot takes set-points once it is in GUIDED; PX4 goes to OFFBOARD once it sees set-points."""
        if self._talk.autopilot.setpoints.before_mode:
            self._begin()
            await self.fly(self._setpoint, ENTRY_S)
            await self._feeding_initial(mode, order)
        else:
            await self._bridge.sender.ensure_mode(mode, order)
            self._begin()
        self._mode = mode

    async def _feeding_initial(self, mode: Mode, order: Order) -> None:
        """Not in a task group: what is raised here reaches the user as it is."""
        self._is_entering = True
        try:
            await self._bridge.sender.ensure_mode(mode, order)
        finally:
            self._is_entering = False
            self._set_at = self._now()
        self._raise_if_stopped()

    # ---------------------------------------------------------------------------- the stream

    def _take(self, setpoint: SetpointT) -> None:
        """Turn it into the message to send, whole: what cannot be sent is refused here."""
        message = self._encode(setpoint)
        message.encode()
        if setpoint != self._setpoint:
            self._left = AT_FIRST
        self._setpoint, self._message, self._set_at = setpoint, message, self._now()

    def _begin(self) -> None:
        self._take(self._setpoint)
        self._tick(self._now())

    def _tick(self, due: float) -> None:
        """Send once more, unless something says that nobody steers any more."""
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
        if not self._is_costly or self._left > 0 or self._now() - self._sent_at >= AGAIN_S:
            self._talk.connection.send(self._message)
            self._left, self._sent_at = self._left - 1, self._now()

    def _why_stop(self, lag: float) -> str | None:
        age = 0.0 if self._is_entering else self._now() - self._set_at
        if lag > self._max_lag_s:
            return f"the event loop was blocked for {lag:.1f} s"
        if age > self._valid_for_s:
            return f"no new set-point came for {age:.1f} s (valid_for_s = {self._valid_for_s:g})"
        # on a connection that has ended, sending tells why
        if self._talk.watch.is_silent and self._talk.connection.is_open:
            return f"the vehicle has been silent for {self._talk.heartbeat_age:.1f} s"
        if self._mode is None or not wants_motion(self._setpoint, self._bridge):
            self._stillness = Stillness(self._talk)
            return None
        return self._stillness()

    def _why_leave_alone(self) -> str | None:
        """Somebody else has taken over: a pilot, a failsafe, another program."""
        mode = self._talk.telemetry.mode.latest
        if self._mode is not None and mode is not None and mode != self._mode:
            return f"the vehicle left {self._mode} for {mode}"
        if self._order is not None and self._order.end:
            return self._order.end
        return None

    def _stop(self, reason: str, *, hold: bool = True) -> None:
        """End it by itself. The vehicle is told to hold, unless somebody else steers it by now."""
        self._end()
        is_told = hold and self._hold()
        self._stopped = SetpointStreamStopped(
            f"the set-point stream has stopped: {reason}"
            + ("; the vehicle was told to hold" if is_told else "")
        )

    def _hold(self) -> bool:
        return self._order is not None and self._holding.hold_soon(self._order)

    def _end(self) -> None:
        self._cancel_timer()
        if self._holding.end_stream == self._stop:
            self._holding.end_stream = None

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _raise_if_stopped(self) -> None:
        if self._stopped is not None:
            self._was_told = True
            raise self._stopped

    def _now(self) -> float:
        return self._talk.connection.now()
