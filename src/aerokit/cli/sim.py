"""``aerokit sim``: a simulated vehicle for other programs."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.vehicles import simulated_vehicle
from aerokit.sim import open_simulator

if TYPE_CHECKING:
    import argparse

__all__ = ["run_sim"]

CLIENTS_USE = {"tcpin": "tcp", "udpout": "udpin", "udpbcast": "udpin", "udpin": "udpout"}
"""What a client writes where the simulator writes this."""


async def run_sim(options: argparse.Namespace) -> int:
    """Serve it until interrupted."""
    try:
        vehicle = simulated_vehicle(
            options.vehicle,
            system_id=options.system_id,
            home=options.home,
            seed=options.seed,
            boot_text=True,
            parameters=dict(options.parameters),
        )
    except KeyError as error:
        print(f"the simulated {options.vehicle} has no parameter {error}", file=sys.stderr)
        return 2
    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with open_simulator(vehicle, *options.addresses, speedup=options.speedup) as simulator:
            for address in simulator.addresses:
                print(f"system {options.system_id} on {address}, {options.speedup:g} times real time")
            print(f"try: aerokit demo --connect {_client_address(simulator.addresses[0])}", flush=True)
            await stop.wait()
    print("stopped")
    return 0


def _client_address(address: str) -> str:
    """How a client on this machine reaches it; serial ports have another end."""
    scheme, _, place = address.partition(":")
    if scheme not in CLIENTS_USE:
        return "the other end of the serial line"
    return f"{CLIENTS_USE[scheme]}:{place.replace('0.0.0.0', '127.0.0.1')}"
