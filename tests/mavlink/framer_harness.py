"""Byte streams for the framer's tests: valid, signed and unknown frames, noise, and random cuts."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from itertools import pairwise

from hypothesis import strategies as st
from wire_samples import random_message

from aerokit.mavlink import STANDARD, Frame, FrameEncoder, Framer
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNED, x25

__all__ = [
    "MAX_FRAME_LENGTH",
    "cut",
    "cuts",
    "feed",
    "framed",
    "good_frames",
    "noise",
    "raws",
    "signed",
    "some_frames",
    "unknown",
]

MAX_FRAME_LENGTH = 280
"""Length of the longest possible frame in bytes, signature included."""


def some_frames(count: int, *, seed: int = 1, versions: Sequence[int] = (1, 2), system_id: int = 1) -> list[bytes]:
    """Return frames of one sender: random messages, consecutive sequence numbers, alternating protocol versions."""
    chance = random.Random(seed)
    classes = [message_class for message_class in STANDARD if message_class.ID < 256]
    encoders = {version: FrameEncoder(system_id, 1, version=version) for version in versions}
    found = []
    for number in range(count):
        encoder = encoders[versions[number % len(versions)]]
        encoder.sequence = number & 0xFF
        found.append(encoder.encode(random_message(chance.choice(classes), chance)))
    return found


def unknown(length: int = 20, message_id: int = 16_000_000, sequence: int = 0, system_id: int = 1) -> bytes:
    """Return a MAVLink 2 frame of an unknown message."""
    header = bytes((MAGIC_V2, length, 0, 0, sequence, system_id, 1)) + message_id.to_bytes(3, "little")
    return header + bytes(range(1, length + 1)) + b"\x11\x22"


def signed(raw: bytes, extra: int, signature: bytes = bytes(range(100, 113))) -> bytes:
    """Return the MAVLink 2 frame with the signed flag and a signature that is not valid."""
    return framed(raw[1:2] + bytes((SIGNED,)) + raw[3:-2], extra) + signature


def framed(body: bytes, extra: int) -> bytes:
    """Return a MAVLink 2 frame made of the bytes between magic byte and checksum."""
    return bytes((MAGIC_V2,)) + body + x25(body + bytes((extra,))).to_bytes(2, "little")


def feed(framer: Framer, pieces: Iterable[bytes]) -> list[Frame]:
    """Feed the pieces and return all frames."""
    return [frame for piece in pieces for frame in framer.receive(piece)]


def raws(frames: Iterable[Frame]) -> list[bytes]:
    return [frame.raw for frame in frames]


def cut(stream: bytes, places: Iterable[int]) -> list[bytes]:
    """Split the stream at the given offsets."""
    edges = [0, *sorted({place % (len(stream) + 1) for place in places}), len(stream)]
    return [stream[begin:end] for begin, end in pairwise(edges)]


# ------------------------------------------------------------------------------------- strategies

good_frames = st.builds(
    some_frames,
    st.integers(1, 8),
    seed=st.integers(0, 10_000),
    versions=st.sampled_from([(1, 2), (2,), (1,)]),
)
cuts = st.lists(st.integers(0, 4000), max_size=12)
_magic = st.sampled_from([bytes((MAGIC_V1,)), bytes((MAGIC_V2,))])
_claims = st.builds(  # the beginning of a possible frame
    lambda magic, length, rest: magic + bytes((length,)) + rest,
    _magic,
    st.integers(0, 255),
    st.binary(max_size=12),
)
_known = st.sampled_from([b"", b"\n\nInit ArduCopter V4.7\n", b"\xfd" * 9, b"\xfe" * 9])
noise = st.one_of(st.binary(max_size=40), _claims, _known)
