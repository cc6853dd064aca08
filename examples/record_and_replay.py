"""Record a live vehicle, then run the same program on the recording at full speed.

python examples/record_and_replay.py udpin:0.0.0.0:14550 flight.tlog [seconds]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import errors, messages


async def count_attitudes(vehicle: aerokit.Vehicle) -> int:
    """Count the ATTITUDE messages of a live vehicle or of a recording."""
    count = 0
    with vehicle.subscribe(messages.Attitude, capacity=1000) as attitudes:
        try:
            async for _ in attitudes:
                count += 1
        except errors.LinkLost:  # a recording has an end
            return count
        finally:
            print(f"{count} attitudes, {attitudes.missed} missed")
    return count


async def main(address: str, path: str = "flight.tlog", seconds: float = 5.0) -> None:
    """Count live for some seconds, then again from the file."""
    async with aerokit.connect(address, record=path) as vehicle:
        try:
            await asyncio.wait_for(count_attitudes(vehicle), seconds)
        except asyncio.TimeoutError:
            print(f"recorded in {path}")
    async with aerokit.connect(f"replay:{path}?speed=max", rates={}) as vehicle:
        await count_attitudes(vehicle)


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            sys.argv[2] if len(sys.argv) > 2 else "flight.tlog",
            float(sys.argv[3]) if len(sys.argv) > 3 else 5.0,
        )
    )
