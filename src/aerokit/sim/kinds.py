"""The kinds of simulated vehicles by name, for command lines, fixtures and configuration files."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from importlib import import_module
from typing import Any

from aerokit._internal.wording import did_you_mean, shown
from aerokit.errors import InvalidArgument
from aerokit.sim.parameters import Parameters
from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["kind_class", "kind_names", "simulated", "wait_longer"]


_KINDS = {
    "copter": ("aerokit.sim.ardupilot", "SimulatedCopter"),
    "plane": ("aerokit.sim.ardupilot", "SimulatedPlane"),
    "rover": ("aerokit.sim.ardupilot", "SimulatedRover"),
    "sub": ("aerokit.sim.ardupilot", "SimulatedSub"),
    "px4": ("aerokit.sim.px4", "SimulatedPx4"),
    "px4_plane": ("aerokit.sim.px4", "SimulatedPx4Plane"),
}
"""Name → module and class; imported when it is asked for."""


def kind_names() -> tuple[str, ...]:
    """What `simulated` takes, such as "copter" and "px4"."""
    return tuple(_KINDS)


def kind_class(name: str) -> type[SimulatedVehicle]:
    """The class of a kind; InvalidArgument lists the kinds when there is none of that name."""
    if name not in _KINDS:
        raise InvalidArgument(
            f"vehicle = {shown(name)} is not one of: {', '.join(_KINDS)}{did_you_mean(name, _KINDS)}"
        )
    module, class_name = _KINDS[name]
    found: type[SimulatedVehicle] = getattr(import_module(module), class_name)
    return found


def simulated(name: str, **options: Any) -> SimulatedVehicle:
    """A vehicle of that kind, just switched on; ``options`` are its class's (``system_id``, ``home``, ``seed`` …).

    InvalidArgument when there is no such kind, TypeError when its class has no such option.
    """
    return kind_class(name)(**options)


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
