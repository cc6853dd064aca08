"""A vehicle with cameras on virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio

import aerokit
from aerokit import messages as m
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link

__all__ = ["commands_to", "on_board", "px4"]


@asynccontextmanager
async def on_board(
    *cameras: SimulatedCamera, vehicle: SimulatedVehicle | None = None, settle_s: float = 1.5
) -> AsyncIterator[aerokit.Vehicle]:
    """A vehicle, by default a copter, with these cameras, which it has discovered."""
    simulated = SimulatedCopter(boot_time_s=0.0, components=cameras) if vehicle is None else vehicle
    async with simulated_link(simulated) as link, aerokit.connect(link) as connected:
        await anyio.sleep(settle_s)
        yield connected


def px4(*cameras: SimulatedCamera) -> SimulatedPx4:
    return SimulatedPx4(boot_time_s=0.0, components=cameras)


def commands_to(simulated: Any, *kinds: int) -> list[tuple[float, ...]]:
    """Record COMMAND_LONG received by a simulated device, as (command, parameters), in a list that grows."""
    received: list[tuple[float, ...]] = []

    def note(message: m.CommandLong, _: object) -> None:
        if not kinds or message.command in kinds:
            params = (message.param1, message.param2, message.param3, message.param4)
            received.append((message.command, *params))

    if isinstance(simulated, SimulatedCamera):
        simulated.on(m.CommandLong, note)
    else:
        simulated.observe(m.CommandLong, note)
    return received
