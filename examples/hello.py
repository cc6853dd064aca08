"""Connect and print the state of the vehicle; nothing moves.

python examples/hello.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def main(address: str) -> None:
    """Print firmware, mode, position, batteries, and whether it can be armed."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        here = vehicle.position.value
        print(f"{vehicle.autopilot.firmware} {vehicle.version.value}, system {vehicle.system_id}")
        print(f"mode {vehicle.mode_name}, {'armed' if vehicle.is_armed else 'disarmed'}")
        print(f"at {here.latitude_deg:.7f}, {here.longitude_deg:.7f}, {vehicle.position.age:.2f} s ago")
        for battery in vehicle.batteries.value:
            print(f"battery {battery.id}: {battery.voltage_v} V, {battery.remaining_percent} %")
        reasons = await vehicle.why_not_armable()
        print("can be armed" if not reasons else "cannot be armed: " + "; ".join(reasons))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
