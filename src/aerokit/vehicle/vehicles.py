"""``vehicles_on``: every vehicle that is heard on a connection, for the time of a block."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING

from aerokit.async_block import async_block
from aerokit.errors import AerokitError
from aerokit.runtime.background import Background
from aerokit.vehicle.connect import connect

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from aerokit.mavlink.message import Message
    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["vehicles_on"]

logger: logging.Logger = logging.getLogger("aerokit")


@async_block
async def vehicles_on(
    connection: Connection,
    *,
    rates: Mapping[type[Message], float] | None = None,
    on_found: Callable[[Vehicle], object] | None = None,
) -> AsyncIterator[Mapping[int, Vehicle]]:
    """Connect to each vehicle that is heard on a connection, as soon as it is heard, for the time of the block.

    A vehicle that falls silent stays: its cells have ages, and its ``link_state`` says so. One that this program has
    a vehicle object of already is left out.

    Args:
        connection: of :func:`aerokit.open_connection`.
        rates: message class → Hz, asked of each, as by :func:`aerokit.connect`; ``{}`` asks for nothing.
        on_found: called with each new vehicle, in the loop.

    Returns:
        System id → vehicle, in the order in which they were heard; it grows while the block lasts.

    Raises:
        ConnectionClosed, LinkLost: the connection has ended.
    """
    connection.raise_if_ended()
    vehicles: dict[int, Vehicle] = {}

    async def keep(system_id: int) -> None:
        try:
            async with connect(connection, system_id=system_id, rates=rates) as vehicle:
                vehicles[system_id] = vehicle
                if on_found is not None:
                    on_found(vehicle)
                await asyncio.Event().wait()
        except AerokitError as error:  # silent again at once, known already, or the connection has ended
            logger.info("system %d is not followed: %s", system_id, error)

    async def look_out() -> None:
        try:
            async for found in connection.vehicles():
                if found.system_id not in vehicles:
                    tasks.start(partial(keep, found.system_id))
        except AerokitError as error:
            logger.info("no more vehicles are looked for: %s", error)

    tasks = Background(connection.fail)
    tasks.start(look_out)
    try:
        yield vehicles
    finally:
        await tasks.aclose()
