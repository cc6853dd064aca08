"""Parameters of a simulated ArduCopter: names, types, values and defaults of 4.7-dev, in its order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.sim.ardupilot.parameter_tables import parameters_of

if TYPE_CHECKING:
    from aerokit.sim.parameters import Parameters

__all__ = ["copter_parameters"]


def copter_parameters(count: int | None = None) -> Parameters:
    """All 1,349, or so many of them; those that the simulation reads are always among them."""
    return parameters_of("copter", count)
