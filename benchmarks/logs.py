"""A recorded flight from a ``.tlog`` to typed messages: frames per second of processor time.

    python benchmarks/logs.py

Each side reads the file as its documentation has it, in turns:

- aerokit by ``read_tlog``, `Framer` and ``STANDARD.decode``,
- pymavlink by ``mavlink_connection`` and ``recv_msg``,
- mavio by ``deserialize(…, tlog=True)``,
- mavkit by ``TlogFile.entries()``, whose entries have a time and an id but no fields; with ``message_json()``, as text.

Peers that are not installed are left out. The rates count what each side delivers: mavkit drops unknown messages.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import decode
from pymavlink import mavutil
from table import Row, higher_is_better

from aerokit import wire_implementation
from aerokit.mavlink import STANDARD, Framer, read_tlog

__all__ = ["rows"]


def rows(rounds: int = 7, recording: str = next(iter(decode.RECORDINGS))) -> list[Row]:
    """One row for each peer."""
    path = decode.RECORDINGS[recording]
    peers = _peers()
    _aerokit(path)  # imports the messages
    own_rates: list[float] = []
    peer_rates: dict[str, list[float]] = {peer.row_name: [] for peer in peers}
    for _ in range(rounds):
        own_rates.append(_rate(_aerokit, path))
        for peer in peers:
            peer_rates[peer.row_name].append(_rate(peer.read, path))
    return [
        higher_is_better(peer.row_name, own_rates, peer_rates[peer.row_name], peer.name, unit="frames/s", aim=peer.aim)
        for peer in peers
    ]


class _Peer(NamedTuple):
    """Another library. ``read`` reads a file, and returns the number of messages."""

    row_name: str
    name: str
    read: Callable[[Path], int]
    aim: float = 1.0


def _peers() -> list[_Peer]:
    aim = 12.0 if wire_implementation == "c" else 3.0
    peers = [_Peer("tlog_typed", "pymavlink mavlink_connection", _pymavlink, aim)]
    if find_spec("mavio"):
        peers.append(_Peer("tlog_typed_mavio", "mavio deserialize", _mavio))
    if find_spec("mavkit"):
        peers.append(_Peer("tlog_typed_mavkit", "mavkit entries, without fields", _mavkit))
        peers.append(_Peer("tlog_typed_mavkit_json", "mavkit entries and message_json", _mavkit_json))
    return peers


def _rate(read: Callable[[Path], int], path: Path) -> float:
    started_at = time.process_time()
    count = read(path)
    return count / (time.process_time() - started_at)


def _aerokit(path: Path) -> int:
    framer = Framer()
    decode_frame = STANDARD.decode
    count = 0
    for unix_s, raw in read_tlog(path):
        for frame in framer.receive(raw, unix_s):
            decode_frame(frame)
            count += 1
    return count


def _pymavlink(path: Path) -> int:
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    count = 0
    while log.recv_msg() is not None:
        count += 1
    log.close()
    return count


def _mavio(path: Path) -> int:
    data = path.read_bytes()

    async def read() -> int:
        reader = asyncio.StreamReader()
        reader.feed_data(data)
        reader.feed_eof()
        count = 0
        async for _ in import_module("mavio.serializer").deserialize(reader, tlog=True):
            count += 1
        return count

    return asyncio.run(read())


async def _mavkit_entries(path: Path) -> list[Any]:
    log = await import_module("mavkit").TlogFile.open(str(path))
    entries: list[Any] = await log.entries()
    return entries


def _mavkit(path: Path) -> int:
    return len(asyncio.run(_mavkit_entries(path)))


def _mavkit_json(path: Path) -> int:
    entries = asyncio.run(_mavkit_entries(path))
    for entry in entries:
        json.loads(entry.message_json())
    return len(entries)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
