"""An ArduCopter and a PX4 as a fleet of two, through a hub in another process, and a zenoh network.

Simulated ones; or real firmwares, whose binaries AEROKIT_ARDUCOPTER and AEROKIT_PX4 name.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import anyio
import pytest
from any_vehicle import INSTANCE
from free_ports import free_port

import aerokit
from aerokit.sim import SimulatedCopter, SimulatedPx4, open_simulator
from aerokit.sim.kinds import scale_timeouts

pytest.importorskip("zenoh")
pytestmark = pytest.mark.anyio

ARDUCOPTER, PX4 = os.environ.get("AEROKIT_ARDUCOPTER"), os.environ.get("AEROKIT_PX4")
BINARIES = [Path(binary).resolve() for binary in (ARDUCOPTER, PX4) if binary]
DEFAULTS = "Tools/autotest/default_params/copter.parm"
SPEEDUP = 1.0 if ARDUCOPTER and PX4 else 8.0
PX4_INSTANCE = 1  # its system id is one more


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextlib.contextmanager
def running(*command: str, env: dict[str, str] | None = None, folder: str | None = None) -> Iterator[None]:
    with subprocess.Popen(
        command, cwd=folder, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:  # fmt: skip
        try:
            yield
        finally:
            process.terminate()


@contextlib.asynccontextmanager
async def two_vehicles() -> AsyncIterator[list[str]]:
    """Addresses that a hub opens to reach them."""
    async with contextlib.AsyncExitStack() as stack:
        if ARDUCOPTER and PX4:
            port = free_port()
            folders = [stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)) for _ in "12"]
            stack.enter_context(
                running(
                    ARDUCOPTER, "--model", "+", "--speedup", "1", f"-I{INSTANCE}",
                    "--defaults", str(BINARIES[0].parents[3] / DEFAULTS), "--home", "-35.363261,149.165230,584,353",
                    "--serial0", f"udpclient:127.0.0.1:{port}",
                    folder=folders[0],
                )
            )  # fmt: skip
            env = {"PX4_SIM_MODEL": "sihsim_quadx", "PATH": "/usr/bin:/bin"}
            command = [PX4, "-d", "-i", str(PX4_INSTANCE), "-w", ".", str(BINARIES[1].parents[1] / "etc")]
            stack.enter_context(running(*command, env=env, folder=folders[1]))
            yield [f"udpin:127.0.0.1:{port}", f"udpin:127.0.0.1:{14540 + PX4_INSTANCE}"]
            return
        addresses = []
        for vehicle in (
            SimulatedCopter(boot_time_s=0.0),
            SimulatedPx4(system_id=PX4_INSTANCE + 1, boot_time_s=0.0),
        ):
            scale_timeouts([vehicle], SPEEDUP)
            server = open_simulator(vehicle, "tcpin:127.0.0.1:0", speedup=SPEEDUP)
            simulator = await stack.enter_async_context(server)
            addresses.append(simulator.addresses[0].replace("tcpin", "tcp"))
        yield addresses


@pytest.mark.exhaustive
async def test_they_take_off_together_go_and_land_together() -> None:
    port = free_port()
    place = f"tcp/127.0.0.1:{port}"
    async with two_vehicles() as addresses:
        hub = [sys.executable, "-m", "aerokit", "hub", *addresses, f"zenohin://field/two?listen={place}"]
        with running(*hub, env={**os.environ}):
            with anyio.fail_after(100):
                while not is_listening(port):  # noqa: ASYNC110
                    await anyio.sleep(0.05)
            await fly(f"zenoh://field/two?connect={place}&client=program&timeout=60")


async def fly(address: str) -> None:
    async with aerokit.fleet({"field": address}, count=2, timeout=90) as fleet:
        assert sorted(fleet.vehicles) == ["field/1", f"field/{PX4_INSTANCE + 1}"]
        firmwares = {vehicle.autopilot.name for vehicle in fleet.vehicles.values()}
        assert firmwares == {"ArduPilot", "PX4"}
        (await fleet.wait_ready(timeout=150)).raise_for_errors()
        for vehicle in fleet.vehicles.values():  # transfers pass, too
            assert len(await vehicle.parameters.download()) > 100
        (await fleet.arm()).raise_for_errors()
        (await fleet.take_off(10, timeout=90)).raise_for_errors()
        await fleet.wait_at_altitude(10, tolerance_m=2)
        starts = {name: vehicle.position.value for name, vehicle in fleet.vehicles.items()}
        result = await fleet.do(lambda member: member.vehicle.go_to(starts[member.name].offset(north_m=30)))
        result.raise_for_errors()
        for name, vehicle in fleet.vehicles.items():
            assert vehicle.distance_to(starts[name]) > 25
        (await fleet.land(timeout=180)).raise_for_errors()
        with anyio.fail_after(100):
            while any(vehicle.is_armed for vehicle in fleet.vehicles.values()):  # noqa: ASYNC110
                await anyio.sleep(0.2)
