"""Waits for something that takes a while, and gives up as soon as it cannot happen any more."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.vehicle.core import VehicleCore

__all__ = ["await_progress"]

TICK_S = 0.25
"""Silence brings no message, so it is looked for this often."""
LONGEST_SILENCE_S = 10.0


async def await_progress(
    vehicle: VehicleCore,
    what: str,
    *,
    is_done: Callable[[], bool],
    trouble: Callable[[], str | None],
    describe: Callable[[], str],
    timeout: float | None,
    held_for: float = 0.0,
) -> None:
    """Return when ``is_done()`` has been true for ``held_for`` seconds; looked at whenever the vehicle's state changes.

    Raises:
        OperationRejected: ``trouble()`` gave a reason: it cannot happen any more.
        HeartbeatTimeout: the vehicle has been silent for ``LONGEST_SILENCE_S`` seconds.
        OperationTimeout: ``timeout`` seconds have passed; ``describe()`` tells how far it came.
        ConnectionClosed, LinkLost: the connection ended.
    """
    changed, loop = asyncio.Event(), asyncio.get_running_loop()
    started = vehicle.connection.now()
    reasons_from = started
    cells = (vehicle.telemetry.mode, vehicle.telemetry.armed, vehicle.telemetry.position)
    ends = [cell.observe(lambda *_: changed.set()) for cell in (*cells, vehicle.telemetry.landed_state)]
    ends.append(vehicle.connection.on_end(lambda _: changed.set()))
    done_since: float | None = None
    try:
        while True:
            now = vehicle.connection.now()
            vehicle.connection.raise_if_ended()
            done_since = (now if done_since is None else done_since) if is_done() else None
            if done_since is not None and now - done_since >= held_for:
                return
            if done_since is None and (reason := trouble()):
                raise OperationRejected(f"{what}: {reason}", reasons=vehicle.texts_since(reasons_from))
            if vehicle.heartbeat_age > LONGEST_SILENCE_S:
                raise HeartbeatTimeout(f"{what}: {vehicle.describe_link()}")
            if timeout is not None and now - started >= timeout:
                raise OperationTimeout(
                    f"{what}: not done within {timeout:g} s; {describe()}; {vehicle.describe_link()}"
                )
            changed.clear()
            tick = loop.call_later(TICK_S, changed.set)  # no cancel scope: on Python 3.10 one that runs out
            try:  # swallows a cancellation that comes at the same turn of the loop
                await changed.wait()
            finally:
                tick.cancel()
    finally:
        for end in ends:
            end()
