"""Telling of heartbeats: their age to listeners, their absence to the log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from aerokit.dronekit.vehicle import Vehicle
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["watch_link"]

SILENT_AFTER_S = 5
TICK_S = 0.05
"""How often listeners are told how old the last heartbeat is."""
LOOK_S = 0.5
"""How often it is looked whether somebody listens by now."""


async def watch_link(vehicle: Vehicle, aio: AsyncVehicle) -> None:
    """Tell ``last_heartbeat`` 20 times a second to those who listen, and log the link's loss and its return."""
    is_lost = False
    while True:
        age = aio.heartbeat_age
        if (age > SILENT_AFTER_S) != is_lost:
            is_lost = not is_lost
            _log(vehicle, is_lost)
        if _is_listened_to(vehicle):
            vehicle._dk_tell("last_heartbeat", age)
            await anyio.sleep(TICK_S)
        else:
            await anyio.sleep(LOOK_S)


def _is_listened_to(vehicle: Vehicle) -> bool:
    return "last_heartbeat" in vehicle._attribute_listeners or "*" in vehicle._attribute_listeners


def _log(vehicle: Vehicle, is_lost: bool) -> None:
    """On the listener thread: the program's log handlers may take their time."""
    post, logger = vehicle._handler.listener_thread.post, vehicle._logger
    if is_lost:
        post(logger.warning, "Link timeout, no heartbeat in last %d seconds", SILENT_AFTER_S)
    else:
        post(logger.info, "...link restored.")
