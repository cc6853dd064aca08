"""Flight modes, and sending orders: what every other action rests on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout, NotSupported, OperationRejected
from aerokit.vehicle.checks import check_seconds
from aerokit.vehicle.orders.health import VehicleHealth
from aerokit.vehicle.orders.helm import KNOWN_S, MODE_GRACE_S
from aerokit.vehicle.orders.order import MOVING_COMMANDS
from aerokit.vehicle.orders.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.autopilots import Mode, Purpose
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.orders.order import Order

__all__ = ["CHANGE_MODE", "DO_REPOSITION", "RESULT_UNSUPPORTED", "ModeActions"]

DO_SET_MODE = 176
DO_REPOSITION = 192
CHANGE_MODE = 1
RESULT_UNSUPPORTED = 3


@checks_arguments
class ModeActions(VehicleHealth):
    """Changing the flight mode."""

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it.

        Args:
            mode: a name as the autopilot's own documentation spells it (``"GUIDED"``, ``"POSCTL"``; case does not
                matter), or the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole of it.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Raises:
            LocalProtocolError: this vehicle has no such mode; the text lists those it has. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: it accepted and stayed in another mode, or did not answer.
        """
        check_seconds("timeout", timeout)
        wanted = self.autopilot.find_mode(mode, self.telemetry.mode_names)
        await self._change_mode(wanted, self._helm.order(wanted), timeout)

    # ---------------------------------------------------------------------------------- orders

    async def _give(
        self,
        order: Order,
        send: Callable[..., Awaitable[CommandAck]],
        command: int,
        *params: float,
        modes: tuple[Mode, ...] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
        **options: Any,
    ) -> None:
        """Send a command of an order until it is answered or its effect was told (``modes``, ``armed``, ``is_done``).

        Raises:
            OperationRejected: the order has ended: a newer one was given, or somebody else steers.
            CommandRejected: the vehicle refused; ``reasons`` has what it said.
            CommandTimeout: there was no answer; the text says so when it was not sent again for a reason.
        """
        self._raise_if_over(order)
        order.is_given = order.is_given or command in MOVING_COMMANDS
        started = self.connection.now()
        with self._helm.sending(order, modes=modes, armed=armed, is_done=is_done) as sending:
            try:
                await send(command, *params, standing=sending, **options)
            except CommandRejected as error:
                if not sending.has_worked:
                    await self._settle()
                    raise self._explained(error, started) from None
            except CommandTimeout as error:
                if not sending.has_worked:
                    raise self._unanswered(error, order) from None

    def _raise_if_over(self, order: Order) -> None:
        """What an order still has to send is not meant any more once it has ended."""
        if order.end:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    def _unanswered(self, error: CommandTimeout, order: Order) -> Exception:
        """Who has taken the vehicle is the better answer; an order that cannot be taken back may still arrive."""
        if order.taken_by:
            return OperationRejected(str(error), reasons=self.texts_since(order.given_at))
        return error

    # ----------------------------------------------------------------------------------- modes

    async def _change_mode(
        self, wanted: Mode, order: Order, timeout: float = 6.0, *, told_since: float = -math.inf
    ) -> None:
        """Order the mode and wait until it is told, by a message that came after ``told_since``."""
        started = self.connection.now()
        was_in_doubt = self._helm.mode_is_in_doubt
        with self._refusals_of(DO_SET_MODE) as refusals, self._helm.changing_mode():
            await self._request_mode(wanted, order, timeout)
            told_since = self.connection.now() if was_in_doubt else told_since
            left = timeout - (self.connection.now() - started)
            await self._await_mode(wanted, order, refusals, left, told_since)
            self._helm.mode_settles_at = -math.inf

    async def _request_mode(self, wanted: Mode, order: Order, timeout: float) -> None:
        params = self.autopilot.mode_order(wanted).params
        try:
            await self._give(
                order,
                self._commands.send_long,
                DO_SET_MODE,
                *params,
                modes=(wanted,),
                attempt_timeout=min(1.0, timeout / 4),
            )
        except CommandRejected as error:
            if error.result != RESULT_UNSUPPORTED:
                raise
            self._raise_if_over(order)
            self.connection.send(self.autopilot.mode_order(wanted).legacy(self.system_id))

    async def _await_mode(
        self,
        wanted: Mode,
        order: Order,
        refusals: list[CommandAck],
        timeout: float,
        told_since: float,
    ) -> None:
        """PX4 acks twice: the first ack is always ACCEPTED, the second one may take it back."""

        def trouble() -> str | None:
            return "the vehicle took its acceptance back" if refusals else order.end or None

        await await_progress(
            self,
            f"set_mode({wanted.name})",
            is_done=lambda: self._is_in(wanted) and self.telemetry.mode.updated_at > told_since,
            trouble=trouble,
            describe=lambda: f"the vehicle is in {self.mode_name}",
            timeout=max(0.1, timeout),
        )

    def _is_in(self, mode: Mode) -> bool:
        latest = self.telemetry.mode.latest
        return latest is not None and latest.custom_mode == mode.custom_mode

    async def _ensure_mode(self, mode: Mode, order: Order) -> None:
        """Change the mode, unless it was told lately that the vehicle is in it: an older mode is no reason."""
        is_told = self._is_in(mode) and self.telemetry.mode.age <= KNOWN_S
        if self._helm.mode_is_in_doubt or not is_told:
            await self._change_mode(mode, order)

    def _mode_for(self, action: str, purpose: Purpose) -> Mode:
        mode = self.autopilot.mode_for(purpose, is_vtol=self.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self.autopilot.firmware} has no mode for it")
        return mode

    def _stays_in(self, order: Order, *modes: Mode) -> Callable[[], str | None]:
        """What can go wrong on the way: another order, it disarms, or its mode becomes another one than these."""
        grace_until, settles_at = self.connection.now() + MODE_GRACE_S, self._helm.mode_settles_at
        arrived = False

        def trouble() -> str | None:
            nonlocal arrived
            if order.end:
                return order.end
            if self.is_surely_disarmed:
                return "the vehicle disarmed"
            if self.connection.now() < settles_at:
                return None
            mode = self.telemetry.mode.latest
            arrived = arrived or mode in modes
            if mode not in modes and (arrived or self.connection.now() > grace_until):
                return f"the mode changed to {mode}" if arrived else f"the vehicle stayed in {mode}"
            return None

        return trouble

    async def _command_of(self, order: Order, command: int, *params: float) -> None:
        """One more command of an order that steers."""
        await self._give(order, self._commands.send_long, command, *params)

    async def _explained_command(self, command: int, *params: float) -> None:
        """A command that changes something and does not steer."""
        with self._helm.aside() as order:
            await self._give(order, self._commands.send_long, command, *params)
