"""Simulated vehicles that behave as ArduPilot does where a client can see it."""

from __future__ import annotations

from aerokit.sim.ardupilot.boot import BootTimeline
from aerokit.sim.ardupilot.copter import SimulatedCopter

__all__ = ["BootTimeline", "SimulatedCopter"]
