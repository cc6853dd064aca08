"""Frames per second, side by side with pymavlink's parser in one process, on a recorded flight.

    python benchmarks/decode.py

The recording is taken in parts of some 20 ms, and all take their turn at each part: what else the machine does hits
them alike. Figures and ratios are the medians over all parts; only the ratios mean something on another machine.
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
PART = 1000


def rows(rounds: int = 7, path: Path | None = None) -> list[dict[str, Any]]:
    """What nobody wants (``decode_skip``), and what is delivered as its typed message (``decode_typed``).

    These are fed frame by frame, as the recording has them and UDP brings them; ``…_stream`` are fed the same bytes in
    pieces of 1 kB, as TCP and serial ports bring them. ``path`` is another recording than the copter's flight.
    """
    frames = [raw for _, raw in read_tlog(path or recording())]
    parts = [frames[begin : begin + PART] for begin in range(0, len(frames), PART)]
    table: list[dict[str, Any]] = []
    for feed, pieces in (("", list), ("_stream", _in_pieces)):
        skip, typed, peer = _rates((_skip, _typed, _pymavlink), [(len(p), pieces(p)) for p in parts], rounds)
        table.append(_row("decode_skip" + feed, skip, peer, 8.0))
        table.append(_row("decode_typed" + feed, typed, peer, 5.0))
    return table


def recording() -> Path:
    """The whole flight where it is at hand, else the short recording that the project carries."""
    return next(path for path in RECORDINGS if path.exists())


def _in_pieces(frames: list[bytes]) -> list[bytes]:
    stream = b"".join(frames)
    return [stream[begin : begin + CHUNK] for begin in range(0, len(stream), CHUNK)]


def _row(name: str, aerokit: list[float], peer: list[float], aim: float) -> dict[str, Any]:
    ratios = [own / other for own, other in zip(aerokit, peer, strict=True)]
    return {
        "name": name,
        "aerokit": round(statistics.median(aerokit)),
        "peer": round(statistics.median(peer)),
        "peer_name": "pymavlink parse_buffer",
        "unit": "frames/s",
        "ratio": round(statistics.median(ratios), 2),
        "aim": aim,
    }


def _rates(
    runs: Sequence[Callable[[list[bytes]], int]], parts: list[tuple[int, list[bytes]]], rounds: int
) -> list[list[float]]:
    rates: list[list[float]] = [[] for _ in runs]
    for count, pieces in parts * rounds:
        for run, found in zip(runs, rates, strict=True):
            started = time.perf_counter()
            seen = run(pieces)
            found.append(count / (time.perf_counter() - started))
            if seen != count:
                raise AssertionError(f"{run.__name__} saw {seen} of {count} frames")
    return rates


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
