"""Fuzz targets of the wire: framer, decoder, signing, recordings, addresses."""

from __future__ import annotations

import io
import random
from collections.abc import Container

from target import Target

from aerokit.errors import InvalidArgument
from aerokit.mavlink import STANDARD, Frame, FrameEncoder, Framer, tlog
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, x25
from aerokit.mavlink.framer import PythonFramer
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import Signing, SigningKey
from aerokit.mavlink.statistics import SourceStatistics
from aerokit.mavlink.tlog import read_tlog
from aerokit.testing import RecordedVehicle
from aerokit.transport import parse_address
from aerokit.transport.create import create_link

__all__ = ["WIRE_TARGETS"]

_KEY = SigningKey(bytes(range(32)))
_IDS = sorted(STANDARD.rows)


def fuzz_framer(data: bytes) -> None:
    """Any bytes, in one piece and in two, give the same frames and counts, and raise nothing.

    Frames of unknown messages are excepted: without a checksum, they depend on how much of the data is available.
    """
    whole, parts, all_of_it = Framer(), Framer(), Framer()
    all_of_it.keep_unknown = True
    all_of_it.receive(data, 1.0)
    cut = data[0] % len(data) if data else 0
    at_once = [frame.raw for frame in whole.receive(data, 1.0)]
    in_two = [frame.raw for piece in (data[:cut], data[cut:]) for frame in parts.receive(piece, 1.0)]
    assert at_once == in_two
    assert whole.statistics.bytes == len(data)
    assert whole.waiting <= 280


def fuzz_wire(data: bytes) -> None:
    """Both framers, in the same random pieces, agree on every frame, counter and verdict; so do both decoders.

    Without the compiled wire, the Python one is compared with itself.
    """
    chance = random.Random(data[:4])
    framers = Framer(), PythonFramer()
    choices: tuple[Container[int] | None, ...] = (None, frozenset(), {0: 1, 30: 1}, range(200))
    wanted = chance.choice(choices)
    for framer in framers:
        framer.wanted, framer.keep_unknown = wanted, bool(len(data) & 1)
    stream, now = data * 2, 0.0  # frames that are repeated, too
    while stream:
        size = chance.choice((1, 2, 7, 30, 280, 4096))
        piece, stream, now = stream[:size], stream[size:], now + chance.choice((0.0, 0.01, 2.0))
        ours, theirs = (_state(framer, framer.receive(piece, now)) for framer in framers)
        assert ours == theirs
        if chance.random() < 0.02:
            for framer in framers:
                framer.reset()


def _state(framer: PythonFramer, frames: list[Frame]) -> list[object]:
    """Return the frames and everything that the framer counts or keeps."""
    statistics = framer.statistics
    found: list[object] = [[_content(frame) for frame in each] for each in (frames, framer.late, framer.foreign)]
    found += [framer.waiting, framer._rest, repr(statistics), statistics.unknown_messages]
    for source in statistics.sources.values():
        names = ("expected", *SourceStatistics.__slots__)
        found.append([getattr(source, name, None) for name in names])
    return found


def _content(frame: Frame) -> tuple[object, ...]:
    message: Message | None = None
    if frame.message_id in STANDARD:
        message = STANDARD.decode(frame)
        expected = STANDARD[frame.message_id].decode_body(frame.body, frame)
        assert repr(message) == repr(expected)
        assert _encoded(FrameEncoder, message) == _encoded(PythonEncoder, message)
    ids = frame.message_id, frame.system_id, frame.component_id
    return frame.raw, frame.body, frame.checksum, frame.received_at, *ids, repr(message)


class PythonEncoder(FrameEncoder):
    """Encodes without compiled code."""

    _encode_frame = None


def _encoded(encoder: type[FrameEncoder], message: Message) -> bytes | str:
    try:
        return encoder(1, 1).encode(message)
    except InvalidArgument as error:
        return str(error)


def decode(message: Message) -> None:
    """Use a message in every way: format it, compare it, send it again."""
    assert message == message
    assert repr(message)
    assert len(message.to_dict()) == len(message.FIELDS)
    try:
        again = type(message).decode(message.encode())
    except InvalidArgument:  # invalid UTF-8 can become longer
        assert any("\ufffd" in str(value) for value in message.to_dict().values())
        return
    assert again == message


def fuzz_decoder(data: bytes) -> None:
    """Any payload of any message."""
    message_id = _IDS[int.from_bytes(data[:2], "little") % len(_IDS)]
    decode(STANDARD[message_id].decode(data[2:257]))


def fuzz_signing(data: bytes) -> None:
    """Frames with any signature are refused; those that we sign are accepted once."""
    ours, theirs = Signing(_KEY, link_id=1), Signing(_KEY, link_id=2)
    for frame in Framer().receive(data, 1.0):
        assert not theirs.accepts(frame) or frame.message_id == 109
        raw = frame.raw
        if raw[0] == MAGIC_V1 or raw[2]:
            continue
        body = raw[1:2] + b"\x01" + raw[3:-2]
        signed = _checked(body)
        (good,) = Framer().receive(signed + ours.sign(signed), 1.0)
        assert theirs.accepts(good)
        assert not theirs.accepts(good) or good.message_id == 109


def _checked(body: bytes) -> bytes:
    message_id = int.from_bytes(body[6:9], "little")
    return bytes((MAGIC_V2,)) + body + x25(body + STANDARD.extras[message_id]).to_bytes(2, "little")


def fuzz_tlog(data: bytes) -> None:
    """Any file gives records with whole frames, or nothing."""
    records = list(read_tlog(io.BytesIO(data)))
    for time, raw in records:
        assert 0 <= time < 1 << 33
        assert len(raw) <= 280
    compiled, tlog._compiled = tlog._compiled, None
    try:
        assert list(read_tlog(io.BytesIO(data))) == records
    finally:
        tlog._compiled = compiled


def fuzz_recording(data: bytes) -> None:
    """Any recording plays as a vehicle, or raises that there is none."""
    try:
        vehicle = RecordedVehicle(io.BytesIO(data))
    except InvalidArgument:
        return
    for second in range(20):
        vehicle.step(float(second))
    assert Framer().receive(vehicle.take_outbox(), 0.0) is not None


def fuzz_address(data: bytes) -> None:
    """Any text is an address that formats to itself, or raises our error."""
    try:
        address = parse_address(data.decode(errors="surrogateescape"))
    except InvalidArgument:
        return
    assert parse_address(str(address)) == address
    create_link(str(address))


WIRE_TARGETS = (
    Target("framer", fuzz_framer, 2048),
    Target("wire", fuzz_wire, 4096),
    Target("decoder", fuzz_decoder, 257),
    Target("signing", fuzz_signing, 1024),
    Target("tlog", fuzz_tlog, 4096),
    Target("recording", fuzz_recording, 4096),
    Target("address", fuzz_address, 200),
)
