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


def _recordings() -> dict[str, Path]:
    recordings = {}
    for suffix, folder in _FOLDERS.items():
        for file_name in ("ardupilot-copter", "ardupilot-plane", "ardupilot-rover", "px4-quad"):
            path = folder / f"{file_name}.tlog"
            if path.exists():
                _, _, vehicle = file_name.rpartition("-")
                recordings[f"{vehicle}{suffix}"] = path
    return recordings


RECORDINGS = _recordings()
"""Recordings by name: the complete flights if they are available, and the short ones in the repository. Frames of PX4
are signed, with or without a key.
"""
# Both ids of the sender are one field. The message id has 3 bytes, so the last field also has the payload's first byte.
_HEADER = Struct("<BBBxBHI").unpack_from
HEADER_SIZE = 10
_CHECKSUM = Struct("<H").unpack_from
_IS_COMPILED = wire_implementation == "c"
SKIP_AIM = 50.0 if _IS_COMPILED else 10.0
TYPED_AIM = 18.0 if _IS_COMPILED else 6.0
# Number of bytes in a piece of a stream.
PIECE_SIZE = 1024
# Number of frames that one library decodes before the next library's turn.
PART_SIZE = 1000


def rows(rounds: int = 7, recordings: Sequence[str] = tuple(RECORDINGS)) -> list[Row]:
    """Measure frames without a subscriber (``decode_skip``) and frames delivered as typed messages
    (``decode_typed``).

    Each call has one frame, as with UDP. The rows ``…_stream`` have pieces of 1 kB, as with TCP and serial ports. Rows
    of the first recording have no suffix; those of the others end with the name of the recording. ``decode_floor``
    compares ``decode_skip`` with the minimum in pure Python, which is parsing the header and comparing the checksum;
    ``decode_floor_typed`` does the same for ``decode_typed``, with an unpacked payload.
    """
    table: list[Row] = []
    for name in recordings:
        frames = frames_of(RECORDINGS[name])
        parts = [frames[begin : begin + PART_SIZE] for begin in range(0, len(frames), PART_SIZE)]
        is_first = name == recordings[0]
        suffix = "" if is_first else f"_{name}"
        pieces = [(len(part), part) for part in parts]
        decoders = (_skip, _typed, _check_only, _check_and_unpack, _pymavlink)
        skip, typed, checked, unpacked, peer = _rates(decoders, pieces, rounds)
        table.append(_row("decode_skip" + suffix, skip, peer, SKIP_AIM))
        table.append(_row("decode_typed" + suffix, typed, peer, TYPED_AIM))
        if not is_first:
            continue
        table.append(_row("decode_floor", skip, checked, 1 / 1.5, "header and checksum alone"))
        table.append(_row("decode_floor_typed", typed, unpacked, 1 / 1.5, "header, checksum, struct.unpack"))
        pieces = [(len(part), in_pieces(part)) for part in parts]
        skip, typed, peer = _rates((_skip, _typed, _pymavlink), pieces, rounds)
        table.append(_row("decode_skip_stream", skip, peer, SKIP_AIM))
        table.append(_row("decode_typed_stream", typed, peer, TYPED_AIM))
    return table


def frames_of(path: Path) -> list[bytes]:
    """Return the frames of a recording whose messages both libraries know. Other frames cannot be compared."""
    known_ids = STANDARD.rows.keys() & ardupilotmega.mavlink_map.keys()
    return [raw for _, raw in read_tlog(path) if _message_id(raw) in known_ids]


def _message_id(raw: bytes) -> int:
    return int.from_bytes(raw[7:10], "little") if raw[0] == MAGIC_V2 else raw[5]


def in_pieces(frames: list[bytes]) -> list[bytes]:
    """Split the bytes of the frames into pieces of 1 kB."""
    stream = b"".join(frames)
    return [stream[begin : begin + PIECE_SIZE] for begin in range(0, len(stream), PIECE_SIZE)]


def _row(
    name: str, aerokit: list[float], peer: list[float], aim: float, peer_name: str = "pymavlink parse_buffer"
) -> Row:
    return higher_is_better(name, aerokit, peer, peer_name, unit="frames/s", aim=aim)


def _rates(
    decoders: Sequence[Callable[[list[bytes]], int]], parts: list[tuple[int, list[bytes]]], rounds: int
) -> list[list[float]]:
    """Return for each decoder its rates of all parts. A part has the number of its frames, and their bytes."""
    rates: list[list[float]] = [[] for _ in decoders]
    for count, pieces in parts * rounds:
        for decoder, decoder_rates in zip(decoders, rates, strict=True):
            started_at = time.process_time()
            decoded = decoder(pieces)
            decoder_rates.append(count / (time.process_time() - started_at))
            if decoded != count:
                raise AssertionError(f"{decoder.__name__} decoded {decoded} of {count} frames")
    return rates


def _skip(chunks: list[bytes]) -> int:
    framer = Framer()
    framer.wanted = frozenset()
    for chunk in chunks:
        framer.receive(chunk)
    return framer.statistics.frames


def _typed(chunks: list[bytes]) -> int:
    framer = Framer()
    decode = STANDARD.decode
    delivered = 0

    def deliver(message: Message) -> None:
        nonlocal delivered
        delivered += 1

    for chunk in chunks:
        for frame in framer.receive(chunk):
            deliver(decode(frame))
    return delivered


def _check_only(chunks: list[bytes]) -> int:
    extras = STANDARD.extras
    valid = 0
    for chunk in chunks:
        _, length, _, _, _, message_id = _HEADER(chunk)
        end = HEADER_SIZE + length
        (checksum,) = _CHECKSUM(chunk, end)
        if x25(chunk[1:end] + extras[message_id & 0xFFFFFF]) == checksum:
            valid += 1
    return valid


def _check_and_unpack(chunks: list[bytes]) -> int:
    extras = STANDARD.extras
    valid = 0
    for chunk in chunks:
        _, length, _, _, _, message_id = _HEADER(chunk)
        message_id &= 0xFFFFFF
        end = HEADER_SIZE + length
        body = chunk[1:end]  # without the magic byte
        (checksum,) = _CHECKSUM(chunk, end)
        if x25(body + extras[message_id]) == checksum:
            unpack, size = _payload(message_id)
            unpack(body.ljust(size, b"\0"), HEADER_SIZE - 1)
            valid += 1
    return valid


@cache
def _payload(message_id: int) -> tuple[Callable[[bytes, int], tuple[Any, ...]], int]:
    """Return the unpacker of all fields of a message, and the required length of the body."""
    fields = ardupilotmega.mavlink_map[message_id].unpacker
    return fields.unpack_from, HEADER_SIZE - 1 + fields.size


def _pymavlink(chunks: list[bytes]) -> int:
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    parsed = 0
    for chunk in chunks:
        parsed += len(parser.parse_buffer(chunk) or ())
    return parsed


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
