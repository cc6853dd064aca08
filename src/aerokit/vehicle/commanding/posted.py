"""`PostedOrder`: an order whose effect need not be awaited, so that the next order can be given at once."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandRejected, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.protocols.command import command_name
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.progress import ChangeSignal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["PostedOrder"]

POLL_INTERVAL_S = 0.05
# Attempts, and seconds between them, for a mode change that the vehicle rejects temporarily.
MAX_MODE_ATTEMPTS, MODE_RETRY_INTERVAL_S = 4, 0.5


@checks_arguments
class PostedOrder:
    """An order whose effect need not be awaited; created by :meth:`aerokit.Vehicle.posted`."""

    def __init__(self, session: VehicleSession, arbiter: CommandArbiter, sender: OrderSender, order: Order) -> None:
        self._session, self._arbiter, self._sender, self._order = session, arbiter, sender, order
        # Collects refusals that arrive after the last command was accepted. It is closed when the next command is sent,
        # or when the `with` block ends.
        self._refusal_watch = ExitStack()
        self._refusals: list[CommandAck] = []
        self._was_left = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._was_left = True
        self._refusal_watch.close()

    @property
    def end(self) -> str:
        """Text that explains why the order's commands are not repeated; empty while they may be repeated."""
        if self._order.is_confirmed:
            return "its effect was reported"
        return self._order.end or self._order.unexplained

    async def command(self, command: int, *params: float, component_id: int | None = None) -> None:
        """Send a COMMAND_LONG of this order. Returns at the acknowledgement, or when the order's effect is reported.

        After a newer order about the same subject, or after another party changed the mode, aerokit does not send the
        command again.

        Args:
            command: the MAV_CMD.
            params: param1 to param7; missing ones are 0, even where the command allows NaN.
            component_id: the target component, by default the autopilot. 0: all components; the autopilot's ack counts.

        Raises:
            InvalidArgument: a parameter has the wrong type or is too large for its field, or the `with` block was left.
                Nothing was sent.
            OperationRejected: the order has ended: it was superseded or taken over.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            CommandTimeout: there was no acknowledgement; the text says why the command was not sent again.
        """
        await self._send(self._session.commands.send_long, command, *params, component_id=component_id)

    async def command_int(
        self,
        command: int,
        *params: float,
        frame: int,
        x: int = 0,
        y: int = 0,
        z: float = 0.0,
        component_id: int | None = None,
    ) -> None:
        """Send a COMMAND_INT: param1 to param4, ``x``, ``y``, ``z`` in ``frame`` (MAV_FRAME).

        ``x`` and ``y`` are latitude and longitude in 1e-7 degrees, or 1e-4 m in local frames; ``z`` is in metres.
        Otherwise works like :meth:`command`.
        """
        place: dict[str, Any] = {"frame": frame, "x": x, "y": y, "z": z}
        await self._send(self._session.commands.send_int, command, *params, component_id=component_id, **place)

    async def set_mode(self, mode: Mode, *, timeout: float = 5.0, component_id: int | None = None) -> None:
        """Order a mode and wait until HEARTBEAT reports the order's effect.

        Sends MAV_CMD_DO_SET_MODE, or SET_MODE to a vehicle that does not support the command. If the vehicle answers
        TEMPORARILY_REJECTED, as PX4 does while it checks a mission, the command is sent again after a HEARTBEAT that
        confirms that the order is still valid.

        Args:
            mode: one of the modes of the order; its ``base_mode`` is sent with it.
            timeout: seconds for HEARTBEAT to report the effect after each ack.
            component_id: as for :meth:`command`.

        Raises:
            InvalidArgument: the mode is not one of the modes of the order, or the `with` block was left. Nothing was
                sent.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: the order has ended: it was superseded or taken over.
            OperationTimeout: the vehicle accepted the mode but stayed in another mode.
        """
        if mode not in self._order.modes:
            allowed = ", ".join(map(str, self._order.modes)) or "none"
            raise InvalidArgument(f"mode = {mode} is not allowed: it must be one of the modes of posted() ({allowed})")
        for attempts_left in reversed(range(MAX_MODE_ATTEMPTS)):
            try:
                self._begin_command(MavCmd.DO_SET_MODE)
                await self._sender.request_mode(mode, self._order, base_mode=mode.base_mode, component_id=component_id)
                await self.wait_confirmed(timeout)
            except CommandRejected as error:
                is_temporary = error.result == MavResult.TEMPORARILY_REJECTED
                may_retry = is_temporary and attempts_left > 0 and not self.end
                if may_retry and await self._is_valid_at_next_heartbeat(timeout):
                    continue
                # Ignore the refusal if HEARTBEAT reports this mode. `is_confirmed` alone may be due to another mode of
                # the order.
                if not (self._order.is_confirmed and self._session.telemetry.is_in(mode)):
                    raise
            return

    async def _is_valid_at_next_heartbeat(self, timeout: float) -> bool:
        """Wait for the next HEARTBEAT. Return False if the order has ended, or if no HEARTBEAT arrives in time."""
        started_at, armed = self._session.connection.now(), self._session.telemetry.armed
        await anyio.sleep(MODE_RETRY_INTERVAL_S)
        with ChangeSignal(self._session, armed, every_arrival=True) as changes, anyio.move_on_after(timeout):
            while armed.updated_at <= started_at or not self._arbiter.is_state_recent:
                self._session.end.raise_if_ended()
                await changes.next(POLL_INTERVAL_S)
            return not self.end
        return False  # No HEARTBEAT was received in time.

    async def wait_confirmed(self, timeout: float) -> None:
        """Wait until HEARTBEAT reports the order's effect. Returns at once if it is already reported.

        Raises:
            CommandRejected: the vehicle first accepted and then refused the command, as PX4 may do.
            OperationRejected: a newer order was given about the same subject.
            OperationTimeout: the effect was not reported within ``timeout`` seconds.
        """
        await self._sender.await_effect(
            "posted order",
            self._order,
            self._refusals,
            is_done=self._is_done,
            failure_reason=lambda: SUPERSEDED if self._arbiter.is_replaced(self._order) else None,
            timeout=timeout,
            max_silence_s=None,
        )

    def _is_done(self) -> bool:
        telemetry, order = self._session.telemetry, self._order
        is_in_mode = any(map(telemetry.is_in, order.modes))
        is_armed_as_ordered = order.armed is not None and telemetry.armed.latest is order.armed
        return is_in_mode or is_armed_as_ordered or order.is_confirmed

    async def _send(
        self, send: Callable[..., Awaitable[CommandAck]], command: int, *params: float, **options: Any
    ) -> None:
        self._begin_command(command)
        order = self._order
        await self._sender.run_command(order, send, command, *params, modes=order.modes, armed=order.armed, **options)

    def _begin_command(self, command: int) -> None:
        if self._was_left:
            raise InvalidArgument(f"the `with` block of this order was left: {command_name(command)} was not sent")
        # The vehicle may refuse a command after accepting it.
        self._refusal_watch.close()
        self._refusals = self._refusal_watch.enter_context(self._session.refusals_of(command))
