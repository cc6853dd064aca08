"""Two vehicles on one link, told apart by their system ids, fly at the same time.

python examples/two_vehicles.py udpin:0.0.0.0:14550 [system id] [system id]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def fly(vehicle: aerokit.Vehicle, altitude_m: float) -> None:
    """The same flight for each, at an altitude of its own."""
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(altitude_m)
    print(f"system {vehicle.system_id} is at {vehicle.position.value.altitude_relative_m} m")
    await vehicle.land()


async def main(address: str, first_id: int = 1, second_id: int = 2) -> None:
    """One connection, two vehicles."""
    async with (
        aerokit.open_connection(address) as connection,
        aerokit.connect(connection, system_id=first_id) as first,
        aerokit.connect(connection, system_id=second_id) as second,
    ):
        await asyncio.gather(fly(first, 5), fly(second, 8))
        print("both landed")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550", *map(int, sys.argv[2:4])))
