"""Simulated vehicles by kind name, for command lines, fixtures and configuration files."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit._internal.formatting import did_you_mean, short_repr
from aerokit.errors import InvalidArgument
from aerokit.sim.vehicle import SimulatedVehicle

if TYPE_CHECKING:
    from aerokit.sim.parameters import SimParameters

__all__ = ["kind_class", "kind_names", "scale_timeouts", "simulated"]


# Module and class of each kind, by name. A module is imported when its kind is used first.
_KINDS = {
    "copter": ("aerokit.sim.ardupilot", "SimulatedCopter"),
    "plane": ("aerokit.sim.ardupilot", "SimulatedPlane"),
    "rover": ("aerokit.sim.ardupilot", "SimulatedRover"),
    "sub": ("aerokit.sim.ardupilot", "SimulatedSub"),
    "px4": ("aerokit.sim.px4", "SimulatedPx4"),
    "px4_plane": ("aerokit.sim.px4", "SimulatedPx4Plane"),
}


def kind_names() -> tuple[str, ...]:
    return tuple(_KINDS)


def kind_class(name: str) -> type[SimulatedVehicle]:
    """Return the class that simulates vehicles of a kind, such as "copter".

    Raises InvalidArgument for an unknown name.
    """
    if name not in _KINDS:
        raise InvalidArgument(
            f"vehicle = {short_repr(name)} is not one of: {', '.join(_KINDS)}{did_you_mean(name, _KINDS)}"
        )
    module, class_name = _KINDS[name]
    vehicle_class: type[SimulatedVehicle] = getattr(import_module(module), class_name)
    return vehicle_class


def simulated(name: str, **options: Any) -> SimulatedVehicle:
    """Create a vehicle of the kind ``name``. Its class gets the ``options``.

    Raises InvalidArgument for an unknown kind, TypeError for an unknown option.
    """
    return kind_class(name)(**options)


# Names of ArduPilot's and PX4's timeouts for heartbeats, set-points, channel overrides and the take-off.
_TIMEOUT_PARAMETERS = (
    "FS_GCS_TIMEOUT", "FS_LONG_TIMEOUT", "FS_PILOT_TIMEOUT", "GUID_TIMEOUT", "RC_OVERRIDE_TIME",
    "DISARM_DELAY", "COM_DISARM_PRFLT", "COM_DL_LOSS_T", "COM_OBC_LOSS_T", "COM_OF_LOSS_T", "COM_RC_LOSS_T",
)  # fmt: skip
_INT8_MAX = 127.0  # The maximum of DISARM_DELAY, which is an INT8.


def scale_timeouts(vehicles: Iterable[SimulatedVehicle], speedup: float, *, leave: Collection[str] = ()) -> None:
    """Multiply the timeouts in the vehicles' parameters by ``speedup``, except those in ``leave``."""
    # A client times its heartbeats and set-points by its own clock. With a speedup of ten, five simulated seconds last
    # only half a second for the client. PX4's simulation scales COM_DL_LOSS_T in the same way.
    if speedup <= 1.0:
        return
    from aerokit.sim.autopilot import SimulatedAutopilot

    for vehicle in vehicles:
        if isinstance(vehicle, SimulatedAutopilot):
            _scale(vehicle.parameters, speedup, leave)
            vehicle.on_speedup(speedup)


def _scale(parameters: SimParameters, speedup: float, leave: Collection[str]) -> None:
    for name in _TIMEOUT_PARAMETERS:
        if name in parameters and name not in leave:
            scaled = parameters[name] * speedup
            parameters[name] = min(scaled, _INT8_MAX) if name == "DISARM_DELAY" else scaled
