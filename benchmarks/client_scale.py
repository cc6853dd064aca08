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
import tracemalloc
from collections.abc import Sequence
from contextlib import AsyncExitStack

import decode
from deliver import FedLink
from stopwatch import Stopwatch
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
MAX_VEHICLES_ON_LINK = 250
MIN_LINEARITY = 0.8
"""Target: the cost of a vehicle among 10, divided by the cost of a vehicle among more than 10."""
MAX_MIB = 0.15
# Interval at which every vehicle sends all messages.
TURN_S = 0.25
HEARTBEAT = messages.Heartbeat(type=2, autopilot=3, base_mode=81, custom_mode=4, system_status=4, mavlink_version=3)

Turn = list[list[bytes]]
"""The datagrams that each link receives in one interval."""


def rows(counts: Sequence[int] = COUNTS, turns: int = 16, rounds: int = 3) -> list[Row]:
    """Measure the share of a core per vehicle for each count, compared with 10 vehicles, and the memory per vehicle."""
    table = _share_rows("clients", "", counts, turns, rounds)
    table += _share_rows("fleet", "as one fleet: ", counts, turns, rounds, is_fleet=True)
    mib = asyncio.run(_mebibytes_of_each(max(counts)))
    memory_row = row("client_memory", mib, MAX_MIB, "maximum", unit="MiB", ratio=MAX_MIB / mib, aim=1.0)
    memory_row["note"] = f"{mib:.3f} MiB for each of {max(counts)} clients after one turn of messages"
    return [*table, memory_row]


def _share_rows(
    prefix: str, note: str, counts: Sequence[int], turns: int, rounds: int, *, is_fleet: bool = False
) -> list[Row]:
    """Measure the share of a core per vehicle for each count, compared with 10 vehicles."""
    percents = {}
    for count in sorted({10, *counts}):
        shares = [asyncio.run(_share_of_each(count, turns, is_fleet=is_fleet)) for _ in range(rounds)]
        percents[count] = 100 * statistics.median(shares)
    table: list[Row] = []
    for count in counts:
        percent = percents[count]
        aim = MIN_LINEARITY if count >= 10 else 0.0
        count_row = row(
            f"{prefix}_{count}", percent, percents[10], "one of ten",
            unit="% of a core each", ratio=percents[10] / percent, aim=aim,
        )  # fmt: skip
        count_row["note"] = f"{note}{percent:.3f} % of a core each, {percent * count:.1f} % together"
        table.append(count_row)
    return table


async def _share_of_each(count: int, turns: int, *, is_fleet: bool = False) -> float:
    """Return the share of a core that each vehicle takes."""
    async with AsyncExitStack() as stack:
        clients = await _connect_all(stack, count, turns)
        if is_fleet:
            members = {f"member {number}": vehicle for number, vehicle in enumerate(clients.vehicles)}
            fleet = await stack.enter_async_context(aerokit.fleet(members, min_distance_m=5.0, on_too_close="report"))
            stack.enter_context(fleet.events(capacity=10_000))
        clients.feed_turn()
        await asyncio.sleep(TURN_S)
        stopwatch = Stopwatch()
        for _ in range(turns):
            clients.feed_turn()
            await asyncio.sleep(TURN_S - stopwatch.real_s % TURN_S)
        share = stopwatch.cpu_s / stopwatch.real_s
        clients.check()
        return share / count


async def _mebibytes_of_each(count: int) -> float:
    async with AsyncExitStack() as stack:
        tracemalloc.start()
        stack.callback(tracemalloc.stop)
        clients = await _connect_all(stack, count, 0)
        clients.feed_turn()
        clients.check()
        clients.forget()
        gc.collect()
        used_bytes, _peak = tracemalloc.get_traced_memory()
        return used_bytes / count / (1 << 20)


class _Clients:
    """Connected clients, and the messages that their vehicles will send."""

    def __init__(self, vehicles: list[Vehicle], connections: list[Connection], turns: list[Turn]) -> None:
        self.vehicles = vehicles
        self._connections = connections
        self._turns = turns

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


async def _connect_all(stack: AsyncExitStack, count: int, turns: int) -> _Clients:
    connections: list[Connection] = []
    vehicles: list[Vehicle] = []
    encoders: list[FrameEncoder] = []
    for number in range(count):
        index_on_link = number % MAX_VEHICLES_ON_LINK
        if index_on_link == 0:
            link = FedLink(f"network {len(connections)}")
            connections.append(await stack.enter_async_context(aerokit.open_connection(link)))
        system_id = 1 + index_on_link
        encoder = FrameEncoder(system_id, 1)
        for _ in range(5):  # let the loop run, so that the connection does not report a blocked loop
            await asyncio.sleep(0)
        connections[-1].bytes_received(encoder.encode(HEARTBEAT), None)
        connecting = aerokit.connect(connections[-1], system_id=system_id, rates={})
        vehicles.append(await stack.enter_async_context(connecting))
        encoders.append(encoder)
    return _Clients(vehicles, connections, _encode_turns(encoders, turns + 1))


def _encode_turns(encoders: Sequence[FrameEncoder], count: int) -> list[Turn]:
    """Return the datagrams of all turns: each message from every vehicle, and a heartbeat in every fourth turn.

    Each message is a datagram.
    """
    observed = _recorded_messages()
    turns: list[Turn] = []
    for number in range(count):
        sent = [HEARTBEAT, *observed] if number % 4 == 0 else observed
        turn: Turn = []
        for begin in range(0, len(encoders), MAX_VEHICLES_ON_LINK):
            datagrams: list[bytes] = []
            for encoder in encoders[begin : begin + MAX_VEHICLES_ON_LINK]:
                datagrams += [encoder.encode(message) for message in sent]
            turn.append(datagrams)
        turns.append(turn)
    return turns


def _recorded_messages() -> list[Message]:
    """Return the last message in the recorded flight of each type that a client observes."""
    observed_types = {getattr(messages, name) for name in DEFAULT_RATES_HZ}
    recording = next(iter(decode.RECORDINGS.values()))
    latest: dict[type[Message], Message] = {}
    for raw in decode.frames_of(recording):
        frame = Frame.parse(raw)
        message_type = STANDARD[frame.message_id]
        if message_type in observed_types:
            latest[message_type] = STANDARD.decode(frame)
    return list(latest.values())


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
