"""Serve one simulated vehicle to a UDP port, as an autopilot calls its ground station, until it is ended."""

from __future__ import annotations

import argparse
import asyncio

from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, open_simulator
from aerokit.sim.kinds import scale_timeouts

VEHICLES: dict[str, type[SimulatedCopter] | type[SimulatedPx4]] = {
    "copter": SimulatedCopter,
    "px4": SimulatedPx4,
}


async def serve(vehicle: SimulatedVehicle, port: int, speedup: float) -> None:
    scale_timeouts([vehicle], speedup)
    async with open_simulator(vehicle, f"udpout:127.0.0.1:{port}", speedup=speedup):
        await asyncio.Event().wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=VEHICLES)
    parser.add_argument("port", type=int)
    parser.add_argument("--speedup", type=float, default=1.0)
    arguments = parser.parse_args()
    vehicle = VEHICLES[arguments.kind]()
    asyncio.run(serve(vehicle, arguments.port, arguments.speedup))


if __name__ == "__main__":
    main()
