"""Simulated vehicles: they speak MAVLink and fly, without hardware, firmware builds or waiting.

`SimulatedCopter` is the vehicle, without any IO: bytes and the time go in, bytes come out.
"""

from __future__ import annotations

from aerokit.sim.ardupilot import BootTimeline, SimulatedCopter
from aerokit.sim.faults import CommandFault, Faults
from aerokit.sim.motion import Wind
from aerokit.sim.vehicle import ExtraComponent, SimulatedVehicle

__all__ = [
    "BootTimeline",
    "CommandFault",
    "ExtraComponent",
    "Faults",
    "SimulatedCopter",
    "SimulatedVehicle",
    "Wind",
]
