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

import decode
from pymavlink import mavutil
from table import Row, higher_is_better

from aerokit import wire_implementation
from aerokit.mavlink import STANDARD, Framer, read_tlog

__all__ = ["rows"]


def rows(rounds: int = 7, recording: str = next(iter(decode.RECORDINGS))) -> list[Row]:
    """One row for each peer."""
    path = decode.RECORDINGS[recording]
    peers: list[tuple[str, str, Callable[[Path], int], float]] = [
        ("tlog_typed", "pymavlink mavlink_connection", _pymavlink, 12.0 if wire_implementation == "c" else 3.0)
    ]
    if find_spec("mavio"):
        peers.append(
            ("tlog_typed_mavio", "mavio deserialize", lambda path: asyncio.run(_mavio(path.read_bytes())), 1.0)
        )
    if find_spec("mavkit"):
        peers.append(("tlog_typed_mavkit", "mavkit entries, without fields", _mavkit, 1.0))
        peers.append(("tlog_typed_mavkit_json", "mavkit entries and message_json", _mavkit_json, 1.0))
    _aerokit(path)  # imports the messages
    rates: list[list[float]] = [[] for _ in range(1 + len(peers))]
    for _ in range(rounds):
        for found, read in zip(rates, (_aerokit, *(peer[2] for peer in peers)), strict=True):
            started = time.process_time()
            seen = read(path)
            found.append(seen / (time.process_time() - started))
    own = rates[0]
    return [
        higher_is_better(name, own, peer, peer_name, unit="frames/s", aim=aim)
        for (name, peer_name, _, aim), peer in zip(peers, rates[1:], strict=True)
    ]


def _aerokit(path: Path) -> int:
    framer, decode_frame, seen = Framer(), STANDARD.decode, 0
    for at, raw in read_tlog(path):
        for frame in framer.receive(raw, at):
            decode_frame(frame)
            seen += 1
    return seen


def _pymavlink(path: Path) -> int:
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    seen = 0
    while log.recv_msg() is not None:
        seen += 1
    log.close()
    return seen


async def _mavio(data: bytes) -> int:
    reader = asyncio.StreamReader()
    reader.feed_data(data)
    reader.feed_eof()
    seen = 0
    async for _ in import_module("mavio.serializer").deserialize(reader, tlog=True):
        seen += 1
    return seen


async def _entries(path: Path, use: Callable[[object], object]) -> int:
    log = await import_module("mavkit").TlogFile.open(str(path))
    entries = await log.entries()
    for entry in entries:
        use(entry)
    return len(entries)


def _mavkit(path: Path) -> int:
    return asyncio.run(_entries(path, lambda entry: entry))


def _mavkit_json(path: Path) -> int:
    return asyncio.run(_entries(path, lambda entry: json.loads(entry.message_json())))  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
