"""Simulated ArduPilot vehicles: Copter, Plane, Rover and Sub."""

from __future__ import annotations

from aerokit.sim.ardupilot.copter import SimulatedCopter
from aerokit.sim.ardupilot.kinds import BootTimeline
from aerokit.sim.ardupilot.plane import SimulatedPlane
from aerokit.sim.ardupilot.rover import SimulatedRover
from aerokit.sim.ardupilot.sub import SimulatedSub

__all__ = ["BootTimeline", "SimulatedCopter", "SimulatedPlane", "SimulatedRover", "SimulatedSub"]
