"""With sniffio installed, anyio detects the library in tasks only; aerokit calls it nowhere else.

The programs run in their own processes, with the real sniffio if installed, else with a stand-in.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

STAND_IN = Path(__file__).parent / "beside_sniffio"
LIMIT_S = 200.0

BLOCKING = """
import aerokit.sync
import sniffio
from aerokit.testing import serve_flight
with serve_flight() as flight:
    with aerokit.sync.connect(flight.address, timeout=100) as vehicle:
        vehicle.mode.wait_until(lambda mode: mode.name == "STABILIZE", timeout=100)
        print(vehicle.parameters.get("RTL_ALT"))
"""
CLASSIC = """
import aerokit.dronekit as dronekit
import sniffio
from aerokit.testing import serve_flight
with serve_flight() as flight:
    vehicle = dronekit.connect(flight.address, wait_ready=True, timeout=60, heartbeat_timeout=100)
    print(vehicle.parameters["RTL_ALT"])
    vehicle.close()
"""
CALLED_FROM_ANOTHER_LIBRARY = """
import asyncio
import sniffio
from aerokit.sync.loop_thread import LoopThread
sniffio.current_async_library_cvar.set("trio")
loop = LoopThread()
import anyio
loop.run(anyio.sleep, 0)
loop.close()
"""
HELD_FROM_A_TIMER = """
import asyncio
import sniffio
from aerokit import VelocitySetpoint, connect
from aerokit.errors import SetpointStreamStopped
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing.clock import VirtualClockLoop

async def main():
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(5)
        async with vehicle.guided.velocity() as stream:
            stream.set(VelocitySetpoint(north_m_s=1))
            await asyncio.sleep(5)
            assert vehicle.mode_name == "BRAKE", vehicle.mode_name

loop = VirtualClockLoop()
try:
    loop.run_until_complete(main())
except SetpointStreamStopped as error:
    print(error)
loop.close()
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "program",
    [BLOCKING, CLASSIC, CALLED_FROM_ANOTHER_LIBRARY, HELD_FROM_A_TIMER],
    ids=["blocking", "classic", "called from another library", "held from a timer"],
)
def test_sniffio_does_not_interfere(program: str) -> None:
    source = str(Path(__file__).parents[1] / "src")
    stand_in = [] if importlib.util.find_spec("sniffio") else [str(STAND_IN)]
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([source, *stand_in])},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
