"""Behaviour that only real sockets show: ports in use or closed, several vehicles on one, a server that closes."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from typing import Any

import anyio
import pytest

from aerokit import connect, open_connection
from aerokit.errors import ConnectFailed, LinkLost, LinkOpenError
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import CommandLong
from aerokit.sim import SimulatedCopter, open_simulator

pytestmark = pytest.mark.anyio

SPEEDUP = 40.0


@contextlib.contextmanager
def udp_socket(host: str = "127.0.0.1") -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        sock.bind((host, 0))
        sock.setblocking(False)
        yield sock


def address_of(sock: socket.socket, kind: str) -> str:
    host, port = sock.getsockname()[:2]
    return f"{kind}:[{host}]:{port}" if ":" in host else f"{kind}:{host}:{port}"


async def datagram(sock: socket.socket) -> bytes:
    with anyio.fail_after(100):
        await anyio.wait_readable(sock)
    return sock.recv(65536)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
async def test_udpout_sends_first(host: str) -> None:
    """A vehicle that only answers known peers would stay silent otherwise."""
    with udp_socket(host) as vehicle:
        async with open_connection(address_of(vehicle, "udpout"), source_system=250):
            frames = Framer().receive(await datagram(vehicle))
            assert [(frame.system_id, frame.message_id) for frame in frames] == [(250, 0)]


async def test_udp_port_closed() -> None:
    with udp_socket() as gone:
        address = address_of(gone, "udpout")
    with pytest.raises(ConnectFailed, match="no bytes were received"):
        async with connect(address, timeout=0.3):
            pytest.fail("there is no vehicle")
    with pytest.raises(LinkOpenError, match="nothing listens there"):
        async with connect(address.replace("udpout", "tcp")):
            pytest.fail("there is no vehicle")


async def test_udp_port_in_use() -> None:
    with udp_socket() as other, pytest.raises(LinkOpenError, match="another program uses this port"):
        async with connect(address_of(other, "udpin")):
            pytest.fail("it is taken")


async def test_several_vehicles_on_one_port() -> None:
    """Each sends from its own port to ours; messages for one of them are sent to that one only."""
    copters = [SimulatedCopter(boot_time_s=0, system_id=system_id) for system_id in (1, 2, 3)]
    received: dict[int, list[int]] = {copter.system_id: [] for copter in copters}
    for copter in copters:
        handler = copter.handlers[CommandLong.ID]

        def note(message: Any, channel: Any, copter: Any = copter, handler: Any = handler) -> None:
            received[copter.system_id].append(message.command)
            handler(message, channel)

        copter.handlers[CommandLong.ID] = note
    async with open_connection("udpin:127.0.0.1:0") as connection, contextlib.AsyncExitStack() as stack:
        address = connection.link.address.replace("udpin", "udpout")
        for copter in copters:
            await stack.enter_async_context(open_simulator(copter, address, speedup=SPEEDUP))
        vehicles = [
            await stack.enter_async_context(connect(connection, system_id=system_id, rates={}))
            for system_id in (2, 1, 3)
        ]
        await vehicles[0].wait_ready(timeout=100)
        await vehicles[0].arm()
        assert [copter.motors.is_armed for copter in copters] == [False, True, False]
        assert [vehicle.is_armed for vehicle in vehicles] == [True, False, False]
        assert 400 in received[2]
        assert 400 not in received[1] + received[3]
        await vehicles[2].set_mode("GUIDED")
        assert [vehicle.mode_name for vehicle in vehicles] == ["STABILIZE", "STABILIZE", "GUIDED"]


async def test_tcp_server_closed_is_detected_immediately() -> None:
    async with contextlib.AsyncExitStack() as stack:
        simulator = await stack.enter_async_context(
            open_simulator(SimulatedCopter(boot_time_s=0), "tcpin:127.0.0.1:0", speedup=SPEEDUP)
        )
        address = simulator.addresses[0].replace("tcpin", "tcp")
        with anyio.fail_after(100), pytest.raises(LinkLost, match=r"other side closed|reset by peer"):
            async with connect(address) as vehicle:
                pending = asyncio.ensure_future(vehicle.command(31_000, retries=49))
                await asyncio.sleep(0)
                await stack.aclose()
                await pending
