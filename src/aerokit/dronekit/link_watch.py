"""Telling of heartbeats: their age to listeners, their absence to the log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.vehicle import Vehicle
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["watch_link"]

SILENT_AFTER_S = 5
TICK_S = 0.05
"""How often listeners are told how old the last heartbeat is."""
LOOK_S = 0.5
"""How often it is looked whether somebody listens by now."""


async def watch_link(vehicle: Callable[[], Vehicle | None], aio: AsyncVehicle) -> None:
    """Tell ``last_heartbeat`` 20 times a second to those who listen, and log the link's loss and its return.

    ``vehicle`` is a weak reference, which nothing here follows while it waits.
    """
    is_lost = False
    while True:
        age = aio.heartbeat_age
        if (age > SILENT_AFTER_S) != is_lost:
            is_lost = not is_lost
            _log(vehicle(), is_lost)
        await anyio.sleep(TICK_S if _tell(vehicle(), age) else LOOK_S)


def _tell(vehicle: Vehicle | None, age: float) -> bool:
    """Says whether somebody listens."""
    if vehicle is None or not (
        "last_heartbeat" in vehicle._attribute_listeners or "*" in vehicle._attribute_listeners
    ):
        return False
    vehicle._dk_tell("last_heartbeat", age)
    return True


def _log(vehicle: Vehicle | None, is_lost: bool) -> None:
    """On the listener thread: the program's log handlers may take their time."""
    if vehicle is None:
        return
    post, logger = vehicle._handler.listener_thread.post, vehicle._logger
    if is_lost:
        post(logger.warning, "Link timeout, no heartbeat in last %d seconds", SILENT_AFTER_S)
    else:
        post(logger.info, "...link restored.")
