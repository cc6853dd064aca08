"""A simulated PX4 multicopter: the paths of a client that differ from ArduPilot's."""

from __future__ import annotations

from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["SimulatedPx4"]
