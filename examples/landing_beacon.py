"""A landing beacon: report the direction of a landing pad to the autopilot, for precision landing.

python examples/landing_beacon.py udpout:127.0.0.1:14550      # set PLND_ENABLED and PLND_TYPE 1 (ArduPilot)
"""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import AsyncIterator
from typing import Any

import aerokit


async def detections() -> AsyncIterator[tuple[float, float, float]]:
    """Yield the direction of the pad, in degrees to the right and to the tail, and its distance in metres.

    Replace this by your detector.
    """
    for number in range(100):
        angle = number / 10
        right_deg = 3.0 * math.cos(angle)
        down_deg = 3.0 * math.sin(angle)
        distance_m = max(0.2, 10.0 - number / 10)
        yield right_deg, down_deg, distance_m
        await asyncio.sleep(0.05)


async def main(address: Any) -> None:
    """Send LANDING_TARGET for every detection, at 20 Hz."""
    count = 0
    async with aerokit.component(address, component_id=191) as beacon:
        async for right_deg, down_deg, distance_m in detections():
            beacon.sources.send_landing_target(right_deg, down_deg, distance_m)
            count += 1
    print(f"{count} detections were sent")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
