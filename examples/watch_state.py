"""Follow a vehicle: values with their ages, every attitude at 20 Hz, and whatever happens.

python examples/watch_state.py udpin:0.0.0.0:14550 [seconds]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import events, messages


async def print_values(vehicle: aerokit.Vehicle) -> None:
    """Once a second, the latest of everything; a value that is not known yet is None."""
    while True:
        position, ground_speed = vehicle.position, vehicle.ground_speed_m_s
        print(f"{vehicle.mode_name}, {ground_speed.latest} m/s, {position.latest}, {position.age:.2f} s old")
        await asyncio.sleep(1.0)


async def print_attitudes(vehicle: aerokit.Vehicle) -> None:
    """The raw message, 20 times a second; a reader that is too slow gets the newest and can see what it missed."""
    with vehicle.subscribe(messages.Attitude, rate_hz=20) as attitudes:
        async for attitude in attitudes:
            print(f"roll {attitude.roll:+.3f} rad, {attitudes.missed} missed")


async def print_events(vehicle: aerokit.Vehicle) -> None:
    """Modes, arming, texts, silence, reboots, slow streams, a blocked loop: all of them."""
    with vehicle.subscribe(events.Event, capacity=100) as news:
        async for event in news:
            print(event)


async def main(address: str, seconds: float = 10.0) -> None:
    """All three at once, for some seconds."""
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
