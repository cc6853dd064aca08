"""Which vehicle is meant: what changes something is not for the first that happens to be heard."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    import argparse

    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["check_alone"]

LISTEN_S = 1.5
"""HEARTBEAT comes once a second."""


async def check_alone(vehicle: Vehicle, options: argparse.Namespace) -> None:
    """Unless ``--system-id`` says which vehicle is meant, listen whether there are others.

    Raises:
        InvalidArgument: there are.
    """
    if options.system_id is not None:
        return
    heard = {vehicle.system_id}
    with anyio.move_on_after(LISTEN_S):
        async for found in vehicle.connection.vehicles():
            heard.add(found.system_id)
            if len(heard) > 1:
                numbers = ", ".join(map(str, sorted(heard)))
                raise InvalidArgument(
                    f"several vehicles were heard ({numbers}): say which by --system-id; nothing was sent"
                )
