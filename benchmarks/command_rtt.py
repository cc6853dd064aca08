"""Command round trip: COMMAND_LONG to COMMAND_ACK over UDP on this machine, in microseconds.

    python benchmarks/command_rtt.py

aerokit's ``vehicle.command``, pymavlink's hand-written blocking loop and MAVSDK's asyncio API take turns in one
process, sixty round trips at a time, with the same responder in another process (``responder.py``).
"""

# pyright: reportMissingImports=false
# MAVSDK is installed only by the nox session ``bench``.
from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

os.environ["MAVLINK20"] = "1"  # pymavlink reads this variable; with it, all libraries send the same frames

import anyio
from pymavlink import mavutil
from table import Row, faster_is_better

import aerokit

__all__ = ["rows"]

COMMAND = 181  # MAV_CMD_DO_SET_RELAY
RESPONDER = Path(__file__).with_name("responder.py")
# Number of round trips before the first measured one.
WARM_UP_TRIPS = 50

Block = Callable[[int], Awaitable[list[float]]]
"""Makes this many round trips and returns their durations in microseconds."""


def rows(rounds: int = 60, trips: int = 60) -> list[Row]:
    """``command_rtt_pymavlink`` and, where it is installed, ``command_rtt_mavsdk``."""
    return anyio.run(_measure, rounds, trips)


async def _measure(rounds: int, trips: int) -> list[Row]:
    aerokit_port, pymavlink_port, mavsdk_port = _free_ports(3)
    async with AsyncExitStack() as stack:
        stack.enter_context(_responder([aerokit_port, pymavlink_port, mavsdk_port]))
        blocks = {
            "aerokit": await stack.enter_async_context(_aerokit(aerokit_port)),
            "pymavlink": stack.enter_context(_pymavlink(pymavlink_port)),
        }
        if _has_mavsdk():
            blocks["mavsdk"] = await stack.enter_async_context(_mavsdk(mavsdk_port))
        return _rows(await _in_turns(blocks, rounds, trips))


def _rows(durations_us: dict[str, list[float]]) -> list[Row]:
    own = durations_us["aerokit"]
    peer = durations_us["pymavlink"]
    name = "pymavlink, blocking loop"
    table = [faster_is_better("command_rtt_pymavlink", own, peer, name, unit="µs", aim=1 / 1.5)]
    if "mavsdk" in durations_us:
        peer = durations_us["mavsdk"]
        name = "MAVSDK asyncio, action.set_relay"
        table.append(faster_is_better("command_rtt_mavsdk", own, peer, name, unit="µs", aim=1 / 0.6))
    return table


async def _in_turns(blocks: dict[str, Block], rounds: int, trips: int) -> dict[str, list[float]]:
    """Return the durations of all round trips. Short turns make other load affect all libraries equally."""
    for block in blocks.values():
        await block(WARM_UP_TRIPS)
    durations_us: dict[str, list[float]] = {name: [] for name in blocks}
    order = list(blocks)
    for _ in range(rounds):
        for name in order:
            durations_us[name] += await blocks[name](trips)
        order.append(order.pop(0))
    return durations_us


# ----------------------------------------------------------------------------------------- the three


@asynccontextmanager
async def _aerokit(port: int) -> AsyncIterator[Block]:
    async with aerokit.connect(f"udpin:127.0.0.1:{port}", rates={}) as vehicle:

        async def block(trips: int) -> list[float]:
            return await _timed(lambda: vehicle.command(COMMAND, 1, 1), trips)

        yield block


@contextmanager
def _pymavlink(port: int) -> Iterator[Block]:
    master: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=254)
    master.wait_heartbeat(timeout=10)
    send = master.mav.command_long_send
    clock = time.perf_counter

    async def block(trips: int) -> list[float]:
        durations_us = []
        for _ in range(trips):
            started_at = clock()
            send(1, 1, COMMAND, 0, 1, 1, 0, 0, 0, 0, 0)  # system, component, command, confirmation, param1 to param7
            ack = master.recv_match(type="COMMAND_ACK", blocking=True)
            while ack.command != COMMAND:
                ack = master.recv_match(type="COMMAND_ACK", blocking=True)
            durations_us.append((clock() - started_at) * 1e6)
        return durations_us

    yield block
    master.close()


@asynccontextmanager
async def _mavsdk(port: int) -> AsyncIterator[Block]:
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
    from mavsdk.asyncio.plugins.action import ActionAsync

    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        action = ActionAsync(await mavsdk.first_autopilot(timeout_s=10.0))

        async def block(trips: int) -> list[float]:
            return await _timed(lambda: action.set_relay(1, 1), trips)

        yield block


async def _timed(trip: Callable[[], Awaitable[object]], trips: int) -> list[float]:
    clock = time.perf_counter
    durations_us = []
    for _ in range(trips):
        started_at = clock()
        await trip()
        durations_us.append((clock() - started_at) * 1e6)
    return durations_us


def _has_mavsdk() -> bool:
    try:
        import mavsdk.asyncio  # noqa: F401
    except ImportError:
        return False
    return True


# ------------------------------------------------------------------------------------- the other side


@contextmanager
def _responder(ports: list[int]) -> Iterator[None]:
    command = [sys.executable, str(RESPONDER), *map(str, ports)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        if process.stdout is None or not process.stdout.readline():
            raise RuntimeError("the responder did not start")
        yield
    finally:
        process.terminate()
        process.communicate()


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for sock in sockets:
            sock.bind(("127.0.0.1", 0))
        addresses = [sock.getsockname() for sock in sockets]
        return [port for _, port in addresses]
    finally:
        for sock in sockets:
            sock.close()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
