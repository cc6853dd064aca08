"""`PostedOrder`: what a program gives of an order that others may follow before it is answered."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandRejected, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.protocols.command import command_name
from aerokit.vehicle.commanding.progress import Arrivals

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.session.session import Talk

__all__ = ["PostedOrder"]

LOOK_S = 0.05
MODE_ATTEMPTS, ASK_AGAIN_S = 4, 0.5


@checks_arguments
class PostedOrder:
    """An order that others may follow before it is answered; made by :meth:`aerokit.Vehicle.posted`."""

    def __init__(self, talk: Talk, arbiter: CommandArbiter, sender: OrderSender, order: Order) -> None:
        self._talk, self._arbiter, self._sender, self._order = talk, arbiter, sender, order
        self._ends = ExitStack()
        self._refusals: list[CommandAck] = []
        self._is_over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._ends.close()

    @property
    def end(self) -> str:
        """Why nothing of it is sent again, as a clause; empty while it may be."""
        return "its effect was told" if self._order.has_worked else self._order.end or self._order.unexplained

    async def command(self, command: int, *params: float, component_id: int | None = None) -> None:
        """Send a COMMAND_LONG of this order; return when it is answered, or the order's effect is told.

        A second one is not sent when a newer order is about its subject, or somebody else has changed the mode, since.

        Args:
            command: the MAV_CMD.
            params: param1 to param7; missing ones are 0.
            component_id: to another component than the autopilot; 0: to all, and the autopilot's answer counts.

        Raises:
            InvalidArgument: a parameter is no number or does not fit, or the block was left. Nothing was sent.
            OperationRejected: the order has ended: a newer one was given, or somebody else steers.
            CommandRejected: the vehicle refused; ``reasons`` has what it said.
            CommandTimeout: there was no answer; the text says so when it was not sent again for a reason.
        """
        await self._give(self._talk.commands.send_long, command, *params, component_id=component_id)

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
        """The same as COMMAND_INT: param1 to param4, ``x`` and ``y`` in 1e-7 degrees, ``z`` metres in ``frame``.

        The rest is as for :meth:`command`.
        """
        place: dict[str, Any] = {"frame": frame, "x": x, "y": y, "z": z}
        await self._give(self._talk.commands.send_int, command, *params, component_id=component_id, **place)

    async def set_mode(self, mode: Mode, *, timeout: float = 5.0, component_id: int | None = None) -> None:
        """Order a mode, and wait until HEARTBEAT tells the order's effect.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command. Where the vehicle says
        that it is too early, as PX4 does while it checks a mission, it is asked again when a HEARTBEAT that has come
        since says that the order still stands.

        Args:
            mode: one of those that the order was posted with; its ``base_mode`` is sent with it.
            timeout: seconds for HEARTBEAT to tell it after each answer.
            component_id: as for :meth:`command`.

        Raises:
            InvalidArgument: the order was not posted with it, or the block was left. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said.
            CommandTimeout: there was no answer.
            OperationTimeout: it accepted, and stays in another mode.
        """
        if mode not in self._order.modes:
            raise InvalidArgument(f"mode = {mode} is not allowed: the order was not posted with it")
        for attempts_left in reversed(range(MODE_ATTEMPTS)):
            try:
                self._begin(MavCmd.DO_SET_MODE)
                await self._sender.request_mode(
                    mode, self._order, base_mode=mode.base_mode, component_id=component_id
                )
                await self.until_told(timeout)
            except CommandRejected as error:
                if self._order.has_worked:
                    return
                if error.result != MavResult.TEMPORARILY_REJECTED or not attempts_left:
                    raise
                if not await self._stands(timeout):
                    raise
            else:
                return

    async def _stands(self, timeout: float) -> bool:
        """Whether HEARTBEAT comes, and tells that the order still stands: nothing is sent again before that."""
        answered_at, told = self._talk.connection.now(), self._talk.telemetry.armed
        await anyio.sleep(ASK_AGAIN_S)
        with (
            Arrivals(self._talk, told, every_arrival=True) as news,
            anyio.move_on_after(timeout),
        ):
            while told.updated_at <= answered_at or not self._arbiter.is_known:
                await news.next(LOOK_S)
            return not self.end
        return False

    async def until_told(self, timeout: float) -> None:
        """Wait until HEARTBEAT tells the order's effect, or that it was there before.

        Raises:
            CommandRejected: the vehicle took its acceptance back, as PX4 does.
            OperationTimeout: it was not told within ``timeout`` seconds.
        """
        await self._sender.await_effect(
            "the order was accepted",
            self._refusals,
            is_done=self._is_done,
            trouble=lambda: None,
            timeout=timeout,
            max_silence_s=None,
        )

    def _is_done(self) -> bool:
        telemetry, order = self._talk.telemetry, self._order
        is_there = any(map(telemetry.is_in, order.modes)) or (
            order.armed is not None and telemetry.armed.latest is order.armed
        )
        return is_there or order.has_worked

    async def _give(
        self, send: Callable[..., Awaitable[CommandAck]], command: int, *params: float, **options: Any
    ) -> None:
        self._begin(command)
        order = self._order
        await self._sender.give(
            order, send, command, *params, modes=order.modes, armed=order.armed, **options
        )

    def _begin(self, command: int) -> None:
        """Hear what the vehicle says later about this command, too."""
        if self._is_over:
            raise InvalidArgument(f"the block of this order was left: {command_name(command)} was not sent")
        self._ends.close()
        self._refusals = self._ends.enter_context(self._talk.refusals_of(command))
