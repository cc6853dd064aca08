"""Notices when the program keeps the event loop from running."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.runtime.events import LoopBlocked

if TYPE_CHECKING:
    from aerokit.runtime.connection import Connection

__all__ = ["watch_loop"]

PERIOD_S = 0.1
BLOCKED_AFTER_S = 0.25


async def watch_loop(connection: Connection) -> None:
    """Publish LoopBlocked when a timer comes ``BLOCKED_AFTER_S`` late or more; runs until cancelled."""
    while connection.is_open:
        due = connection.now() + PERIOD_S
        await anyio.sleep(PERIOD_S)
        late = connection.now() - due
        if late > BLOCKED_AFTER_S:
            connection.bus.publish(LoopBlocked(connection.now(), 0, late + PERIOD_S))
