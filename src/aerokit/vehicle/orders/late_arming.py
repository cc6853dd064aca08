"""`LateArming`: an order to arm that was given up may still be carried out: the vehicle is disarmed then."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.orders.helm import FIRST_HEARTBEAT_S
from aerokit.vehicle.orders.leftover import Leftover

if TYPE_CHECKING:
    from aerokit.vehicle.orders.helm import Helm
    from aerokit.vehicle.orders.order import Order
    from aerokit.vehicle.orders.orders import Orders
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["LATE_S", "LateArming", "give_arm"]

LATE_S = 15.0
"""For so long after an order to arm was given up the vehicle is watched, and disarmed if that order arms it."""
ACK_S = 3.0
"""How long after a HEARTBEAT that says armed the COMMAND_ACK of the order may come."""
ARMING_AT_END_S = 1.5
"""How long the end of a block waits for it."""
FORCE = 21196

logger: logging.Logger = logging.getLogger("aerokit")


async def give_arm(talk: Talk, orders: Orders, order: Order, armed: bool, *, force: bool = False) -> None:
    """Order it to arm or disarm."""
    talk.commands.forget_result(MavCmd.COMPONENT_ARM_DISARM)
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
        return f"the order may still be carried out{where}: if it arms the vehicle within {LATE_S:g} s, it is disarmed"

    def watch(self, order: Order, was_armed: bool) -> None:
        """The order to arm was given up; it may have been heard, or may still arrive."""
        self._talk.connection.discard_unsent()
        self._leftover.start(partial(self._look, order, was_armed, self._helm.arming_orders))

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
        if self._helm.arming_orders != count:  # the program has ordered it by a command of its own
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
                with self._helm.aside(ends_flight=True) as order:
                    await give_arm(self._talk, self._orders, order, False)
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
        return disarmed_at <= accepted_at + FIRST_HEARTBEAT_S

    def stop(self) -> None:
        """Another order about arming is given."""
        self._leftover.drop()

    async def finish(self) -> None:
        """At the end of everything: an order to arm that was given up is answered, or is said to be out."""
        await self._leftover.finish(ARMING_AT_END_S)
