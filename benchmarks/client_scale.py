"""Cost of each vehicle for a client: processor time and memory with 1 to 500 vehicles.

    python benchmarks/client_scale.py

Every vehicle sends the states that a client observes at 4 Hz, from a recorded flight, in real time. The frames are
encoded in advance and passed to the connections in this process, so that only the clients and the loop are measured.
System ids are limited to 255, so more vehicles need several connections. ``fleet_…`` measures the same clients as one
fleet whose events are read. The vehicles are disarmed, so that the distance monitor compares no positions.
"""

from __future__ import annotations

import asyncio
import gc
import json
import statistics
import sys
import time
import tracemalloc
from collections.abc import Sequence
from contextlib import AsyncExitStack

import decode
from deliver import FedLink
from table import Row, row

import aerokit
from aerokit import messages
from aerokit.connection.connection import Connection
from aerokit.mavlink import STANDARD, Frame, Message
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ
from aerokit.vehicle.vehicle import Vehicle

__all__ = ["COUNTS", "rows"]

COUNTS = (1, 10, 50, 100, 200, 500)
ON_A_LINK = 250
LINEAR = 0.8
"""Minimum ratio of the cost of one vehicle among 10 to that of one vehicle among more than 10."""
MAX_MIB = 0.15
# Interval at which every vehicle sends all messages.
TURN_S = 0.25
HEARTBEAT = messages.Heartbeat(2, 3, 81, 4, 4, 3)

Turn = list[list[bytes]]
"""The datagrams that each link receives in one interval."""


def rows(counts: Sequence[int] = COUNTS, turns: int = 16, rounds: int = 3) -> list[Row]:
    """Measure the share of a core per vehicle for each count, compared with 10 vehicles, and the memory per vehicle."""
    found = {
        count: statistics.median(asyncio.run(_share_of_each(count, turns)) for _ in range(rounds))
        for count in sorted({10, *counts})
    }
    table: list[Row] = []
    for count in counts:
        percent, percent_of_ten = 100 * found[count], 100 * found[10]
        shown = row(
            f"clients_{count}", percent, percent_of_ten, "one of ten",
            unit="% of a core each", ratio=percent_of_ten / percent, aim=LINEAR if count >= 10 else 0.0,
        )  # fmt: skip
        table.append({**shown, "note": f"{percent:.3f} % of a core each, {percent * count:.1f} % together"})
    table += _fleet_rows(counts, turns, rounds)
    mib = asyncio.run(_mebibytes_of_each(max(counts)))
    shown = row("client_memory", mib, MAX_MIB, "maximum", unit="MiB", ratio=MAX_MIB / mib, aim=1.0)
    return [
        *table,
        {**shown, "note": f"{mib:.3f} MiB for each of {max(counts)} clients after one turn of messages"},
    ]


def _fleet_rows(counts: Sequence[int], turns: int, rounds: int) -> list[Row]:
    """Measure the share of a core per fleet member for each count, compared with 10 members."""
    found = {
        count: statistics.median(asyncio.run(_share_of_each(count, turns, is_fleet=True)) for _ in range(rounds))
        for count in sorted({10, *counts})
    }
    table: list[Row] = []
    for count in counts:
        percent, percent_of_ten = 100 * found[count], 100 * found[10]
        shown = row(
            f"fleet_{count}", percent, percent_of_ten, "one of ten",
            unit="% of a core each", ratio=percent_of_ten / percent, aim=LINEAR if count >= 10 else 0.0,
        )  # fmt: skip
        note = f"as one fleet: {percent:.3f} % of a core each, {percent * count:.1f} % together"
        table.append({**shown, "note": note})
    return table


