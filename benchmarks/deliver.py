"""A recorded flight through a whole connection, with a vehicle's telemetry attached: frames per second.

    python benchmarks/deliver.py

Datagram by datagram: framed, checked, decoded where a state cell wants the message, and kept in the cells with units
converted. pymavlink's counterpart is what ``recv_match`` does with bytes it has read: ``parse_buffer`` and
``post_message``, which keeps the latest message of each type.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
from decode import recording
from pymavlink import mavutil
from table import Row, row

import aerokit
from aerokit.links.base import BaseLink
from aerokit.mavlink import read_tlog

__all__ = ["rows"]

AUTOPILOT = (1, 1)


def rows(rounds: int = 7, path: Path | None = None) -> list[Row]:
    """``deliver_telemetry``; ``path`` is another recording than the copter's flight."""
    frames = [raw for _, raw in read_tlog(path or recording())]
    own, peer = anyio.run(_in_turns, frames, rounds)
    return [
        row(
            "deliver_telemetry",
            own,
            peer,
            "pymavlink parse_buffer + post_message",
            unit="frames/s",
            ratio=own / peer,
            aim=2.0,
        )
    ]


async def _in_turns(frames: list[bytes], rounds: int) -> tuple[float, float]:
    own, peer = [], []
    for _ in range(rounds):
        own.append(await _aerokit(frames))
        peer.append(_pymavlink(frames))
    return statistics.median(own), statistics.median(peer)


async def _aerokit(frames: list[bytes]) -> float:
    link = _FedLink("recording")
    async with aerokit.open_connection(link) as connection:
        for raw in frames:
            connection.bytes_received(raw, None)
            if AUTOPILOT in connection.heard:
                break
        async with aerokit.connect(connection, rates={}) as vehicle:
            rate = _rate(frames, lambda raw: connection.bytes_received(raw, None))
            if not vehicle.attitude.is_known:
                raise AssertionError("the telemetry saw nothing")
    return rate


def _pymavlink(frames: list[bytes]) -> float:
    master: Any = mavutil.mavfile(None, "recording")
    master.mav.robust_parsing = True

    def feed(raw: bytes) -> None:
        for message in master.mav.parse_buffer(raw) or ():
            master.post_message(message)

    return _rate(frames, feed)


def _rate(frames: list[bytes], feed: Callable[[bytes], None]) -> float:
    started = time.perf_counter()
    for raw in frames:
        feed(raw)
    return len(frames) / (time.perf_counter() - started)


class _FedLink(BaseLink):
    """A link whose bytes the benchmark brings; what is sent is thrown away."""

    async def _connect(self) -> None:
        pass

    def _release(self) -> None:
        pass

    def write(self, data: bytes, peer: object = None) -> None:
        pass


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
