"""Telling of heartbeats: their age to listeners, their absence to the log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.core import Core
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["watch_link"]

SILENT_AFTER_S = 5
TICK_S = 0.05
"""How often listeners are told how old the last heartbeat is."""
LOOK_S = 0.5
"""How often it is looked whether somebody listens by now."""


async def watch_link(core: Callable[[], Core | None], aio: AsyncVehicle) -> None:
    """Tell ``last_heartbeat`` 20 times a second to those who listen, and log the link's loss and its return.

    ``core`` is a weak reference, which nothing here follows while it waits.
    """
    is_lost = False
    while True:
        age = aio.heartbeat_age
        if (age > SILENT_AFTER_S) != is_lost:
            is_lost = not is_lost
            _log(core(), is_lost)
        await anyio.sleep(TICK_S if _tell(core(), age) else LOOK_S)


def _tell(core: Core | None, age: float) -> bool:
    """Says whether somebody listens."""
    if core is None or not core.listeners.heed("last_heartbeat"):
        return False
    core.listeners.tell("last_heartbeat", age)
    return True


def _log(core: Core | None, is_lost: bool) -> None:
    """On the listener thread: the program's log handlers may take their time."""
    if core is None:
        return
    post, logger = core.handler.listener_thread.post, core.logger
    if is_lost:
        post(logger.warning, "Link timeout, no heartbeat in last %d seconds", SILENT_AFTER_S)
    else:
        post(logger.info, "...link restored.")
