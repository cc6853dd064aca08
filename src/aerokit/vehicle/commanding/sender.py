"""`OrderSender`: sends what orders consist of: commands, changes of mode, arming. Each choreography is here once."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import check_range
from aerokit.errors import CommandRejected, CommandTimeout, NotSupported, OperationRejected
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.protocols.command import ATTEMPT_TIMEOUT_S, ATTEMPTS, rejection
from aerokit.vehicle.commanding.arbiter import KNOWN_S, MODE_GRACE_S
from aerokit.vehicle.commanding.order import ARM_ALONE, CHANGED_BY_COMMAND, QUESTIONS
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, await_progress

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterator

    from aerokit.autopilots import Mode, Purpose
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.session.session import Talk

FORCE = 21196
"""param2 of COMPONENT_ARM_DISARM: without the checks."""
TAKEN_BACK = "the vehicle took its acceptance back"


class OrderSender:
    """Sends what orders consist of, as far as docs/reliability.md allows, waited for or not."""

    def __init__(self, talk: Talk, arbiter: CommandArbiter) -> None:
        self._talk, self._arbiter = talk, arbiter

    async def give(
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
        self.raise_if_over(order)
        order.is_given = order.is_given or command in CHANGED_BY_COMMAND
        started = self._talk.connection.now()
        with self._arbiter.sending(order, modes=modes, armed=armed, is_done=is_done) as sending:
            try:
                await send(command, *params, standing=sending, **options)
            except CommandRejected as error:
                if not sending.has_worked:
                    order.was_refused = True
                    await self._talk.settle()
                    raise self._talk.explained(error, started) from None
            except CommandTimeout as error:
                if not sending.has_worked:
                    raise self._unanswered(error, order) from None

    def raise_if_over(self, order: Order) -> None:
        """What an order still has to send is not meant any more once it has ended."""
        if order.end:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    def _unanswered(self, error: CommandTimeout, order: Order) -> Exception:
        """Who has taken the vehicle is the better answer; an order that cannot be taken back may still arrive."""
        if order.taken_by or (order.failsafe and order.end):
            return OperationRejected(str(error), reasons=self._talk.texts_since(order.given_at))
        return error

    async def give_arm(self, order: Order, armed: bool, *, force: bool = False) -> None:
        """Order it to arm or disarm."""
        self._talk.commands.forget_result(MavCmd.COMPONENT_ARM_DISARM)
        params = (float(armed), FORCE if force else 0)
        await self.give(
            order, self._talk.commands.send_long, MavCmd.COMPONENT_ARM_DISARM, *params, armed=armed
        )

    # ----------------------------------------------------------------------------------- modes

    async def change_mode(
        self, wanted: Mode, order: Order, timeout: float = 6.0, *, told_since: float = -math.inf
    ) -> None:
        """Order the mode and wait until it is told, by a message that came after ``told_since``."""
        started = self._talk.connection.now()
        was_in_doubt = self._arbiter.mode_is_in_doubt
        with self._talk.refusals_of(MavCmd.DO_SET_MODE) as refusals, self._arbiter.changing_mode():
            await self.request_mode(wanted, order, attempt_timeout=min(1.0, timeout / 4))
            told_since = self._talk.connection.now() if was_in_doubt else told_since
            left = timeout - (self._talk.connection.now() - started)
            await self.await_mode(wanted, order, refusals, left, told_since)
            self._arbiter.mode_settles_at = -math.inf

    async def request_mode(
        self,
        wanted: Mode,
        order: Order,
        *,
        attempt_timeout: float | None = None,
        base_mode: int | None = None,
        component_id: int | None = None,
    ) -> None:
        """Order a mode, and do not wait for HEARTBEAT to tell it.

        Firmware that does not know MAV_CMD_DO_SET_MODE is sent SET_MODE, once, if the order still stands then.
        """
        request = self._talk.autopilot.mode_order(wanted)
        if base_mode is not None:
            request = request.replace(base_mode=base_mode, params=(base_mode, *request.params[1:]))
        try:
            await self.give(
                order,
                self._talk.commands.send_long,
                MavCmd.DO_SET_MODE,
                *request.params,
                modes=(wanted,),
                attempt_timeout=attempt_timeout,
                component_id=component_id,
            )
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            self.raise_if_over(order)
            if not self._arbiter.is_known:
                raise
            self._talk.send(request.legacy(self._talk.system_id))

    async def await_mode(
        self, wanted: Mode, order: Order, refusals: list[CommandAck], timeout: float, told_since: float
    ) -> None:
        """Wait until the mode is told by a message that came after ``told_since``."""
        telemetry = self._talk.telemetry
        await self.await_effect(
            f"set_mode({wanted.name})",
            refusals,
            is_done=lambda: telemetry.is_in(wanted) and telemetry.mode.updated_at > told_since,
            trouble=lambda: order.end or None,
            timeout=max(0.1, timeout),
        )

    async def await_effect(
        self,
        what: str,
        refusals: list[CommandAck],
        *,
        is_done: Callable[[], bool],
        trouble: Callable[[], str | None],
        timeout: float,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Wait until HEARTBEAT tells what was accepted.

        PX4 acks twice: the first ack is always ACCEPTED, the second one, in ``refusals``, may take it back.

        Raises:
            CommandRejected: the vehicle took its acceptance back.
            OperationRejected: ``trouble()`` gave a reason.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: it was not told within ``timeout`` seconds.
        """
        telemetry, started = self._talk.telemetry, self._talk.connection.now()
        try:
            await await_progress(
                self._talk,
                what,
                is_done=is_done,
                trouble=lambda: TAKEN_BACK if refusals else trouble(),
                describe=lambda: (
                    f"the vehicle is in {telemetry.mode_name}, {'' if telemetry.is_armed else 'not '}armed"
                ),
                timeout=timeout,
                max_silence_s=max_silence_s,
            )
        except OperationRejected:
            if not refusals:
                raise
            error = rejection(refusals[-1].command, refusals[-1].result)
            error.args = (f"{what}: {TAKEN_BACK}: {error}",)
            raise self._talk.explained(error, started) from None

    async def ensure_mode(self, mode: Mode, order: Order) -> None:
        """Change the mode, unless it was told lately that the vehicle is in it: an older mode is no reason."""
        is_told = self._talk.telemetry.is_in(mode) and self._talk.telemetry.mode.age <= KNOWN_S
        if self._arbiter.mode_is_in_doubt or not is_told:
            await self.change_mode(mode, order)

    def mode_for(self, action: str, purpose: Purpose) -> Mode:
        """The autopilot's mode for this; NotSupported, which names the action, where it has none."""
        mode = self._talk.autopilot.mode_for(purpose, is_vtol=self._talk.telemetry.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self._talk.autopilot.firmware} has no mode for it")
        return mode

    def stays_in(self, order: Order, *modes: Mode) -> Callable[[], str | None]:
        """What can go wrong on the way: another order, it disarms, or its mode becomes another one than these."""
        grace_until, settles_at = self._talk.connection.now() + MODE_GRACE_S, self._arbiter.mode_settles_at
        arrived = False

        def trouble() -> str | None:
            nonlocal arrived
            if order.end:
                return order.end
            if self._talk.telemetry.is_surely_disarmed:
                return "the vehicle disarmed"
            if self._talk.connection.now() < settles_at:
                return None
            mode = self._talk.telemetry.mode.latest
            arrived = arrived or mode in modes
            if mode not in modes and (arrived or self._talk.connection.now() > grace_until):
                return f"the mode changed to {mode}" if arrived else f"the vehicle stayed in {mode}"
            return None

        return trouble

    async def command_of(self, order: Order, command: int, *params: float) -> None:
        """One more command of an order that steers."""
        await self.give(order, self._talk.commands.send_long, command, *params)

    async def command_aside(self, command: int, *params: float) -> None:
        """A command that changes something and does not steer."""
        with self._arbiter.aside() as order:
            await self.give(order, self._talk.commands.send_long, command, *params)

    # ------------------------------------------------------------------------ the program's own

    async def answered(
        self,
        send: Callable[..., Awaitable[CommandAck]],
        command: int,
        *params: float,
        retries: int | None,
        **options: Any,
    ) -> CommandAck:
        """Any command that the program itself sends; ``send`` is one of the command sender's."""
        started = self._talk.connection.now()
        if retries is None:
            retries = ATTEMPTS - 1 if command in QUESTIONS else 0
        check_range("retries", retries, 0, 1000)
        options["attempts"] = 1 + retries
        if options["attempt_timeout"] is None and not retries:
            options["attempt_timeout"] = ATTEMPTS * ATTEMPT_TIMEOUT_S
        try:
            if command in QUESTIONS:
                return await send(command, *params, **options)
            names = self._talk.telemetry.mode_names
            modes = self._talk.autopilot.modes_of_command(command, params, names)
            armed = params[0] == 1 if command == MavCmd.COMPONENT_ARM_DISARM and params else None
            with (
                self._own_order(command, modes) as order,
                self._arbiter.sending(order, modes=modes, armed=armed) as sending,
            ):
                return await send(command, *params, standing=sending, **options)
        except CommandRejected as error:
            await self._talk.settle()
            raise self._talk.explained(error, started) from None

    @contextmanager
    def _own_order(self, command: int, modes: Collection[Mode]) -> Iterator[Order]:
        """A program that steers past the actions gives a new order, which ends theirs."""
        if CHANGED_BY_COMMAND.get(command, ARM_ALONE) != ARM_ALONE:
            yield self._arbiter.order_of_the_programs_own(CHANGED_BY_COMMAND[command], modes=modes)
        else:
            with self._arbiter.aside() as order:
                yield order
