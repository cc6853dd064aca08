"""``overview``: all that is known of a vehicle now, as plain values with their ages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.plain import plain

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["overview"]


def overview(vehicle: Vehicle) -> dict[str, Any]:
    """What is known of a vehicle, for showing and for other programs; nothing is asked of it.

    Returns:
        ``system_id``, ``autopilot`` and ``firmware`` (names), ``vehicle_type`` (MAV_TYPE), ``link`` (``state`` as of
        :class:`aerokit.LinkState`, ``heartbeat_age_s``, and how many frames of the vehicle came and were lost on the
        way, by their numbers) and ``states``: for each state of docs/states.md that the vehicle has told, ``value``
        (as :func:`aerokit.plain.plain` gives it) and ``age_s``, seconds since it was told.
    """
    received, lost = vehicle.connection.counts(vehicle.system_id)
    telemetry, link = vehicle.telemetry, vehicle.link_state.latest
    return {
        "system_id": vehicle.system_id,
        "autopilot": vehicle.autopilot.name,
        "firmware": vehicle.autopilot.firmware,
        "vehicle_type": vehicle.autopilot.vehicle_type,
        "link": {
            "state": None if link is None else link.value,
            "heartbeat_age_s": plain(vehicle.heartbeat_age),
            "frames_received": received,
            "frames_lost": lost,
        },
        "states": {
            name: {"value": plain(cell.value), "age_s": plain(cell.age)}
            for name, cell in telemetry.cells.items()
            if cell.is_known
        },
    }
