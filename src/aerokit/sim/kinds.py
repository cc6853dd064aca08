"""The kinds of simulated vehicles by name, for command lines, fixtures and configuration files."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit._internal.wording import did_you_mean, shown
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["kind_class", "kind_names", "simulated"]

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
