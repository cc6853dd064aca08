"""Vehicles that are served faster than real time wait longer for their clients, as PX4's own simulation does."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from aerokit.sim.parameters import Parameters
from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["wait_longer"]

_SECONDS = (
    "FS_GCS_TIMEOUT", "FS_LONG_TIMEOUT", "FS_PILOT_TIMEOUT", "GUID_TIMEOUT", "RC_OVERRIDE_TIME",
    "DISARM_DELAY", "COM_DISARM_PRFLT", "COM_DL_LOSS_T", "COM_OBC_LOSS_T", "COM_OF_LOSS_T", "COM_RC_LOSS_T",
)  # fmt: skip
"""How long ArduPilot and PX4 wait for heartbeats, set-points, channel overrides or a take-off."""
_INT8_MAX = 127.0
"""The longest DISARM_DELAY that the firmware takes."""


def wait_longer(vehicles: Iterable[SimulatedVehicle], speedup: float, *, leave: Collection[str] = ()) -> None:
    """Make the parameters that say how long vehicles wait for a client ``speedup`` times as long.

    A client sends heartbeats and set-points by its own clock: ten times as fast, five seconds of the vehicle are half
    a second of the client. PX4's simulation lengthens COM_DL_LOSS_T and its like in the same way. ArduPilot's
    DISARM_DELAY becomes 127 s at most, as its type allows. ``leave`` are names of parameters that stay; nothing changes
    in real time or slower.
    """
    if speedup <= 1.0:
        return
    for vehicle in vehicles:
        parameters = getattr(vehicle, "parameters", None)
        if isinstance(parameters, Parameters):
            _lengthen(parameters, speedup, leave)


def _lengthen(parameters: Parameters, speedup: float, leave: Collection[str]) -> None:
    for name in _SECONDS:
        if name in parameters and name not in leave:
            longer = parameters[name] * speedup
            parameters[name] = min(longer, _INT8_MAX) if name == "DISARM_DELAY" else longer
