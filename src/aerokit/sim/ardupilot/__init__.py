"""Simulated vehicles that behave as ArduPilot does where a client can see it."""

from __future__ import annotations

from aerokit.sim.ardupilot.copter.vehicle import SimulatedCopter
from aerokit.sim.ardupilot.kinds import BootTimeline
from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane
from aerokit.sim.ardupilot.rover.vehicle import SimulatedRover
from aerokit.sim.ardupilot.sub.vehicle import SimulatedSub

__all__ = ["BootTimeline", "SimulatedCopter", "SimulatedPlane", "SimulatedRover", "SimulatedSub"]
