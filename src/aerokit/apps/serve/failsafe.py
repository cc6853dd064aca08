"""Ground station failsafes: the action that a vehicle takes according to its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.autopilots.gcs_failsafe import gcs_failsafe

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle


def ground_station_failsafe(vehicle: Vehicle) -> dict[str, Any]:
    """Return what the vehicle does after the loss of the ground station. Requests nothing.

    ``action`` is a part of a sentence, such as ``lands``, or None if it is unknown. ``because`` is the parameter that
    sets the action, with its value. If the value is not known yet, ``unread`` has the name of the parameter.
    """

    def value_of(name: str) -> float | None:
        parameter = vehicle.parameters.known(name)
        return None if parameter is None else parameter.value

    name, action = gcs_failsafe(vehicle.autopilot.firmware, value_of)
    if name is None or action is None:
        return {"action": None, "because": None, "unread": [] if name is None else [name]}
    return {"action": action, "because": f"{name} = {value_of(name):g}", "unread": []}
