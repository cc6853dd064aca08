"""`LateArming`: an order to arm that was given up may still be carried out: the vehicle is disarmed then."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.orders.leftover import Leftover

if TYPE_CHECKING:
    from aerokit.vehicle.orders.helm import Helm
    from aerokit.vehicle.orders.order import Order
    from aerokit.vehicle.orders.orders import Orders
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["LATE_S", "LateArming", "give_arm"]

LATE_S = 15.0
"""For so long after an order to arm was given up the vehicle is watched, and disarmed if it arms after all."""
ARMING_AT_END_S = 1.5
"""How long the end of a block waits for it."""
FORCE = 21196

logger: logging.Logger = logging.getLogger("aerokit")


async def give_arm(talk: Talk, orders: Orders, order: Order, armed: bool, *, force: bool = False) -> None:
    """Order it to arm or disarm."""
    params = (float(armed), FORCE if force else 0)
    await orders.give(order, talk.commands.send_long, MavCmd.COMPONENT_ARM_DISARM, *params, armed=armed)


class LateArming:
    """Watches a vehicle after an order to arm was given up."""

    def __init__(self, talk: Talk, helm: Helm, orders: Orders) -> None:
        self._talk, self._helm, self._orders = talk, helm, orders
        unsure = "while an order to arm may still be carried out"
        self._leftover = Leftover(talk, "aerokit late arming", unsure)

    def text(self) -> str:
        """What an error says of an order to arm that may still arrive."""
        unsent = self._talk.connection.unsent_bytes
        where = f"; {unsent} bytes have not left this computer yet" if unsent else ""
        return f"the order may still be carried out{where}: if it arms within {LATE_S:g} s it is disarmed"

    def watch(self, was_armed: bool) -> None:
        """The order to arm was given up; it may have been heard, or may still arrive."""
        self._talk.connection.discard_unsent()
        self._leftover.start(partial(self._look, was_armed, self._helm.arming_orders))

    async def _look(self, was_armed: bool, count: int) -> None:
        with anyio.move_on_after(LATE_S):
            await self._disarm_again(was_armed, count)

    async def _disarm_again(self, was_armed: bool, count: int) -> None:
        """What was armed before the order is left alone, until it has been heard disarmed."""
        armed, since = self._talk.telemetry.armed, self._talk.connection.now()
        try:
            if was_armed:
                await armed.wait_until(lambda value: not value, description="disarmed")
            await armed.wait_until(lambda value: value and armed.updated_at > since, description="armed")
        except AerokitError as error:
            logger.warning("the link ended while an order to arm may still be carried out: %s", error)
            return
        if self._helm.arming_orders != count:  # the program has ordered it by a command of its own
            return
        logger.warning("the vehicle armed although the order to arm was given up: it is disarmed again")
        with anyio.CancelScope(shield=True):
            try:
                with self._helm.aside() as order:
                    await give_arm(self._talk, self._orders, order, False)
            except AerokitError as error:
                logger.error(
                    "the vehicle armed after the order was given up, and could not be disarmed: %s", error
                )

    def stop(self) -> None:
        """Another order about arming is given."""
        self._leftover.drop()

    async def finish(self) -> None:
        """At the end of everything: an order to arm that was given up is answered, or is said to be out."""
        await self._leftover.finish(ARMING_AT_END_S)
