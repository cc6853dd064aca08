"""The simulated vehicles that the command line knows by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.sim import SimulatedVehicle

__all__ = ["HOME", "NAMES", "simulated_vehicle"]

NAMES = ("copter", "px4")
"""What --vehicle takes."""
HOME = (47.397742, 8.545594, 488.0)
"""Where they stand unless told otherwise: latitude, longitude, metres above the sea."""


def simulated_vehicle(
    name: str,
    *,
    system_id: int = 1,
    home: tuple[float, float, float] = HOME,
    seed: int = 0,
    boot_text: bool = False,
    parameters: dict[str, float] | None = None,
) -> SimulatedVehicle:
    """An ArduCopter ("copter") or a PX4 quadrotor ("px4"), just switched on."""
    from aerokit.sim import SimulatedCopter, SimulatedPx4

    if name == "px4":
        return SimulatedPx4(system_id=system_id, home=home, seed=seed, parameters=parameters)
    return SimulatedCopter(
        system_id=system_id, home=home, seed=seed, boot_text=boot_text, parameters=parameters
    )
