"""Fly two vehicles on one link at the same time; their system ids distinguish them.

python examples/two_vehicles.py udpin:0.0.0.0:14550 [system id] [system id]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def fly(vehicle: aerokit.Vehicle, altitude_m: float) -> None:
    """Fly up and down."""
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(altitude_m)
    print(f"system {vehicle.system_id} is at {vehicle.position.value.altitude_relative_m} m")
    await vehicle.land()


async def main(address: str, first_id: int = 1, second_id: int = 2) -> None:
    """Connect to both vehicles over one connection, and fly them."""
    async with (
        aerokit.open_connection(address) as connection,
        aerokit.connect(connection, system_id=first_id) as first,
        aerokit.connect(connection, system_id=second_id) as second,
    ):
        await asyncio.gather(fly(first, 5), fly(second, 8))
        print("both landed")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550", *map(int, sys.argv[2:4])))
