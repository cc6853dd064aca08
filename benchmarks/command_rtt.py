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
TRIPS_BEFORE = 50

Block = Callable[[int], Awaitable[list[float]]]
"""Makes this many round trips and returns their durations in microseconds."""


def rows(rounds: int = 60, trips: int = 60) -> list[Row]:
    """``command_rtt_pymavlink`` and, where it is installed, ``command_rtt_mavsdk``."""
    return anyio.run(_measure, rounds, trips)


async def _measure(rounds: int, trips: int) -> list[Row]:
    ports = _free_ports(3)
    async with AsyncExitStack() as stack:
        stack.enter_context(_responder(ports))
        blocks = {
            "aerokit": await stack.enter_async_context(_aerokit(ports[0])),
            "pymavlink": stack.enter_context(_pymavlink(ports[1])),
        }
        if _has_mavsdk():
            blocks["mavsdk"] = await stack.enter_async_context(_mavsdk(ports[2]))
        return _rows(await _in_turns(blocks, rounds, trips))


def _rows(taken: dict[str, list[float]]) -> list[Row]:
    own = taken["aerokit"]
    found = [
        faster_is_better(
            "command_rtt_pymavlink",
            own,
            taken["pymavlink"],
            "pymavlink, blocking loop",
            unit="µs",
            aim=1 / 1.5,
        )
    ]
    if "mavsdk" in taken:
        name = "MAVSDK asyncio, action.set_relay"
        found.append(faster_is_better("command_rtt_mavsdk", own, taken["mavsdk"], name, unit="µs", aim=1 / 0.6))
    return found


async def _in_turns(blocks: dict[str, Block], rounds: int, trips: int) -> dict[str, list[float]]:
    """Return the durations. Turns are short, so that other load on the machine affects all libraries equally."""
    for block in blocks.values():
        await block(TRIPS_BEFORE)
    taken: dict[str, list[float]] = {name: [] for name in blocks}
    order = list(blocks)
    for _ in range(rounds):
        for name in order:
            taken[name] += await blocks[name](trips)
        order.append(order.pop(0))
    return taken


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
    send, clock = master.mav.command_long_send, time.perf_counter

    async def block(trips: int) -> list[float]:
        taken = []
        for _ in range(trips):
            started = clock()
            send(1, 1, COMMAND, 0, 1, 1, 0, 0, 0, 0, 0)
            ack = master.recv_match(type="COMMAND_ACK", blocking=True)
            while ack.command != COMMAND:
                ack = master.recv_match(type="COMMAND_ACK", blocking=True)
            taken.append((clock() - started) * 1e6)
        return taken

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
    taken, clock = [], time.perf_counter
    for _ in range(trips):
        started = clock()
        await trip()
        taken.append((clock() - started) * 1e6)
    return taken


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
        return [sock.getsockname()[1] for sock in sockets]
    finally:
        for sock in sockets:
            sock.close()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
