"""An arm authorizer: a vehicle may arm only with a flight plan.

python examples/arm_authorizer.py udpout:127.0.0.1:14550      # ArduPilot: ARMING_CHECK; PX4: COM_ARM_AUTH_REQ
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Collection
from typing import Any

import aerokit
from aerokit.onboard import CommandResult

AUTHORIZED_S = 60.0


async def has_flight_plan(system_id: int, plans: Collection[int]) -> bool:
    """Return True if the system has a plan; replace this by a request to your service."""
    await asyncio.sleep(0.3)
    return system_id in plans


async def main(address: Any, plans: Collection[int] = (1,)) -> None:
    """Answer requests until the link ends."""
    async with aerokit.component(address, component_id=191) as authorizer:

        async def authorize(system_id: int) -> float | CommandResult:
            if not await has_flight_plan(system_id, plans):
                raise PermissionError(f"system {system_id} has no flight plan")
            return AUTHORIZED_S

        authorizer.add_arm_authorizer(authorize)
        print("ready")
        await authorizer.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
