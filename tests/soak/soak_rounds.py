"""One soak round: connect, fly, lose the radio, reboot, unplug, plug in again; and the remaining objects."""

from __future__ import annotations

import asyncio
import gc
import os
import socket
import threading
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

import anyio

import aerokit
from aerokit.events import LinkRestored
from aerokit.sim import SimulatedCopter, SimulatedPx4, open_simulator
from aerokit.sim.kinds import scale_timeouts

__all__ = ["ProcessObjects", "count_objects", "fly_round"]

SPEEDUP = 8.0
"""Faster, a busy machine starves the simulated vehicles rather than the library."""
LIMIT_S = 200.0


@dataclass(frozen=True)
class ProcessObjects:
    """Objects of the process between two rounds."""

    tasks: int
    threads: int
    descriptors: int
    objects: int
    resident_kb: int


def count_objects() -> ProcessObjects:
    """Count the present objects; call it on the loop."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if Path("/proc").is_dir() else 0
    folder = Path("/proc/self/fd")
    descriptors = len(list(folder.iterdir())) if folder.is_dir() else 0
    resident_kb = pages * os.sysconf("SC_PAGE_SIZE") // 1024
    return ProcessObjects(
        len(asyncio.all_tasks()), threading.active_count(), descriptors, len(gc.get_objects()), resident_kb
    )


async def fly_round(number: int) -> None:
    """Fly a copter and a PX4 alternately, over TCP, on a reconnecting link."""
    port = _free_port()
    with anyio.fail_after(LIMIT_S):
        simulator = open_simulator(_vehicle(number), f"tcpin:127.0.0.1:{port}", speedup=SPEEDUP)
        async with simulator, aerokit.connect(f"tcp:127.0.0.1:{port}") as vehicle:
            await _fly(vehicle)
        await _plug_in_again(number, port)
        await _silence_and_reboot(number)


async def _fly(vehicle: aerokit.Vehicle) -> None:
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(4.0)
    with vehicle.subscribe(aerokit.messages.Attitude, rate_hz=50, capacity=100) as attitudes:
        async with vehicle.guided.velocity(rate_hz=50, max_lag_s=5.0, valid_for_s=5.0) as stream:
            await stream.fly(aerokit.VelocitySetpoint(north_m_s=2.0), 0.3)
        await attitudes.get(timeout=LIMIT_S)
    with anyio.move_on_after(0.1):
        await vehicle.go_to(vehicle.position.value.offset(north_m=50))
    await vehicle.parameters.download()
    await vehicle.land()


async def _plug_in_again(number: int, port: int) -> None:
    """Close and reopen the other end; the same connection continues."""
    address, again = f"tcp:127.0.0.1:{port}", f"tcpin:127.0.0.1:{port}"
    async with AsyncExitStack() as far, AsyncExitStack() as near:
        await far.enter_async_context(open_simulator(_vehicle(number), again, speedup=SPEEDUP))
        vehicle = await near.enter_async_context(aerokit.connect(address, reconnect=True))
        restored = near.enter_context(vehicle.connection.subscribe(LinkRestored))
        await far.aclose()
        await far.enter_async_context(open_simulator(_vehicle(number), again, speedup=SPEEDUP))
        await restored.get(timeout=LIMIT_S)
        since = vehicle.connection.now()
        await vehicle.armed.wait_until(lambda _: vehicle.armed.updated_at > since, timeout=LIMIT_S)


async def _silence_and_reboot(number: int) -> None:
    simulated = _vehicle(number)
    async with open_simulator(simulated, "udpin:127.0.0.1:0", speedup=SPEEDUP) as simulator:
        address = simulator.addresses[0].replace("udpin", "udpout")
        async with aerokit.connect(address) as vehicle:
            await vehicle.wait_ready()
            simulated.faults.silent = True
            await asyncio.sleep(0.2)
            simulated.faults.silent = False
            if number % 2 == 0:  # Odd numbers are PX4, which denies a reboot in simulation.
                await vehicle.reboot()
            await vehicle.wait_ready()


def _vehicle(number: int) -> SimulatedCopter | SimulatedPx4:
    vehicle = SimulatedPx4(boot_time_s=1.0) if number % 2 else SimulatedCopter(boot_time_s=0.0)
    scale_timeouts([vehicle], SPEEDUP)
    return vehicle


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
