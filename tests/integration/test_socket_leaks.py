"""Connecting over real sockets and a pseudo-terminal, cancelled at any turn of the loop: all of them are closed."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest
from leak_check import RealCountingLoop, run_and_do

from aerokit import connect
from aerokit.sim import SimulatedCopter, open_simulator

SPEEDUP = 40.0


@asynccontextmanager
async def served(kind: str) -> AsyncIterator[str]:
    copter = SimulatedCopter(boot_time_s=0)
    if kind == "serial":
        async with open_pseudo_terminal(copter) as device:
            yield device
    elif kind == "udpin":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        async with open_simulator(copter, f"udpout:127.0.0.1:{port}", speedup=SPEEDUP):
            yield f"udpin:127.0.0.1:{port}"
    else:
        listening = {"tcp": "tcpin", "udpout": "udpin"}[kind]
        async with open_simulator(copter, f"{listening}:127.0.0.1:0", speedup=SPEEDUP) as simulator:
            yield simulator.addresses[0].replace(listening, kind)


@asynccontextmanager
async def open_pseudo_terminal(copter: SimulatedCopter) -> AsyncIterator[str]:
    """The copter at the other end of the cable, stepped by hand."""
    master, slave = os.openpty()
    device = os.ttyname(slave)
    loop = asyncio.get_running_loop()
    started = loop.time()

    timer: asyncio.Handle

    def step() -> None:
        nonlocal timer
        copter.step((loop.time() - started) * SPEEDUP)
        os.write(master, copter.take_outbox())
        timer = loop.call_later(0.005, step)

    timer = loop.call_soon(step)
    loop.add_reader(master, lambda: copter.receive(os.read(master, 4096), (loop.time() - started) * SPEEDUP))
    try:
        yield f"{device},921600"
    finally:
        timer.cancel()
        loop.remove_reader(master)
        os.close(slave)
        os.close(master)


def session(kind: str) -> Callable[[], Awaitable[None]]:
    async def run() -> None:
        async with served(kind) as address, connect(address, timeout=100, rates={}) as vehicle:
            await vehicle.mode.wait_until(lambda _: True)

    return run


each_kind = pytest.mark.parametrize("kind", ["tcp", "udpin", "udpout", "serial"])


@pytest.mark.exhaustive
@each_kind
def test_cancelled_at_any_iteration_leaves_no_socket(kind: str) -> None:
    for turns in range(32):
        asked: list[bool] = []
        task = run_and_do(
            session(kind),
            turns,
            lambda task, asked=asked: asked.append(task.cancel()),  # type: ignore[misc]
            RealCountingLoop,
        )
        assert task.cancelled() is any(asked), turns
