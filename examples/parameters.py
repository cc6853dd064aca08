"""Print parameters that differ from their defaults, and change one temporarily.

python examples/parameters.py udpin:0.0.0.0:14550 [NAME VALUE]
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import errors


async def main(address: str, name: str = "LAND_SPEED", value: float = 40) -> None:
    """Print parameters that differ from their defaults, which are known only if the vehicle supports MAVFTP."""
    async with aerokit.connect(address) as vehicle:
        table = await vehicle.parameters.download()
        print(f"{len(table)} parameters")
        try:
            for parameter in (await vehicle.parameters.changed_from_default()).values():
                print(f"{parameter.name} = {parameter.value} instead of {parameter.default}")
        except errors.NotSupported as error:
            print(error)
        async with vehicle.parameters.temporarily({name: value}):
            print(f"{name} is {await vehicle.parameters.get(name)} for now")
        print(f"{name} is {await vehicle.parameters.get(name)} again")


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            sys.argv[2] if len(sys.argv) > 2 else "LAND_SPEED",
            float(sys.argv[3]) if len(sys.argv) > 3 else 40.0,
        )
    )
