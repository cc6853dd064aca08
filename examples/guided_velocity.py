"""Steer by velocity. When the program stops sending set-points, the vehicle holds.

python examples/guided_velocity.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import math
import sys

import aerokit
from aerokit import VelocitySetpoint


async def fly_circle(vehicle: aerokit.Vehicle, speed_m_s: float = 4.0, seconds: float = 4.0) -> None:
    """Set a new velocity ten times a second. The stream ends when the last one is older than a second."""
    async with vehicle.guided.velocity() as stream:
        steps = round(seconds * 10)
        for step in range(steps):
            course = 2 * math.pi * step / steps
            north_m_s = speed_m_s * math.cos(course)
            east_m_s = speed_m_s * math.sin(course)
            stream.set(VelocitySetpoint(north_m_s, east_m_s, yaw_deg=math.degrees(course)))
            await asyncio.sleep(0.1)


async def main(address: str) -> None:
    """Take off, fly a circle and land."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(altitude_m=10)
        await fly_circle(vehicle)
        print(f"holding in {vehicle.mode_name}")
        await vehicle.land()
        print("landed")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