async def _share_of_each(count: int, turns: int, *, is_fleet: bool = False) -> float:
    """Return the share of a core that each vehicle takes."""
    async with AsyncExitStack() as stack:
        fleet = await _connected(stack, count, turns)
        if is_fleet:
            names = {f"member {number}": vehicle for number, vehicle in enumerate(fleet.vehicles)}
            one = await stack.enter_async_context(aerokit.fleet(names, min_distance_m=5.0, on_too_close="report"))
            stack.enter_context(one.events(capacity=10_000))
        fleet.feed_turn()
        await asyncio.sleep(TURN_S)
        wall, used = time.perf_counter(), time.process_time()
        for _ in range(turns):
            fleet.feed_turn()
            await asyncio.sleep(max(0.0, TURN_S - (time.perf_counter() - wall) % TURN_S))
        wall, used = time.perf_counter() - wall, time.process_time() - used
        fleet.check()
        return used / wall / count


async def _mebibytes_of_each(count: int) -> float:
    async with AsyncExitStack() as stack:
        tracemalloc.start()
        stack.callback(tracemalloc.stop)
        fleet = await _connected(stack, count, 0)
        fleet.feed_turn()
        fleet.check()
        fleet.forget()
        gc.collect()
        return tracemalloc.get_traced_memory()[0] / count / (1 << 20)


class _Fleet:
    """Connected clients, and the messages that their vehicles will send."""

    def __init__(self, vehicles: list[Vehicle], connections: list[Connection], turns: list[Turn]) -> None:
        self.vehicles = vehicles
        self._connections, self._turns = connections, turns

    def feed_turn(self) -> None:
        for connection, datagrams in zip(self._connections, self._turns.pop(0), strict=True):
            for datagram in datagrams:
                connection.bytes_received(datagram, None)

    def forget(self) -> None:
        """Release the messages that were not sent, to exclude them from the measured memory."""
        self._turns.clear()

    def check(self) -> None:
        if not all(vehicle.attitude.is_known for vehicle in self.vehicles):
            raise AssertionError("a client received no messages of its vehicle")


async def _connected(stack: AsyncExitStack, count: int, turns: int) -> _Fleet:
    encoders = [FrameEncoder(1 + number % ON_A_LINK, 1) for number in range(count)]
    connections = [
        await stack.enter_async_context(aerokit.open_connection(FedLink(f"network {number}")))
        for number in range(-(-count // ON_A_LINK))
    ]
    vehicles = []
    for number, encoder in enumerate(encoders):
        connection = connections[number // ON_A_LINK]
        for _ in range(5):  # let the loop run, so that the connection does not report a blocked loop
            await asyncio.sleep(0)
        connection.bytes_received(encoder.encode(HEARTBEAT), None)
        system_id = 1 + number % ON_A_LINK
        vehicles.append(await stack.enter_async_context(aerokit.connect(connection, system_id=system_id, rates={})))
    return _Fleet(vehicles, connections, _made(encoders, turns + 1))


def _made(encoders: Sequence[FrameEncoder], turns: int) -> list[Turn]:
    """Return the messages of all turns: one of each kind from every vehicle, and a heartbeat in every fourth turn.

    Each message is a datagram.
    """
    kinds = _kinds()
    made: list[Turn] = []
    for number in range(turns):
        turn: Turn = [[] for _ in range(-(-len(encoders) // ON_A_LINK))]
        for which, encoder in enumerate(encoders):
            sent = [HEARTBEAT, *kinds] if number % 4 == 0 else kinds
            turn[which // ON_A_LINK] += [encoder.encode(message) for message in sent]
        made.append(turn)
    return made


def _kinds() -> list[Message]:
    """Return the last message in the recorded flight of each kind that a client observes."""
    wanted = {getattr(messages, name) for name in DEFAULT_RATES_HZ}
    found: dict[type[Message], Message] = {}
    for raw in decode.frames_of(next(iter(decode.RECORDINGS.values()))):
        frame = Frame.parse(raw)
        if STANDARD[frame.message_id] in wanted:
            found[STANDARD[frame.message_id]] = STANDARD.decode(frame)
    return list(found.values())


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
