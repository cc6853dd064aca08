"""Fly three vehicles as a fleet: take off, fly in formation behind the leader, land.

python examples/fleet_formation.py udpin:0.0.0.0:14550 [count]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit


async def main(address: str, count: int = 3) -> None:
    """Take off together, form a wedge, follow the leader, land."""
    async with aerokit.fleet({"field": address}, count=count, on_error="hold_others") as fleet:
        print(fleet)
        for action in (fleet.wait_ready(), fleet.arm(), fleet.take_off(10, stagger_s=2)):
            (await action).raise_for_errors()
        leader, *others = fleet.members
        wedge = aerokit.Formation.wedge(others, 8.0, frame="north")
        (await fleet.form(wedge, leader=leader)).raise_for_errors()
        print("in formation")
        ahead = fleet.vehicles[leader].position.value.offset(north_m=60)
        async with fleet.following(wedge, leader=leader) as following:
            await fleet.vehicles[leader].go_to(ahead, speed_m_s=4)
            for name in others:
                print(f"{name} is {following.error_m(name):.1f} m from its place")
        print(await fleet.land())


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550", *map(int, sys.argv[2:3])))
