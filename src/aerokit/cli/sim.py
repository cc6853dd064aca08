"""``aerokit sim``: a simulated copter for other programs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aerokit.errors import LocalProtocolError
from aerokit.sim import SimulatedCopter, open_simulator

if TYPE_CHECKING:
    import argparse

__all__ = ["run_sim"]


async def run_sim(options: argparse.Namespace) -> int:
    """Serve it until interrupted."""
    copter = SimulatedCopter(
        system_id=options.system_id, home=_home(options.home), seed=options.seed, boot_text=True
    )
    async with open_simulator(copter, *options.addresses, speedup=options.speedup) as simulator:
        for address in simulator.addresses:
            print(f"system {options.system_id} on {address}, {options.speedup:g} times real time", flush=True)
        await asyncio.Event().wait()
    return 0


def _home(text: str) -> tuple[float, float, float]:
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(","))
    except ValueError:
        raise LocalProtocolError(
            f"--home {text!r}: latitude,longitude,altitude in degrees and metres"
        ) from None
    return latitude, longitude, altitude
