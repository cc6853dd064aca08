"""`Holding`: what is left of an order that was given up: the vehicle is told to hold, as far as it may be."""

from __future__ import annotations

import logging
import math
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags
from aerokit.vehicle.orders.leftover import Leftover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.autopilots import Mode
    from aerokit.vehicle.orders.helm import Helm
    from aerokit.vehicle.orders.order import Order
    from aerokit.vehicle.orders.orders import Orders
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["Holding"]

logger: logging.Logger = logging.getLogger("aerokit")

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

    def __init__(self, talk: Talk, helm: Helm, orders: Orders) -> None:
        self._talk, self._helm, self._orders = talk, helm, orders
        self.end_stream: Callable[[str], None] | None = None
        self._flight: Order | None = None
        self._leftover = Leftover(talk, "aerokit hold", "before it confirmed that it holds")
        helm.on_new(self._leftover.drop)  # what an earlier order left is not confirmed any more

    async def hold(self) -> None:
        """Order it, as :meth:`aerokit.Vehicle.hold` says."""
        mode = self._orders.mode_for("hold", "hold")
        await self.stop_in(mode, self._helm.order(mode))

    async def stop_in(self, mode: Mode, order: Order) -> None:
        """Order it in any case; PX4 in LOITER may be on its way somewhere, where the mode alone would not stop it."""
        if self._holds_by_reposition:
            await self._orders.command_of(order, *STOP_HERE)
            await self._orders.ensure_mode(mode, order)
        else:
            await self._orders.change_mode(mode, order, told_since=order.given_at)

    async def _confirm_hold(self, mode: Mode, order: Order) -> None:
        """What :meth:`_send_hold` has sent is answered, or sent again."""
        by_mode = (MavCmd.DO_SET_MODE, *self._talk.autopilot.mode_order(mode).params)
        command, *params = STOP_HERE if self._holds_by_reposition else by_mode
        await self._orders.give(
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
        is_sent = self._helm.is_known
        if is_sent:
            self._send_hold(mode)
            order = self._helm.order(*order.modes, mode)
            self._helm.doubt_mode()
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
                        order = self._helm.order(*order.modes, mode)
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
        await self._leftover.finish(HOLD_AT_END_S if self._helm.is_known else 0)

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
