"""Print values with their ages, attitudes at 20 Hz, and all events.

python examples/watch_state.py udpin:0.0.0.0:14550 [seconds]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import events, messages


async def print_values(vehicle: aerokit.Vehicle) -> None:
    """Print the latest values once a second; an unknown value is None."""
    while True:
        position = vehicle.position
        speed_m_s = vehicle.ground_speed_m_s.latest
        print(f"{vehicle.mode_name}, {speed_m_s} m/s, {position.latest}, {position.age:.2f} s old")
        await asyncio.sleep(1.0)


async def print_attitudes(vehicle: aerokit.Vehicle) -> None:
    """Print raw messages at 20 Hz. If printing is slow, messages are dropped and counted in ``missed``."""
    with vehicle.subscribe(messages.Attitude, rate_hz=20) as attitudes:
        async for attitude in attitudes:
            print(f"roll {attitude.roll:+.3f} rad, {attitudes.missed} missed")


async def print_events(vehicle: aerokit.Vehicle) -> None:
    """Print every event: modes, arming, status texts, silence, reboots, slow streams, a blocked event loop."""
    with vehicle.subscribe(events.Event, capacity=100) as subscription:
        async for event in subscription:
            print(event)


async def main(address: str, seconds: float = 10.0) -> None:
    """Run all three for some seconds."""
    async with aerokit.connect(address) as vehicle:
        watching = (print_values(vehicle), print_attitudes(vehicle), print_events(vehicle))
        try:
            await asyncio.wait_for(asyncio.gather(*watching), seconds)
        except asyncio.TimeoutError:
            print("enough")


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            float(sys.argv[2]) if len(sys.argv) > 2 else 10.0,
        )
    )
