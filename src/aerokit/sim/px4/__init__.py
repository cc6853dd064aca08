"""Simulated PX4 vehicles, multicopter and fixed wing: the paths of a client that differ from ArduPilot's."""

from __future__ import annotations

from aerokit.sim.px4.plane import SimulatedPx4Plane
from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["SimulatedPx4", "SimulatedPx4Plane"]
