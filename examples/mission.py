"""Upload a small mission, fly it, and report its progress.

python examples/mission.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import errors, events
from aerokit.missions import Mission, change_speed, return_to_launch, take_off, waypoint


async def main(address: str) -> None:
    """Fly the mission; the upload is checked first and read back afterwards."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        start = vehicle.position.value
        corners = [start.offset(north_m=20), start.offset(north_m=20, east_m=20)]
        mission = Mission([
            take_off(start, altitude_relative_m=10),
            change_speed(4),
            *(waypoint(place, altitude_relative_m=10) for place in corners),
            return_to_launch(),
        ])  # fmt: skip
        try:
            await vehicle.mission.upload(mission)
        except errors.MissionRejected as error:
            print(f"item {error.item}: {error}")
            return
        with vehicle.subscribe(events.MissionItemReached, capacity=20) as reached:
            await vehicle.arm()
            await vehicle.mission.start()
            await vehicle.mission.wait_finished(timeout=300)
            while (event := reached.get_nowait()) is not None:
                print(f"item {event.item} was reached")
        print("flown")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
