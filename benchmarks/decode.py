"""Frames per second, side by side with pymavlink's parser in one process, on a recorded flight.

    python benchmarks/decode.py

Each figure is the median of interleaved rounds; only the ratios mean something on another machine.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from aerokit.mavlink import STANDARD, Framer, Message, read_tlog

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = (
    ROOT.parent / "shared" / "traces" / "ardupilot-copter.tlog",
    ROOT / "tests" / "recordings" / "ardupilot-copter.tlog",
)
CHUNK = 1024


def rows(rounds: int = 7) -> list[dict[str, Any]]:
    """``decode_skip`` (nobody wants the frames) and ``decode_typed`` (each is delivered as its typed message).

    Both are measured frame by frame, as datagrams come, and in pieces of 1 kB, as a stream comes; the row says which
    of the two ratios was the worse, and holds that one.
    """
    frames = [raw for _, raw in read_tlog(recording())]
    stream = b"".join(frames)
    feeds = {
        "datagrams": frames,
        "1 kB pieces": [stream[i : i + CHUNK] for i in range(0, len(stream), CHUNK)],
    }
    table: dict[str, list[dict[str, Any]]] = {"decode_skip": [], "decode_typed": []}
    for feed, chunks in feeds.items():
        skip, typed, peer = _medians((_skip, _typed, _pymavlink), chunks, len(frames), rounds)
        table["decode_skip"].append(_row("decode_skip", skip, peer, 8.0, feed))
        table["decode_typed"].append(_row("decode_typed", typed, peer, 5.0, feed))
    return [min(found, key=lambda row: row["ratio"]) for found in table.values()]


def recording() -> Path:
    """The whole flight where it is at hand, else the short recording that the project carries."""
    return next(path for path in RECORDINGS if path.exists())


def _row(name: str, aerokit: float, peer: float, aim: float, feed: str) -> dict[str, Any]:
    return {
        "name": name,
        "aerokit": round(aerokit),
        "peer": round(peer),
        "peer_name": f"pymavlink parse_buffer, frames/s, {feed}",
        "ratio": round(aerokit / peer, 2),
        "aim": aim,
    }


def _medians(
    runs: Sequence[Callable[[list[bytes]], int]], chunks: list[bytes], count: int, rounds: int
) -> list[float]:
    rates: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, found in zip(runs, rates, strict=True):
            started = time.perf_counter()
            seen = run(chunks)
            found.append(count / (time.perf_counter() - started))
            if seen != count:
                raise AssertionError(f"{run.__name__} saw {seen} of {count} frames")
    return [statistics.median(found) for found in rates]


def _skip(chunks: list[bytes]) -> int:
    framer = Framer()
    framer.wanted = frozenset()
    for chunk in chunks:
        framer.receive(chunk)
    return framer.statistics.frames


def _typed(chunks: list[bytes]) -> int:
    framer, decode = Framer(), STANDARD.decode
    seen = 0

    def deliver(message: Message) -> None:
        nonlocal seen
        seen += 1

    for chunk in chunks:
        for frame in framer.receive(chunk):
            deliver(decode(frame))
    return seen


def _pymavlink(chunks: list[bytes]) -> int:
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    seen = 0
    for chunk in chunks:
        seen += len(parser.parse_buffer(chunk) or ())
    return seen


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
