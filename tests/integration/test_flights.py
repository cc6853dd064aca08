"""The same short flight over every kind of real link, on stock asyncio and on uvloop."""

from __future__ import annotations

import os
import select
import socket
import threading
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import pytest

from aerokit import VelocitySetpoint, connect
from aerokit.sim import SimulatedCopter, open_simulator

pytestmark = pytest.mark.anyio

SPEEDUP = 40.0


@contextmanager
def pseudo_terminals() -> Iterator[tuple[str, str]]:
    """Two serial ports joined by a wire: data written to one is read from the other."""
    pairs = [os.openpty(), os.openpty()]
    for pair in pairs:
        for end in pair:
            tty.setraw(end)
    stop_read, stop_write = os.pipe()

    def carry() -> None:
        masters = [pair[0] for pair in pairs]
        for master in masters:
            os.set_blocking(master, False)  # a port that is no longer read is full, and must not block the end
        while True:
            ready, _, _ = select.select([*masters, stop_read], [], [])
            if stop_read in ready:
                return
            for master in ready:
                other, data = masters[1 - masters.index(master)], os.read(master, 4096)
                while data and stop_read not in select.select([stop_read], [other], [])[0]:
                    data = data[os.write(other, data) :]

    wire = threading.Thread(target=carry)
    wire.start()
    try:
        yield os.ttyname(pairs[0][1]), os.ttyname(pairs[1][1])
    finally:
        os.write(stop_write, b"x")
        wire.join()
        for end in (*pairs[0], *pairs[1], stop_read, stop_write):
            os.close(end)


@asynccontextmanager
async def served(kind: str) -> AsyncIterator[str]:
    """A simulated copter on a real link; gives the address for the program."""
    # On a busy machine, more than 10 simulated seconds may pass between arming and the take-off.
    copter = SimulatedCopter(boot_time_s=2, boot_text=True, parameters={"DISARM_DELAY": 0.0})
    if kind == "serial":
        with pseudo_terminals() as (vehicle_port, program_port):
            async with open_simulator(copter, f"{vehicle_port},921600", speedup=SPEEDUP):
                yield f"{program_port},921600"
        return
    host = "[::1]" if kind.endswith("6") else "127.0.0.1"
    listens = f"{'tcpin' if kind.startswith('tcp') else 'udpin'}:{host}:0"
    async with open_simulator(copter, listens, speedup=SPEEDUP) as simulator:
        address = simulator.addresses[0]
        yield address.replace("tcpin", "tcp").replace("udpin", "udpout")


@pytest.mark.sampled(5)
@pytest.mark.parametrize("kind", ["udp", "udp6", "tcp", "tcp6", "serial"])
async def test_whole_flight(kind: str) -> None:
    async with served(kind) as address, connect(address, timeout=100) as vehicle:
        await vehicle.wait_ready(timeout=100)
        await vehicle.arm()
        await vehicle.take_off(5, timeout=100)
        here = vehicle.position.value
        await vehicle.go_to(here.offset(north_m=10).replace(altitude_amsl_m=None), timeout=100)
        async with vehicle.guided.velocity(valid_for_s=60.0, max_lag_s=60.0) as stream:
            await stream.fly(VelocitySetpoint(east_m_s=1), 0.3)
        assert vehicle.mode_name == "BRAKE"
        await vehicle.land(timeout=100)
        assert here.distance_to(vehicle.position.fresh(within=5)) > 8


async def test_vehicle_that_connects_to_us() -> None:
    """The usual way round: we listen, the vehicle sends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    copter = SimulatedCopter(boot_time_s=0)
    async with (
        open_simulator(copter, f"udpout:127.0.0.1:{port}", speedup=SPEEDUP),
        connect(f"127.0.0.1:{port}", timeout=100) as vehicle,
    ):
        await vehicle.wait_ready(timeout=100)
        await vehicle.arm()
        assert vehicle.is_armed
