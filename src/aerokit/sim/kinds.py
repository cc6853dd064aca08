"""The kinds of simulated vehicles by name, for command lines, fixtures and configuration files.

A kind whose class this installation does not have is not among `kind_names`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.errors import LocalProtocolError

if TYPE_CHECKING:
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["kind_class", "kind_names", "simulated"]

_KINDS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "copter": ("aerokit.sim.ardupilot", "SimulatedCopter", {}),
    "plane": ("aerokit.sim.ardupilot", "SimulatedPlane", {}),
    "rover": ("aerokit.sim.ardupilot", "SimulatedRover", {}),
    "sub": ("aerokit.sim.ardupilot", "SimulatedSub", {}),
    "px4": ("aerokit.sim.px4", "SimulatedPx4", {}),
    "px4_plane": ("aerokit.sim.px4", "SimulatedPx4Plane", {}),
}
"""Name → module, class, and what the class is told besides."""


def kind_names() -> tuple[str, ...]:
    """What `simulated` takes, such as "copter" and "px4"."""
    return tuple(name for name in _KINDS if _find(name) is not None)


def kind_class(name: str) -> type[SimulatedVehicle]:
    """The class of a kind; LocalProtocolError lists the kinds when there is none of that name."""
    found = _find(name)
    if found is None:
        raise LocalProtocolError(f"vehicle = {name!r} is not one of: {', '.join(kind_names())}")
    return found


def simulated(name: str, **options: Any) -> SimulatedVehicle:
    """A vehicle of that kind, just switched on; ``options`` are its class's (``system_id``, ``home``, ``seed`` …).

    LocalProtocolError when there is no such kind, TypeError when its class has no such option.
    """
    return kind_class(name)(**{**_KINDS[name][2], **options})


def _find(name: str) -> type[SimulatedVehicle] | None:
    if name not in _KINDS:
        return None
    module, class_name, _ = _KINDS[name]
    found: type[SimulatedVehicle] | None = getattr(import_module(module), class_name, None)
    return found
