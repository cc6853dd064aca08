"""Watch the battery while flying, and land when it is low. A flight is a task that you can cancel.

python examples/land_on_low_battery.py udpin:0.0.0.0:14550 [percent]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def battery_low(vehicle: aerokit.Vehicle, percent: float) -> None:
    """Return when the first battery has been below ``percent`` for a second."""
    await vehicle.batteries.wait_until(
        lambda batteries: batteries[0].remaining_percent is not None and batteries[0].remaining_percent < percent,
        held_for=1.0,
    )


async def patrol(vehicle: aerokit.Vehicle) -> None:
    """Fly between two places until cancelled."""
    start = vehicle.position.value
    while True:
        await vehicle.go_to(start.offset(north_m=40))
        await vehicle.go_to(start)


async def main(address: str, percent: float = 30.0) -> None:
    """Patrol until the battery is low, then land. A cancelled go_to ends in a hold."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(altitude_m=10)
        patrolling = asyncio.create_task(patrol(vehicle))
        watching = asyncio.create_task(battery_low(vehicle, percent))
        await asyncio.wait({patrolling, watching}, return_when=asyncio.FIRST_COMPLETED)
        for task in (patrolling, watching):
            task.cancel()
        await asyncio.gather(patrolling, watching, return_exceptions=True)
        print(f"landing with {vehicle.batteries.value[0].remaining_percent} %")
        await vehicle.land()


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            float(sys.argv[2]) if len(sys.argv) > 2 else 30.0,
        )
    )
