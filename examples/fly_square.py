"""Take off, fly a square and land.

python examples/fly_square.py udpin:0.0.0.0:14550 [metres]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def main(address: str, side_m: float = 20.0) -> None:
    """Fly the square. Every call returns when the action is complete."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(altitude_m=10)
        start = vehicle.position.value
        for north, east in ((1, 0), (1, 1), (0, 1), (0, 0)):
            await vehicle.go_to(start.offset(north_m=north * side_m, east_m=east * side_m))
            print(f"at {vehicle.position.value}")
        await vehicle.land()
        print("landed")


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            float(sys.argv[2]) if len(sys.argv) > 2 else 20.0,
        )
    )
