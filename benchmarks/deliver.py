"""Frames of a recorded flight that a connection processes per second of processor time.

    python benchmarks/deliver.py

``deliver_telemetry``: a vehicle's telemetry is attached. Each datagram is framed, checked, decoded where a state cell
needs the message, and stored in the cells with units converted. ``deliver_async_for``: a program subscribes to all
messages and reads them by ``async for``, in pieces of 1 kB, as TCP, serial ports and busy UDP ports deliver them; the
loop runs once after each piece. pymavlink's counterpart is the work of ``recv_match`` on received bytes:
``parse_buffer`` and ``post_message``, which keeps the latest message of each type.
"""

from __future__ import annotations

import asyncio
import json
import statistics
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import anyio.lowlevel
import decode
from pymavlink import mavutil
from table import Row, row

import aerokit
from aerokit import wire_implementation
from aerokit.mavlink import STANDARD, Frame
from aerokit.transport.link import BaseLink

__all__ = ["FedLink", "rows"]

AUTOPILOT = (1, 1)
FLIGHT = next(iter(decode.RECORDINGS))
TELEMETRY_AIM = 12.0 if wire_implementation == "c" else 2.0
READ_AIM = 10.0 if wire_implementation == "c" else 2.0


def rows(rounds: int = 7, recording: str = FLIGHT) -> list[Row]:
    """Measure both rows, by default with the recorded flight of the copter."""
    frames = decode.frames_of(decode.RECORDINGS[recording])
    pieces = decode.in_pieces(frames)
    peer_name = "pymavlink parse_buffer + post_message"
    telemetry, peer = anyio.run(_in_turns, _telemetry, frames, frames, rounds)
    read, peer_of_read = anyio.run(_in_turns, _async_for, frames, pieces, rounds)
    return [
        row(
            "deliver_telemetry", telemetry, peer, peer_name, unit="frames/s", ratio=telemetry / peer, aim=TELEMETRY_AIM
        ),
        row(
            "deliver_async_for",
            read,
            peer_of_read,
            peer_name,
            unit="frames/s",
            ratio=read / peer_of_read,
            aim=READ_AIM,
        ),
    ]


async def _in_turns(
    measure: Callable[[list[bytes], list[bytes]], Awaitable[float]],
    frames: list[bytes],
    pieces: list[bytes],
    rounds: int,
) -> tuple[float, float]:
    """Return the median rates of aerokit and of pymavlink."""
    own_rates = []
    peer_rates = []
    for _ in range(rounds):
        own_rates.append(await measure(frames, pieces))
        peer_rates.append(_pymavlink(len(frames), pieces))
    return statistics.median(own_rates), statistics.median(peer_rates)


async def _async_for(frames: list[bytes], pieces: list[bytes]) -> float:
    """Return the rate at which a subscriber reads all messages by ``async for``."""
    message_types = {STANDARD[Frame.parse(raw).message_id] for raw in frames}
    cpu_s = 0.0
    read_count = 0

    async def read(subscription: Any) -> None:
        nonlocal read_count
        async for _ in subscription:
            read_count += 1

    async with (
        aerokit.open_connection(FedLink("recording")) as connection,
        anyio.create_task_group() as group,
    ):
        with connection.subscribe(*message_types, capacity=1000) as subscription:
            group.start_soon(read, subscription)
            await anyio.lowlevel.checkpoint()
            started_at = time.process_time()
            for piece in pieces:
                connection.bytes_received(piece, None)
                await asyncio.sleep(0)
            cpu_s = time.process_time() - started_at
            group.cancel_scope.cancel()
            if read_count != len(frames):
                raise AssertionError(f"{read_count} of {len(frames)} messages were read")
    return read_count / cpu_s


async def _telemetry(frames: list[bytes], pieces: list[bytes]) -> float:
    """Return the rate at which the telemetry of a vehicle processes frames."""
    link = FedLink("recording")
    async with aerokit.open_connection(link) as connection:
        for raw in frames:
            connection.bytes_received(raw, None)
            if AUTOPILOT in connection.heartbeats:
                break
        async with aerokit.connect(connection, rates={}) as vehicle:
            rate = _rate(len(frames), pieces, lambda raw: connection.bytes_received(raw, None))
            if not vehicle.attitude.is_known:
                raise AssertionError("the telemetry received no messages")
    return rate


def _pymavlink(count: int, pieces: list[bytes]) -> float:
    master: Any = mavutil.mavfile(None, "recording")
    master.mav.robust_parsing = True

    def feed(raw: bytes) -> None:
        for message in master.mav.parse_buffer(raw) or ():
            master.post_message(message)

    return _rate(count, pieces, feed)


def _rate(count: int, pieces: list[bytes], feed: Callable[[bytes], None]) -> float:
    started_at = time.process_time()
    for piece in pieces:
        feed(piece)
    return count / (time.process_time() - started_at)


class FedLink(BaseLink):
    """A link fed with bytes by the benchmark; sent bytes are discarded."""

    async def _connect(self) -> None:
        pass

    def _release(self) -> None:
        pass

    def write(self, data: bytes, peer: object = None) -> None:
        """Discard the bytes."""


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
