"""Simulated PX4 multicopter and fixed wing, as clients see them."""

from __future__ import annotations

from aerokit.sim.px4.vehicle import SimulatedPx4, SimulatedPx4Plane

__all__ = ["SimulatedPx4", "SimulatedPx4Plane"]
