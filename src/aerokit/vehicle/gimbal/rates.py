"""``GimbalRates``: turns a gimbal at rates while the program supplies them."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import AerokitError, BusyError, CommandRejected, NotSupported, SetpointStreamStopped
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink.messages import GimbalManagerSetAttitude, GimbalManagerSetPitchyaw
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.streams import ValueStream
from aerokit.vehicle.gimbal.control import ReleaseCommand
from aerokit.vehicle.gimbal.orders import LEVEL, LOCKED, NAN, PITCHYAW, GimbalOrders

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.order import Order

__all__ = ["GimbalRates"]

# Limits of the arguments. Gimbals may limit the rates further.
MAX_RATE_DEG_S, MAX_RATE_HZ = 720.0, 100


@checks_arguments
class GimbalRates(ValueStream[tuple[float, float]]):
    """Turns a gimbal at the latest rates that the program supplies in the ``async with`` block.

    Entering orders the first rates by MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW. From then on the latest rates are sent at
    ``rate_hz`` (GIMBAL_MANAGER_SET_PITCHYAW, or GIMBAL_MANAGER_SET_ATTITUDE to PX4). Leaving the block, also by an
    error, orders a rate of zero, so that the gimbal keeps its direction.

    The stream stops earlier, with a rate of zero, if no new rates are set for ``valid_for_s``, the event loop is
    blocked for ``max_lag_s``, or the vehicle is silent. It stops without sending a rate of zero if another order to the
    gimbal is given, or if control is lost. After these stops, ``set`` and leaving the block raise
    :class:`SetpointStreamStopped` or :class:`GimbalTaken`.

    Entering raises:
        InvalidArgument: a rate is out of range. Nothing was sent.
        NotSupported: the vehicle has no gimbal manager, and older mounts support only angles.
        CommandRejected: the manager refused.
        CommandTimeout: there was no answer.
        GimbalTaken: your program had control and lost it.
    """

    _NAME, _VALUE = "stream of gimbal rates", "pair of rates"

    def __init__(
        self,
        orders: GimbalOrders,
        first_rates: tuple[float, float],
        is_from_north: bool,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, 2, MAX_RATE_HZ)
        super().__init__(orders.context, self._encode_rates, first_rates, rate_hz, valid_for_s, max_lag_s)
        _check_rates(*first_rates)
        self._orders = orders
        self._flags = int(LOCKED if is_from_north else LEVEL)
        # Time at which the manager accepted the first rates. If it sends nothing, it counts as silent since then.
        self._began_at = -math.inf
        self._order: Order | None = None
        # The error that describes the loss of control; None until control is lost.
        self._loss: AerokitError | None = None
        # Until this stack is closed, the gimbal counts as in use, so that ``vehicle.gimbal`` stays this gimbal.
        self._cleanup = ExitStack()

    def set(self, pitch_deg_s: float = 0.0, yaw_deg_s: float = 0.0) -> None:
        """Set new rates. They are sent at the next tick, and repeated until ``valid_for_s`` seconds have passed.

        Args:
            pitch_deg_s: degrees per second, −720 to 720; positive is up.
            yaw_deg_s: degrees per second, −720 to 720; positive is to the right.

        Raises:
            InvalidArgument: a rate is out of range; the previous rates stay valid.
            SetpointStreamStopped: the stream has stopped, or the block has ended.
            GimbalTaken: your program had control and lost it.
        """
        _check_rates(pitch_deg_s, yaw_deg_s)
        self._set((pitch_deg_s, yaw_deg_s))

    async def turn(self, pitch_deg_s: float, yaw_deg_s: float, duration_s: float) -> None:
        """Turn at one pair of rates for ``duration_s`` seconds. Arguments and errors are those of :meth:`set`."""
        _check_rates(pitch_deg_s, yaw_deg_s)
        await self._supply_for((pitch_deg_s, yaw_deg_s), duration_s)

    async def __aenter__(self) -> Self:
        """Order the first rates by a command, which the manager acknowledges, and begin to send rates."""
        if self._was_entered:
            raise BusyError("GimbalRates can be entered only once: call rates() for a new one")
        self._was_entered = True
        orders = self._orders
        self._order = orders.begin_order()
        self._cleanup.enter_context(orders.device.in_use())
        # The callback is registered before the command, so that the gimbal also stops if `async with connect(…)` ends
        # before the ack.
        self._cleanup.callback(orders.context.on_finish(self._finish))
        try:
            is_supported = await orders.send_pitch_yaw(self._order, NAN, NAN, rates=self._value, flags=self._flags)
            if not is_supported:
                raise orders.not_supported("has no gimbal manager, which is needed for rates")
            self._began_at = self._now()
            self._begin_sending()
        except (CommandRejected, NotSupported):  # The gimbal does not turn, because the manager refused.
            self._end()
            raise
        except BaseException:  # The gimbal may turn, because the manager may have received the command.
            self._stop("it was not entered")
            raise
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Stop the gimbal. If the stream has already stopped, raise its error instead."""
        takeover_reason = self._takeover_reason() if self._stop_error is None else None
        if takeover_reason:
            self._stop(takeover_reason, hold=False)  # This sets `_stop_error`.
        if self._stop_error is None:
            # Create the command before `_end`, because afterwards it might address another gimbal.
            stop_command = self._zero_rates_command()
            self._end()
            self._stop_error = SetpointStreamStopped("the block of these rates has ended")
            if error is None:
                await stop_command.send_and_wait(f"{self._orders.name}: rates of zero")
                self._orders.raise_if_taken()  # If control was lost meanwhile, the gimbal may still turn.
            else:
                stop_command.send_soon()
        elif error is None and not self._has_raised_stop:
            raise self._stop_error

    def _send(self) -> None:
        self._session.connection.send(self._encode_rates(self._value))  # The message depends on the present manager.

    def _encode_rates(self, rates: tuple[float, float]) -> Message:
        """Encode pitch and yaw rates in degrees per second in the message that the manager supports."""
        orders = self._orders
        pitch_rate, yaw_rate = map(math.radians, rates)
        first_fields = (self._session.system_id, orders.manager_id, self._flags, orders.gimbal_id_param)
        if orders.rules.supports_pitchyaw:
            return GimbalManagerSetPitchyaw(*first_fields, pitch=NAN, yaw=NAN, pitch_rate=pitch_rate, yaw_rate=yaw_rate)
        no_attitude = (NAN, NAN, NAN, NAN)
        angular_velocity = (0.0, pitch_rate, yaw_rate)
        return GimbalManagerSetAttitude(*first_fields, no_attitude, *angular_velocity)

    def _stop_reason(self, lag: float) -> str | None:
        manager_id = self._orders.manager_id
        silent_for_s = min(self._orders.registry.silent_for_s(manager_id), self._now() - self._began_at)
        is_silent = manager_id != self._session.component_id and silent_for_s > SILENT_AFTER_S
        if reason := super()._stop_reason(lag):
            return reason
        return f"the gimbal's manager has been silent for {silent_for_s:.1f} s" if is_silent else None

    def _takeover_reason(self) -> str | None:
        try:
            self._orders.raise_if_taken()
        except AerokitError as error:
            self._loss = error
            return str(error)
        return SUPERSEDED if self._order is not None and not self._order.is_newest else None

    def _stop(self, reason: str, *, hold: bool = True) -> None:
        stop_command = self._zero_rates_command()  # After `super()._stop`, the command might address another gimbal.
        super()._stop(reason, hold=hold)
        if hold:
            stop_command.send_soon()
        if self._loss is not None:
            self._stop_error = self._loss

    def _zero_rates_command(self) -> ReleaseCommand:
        orders, order = self._orders, self._order
        no_angles, zero_rates, reserved = (NAN, NAN), (0.0, 0.0), 0
        params = (*no_angles, *zero_rates, self._flags, reserved, orders.gimbal_id_param)

        def is_still_due() -> bool:
            return order is not None and order.is_newest and not orders.is_taken

        # The command may overtake a message with an earlier rate, so messages with a rate of zero follow.
        return ReleaseCommand(orders, PITCHYAW, params, is_still_due, stop_message=self._encode_rates((0.0, 0.0)))

    def _finish(self) -> None:
        self._stop("the block of the vehicle has ended")

    def _end(self) -> None:
        super()._end()
        self._cleanup.close()


def _check_rates(pitch_deg_s: float, yaw_deg_s: float) -> None:
    check_range("pitch_deg_s", pitch_deg_s, -MAX_RATE_DEG_S, MAX_RATE_DEG_S)
    check_range("yaw_deg_s", yaw_deg_s, -MAX_RATE_DEG_S, MAX_RATE_DEG_S)
