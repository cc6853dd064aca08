"""Decoded frames per second of a recorded flight, compared with pymavlink's parser.

    python benchmarks/decode.py

Both run in one process and take turns after every 20 ms, so that other load on the machine affects them equally.
Figures and ratios are medians over all parts of the recording. Only the ratios are comparable between machines.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from struct import Struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega
from table import Row, higher_is_better

from aerokit import wire_implementation
from aerokit.mavlink import STANDARD, Framer, Message, read_tlog
from aerokit.mavlink.frame import MAGIC_V2, x25

ROOT = Path(__file__).resolve().parent.parent
_FOLDERS = {"": ROOT.parent / "shared" / "traces", "_short": ROOT / "tests" / "recordings"}
RECORDINGS = {
    f"{name.rpartition('-')[2]}{suffix}": folder / f"{name}.tlog"
    for suffix, folder in _FOLDERS.items()
    for name in ("ardupilot-copter", "ardupilot-plane", "ardupilot-rover", "px4-quad")
    if (folder / f"{name}.tlog").exists()
}
"""Recordings by name: the complete flights if they are available, and the short ones in the repository. Frames of PX4
are signed, with or without a key.
"""
_HEADER = Struct("<BBBxBHI").unpack_from
_CHECKSUM = Struct("<H").unpack_from
SKIP_AIM, TYPED_AIM = (50.0, 18.0) if wire_implementation == "c" else (10.0, 6.0)
CHUNK = 1024
PART = 1000


def rows(rounds: int = 7, recordings: Sequence[str] = tuple(RECORDINGS)) -> list[Row]:
    """Measure frames without a subscriber (``decode_skip``) and frames delivered as typed messages
    (``decode_typed``).

    Each call has one frame, as with UDP. The rows ``…_stream`` have pieces of 1 kB, as with TCP and serial ports. Rows
    of the first recording have no suffix; those of the others end with the name of the recording. ``decode_floor``
    compares ``decode_skip`` with the minimum in pure Python, which is parsing the header and comparing the checksum;
    ``decode_floor_typed`` does the same for ``decode_typed``, with an unpacked payload.
    """
    table: list[Row] = []
    for which, name in enumerate(recordings):
        frames = frames_of(RECORDINGS[name])
        parts = [frames[begin : begin + PART] for begin in range(0, len(frames), PART)]
        end = f"_{name}" if which else ""
        pieces = [(len(part), part) for part in parts]
        skip, typed, least, unpacked, peer = _rates((_skip, _typed, _least, _unpacked, _pymavlink), pieces, rounds)
        table.append(_row("decode_skip" + end, skip, peer, SKIP_AIM))
        table.append(_row("decode_typed" + end, typed, peer, TYPED_AIM))
        if which:
            continue
        table.append(_row("decode_floor", skip, least, 1 / 1.5, "header and checksum alone"))
        table.append(_row("decode_floor_typed", typed, unpacked, 1 / 1.5, "header, checksum, struct.unpack"))
        pieces = [(len(part), in_pieces(part)) for part in parts]
        skip, typed, peer = _rates((_skip, _typed, _pymavlink), pieces, rounds)
        table.append(_row("decode_skip_stream", skip, peer, SKIP_AIM))
        table.append(_row("decode_typed_stream", typed, peer, TYPED_AIM))
    return table


def frames_of(path: Path) -> list[bytes]:
    """Return the frames of a recording whose messages both libraries know. Other frames cannot be compared."""
    frames = [raw for _, raw in read_tlog(path)]
    ids = [int.from_bytes(raw[7:10], "little") if raw[0] == MAGIC_V2 else raw[5] for raw in frames]
    known = STANDARD.rows.keys() & ardupilotmega.mavlink_map.keys()
    return [raw for raw, message_id in zip(frames, ids, strict=True) if message_id in known]


def in_pieces(frames: list[bytes]) -> list[bytes]:
    """Split the bytes of the frames into pieces of 1 kB."""
    stream = b"".join(frames)
    return [stream[begin : begin + CHUNK] for begin in range(0, len(stream), CHUNK)]


def _row(
    name: str, aerokit: list[float], peer: list[float], aim: float, peer_name: str = "pymavlink parse_buffer"
) -> Row:
    return higher_is_better(name, aerokit, peer, peer_name, unit="frames/s", aim=aim)


def _rates(
    runs: Sequence[Callable[[list[bytes]], int]], parts: list[tuple[int, list[bytes]]], rounds: int
) -> list[list[float]]:
    rates: list[list[float]] = [[] for _ in runs]
    for count, pieces in parts * rounds:
        for run, found in zip(runs, rates, strict=True):
            started = time.process_time()
            seen = run(pieces)
            found.append(count / (time.process_time() - started))
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


def _least(chunks: list[bytes]) -> int:
    extras, seen = STANDARD.extras, 0
    for chunk in chunks:
        _, length, _, _, _, message_id = _HEADER(chunk)
        upto = 10 + length
        if x25(chunk[1:upto] + extras[message_id & 0xFFFFFF]) == _CHECKSUM(chunk, upto)[0]:
            seen += 1
    return seen


def _unpacked(chunks: list[bytes]) -> int:
    extras, seen = STANDARD.extras, 0
    for chunk in chunks:
        _, length, _, _, _, message_id = _HEADER(chunk)
        message_id &= 0xFFFFFF
        upto = 10 + length
        body = chunk[1:upto]
        if x25(body + extras[message_id]) == _CHECKSUM(chunk, upto)[0]:
            unpack, size = _payload(message_id)
            unpack(body.ljust(size, b"\0"), 9)
            seen += 1
    return seen


@cache
def _payload(message_id: int) -> tuple[Callable[[bytes, int], tuple[Any, ...]], int]:
    """Return the unpacker of all fields of a message, and the required lengths of header and payload."""
    fields = ardupilotmega.mavlink_map[message_id].unpacker
    return fields.unpack_from, 9 + fields.size


def _pymavlink(chunks: list[bytes]) -> int:
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    seen = 0
    for chunk in chunks:
        seen += len(parser.parse_buffer(chunk) or ())
    return seen


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
