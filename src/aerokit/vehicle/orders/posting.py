"""`PostedOrder`: what a program gives of an order that others may follow before it is answered."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout, LocalProtocolError, OperationTimeout
from aerokit.protocols.command import command_name, rejection
from aerokit.vehicle.orders.progress import Arrivals

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from typing_extensions import Self

    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.orders.posted import Posted
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["PostedOrder"]

LOOK_S = 0.05


@checks_arguments
class PostedOrder:
    """An order that others may follow before it is answered; made by :meth:`aerokit.Vehicle.posted`."""

    def __init__(self, talk: Talk, posted: Posted) -> None:
        self._talk, self._posted = talk, posted
        self._ends = ExitStack()
        self._started = talk.connection.now()
        self._refusals: list[CommandAck] = []
        self._has_begun = self._is_over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._ends.close()

    @property
    def end(self) -> str:
        """Why nothing of it is sent again, as a clause; empty while it may be."""
        return self._posted.end

    async def command(self, command: int, *params: float, component_id: int | None = None) -> None:
        """Send a COMMAND_LONG of this order; return when it is answered, or the order's effect is told.

        A second one is not sent when a newer order is about its subject, or somebody else has changed the mode, since.

        Args:
            command: the MAV_CMD.
            params: param1 to param7; missing ones are 0.
            component_id: to another component than the autopilot; 0: to all, and the autopilot's answer counts.

        Raises:
            LocalProtocolError: a parameter is no number or does not fit, or the block was left. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said.
            CommandTimeout: there was no answer; the text says so when it was not sent, or not again, for a reason.
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

    async def until_told(self, timeout: float) -> None:
        """Wait until HEARTBEAT tells the order's effect, or that it was there before.

        Raises:
            CommandRejected: the vehicle took its acceptance back, as PX4 does.
            OperationTimeout: it was not told within ``timeout`` seconds.
        """
        telemetry = self._talk.telemetry
        with (
            Arrivals(self._talk, telemetry.mode, telemetry.armed, every_arrival=True) as news,
            anyio.move_on_after(timeout),
        ):
            while not self._is_done():
                self._talk.connection.raise_if_ended()
                if self._refusals:
                    raise self._refused(rejection(self._refusals[-1].command, self._refusals[-1].result))
                await news.next(LOOK_S)
            return
        armed = "armed" if telemetry.is_armed else "not armed"
        raise OperationTimeout(
            f"accepted, and not done within {timeout:g} s: the vehicle is in {telemetry.mode_name}, {armed}"
        )

    def _is_done(self) -> bool:
        telemetry, posted = self._talk.telemetry, self._posted
        is_there = any(map(telemetry.is_in, posted.modes)) or (
            posted.armed is not None and telemetry.armed.latest is posted.armed
        )
        return is_there or posted.has_worked

    async def _give(
        self, send: Callable[..., Awaitable[CommandAck]], command: int, *params: float, **options: Any
    ) -> None:
        if self._is_over:
            raise LocalProtocolError(
                f"the block of this order was left: {command_name(command)} was not sent"
            )
        if self._has_begun and self._posted.lost:
            raise CommandTimeout(f"{command_name(command)} was not sent: {self._posted.lost}")
        self._has_begun, self._started = True, self._talk.connection.now()
        self._ends.close()
        self._refusals = self._ends.enter_context(self._talk.refusals_of(command))
        try:
            await send(command, *params, standing=self._posted, **options)
        except CommandRejected as error:
            await self._talk.settle()
            raise self._refused(error) from None
        except CommandTimeout:
            if not self._posted.has_worked:
                raise

    def _refused(self, error: CommandRejected) -> CommandRejected:
        return self._talk.explained(error, self._started)
