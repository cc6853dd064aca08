"""Connect, and print the state of the vehicle and the missing requirements for flight. Nothing moves.

python examples/hello.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def main(address: str) -> None:
    """Print every value as soon as it is known."""
    print(f"waiting for a vehicle on {address}")
    async with aerokit.connect(address) as vehicle:
        print(f"found system {vehicle.system_id}, mode {vehicle.mode_name}")
        printing = asyncio.create_task(print_missing(vehicle))
        await vehicle.wait_ready()
        printing.cancel()
        here = vehicle.position.value
        armed = "armed" if vehicle.is_armed else "disarmed"
        print(f"{vehicle.autopilot.firmware} {vehicle.version.value}, {armed}")
        print(f"at {here.latitude_deg:.7f}, {here.longitude_deg:.7f}, {vehicle.position.age:.2f} s ago")
        for battery in vehicle.batteries.value:
            print(f"battery {battery.id}: {battery.voltage_v} V, {battery.remaining_percent} %")
        reasons = await vehicle.why_not_armable()
        print("can be armed" if not reasons else "cannot be armed: " + "; ".join(reasons))


async def print_missing(vehicle: aerokit.Vehicle) -> None:
    """Print the missing requirements for a flight whenever they change."""
    previous: list[str] = []
    while True:
        missing = vehicle.missing_for_flight()
        if missing != previous:
            print(f"still missing: {'; '.join(missing) or 'nothing'}")
        previous = missing
        await asyncio.sleep(0.5)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
