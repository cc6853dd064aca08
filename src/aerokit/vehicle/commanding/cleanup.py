"""`Holding`: what is left of an order that was given up: the vehicle is told to hold, as far as it may be."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.connection.tasks import Cancellation
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags
from aerokit.vehicle.commanding.arbiter import FIRST_HEARTBEAT_S, is_first_told

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.session.session import Talk

logger: logging.Logger = logging.getLogger("aerokit")


class Leftover:
    """The latest of its tasks: it can be dropped, and the end of the vehicle's block gives it a moment.

    ``name`` is the task's, ``what_it_leaves`` how the warning ends when the block is left before it is done.
    """

    def __init__(self, talk: Talk, name: str, what_it_leaves: str) -> None:
        self._talk, self._name, self._what_it_leaves = talk, name, what_it_leaves
        self._scope: Cancellation | None = None
        self._is_over: asyncio.Event | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is still to be done."""
        return self._scope is not None

    def start(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do this, for as long as the connection is there."""
        scope, is_over = Cancellation(), asyncio.Event()
        self._scope, self._is_over = scope, is_over

        async def run() -> None:
            with scope:
                await work()
            if self._scope is scope:
                self._scope = None
            is_over.set()

        self._talk.background.start(run, self._name)

    def drop(self) -> None:
        """It is not to be done any more; what it has shielded it ends."""
        if self._scope is not None:
            self._scope.cancel()
            self._scope = None

    @contextmanager
    def spared(self) -> Iterator[None]:
        """Within, ``drop`` leaves it alone: for what it does itself."""
        scope, self._scope = self._scope, None
        try:
            yield
        finally:
            self._scope = scope

    async def finish(self, within_s: float) -> None:
        """At the end of everything: wait for so long, and say so if it is not done then."""
        if self._scope is None or self._is_over is None or not self._talk.connection.is_open:
            return
        if within_s:
            with anyio.CancelScope(shield=True), anyio.move_on_after(within_s):
                await self._is_over.wait()
        if self._scope is not None:
            logger.warning(
                "the block of this vehicle was left %s: %s", self._what_it_leaves, self._talk.describe_link()
            )


HOLD_AT_END_S = 1.5
"""How long the end of a block waits for the answer to an order to hold."""

ROUNDS = 3
"""So often it is told to hold when it is heard again."""

ANSWER_S, ATTEMPTS_TO_HOLD = 0.5, 10
"""An order to hold that was sent in passing is given again when it is not answered."""

STOP_HERE = (MavCmd.DO_REPOSITION, -1, MavDoRepositionFlags.CHANGE_MODE, 0, *(math.nan,) * 4)
"""A place that is no number means: here, with the way it takes to brake."""


class Holding:
    """Stops the vehicle: as an order, and when one was given up.

    ``end_stream`` ends the set-point stream that is open, for a reason.
    """

    def __init__(self, talk: Talk, arbiter: CommandArbiter, sender: OrderSender) -> None:
        self._talk, self._arbiter, self._sender = talk, arbiter, sender
        self.end_stream: Callable[[str], None] | None = None
        self._flight: Order | None = None
        self._leftover = Leftover(talk, "aerokit hold", "before it confirmed that it holds")
        arbiter.on_steering(self._leftover.drop)  # what an earlier order left is not confirmed any more

    async def hold(self) -> None:
        """Order it, as :meth:`aerokit.Vehicle.hold` says."""
        mode = self._sender.mode_for("hold", "hold")
        await self.stop_in(mode, self._arbiter.order(mode))

    async def stop_in(self, mode: Mode, order: Order) -> None:
        """Order it in any case; PX4 in LOITER may be on its way somewhere, where the mode alone would not stop it."""
        if self._holds_by_reposition:
            await self._sender.command_of(order, *STOP_HERE)
            await self._sender.ensure_mode(mode, order)
        else:
            await self._sender.change_mode(mode, order, told_since=order.given_at)

    async def _confirm_hold(self, mode: Mode, order: Order) -> None:
        """What :meth:`_send_hold` has sent is answered, or sent again."""
        by_mode = (MavCmd.DO_SET_MODE, *self._talk.autopilot.mode_order(mode).params)
        command, *params = STOP_HERE if self._holds_by_reposition else by_mode
        await self._sender.give(
            order,
            self._talk.commands.send_long,
            int(command),
            *params,
            modes=() if self._holds_by_reposition else (mode,),
            attempt_timeout=ANSWER_S,
            attempts=ATTEMPTS_TO_HOLD,
            is_sent=True,
        )

    # -------------------------------------------------------------------- what was given up

    def hold_soon(self, order: Order) -> bool:
        """An order was given up: tell the vehicle to hold without waiting, for the ends of blocks and cancelled calls.

        One command goes out at once, if the vehicle has told lately what it does; else as soon as it tells it: what
        a failsafe or a pilot has made of it meanwhile is left alone. A task of the vehicle's own confirms it, as
        long as the connection is there. Nothing is sent when the order has ended, when nothing was given of it yet to
        a vehicle that somebody else flies, or the vehicle is known to be disarmed; says whether it was, or may be.
        """
        if not order.is_given:
            return False
        mode = self._talk.autopilot.mode_for("hold", is_vtol=self._talk.telemetry.is_vtol)
        if (
            mode is None
            or not self._talk.connection.is_open
            or self._talk.telemetry.is_surely_disarmed
            or order.end
        ):
            return False
        is_sent = self._arbiter.is_known
        if is_sent:
            self._send_hold(mode)
            order = self._arbiter.order(*order.modes, mode)
            self._arbiter.doubt_mode()
        self._leftover.start(partial(self._hold_when_known, mode, order, is_sent=is_sent))
        return True

    def _send_hold(self, mode: Mode) -> None:
        if self._holds_by_reposition:
            self._talk.commands.send_unconfirmed(*STOP_HERE)
        else:
            self._talk.commands.send_unconfirmed(
                MavCmd.DO_SET_MODE, *self._talk.autopilot.mode_order(mode).params
            )

    async def _hold_when_known(self, mode: Mode, order: Order, *, is_sent: bool) -> None:
        for _ in range(ROUNDS):
            try:
                if is_sent:
                    await self._confirm_hold(mode, order)
                    return
                await self._hear()
                if not order.end and not self._talk.telemetry.is_surely_disarmed:
                    with self._leftover.spared():  # it is this task that gives the newer order
                        order = self._arbiter.order(*order.modes, mode)
                    await self.stop_in(mode, order)
                return
            except OperationTimeout as error:
                logger.warning("the vehicle was told to hold and has not confirmed it yet: %s", error)
                is_sent = False
            except AerokitError as error:
                if not order.end:
                    logger.warning("the vehicle was told to hold and does not: %s", error)
                return

    async def _hear(self) -> None:
        """Until the vehicle tells what it does."""
        armed, since = self._talk.telemetry.armed, self._talk.connection.now()
        await armed.wait_until(lambda _: armed.updated_at > since, description="what the vehicle does now")

    @property
    def is_told_to_hold(self) -> bool:
        """Whether a flight was given up and the hold that was ordered is not confirmed yet."""
        return self._leftover.is_open

    async def finish(self) -> None:
        """At the end of everything: give an order to hold the time to be answered, or to be given again."""
        await self._leftover.finish(HOLD_AT_END_S if self._arbiter.is_known else 0)

    @contextmanager
    def flying(self, order: Order) -> Iterator[None]:
        """For as long as a call waits for this order, the end of the vehicle's block means hold."""
        self._flight = order
        try:
            yield
        finally:
            if self._flight is order:
                self._flight = None

    def end_flights(self) -> None:
        """At the end of everything: what other tasks still have under way ends, and the vehicle is told to hold."""
        if self.end_stream is not None:
            self.end_stream("the block of its vehicle was left")
        if self._flight is not None:
            self.hold_soon(self._flight)

    @property
    def _holds_by_reposition(self) -> bool:
        return (
            self._talk.autopilot.reposition is not None and self._talk.autopilot.reposition_purpose == "hold"
        )


LATE_S = 15.0
"""For so long after an order to arm was given up the vehicle is watched, and disarmed if that order arms it."""

ACK_S = 3.0
"""How long after a HEARTBEAT that says armed the COMMAND_ACK of the order may come."""

ARMING_AT_END_S = 1.5
"""How long the end of a block waits for it."""


class LateArming:
    """Watches a vehicle after an order to arm was given up."""

    def __init__(self, talk: Talk, arbiter: CommandArbiter, sender: OrderSender) -> None:
        self._talk, self._arbiter, self._sender = talk, arbiter, sender
        unsure = "while an order to arm may still be carried out"
        self._leftover = Leftover(talk, "aerokit late arming", unsure)

    def text(self) -> str:
        """What an error says of an order to arm that may still arrive."""
        unsent = self._talk.connection.unsent_bytes
        where = f"; {unsent} bytes have not left this computer yet" if unsent else ""
        return f"the order may still be carried out{where}: if it arms the vehicle within {LATE_S:g} s, it is disarmed"

    def watch(self, order: Order, was_armed: bool) -> None:
        """The order to arm was given up; it may have been heard, or may still arrive."""
        self._talk.connection.discard_unsent()
        self._leftover.start(partial(self._look, order, was_armed, self._arbiter.arming_orders))

    async def _look(self, order: Order, was_armed: bool, count: int) -> None:
        armed = self._talk.telemetry.armed
        disarmed_at = [order.given_at]
        stop = armed.observe(
            lambda _, value: None if value else disarmed_at.append(armed.updated_at), every_arrival=True
        )
        has_armed = False
        try:
            with anyio.move_on_after(LATE_S):
                has_armed = await self._arms(was_armed)
        finally:
            stop()
        if has_armed:
            await self._disarm_again(order, count, disarmed_at[-1])

    async def _arms(self, was_armed: bool) -> bool:
        """Wait until it arms; what was armed before the order is left alone until it has disarmed."""
        armed, since = self._talk.telemetry.armed, self._talk.connection.now()
        try:
            if was_armed:
                await armed.wait_until(lambda value: not value, description="disarmed")
            await armed.wait_until(lambda value: value and armed.updated_at > since, description="armed")
        except AerokitError as error:
            logger.warning("the link ended while an order to arm may still be carried out: %s", error)
            return False
        return True

    async def _disarm_again(self, order: Order, count: int, disarmed_at: float) -> None:
        """What somebody else has armed is left alone."""
        if self._arbiter.arming_orders != count:  # the program has ordered it by a command of its own
            return
        if not await self._has_armed(order, disarmed_at):
            logger.warning(
                "the vehicle armed after an order to arm was given up, and nothing shows that this order"
                " did it: it is left armed"
            )
            return
        logger.warning("the vehicle armed although the order to arm was given up: it is disarmed again")
        with anyio.CancelScope(shield=True):
            try:
                with self._arbiter.aside(ends_flight=True) as order:
                    await self._sender.give_arm(order, False)
            except AerokitError as error:
                logger.error(
                    "the vehicle armed after the order was given up, and could not be disarmed: %s", error
                )

    async def _has_armed(self, order: Order, disarmed_at: float) -> bool:
        """Whether it was this order that armed the vehicle, and not a pilot.

        It was when the vehicle has accepted it and has not told since that it is disarmed. Without an answer the time
        tells, unless somebody else has taken the vehicle.
        """
        told_after = self._talk.telemetry.armed.updated_at - order.given_at
        if not order.end and told_after <= FIRST_HEARTBEAT_S:
            return True
        if not self._is_accepted(disarmed_at):
            await anyio.sleep(ACK_S)
        return self._is_accepted(disarmed_at)

    def _is_accepted(self, disarmed_at: float) -> bool:
        accepted_at = self._talk.commands.accepted_at(MavCmd.COMPONENT_ARM_DISARM)
        return is_first_told(disarmed_at, accepted_at)

    def stop(self) -> None:
        """Another order about arming is given."""
        self._leftover.drop()

    async def finish(self) -> None:
        """At the end of everything: an order to arm that was given up is answered, or is said to be out."""
        await self._leftover.finish(ARMING_AT_END_S)
