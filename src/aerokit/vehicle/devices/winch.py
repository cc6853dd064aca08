"""``Winch``: lowers, raises and releases a load on a line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import NotSupported
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavWinchStatusFlag, WinchActions
from aerokit.vehicle.commanding.simple_orders import Effect, SimpleOrder, receive_once

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order, Topic
    from aerokit.vehicle.state.measurements import WinchStatus

__all__ = ["Winch"]


LENGTH_TOLERANCE_M = 0.1
RATE_TOLERANCE_M_S = 0.05
ACTION_TIMEOUT_S = 120.0
MAX_LENGTH_M, MAX_RATE_M_S = 1000.0, 20.0


@checks_arguments
class Winch(ReadOnly):
    """One winch: ``vehicle.winch()`` (MAV_CMD_DO_WINCH).

    ArduCopter supports :meth:`relax`, :meth:`pay_out` and :meth:`set_rate`. The other orders are for winches that are
    MAVLink components: ``vehicle.winch(component_id=169)``. PX4 itself drives no winch, but forwards the command to
    these components. An order is sent only once if a second transmission could pay out more line. A newer order for the
    winch ends the call that waits for the previous order. A cancelled call does not stop the winch: call
    ``set_rate(0)``.
    """

    def __init__(self, context: VehicleContext, number: int, component_id: int | None) -> None:
        self._context, self._number, self._component_id = context, number, component_id

    @property
    def _topic(self) -> Topic:
        return ("winch", self._number, self._component_id)

    @property
    def status(self) -> StateCell[WinchStatus]:
        """Length, speed, tension and state of the autopilot's winch; the same cell as ``vehicle.winch_status``."""
        cell: StateCell[WinchStatus] = self._context.session.telemetry.cells["winch_status"]
        return cell

    async def relax(self) -> None:
        """Let the line run freely. Returns at the acknowledgement, because ArduCopter does not report the effect.

        Raises:
            NotSupported: the autopilot has no such order. Nothing was sent.
            CommandRejected: there is no winch (WINCH_TYPE).
            CommandTimeout: there was no acknowledgement.
            OperationRejected: your program gave a newer order for this winch before the acknowledgement.
        """
        await self._send(WinchActions.RELAXED)

    async def pay_out(self, length_m: float, *, rate_m_s: float = 0.5, timeout: float = ACTION_TIMEOUT_S) -> None:
        """Pay out a length of line, and return when WINCH_STATUS reports it within 0.1 m.

        Returns at the acknowledgement if the winch sends no WINCH_STATUS. The command is sent once, because a second
        one would pay out more line. The length counts from the moment at which the winch gets the command. If it is
        turning at that moment, the call returns when it has stopped.

        Args:
            length_m: metres, −1000 to 1000; negative values wind the line up.
            rate_m_s: speed, above 0, at most 20 m/s; ArduCopter uses WINCH_MAX_RATE instead.
            timeout: seconds until WINCH_STATUS reports the length.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
            NotSupported: the autopilot has no such order. Nothing was sent.
            CommandRejected: there is no winch (WINCH_TYPE).
            CommandTimeout: there was no acknowledgement; the winch may run.
            OperationRejected: your program gave a newer order for this winch.
            HeartbeatTimeout: the vehicle was silent for ten seconds.
            OperationTimeout: WINCH_STATUS did not report the length in time.
        """
        check_range("length_m", length_m, -MAX_LENGTH_M, MAX_LENGTH_M)
        check_range("rate_m_s", rate_m_s, 0, MAX_RATE_M_S, above=True)
        self._check_supported(WinchActions.RELATIVE_LENGTH_CONTROL)
        # The order is created before the wait for a status. A newer order that is given during the wait then ends this
        # order.
        order = self._context.arbiter.device_order(self._topic)
        status_before: m.WinchStatus | None = None
        for _ in range(2):  # The first requests may be lost in a silence.
            status_before = await receive_once(self._context, m.WinchStatus, self._component_id)
            await self._context.sender.await_recent_state(order)  # The vehicle may have become silent.
            if status_before is not None:
                break
        await self._send(
            WinchActions.RELATIVE_LENGTH_CONTROL,
            length_m,
            rate_m_s,
            is_done=None if status_before is None else self._has_paid_out(status_before, length_m),
            timeout=timeout,
            order=order,
        )

    def _has_paid_out(self, status_before: m.WinchStatus, length_m: float) -> Callable[[m.WinchStatus], bool]:
        """Return a predicate that is True for a WINCH_STATUS which reports that ``length_m`` was paid out.

        The winch adds ``length_m`` to the length of its line at the time when it gets the command. If it was turning,
        that length is not known exactly.
        """
        frame, now = status_before.received_frame, self._context.session.connection.now
        reported_at = now() if frame is None else frame.received_at
        was_turning = abs(status_before.speed) > RATE_TOLERANCE_M_S
        max_moved_m: float | None = None

        def has_paid_out(status: m.WinchStatus) -> bool:
            nonlocal max_moved_m
            # A turning winch moved its line further between `status_before` and the command. `max_moved_m` limits this
            # movement. It is computed in the first call, because the command was acknowledged before that call.
            if max_moved_m is None:
                max_moved_m = status_before.speed * (now() - reported_at) if was_turning else 0.0
            moved_m = status.line_length - length_m - status_before.line_length
            lowest_m, highest_m = sorted((0.0, max_moved_m))
            is_near = lowest_m - LENGTH_TOLERANCE_M <= moved_m <= highest_m + LENGTH_TOLERANCE_M
            return is_near and (not was_turning or abs(status.speed) <= RATE_TOLERANCE_M_S)

        return has_paid_out

    async def set_rate(self, rate_m_s: float) -> None:
        """Pay out line at this speed until the next order. Returns when WINCH_STATUS reports the speed.

        Args:
            rate_m_s: −20 to 20 m/s; negative values wind the line up, 0 stops. ArduCopter limits the speed to
                WINCH_MAX_RATE; a call with a higher speed times out.

        Raises:
            InvalidArgument, NotSupported, CommandRejected, CommandTimeout, OperationRejected, OperationTimeout: as for
                ``pay_out``.
        """
        check_range("rate_m_s", rate_m_s, -MAX_RATE_M_S, MAX_RATE_M_S)
        await self._send(
            WinchActions.RATE_CONTROL,
            rate_m_s=rate_m_s,
            is_done=lambda status: abs(status.speed - rate_m_s) <= RATE_TOLERANCE_M_S,
        )

    async def lock(self) -> None:
        """Engage the brake, and return when WINCH_STATUS reports it locked. Raises as :meth:`retract`."""
        await self._send_until(MavWinchStatusFlag.LOCKED, WinchActions.LOCK)

    async def deliver(self) -> None:
        """Start the winch's automatic delivery: lower, release, retract. Returns at the acknowledgement.

        Raises as :meth:`relax`.
        """
        await self._send(WinchActions.DELIVER)

    async def hold(self) -> None:
        """Hold the line by the motor instead of the brake. Returns at the acknowledgement. Raises as :meth:`relax`."""
        await self._send(WinchActions.HOLD)

    async def retract(self, *, timeout: float = ACTION_TIMEOUT_S) -> None:
        """Wind up all line, and return when WINCH_STATUS reports it fully retracted.

        Args:
            timeout: seconds until the line is retracted.

        Raises:
            NotSupported: the autopilot has no such order. Nothing was sent.
            CommandRejected: the winch refused.
            CommandTimeout: there was no acknowledgement; the winch may run.
            OperationRejected: a newer order for this winch was given.
            HeartbeatTimeout: the vehicle was silent for ten seconds.
            OperationTimeout: WINCH_STATUS did not report the end in time.
        """
        await self._send_until(MavWinchStatusFlag.FULLY_RETRACTED, WinchActions.RETRACT, timeout)

    async def load_line(self) -> None:
        """Load new line onto the winch. Returns when WINCH_STATUS reports LOAD_LINE. Raises as :meth:`retract`."""
        await self._send_until(MavWinchStatusFlag.LOAD_LINE, WinchActions.LOAD_LINE)

    async def abandon_line(self) -> None:
        """Spool out the entire line. Returns when WINCH_STATUS reports ABANDON_LINE. Raises as :meth:`retract`."""
        await self._send_until(MavWinchStatusFlag.ABANDON_LINE, WinchActions.ABANDON_LINE)

    async def load_payload(self) -> None:
        """Present the hook for a payload. Returns when WINCH_STATUS reports LOAD_PAYLOAD. Raises as :meth:`retract`."""
        await self._send_until(MavWinchStatusFlag.LOAD_PAYLOAD, WinchActions.LOAD_PAYLOAD)

    async def _send_until(
        self, flag: MavWinchStatusFlag, action: WinchActions, timeout: float = ACTION_TIMEOUT_S
    ) -> None:
        await self._send(action, is_done=lambda status: bool(status.status & flag), timeout=timeout)

    async def _send(
        self,
        action: WinchActions,
        length_m: float = 0.0,
        rate_m_s: float = 0.0,
        is_done: Callable[[m.WinchStatus], bool] | None = None,
        timeout: float = 5.0,
        order: Order | None = None,
    ) -> None:
        """Send a command as a part of ``order``, or as a new order."""
        self._check_supported(action)
        params = (self._number, action, length_m, rate_m_s)
        effect = None if is_done is None else Effect("WinchStatus", is_done)
        await SimpleOrder(f"winch {action.name.lower()}", MavCmd.DO_WINCH, params, effect).send(
            self._context, device_order=order, topic=self._topic, component_id=self._component_id, timeout=timeout
        )

    def _check_supported(self, action: WinchActions) -> None:
        autopilot = self._context.session.autopilot
        is_for_autopilot = self._component_id in (None, self._context.session.component_id)
        if is_for_autopilot and action not in autopilot.winch_actions:
            raise NotSupported(f"winch: {autopilot.firmware} has no action {action.name}; nothing was sent")
