"""`PostedOrder`: what a program gives of an order that others may follow before it is answered."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.protocols.command import command_name, rejection
from aerokit.vehicle.commanding.progress import Arrivals

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from typing_extensions import Self

    from aerokit.autopilots import Mode
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.commanding.helm import Helm
    from aerokit.vehicle.commanding.posted import Posted
    from aerokit.vehicle.session.session import Talk

__all__ = ["PostedOrder"]

LOOK_S = 0.05
MODE_ATTEMPTS, ASK_AGAIN_S = 4, 0.5


@checks_arguments
class PostedOrder:
    """An order that others may follow before it is answered; made by :meth:`aerokit.Vehicle.posted`."""

    def __init__(self, talk: Talk, helm: Helm, posted: Posted) -> None:
        self._talk, self._helm, self._posted = talk, helm, posted
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
            InvalidArgument: a parameter is no number or does not fit, or the block was left. Nothing was sent.
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
        if mode not in self._posted.modes:
            raise InvalidArgument(f"mode = {mode} is not allowed: the order was not posted with it")
        for attempts_left in reversed(range(MODE_ATTEMPTS)):
            try:
                await self._request_mode(mode, component_id)
                await self.until_told(timeout)
            except CommandRejected as error:
                if self._posted.has_worked:
                    return
                if error.result != MavResult.TEMPORARILY_REJECTED or not attempts_left:
                    raise
                if not await self._stands(timeout):
                    raise
            else:
                return

    async def _stands(self, timeout: float) -> bool:
        """Whether HEARTBEAT comes, and tells that the order still stands: nothing is sent again before that."""
        answered_at = self._talk.connection.now()
        await anyio.sleep(ASK_AGAIN_S)
        with (
            Arrivals(self._talk, self._talk.telemetry.armed, every_arrival=True) as news,
            anyio.move_on_after(timeout),
        ):
            while self._posted.told_at <= answered_at or not self._helm.is_known:
                await news.next(LOOK_S)
            return not (self.end or self._is_over)
        return False

    async def _request_mode(self, mode: Mode, component_id: int | None) -> None:
        talk = self._talk
        order = talk.autopilot.mode_order(mode).replace(base_mode=mode.base_mode)
        params = (order.base_mode, *order.params[1:])
        try:
            await self.command(MavCmd.DO_SET_MODE, *params, component_id=component_id)
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED or (self.end and not talk.telemetry.is_in(mode)):
                raise
            if not self.end:
                if self._is_over or not self._helm.is_known:
                    raise
                talk.send(order.legacy(talk.system_id))

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
            raise InvalidArgument(f"the block of this order was left: {command_name(command)} was not sent")
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
