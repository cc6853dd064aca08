"""Two machines: the one with the vehicle's link and a hub is killed and replaced, while the other one flies."""

from __future__ import annotations

import contextlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterator

import pytest
from free_ports import free_port
from zenoh_network import router

import aerokit
from aerokit import events
from aerokit.sim import SimulatedCopter, open_simulator
from aerokit.sim.kinds import scale_timeouts

pytest.importorskip("zenoh")
pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif(importlib.util.find_spec("aerokit.hub") is None, reason="there is no hub yet"),
]
SPEEDUP = 20.0


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@contextlib.contextmanager
def hub(*addresses: str) -> Iterator[subprocess.Popen[str]]:
    """``aerokit hub`` as a process."""
    command = [sys.executable, "-m", "aerokit", "hub", "--json", *addresses]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        try:
            assert running.stdout is not None
            assert running.stdout.readline()
            yield running
        finally:
            running.kill()


@pytest.mark.exhaustive
async def test_killed_hub_is_replaced_in_flight() -> None:
    vehicle_port, port = free_port(), free_port()
    copter = SimulatedCopter(boot_time_s=0.0)
    scale_timeouts([copter], SPEEDUP)
    machine = (f"tcp:127.0.0.1:{vehicle_port}", f"zenohin://north/alpha?connect=tcp/127.0.0.1:{port}")
    address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{port}&timeout=2"
    with router(port):
        async with open_simulator(copter, f"tcpin:127.0.0.1:{vehicle_port}", speedup=SPEEDUP):
            with hub(*machine) as first:
                async with aerokit.connect(address, reconnect=True) as vehicle:
                    await vehicle.wait_ready()
                    await vehicle.set_mode("GUIDED")
                    await vehicle.arm()
                    await vehicle.take_off(4)
                    with vehicle.subscribe(events.LinkInterrupted, events.LinkRestored, capacity=8) as news:
                        first.kill()
                        assert isinstance(await news.get(timeout=100), events.LinkInterrupted)
                        with hub(*machine):
                            assert isinstance(await news.get(timeout=100), events.LinkRestored)
                            await vehicle.land()
                            assert vehicle.mode.value.name == "LAND"
                            assert abs(vehicle.position.value.altitude_relative_m or 0) < 1
