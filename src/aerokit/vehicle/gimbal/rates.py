"""``GimbalRates``: turning a gimbal at rates while the program feeds them."""

from __future__ import annotations

import asyncio
import math
from contextlib import ExitStack
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import AerokitError, BusyError, CommandRejected, NotSupported, SetpointStreamStopped
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink.messages import GimbalManagerSetAttitude, GimbalManagerSetPitchyaw
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.gimbal.control import ReleaseCommand
from aerokit.vehicle.gimbal.orders import LEVEL, LOCKED, NAN, PITCHYAW, GimbalOrders

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.order import Order

__all__ = ["GimbalRates"]

# Gimbals limit the rate themselves.
MAX_RATE_DEG_S = 720.0


@checks_arguments
class GimbalRates:
    """Turns a gimbal at the latest rates while its ``async with`` block feeds them.

    Entering orders the first rates by MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW; then they are sent at ``rate_hz``
    (GIMBAL_MANAGER_SET_PITCHYAW, or GIMBAL_MANAGER_SET_ATTITUDE to PX4). Leaving, in any way, orders a rate of zero:
    the gimbal keeps its direction. The stream stops by itself, with a rate of zero, if no new rates are set for
    ``valid_for_s``, the event loop is blocked for ``max_lag_s``, or the vehicle is silent. It stops without sending a
    rate of zero if another order is given to the gimbal, or control is lost. Then ``set`` and leaving the block raise.

    Entering raises:
        InvalidArgument: a rate is out of range. Nothing was sent.
        NotSupported: the vehicle has no gimbal manager; older mounts turn to angles only.
        CommandRejected: the manager refused.
        CommandTimeout: there was no answer.
        GimbalTaken: your program had control and lost it.
    """

    def __init__(
        self,
        orders: GimbalOrders,
        first: tuple[float, float],
        is_from_north: bool,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, 2, 100)
        check_range("valid_for_s", valid_for_s, 0, 60, above=True)
        check_range("max_lag_s", max_lag_s, 0, 60, above=True)
        _check(*first)
        self._orders, self._session = orders, orders.session
        self._rates, self._flags = first, int(LOCKED if is_from_north else LEVEL)
        self._period_s, self._valid_for_s, self._max_lag_s = 1 / rate_hz, valid_for_s, max_lag_s
        self._set_at = self._began_at = -math.inf
        self._order: Order | None = None
        # Marks the gimbal as in use, so that ``vehicle.gimbal`` does not change to another one.
        self._release = ExitStack()
        self._timer: asyncio.TimerHandle | None = None
        self._stopped: AerokitError | None = None
        self._was_raised = self._was_entered = False

    @property
    def is_running(self) -> bool:
        """True while rates are being sent."""
        return self._timer is not None

    def set(self, pitch_deg_s: float = 0.0, yaw_deg_s: float = 0.0) -> None:
        """Set new rates; they are sent at the next tick, and repeated until ``valid_for_s`` has passed.

        Args:
            pitch_deg_s: degrees per second, −720 to 720; positive is up.
            yaw_deg_s: degrees per second, −720 to 720; positive is to the right.

        Raises:
            InvalidArgument: a rate is out of range; the previous rates stay valid.
            SetpointStreamStopped: the stream has stopped, or the block has ended.
            GimbalTaken: your program had control and lost it.
        """
        _check(pitch_deg_s, yaw_deg_s)
        self._raise_if_stopped()
        if self._timer is None:
            raise SetpointStreamStopped("these rates are not being sent: set them inside the `async with` block")
        self._rates, self._set_at = (pitch_deg_s, yaw_deg_s), self._now()

    async def turn(self, pitch_deg_s: float, yaw_deg_s: float, duration_s: float) -> None:
        """Feed one pair of rates for a time.

        Args:
            pitch_deg_s: degrees per second, −720 to 720; positive is up.
            yaw_deg_s: degrees per second, −720 to 720; positive is to the right.
            duration_s: time in seconds.

        Raises:
            InvalidArgument: a rate is out of range.
            SetpointStreamStopped: the stream has stopped.
            GimbalTaken: your program had control and lost it.
        """
        until = self._now() + duration_s
        while (left := until - self._now()) > 0:
            self.set(pitch_deg_s, yaw_deg_s)
            await anyio.sleep(min(left, self._valid_for_s / 3))
        self._raise_if_stopped()

    async def __aenter__(self) -> Self:
        if self._was_entered:
            raise BusyError("GimbalRates can be entered only once: call rates() again")
        self._was_entered = True
        orders = self._orders
        self._order = orders.begin_order()
        self._release.enter_context(orders.device.in_use())
        try:
            if not await orders.send_pitch_yaw(self._order, NAN, NAN, *self._rates, flags=self._flags):
                orders.raise_not_supported("has no gimbal manager, which is needed for rates")
            self._set_at = self._began_at = self._now()
            orders.context.on_finish.append(self._finish)
            self._tick(self._now())
        except (CommandRejected, NotSupported):  # The gimbal does not turn.
            self._end()
            raise
        except BaseException:  # Without an answer it may turn.
            self._stop_rotation()
            raise
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if self._stopped is None and (loss := self._lost_to()):
            self._stop(loss, zero=False)
        if self._stopped is None:
            zero = self._zero()
            self._end()
            self._stopped = SetpointStreamStopped("the block of these rates has ended")
            if error is None:
                await zero.send_and_wait(f"{self._orders.name}: rates of zero")
            else:
                zero.send_soon()
        elif error is None and not self._was_raised:
            raise self._stopped

    def _tick(self, due: float) -> None:
        """Send once more, unless the stream must stop."""
        self._timer = None
        if error := self._lost_to():
            self._stop(error, zero=False)
            return
        if reason := self._stop_reason(self._now() - due):
            self._stop(_stopped(reason))
            return
        try:
            self._session.connection.send(self._message())
        except AerokitError as error:
            self._stop(_stopped(str(error)))
            return
        due = max(due + self._period_s, self._now())
        self._timer = asyncio.get_running_loop().call_at(due, self._tick, due)

    def _message(self) -> Message:
        orders = self._orders
        pitch, yaw = (math.radians(rate) for rate in self._rates)
        address = (self._session.system_id, orders.manager_id, self._flags, orders.gimbal_id_param)
        if orders.rules.supports_pitchyaw:
            return GimbalManagerSetPitchyaw(*address, NAN, NAN, pitch, yaw)
        return GimbalManagerSetAttitude(*address, (NAN, NAN, NAN, NAN), 0.0, pitch, yaw)

    def _stop_reason(self, lag: float) -> str | None:
        age = self._now() - self._set_at
        if lag > self._max_lag_s:
            return f"the event loop was blocked for {lag:.1f} s"
        if age > self._valid_for_s:
            return f"no new rates came for {age:.1f} s (valid_for_s = {self._valid_for_s:g})"
        if self._session.watch.is_silent and self._session.connection.is_open:
            return f"the vehicle has been silent for {self._session.heartbeat_age:.1f} s"
        manager_id = self._orders.manager_id
        silent_for_s = min(self._orders.registry.silent_for_s(manager_id), self._now() - self._began_at)
        if manager_id != self._session.component_id and silent_for_s > SILENT_AFTER_S:
            return f"the gimbal's manager has been silent for {silent_for_s:.1f} s"
        return None

    def _lost_to(self) -> AerokitError | None:
        """Return the error if control was lost, or a newer order was given."""
        try:
            self._orders.raise_if_taken()
        except AerokitError as error:
            return error
        if self._order is not None and not self._order.is_newest:
            return _stopped(SUPERSEDED)
        return None

    def _stop(self, error: AerokitError, *, zero: bool = True) -> None:
        self._stopped = error
        if zero:
            self._stop_rotation()
        else:
            self._end()

    def _zero(self) -> ReleaseCommand:
        orders, order = self._orders, self._order
        params = (NAN, NAN, 0.0, 0.0, self._flags, 0, orders.gimbal_id_param)
        return ReleaseCommand(
            orders, PITCHYAW, params, lambda: order is not None and order.is_newest and not orders.is_taken
        )

    def _stop_rotation(self) -> None:
        zero = self._zero()
        self._end()
        zero.send_soon()

    def _finish(self) -> None:
        self._stop(_stopped("the block of the vehicle has ended"))

    def _end(self) -> None:
        self._release.close()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._finish in self._orders.context.on_finish:
            self._orders.context.on_finish.remove(self._finish)

    def _raise_if_stopped(self) -> None:
        if self._stopped is not None:
            self._was_raised = True
            raise self._stopped

    def _now(self) -> float:
        return self._session.connection.now()


def _stopped(reason: str) -> SetpointStreamStopped:
    return SetpointStreamStopped(f"the rates of the gimbal have stopped: {reason}")


def _check(pitch_deg_s: float, yaw_deg_s: float) -> None:
    check_range("pitch_deg_s", pitch_deg_s, -MAX_RATE_DEG_S, MAX_RATE_DEG_S)
    check_range("yaw_deg_s", yaw_deg_s, -MAX_RATE_DEG_S, MAX_RATE_DEG_S)
