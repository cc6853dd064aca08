"""The framer: it never raises, never returns a wrong frame, and finds all valid ones."""

from __future__ import annotations

import random
from itertools import chain

import pytest
from framer_harness import (
    MAX_FRAME_LENGTH,
    cut,
    cuts,
    feed,
    framed,
    good_frames,
    noise,
    raws,
    signed,
    some_frames,
    unknown,
)
from hypothesis import given
from hypothesis import strategies as st

from aerokit.mavlink import STANDARD, Dialect, FrameEncoder, Framer, Message, messages
from aerokit.mavlink.frame import is_whole_frame
from aerokit.mavlink.framer import PythonFramer

HEARTBEAT = messages.Heartbeat(2, 3, 81, 4, 3)
ATTITUDE = messages.Attitude(1000, 0.25, 0.5, 0.75, -1.25, -1.5, -1.75)


def frame_of(message: Message, *, sequence: int = 0, system_id: int = 1, version: int = 2) -> bytes:
    encoder = FrameEncoder(system_id, 1, version=version)
    encoder.sequence = sequence
    return encoder.encode(message)


# ------------------------------------------------------------------------------------ valid streams


@given(good_frames, cuts)
def test_framer_returns_all_frames_of_split_stream(frames: list[bytes], places: list[int]) -> None:
    framer = Framer()
    assert raws(feed(framer, cut(b"".join(frames), places))) == frames
    statistics = framer.statistics
    assert statistics.bytes == sum(map(len, frames))
    assert statistics.frames == len(frames)
    assert (statistics.bad_bytes, statistics.bad_crcs, statistics.unknown_ids, framer.waiting) == (0, 0, 0, 0)
    (source,) = statistics.sources.values()
    assert (source.system_id, source.component_id, source.received, source.lost) == (1, 1, len(frames), 0)


def test_framer_handles_every_split_position() -> None:
    frames = some_frames(6)
    stream = b"".join(frames)
    for place in range(len(stream)):
        assert raws(feed(Framer(), cut(stream, [place]))) == frames
    assert raws(feed(Framer(), (stream[i : i + 1] for i in range(len(stream))))) == frames


def test_frame_has_header_fields() -> None:
    raw = frame_of(ATTITUDE, sequence=200, system_id=9)
    (frame,) = Framer().receive(raw, 12.5)
    assert (frame.version, frame.sequence, frame.system_id, frame.component_id) == (2, 200, 9, 1)
    assert (frame.message_id, frame.payload, frame.raw) == (30, raw[10:-2], raw)
    assert (frame.incompat_flags, frame.compat_flags, frame.signature) == (0, 0, b"")
    assert frame.received_at == 12.5
    assert repr(frame) == "<Frame v2 id=30 from=9/1 seq=200>"


def test_frame_of_version_1() -> None:
    raw = frame_of(ATTITUDE, sequence=3, version=1)
    (frame,) = Framer().receive(raw)
    assert (frame.version, frame.sequence, frame.message_id, frame.payload) == (1, 3, 30, raw[6:-2])
    assert (frame.incompat_flags, frame.compat_flags, frame.signature) == (0, 0, b"")


def test_framer_ignores_compatibility_flags() -> None:
    body = bytes.fromhex("0900 80 00 0101 000000") + HEARTBEAT.encode()
    raw = framed(body, HEARTBEAT.CRC_EXTRA)
    (frame,) = Framer().receive(raw)
    assert (frame.compat_flags, STANDARD.decode(frame)) == (0x80, HEARTBEAT)


def test_framer_rejects_unknown_incompatibility_flags() -> None:
    body = bytes.fromhex("0902 00 00 0101 000000") + HEARTBEAT.encode()
    raw = framed(body, HEARTBEAT.CRC_EXTRA)
    framer = Framer()
    assert raws(framer.receive(raw + frame_of(ATTITUDE))) == [frame_of(ATTITUDE)]
    assert framer.statistics.bad_bytes == len(raw)


@pytest.mark.parametrize("kind", [bytearray, memoryview])
def test_framer_accepts_bytes_like_data(kind: type) -> None:
    frames = some_frames(3)
    assert raws(Framer().receive(kind(b"".join(frames)))) == frames


def test_framer_of_empty_data() -> None:
    assert Framer().receive(b"") == []


def test_framer_accepts_longer_payloads() -> None:
    """A newer standard may add extension fields; the checksum stays the same."""
    payload = ATTITUDE.encode() + b"\x01\x02\x03"
    body = bytes((len(payload), 0, 0, 0, 1, 1, 30, 0, 0)) + payload
    raw = framed(body, ATTITUDE.CRC_EXTRA)
    for pieces in ([raw], [raw[:20], raw[20:]], [raw[:41], raw[41:]]):
        (frame,) = feed(Framer(), pieces)
        assert STANDARD.decode(frame) == ATTITUDE


# ------------------------------------------------------------------------------------------ signing


@given(cuts)
def test_framer_returns_signed_frames(places: list[int]) -> None:
    plain = some_frames(4, versions=(2,))
    extras = [STANDARD[int.from_bytes(raw[7:10], "little")].CRC_EXTRA for raw in plain]
    frames = [signed(raw, extra) for raw, extra in zip(plain, extras, strict=True)]
    mixed = list(chain.from_iterable(zip(frames, plain, strict=True)))
    found = feed(Framer(), cut(b"".join(mixed), places))
    assert raws(found) == mixed
    assert [frame.signature for frame in found] == [bytes(range(100, 113)), b""] * 4
    assert [frame.payload for frame in found[::2]] == [frame.payload for frame in found[1::2]]


# -------------------------------------------------------------------------------------------- noise


@given(st.lists(st.tuples(noise, good_frames), min_size=1, max_size=4), cuts)
def test_framer_finds_frames_between_noise(parts: list[tuple[bytes, list[bytes]]], places: list[int]) -> None:
    frames = [raw for _, group in parts for raw in group]
    stream = b"".join(bad + b"".join(group) for bad, group in parts)
    trailer = some_frames(20, seed=77, system_id=200)  # as long as a false header may claim
    framer = Framer()
    found = raws(feed(framer, cut(stream + b"".join(trailer), places)))
    assert [raw for raw in found if raw in set(frames)] == frames
    assert set(found) <= {*frames, *trailer}


@given(st.lists(noise, max_size=30), cuts)
def test_framer_returns_nothing_for_noise(parts: list[bytes], places: list[int]) -> None:
    stream = b"".join(parts)
    framer = Framer()
    assert feed(framer, cut(stream, places)) == []
    assert framer.statistics.bytes == len(stream)
    assert framer.statistics.bad_bytes + framer.waiting <= len(stream)
    if not framer.statistics.unknown_ids:
        assert framer.statistics.bad_bytes + framer.waiting == len(stream)


@given(good_frames, st.lists(st.tuples(st.integers(0, 4000), st.integers(1, 255)), min_size=1, max_size=6), cuts)
def test_framer_never_returns_damaged_frame(
    frames: list[bytes], damage: list[tuple[int, int]], places: list[int]
) -> None:
    stream = bytearray(b"".join(frames))
    for place, change in damage:
        stream[place % len(stream)] ^= change
    trailer = some_frames(20, seed=77, system_id=200)
    found = raws(feed(Framer(), cut(bytes(stream) + b"".join(trailer), places)))
    whole = [raw for raw in frames if raw in bytes(stream)]
    assert set(found) <= {*frames, *trailer}
    assert [raw for raw in found if raw in set(whole)] == whole


@given(good_frames, st.integers(0, 4000), st.integers(1, 60))
def test_framer_recovers_after_missing_bytes(frames: list[bytes], place: int, count: int) -> None:
    stream = b"".join(frames)
    place %= len(stream)
    stream = stream[:place] + stream[place + count :]
    trailer = some_frames(20, seed=77, system_id=200)
    found = raws(Framer().receive(stream + b"".join(trailer)))
    whole = [raw for raw in frames if raw in stream]
    assert [raw for raw in found if raw in set(whole)] == whole
    assert set(found) <= {*frames, *trailer}


@pytest.mark.parametrize(
    "claim",
    [
        b"\xfe\xff",
        b"\xfd\xff\x00\x00",
        b"\xfe\xff\x00\x01\x01\x0c",  # an unknown message of version 1
        b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00",  # longer than any ATTITUDE
        b"\xfd\xff\x01\x00\x00\x01\x01\x99\x99\x99",  # unknown, signed
    ],
    ids=bytes.hex,
)
def test_false_start_does_not_delay_frames(claim: bytes) -> None:
    framer, frames = Framer(), some_frames(3, versions=(2,))
    assert framer.receive(claim) == []
    found = [raw for raw in frames for raw in raws(framer.receive(raw))]
    assert found == frames
    assert framer.statistics.bad_bytes == len(claim)


def test_plausible_false_start_loses_no_frames() -> None:
    claim = b"\xfd\x1c\x00\x00\x00\x01\x01\x1e\x00\x00"  # the header of a valid ATTITUDE
    framer, frames = Framer(), some_frames(10)
    found = [raw for raw in frames for raw in raws(framer.receive(raw))]
    framer = Framer()
    framer.receive(claim)
    assert raws(feed(framer, frames)) == found == frames
    assert framer.statistics.bad_crcs == 1
    assert framer.statistics.bad_bytes == len(claim)


def test_unknown_flags_end_waiting_at_once() -> None:
    framer = Framer()
    framer.receive(b"\xfd\x09")
    assert framer.waiting == 2
    framer.receive(b"\x02")
    assert (framer.waiting, framer.statistics.bad_bytes) == (0, 3)


def test_framer_skips_text_before_first_frame() -> None:
    text = b"\n\nInit ArduCopter V4.7.0-dev (21910f24)\n\nFree RAM: 524288\nBooting 0/0\n"
    framer = Framer()
    assert framer.receive(text) == []
    assert raws(framer.receive(frame_of(HEARTBEAT))) == [frame_of(HEARTBEAT)]
    assert (framer.statistics.bad_bytes, framer.statistics.bad_crcs) == (len(text), 0)


def test_bad_checksum_is_counted_once() -> None:
    raw = bytearray(frame_of(ATTITUDE))
    raw[-1] ^= 0x40
    framer = Framer()
    assert raws(framer.receive(bytes(raw) + frame_of(HEARTBEAT))) == [frame_of(HEARTBEAT)]
    assert (framer.statistics.bad_crcs, framer.statistics.bad_bytes) == (1, len(raw))


@given(st.lists(noise, min_size=1, max_size=60), good_frames)
def test_framer_memory_is_bounded(parts: list[bytes], frames: list[bytes]) -> None:
    framer = Framer()
    for part in (*parts, *frames, *parts):
        framer.receive(part)
        assert framer.waiting <= 2 * MAX_FRAME_LENGTH


def test_framer_memory_is_bounded_for_random_bytes() -> None:
    chance = random.Random(5)
    framer = Framer()
    for _ in range(400):
        framer.receive(chance.randbytes(chance.randint(0, 500)).replace(b"\x00", b"\xfd"))
        assert framer.waiting <= 2 * MAX_FRAME_LENGTH
    assert framer.statistics.frames == 0


# ----------------------------------------------------------------------------------- unknown messages


@given(good_frames, st.integers(0, 200), cuts)
def test_unknown_frames_are_skipped_and_counted(frames: list[bytes], length: int, places: list[int]) -> None:
    stream = b"".join(unknown(length) + raw for raw in frames)
    framer = Framer()
    assert raws(feed(framer, cut(stream, places))) == frames
    assert framer.statistics.unknown_ids == len(frames)
    assert framer.statistics.unknown_messages == {16_000_000: len(frames)}
    assert framer.statistics.bad_bytes == 0


def test_frame_inside_unknown_frame_is_found() -> None:
    """An unknown message's checksum cannot be verified, so its length proves nothing."""
    raw = frame_of(HEARTBEAT)
    seeming = bytearray(unknown(80))
    seeming[30 : 30 + len(raw)] = raw
    framer = Framer()
    assert raws(framer.receive(bytes(seeming) + raw)) == [raw, raw]
    assert framer.statistics.unknown_ids == 0


def test_unknown_frame_inside_incomplete_frame_is_ignored() -> None:
    inner, outer = unknown(20, 1_000_001), bytearray(unknown(200, 1_000_002))
    outer[40 : 40 + len(inner)] = inner
    framer = Framer()
    feed(framer, cut(bytes(outer), [100]))
    assert framer.statistics.unknown_messages == {1_000_002: 1}


def test_bad_checksum_after_unknown_frame_counts_once() -> None:
    claim = b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00"  # longer than any ATTITUDE
    damaged = frame_of(ATTITUDE)[:-1] + b"\x00"
    stream = (claim + unknown() + damaged).ljust(300, b"\0")
    for places in ([], [120], range(len(stream))):
        framer = Framer()
        assert feed(framer, cut(stream, places)) == []
        assert (framer.statistics.bad_crcs, framer.statistics.unknown_ids) == (2, 1)


def test_unknown_frames_do_not_count_as_lost() -> None:
    framer = Framer()
    framer.receive(frame_of(HEARTBEAT, sequence=0))
    framer.receive(unknown(sequence=1))
    framer.receive(frame_of(HEARTBEAT, sequence=2))
    assert [source.lost for source in framer.statistics.sources.values()] == [0]


def test_unknown_id_table_is_bounded() -> None:
    framer = Framer()
    for number in range(200):
        framer.receive(unknown(message_id=1_000_000 + number % 100))
    assert framer.statistics.unknown_ids == 200
    assert len(framer.statistics.unknown_messages) == 64


def test_framer_keep_unknown_returns_frames() -> None:
    framer = Framer()
    framer.keep_unknown = True
    framer.wanted = frozenset()
    stream = frame_of(HEARTBEAT) + unknown(sequence=1) + frame_of(HEARTBEAT, sequence=2) + unknown(sequence=3)
    found = framer.receive(stream, 4.0)
    assert raws(found) == [unknown(sequence=1), unknown(sequence=3)]
    assert [(frame.message_id, frame.sequence, frame.received_at) for frame in found] == [
        (16_000_000, 1, 4.0),
        (16_000_000, 3, 4.0),
    ]


def test_framer_of_small_dialect() -> None:
    framer = Framer(Dialect("heartbeats", [messages.Heartbeat]))
    assert raws(framer.receive(frame_of(ATTITUDE) + frame_of(HEARTBEAT))) == [frame_of(HEARTBEAT)]
    assert framer.statistics.unknown_messages == {30: 1}


# ------------------------------------------------------------------------------------------- filters


def test_framer_returns_wanted_ids_only() -> None:
    framer = Framer()
    framer.wanted = {0}
    stream = b"".join(frame_of(m, sequence=i) for i, m in enumerate([HEARTBEAT, ATTITUDE, HEARTBEAT]))
    assert [frame.message_id for frame in framer.receive(stream)] == [0, 0]
    (source,) = framer.statistics.sources.values()
    assert (source.received, source.lost) == (3, 0)


def test_framer_wanted_may_change() -> None:
    framer, wanted = Framer(), set[int]()
    framer.wanted = wanted
    assert framer.receive(frame_of(HEARTBEAT)) == []
    wanted.add(0)
    assert len(framer.receive(frame_of(HEARTBEAT, sequence=1))) == 1


# ----------------------------------------------------------------------------------------- sequences


def lost_after(sequences: list[int]) -> tuple[int, int]:
    framer = Framer()
    feed(framer, (frame_of(HEARTBEAT, sequence=sequence) for sequence in sequences))
    (source,) = framer.statistics.sources.values()
    return source.received, source.lost


@pytest.mark.parametrize(
    ("sequences", "lost"),
    [
        ([0, 1, 2], 0),
        ([200, 201], 0),
        ([254, 255, 0, 1], 0),
        ([0, 2], 1),
        ([250, 4], 9),
        ([255, 1], 1),
        ([0, 100], 99),
        ([0, 2, 1, 3], 0),
        ([0, 3, 2, 1, 4], 0),
        ([255, 1, 0, 2], 0),
        ([0, 1, 1, 2], 0),
        ([0, 1, 0, 2], 0),
        ([0, 2, 2, 3], 1),
        ([0, 2, 1, 1, 3], 0),
        ([200, 201, 0, 1, 2], 54),
        ([100, 101, 0, 1, 2, 3], 0),
        ([100, 101, 50, 51, 52, 54], 1),
    ],
)
def test_lost_frames_are_counted(sequences: list[int], lost: int) -> None:
    assert lost_after(sequences) == (len(sequences), lost)


@given(st.integers(0, 255), st.lists(st.booleans(), min_size=1, max_size=600))
def test_every_gap_is_counted(first: int, came: list[bool]) -> None:
    numbers = [first] + [(first + i) & 0xFF for i, here in enumerate(came, start=1) if here or i % 50 == 0]
    inside = 0
    last = 0
    for i, here in enumerate(came, start=1):
        if here or i % 50 == 0:
            inside += i - last - 1
            last = i
    assert lost_after(numbers) == (len(numbers), inside)


@given(st.permutations(range(8)))
def test_reordered_frames_are_not_lost(order: list[int]) -> None:
    """The last of a reordered batch: all eight frames arrived, none is missing."""
    received, lost = lost_after([100, *(101 + number for number in order), 109, 110])
    assert (received, lost) == (11, 0)


def test_python_parameter_selects_python_framer(request: pytest.FixtureRequest) -> None:
    assert (Framer is PythonFramer) == (request.node.callspec.params["implementation"] == "python")


def test_senders_are_counted_apart() -> None:
    framer = Framer()
    stream = [frame_of(HEARTBEAT, sequence=i, system_id=s) for i in (0, 1, 3) for s in (1, 2)]
    feed(framer, stream)
    counted = {key: (source.received, source.lost) for key, source in framer.statistics.sources.items()}
    assert counted == {(1, 1): (3, 1), (2, 1): (3, 1)}
    assert framer.statistics.frames == 6
    assert framer.statistics.sources[1, 1].loss == pytest.approx(0.25)
    assert repr(framer.statistics.sources[2, 1]) == "<2/1: 3 received, 1 lost>"
    assert "frames=6" in repr(framer.statistics)


def test_many_alternating_senders_are_counted_apart() -> None:
    """The compiled framer keeps the keys of a few senders, so some of these replace each other there."""
    framer = Framer()
    feed(framer, [frame_of(HEARTBEAT, sequence=i, system_id=s) for i in (0, 1, 2) for s in range(1, 100)])
    counted = {key: (source.received, source.lost) for key, source in framer.statistics.sources.items()}
    assert counted == {(system_id, 1): (3, 0) for system_id in range(1, 100)}


@pytest.mark.parametrize(
    ("head", "size"),
    [
        (b"\xfe\x00", 8),
        (b"\xfe\x01", 9),
        (b"\xfe\xff", 263),
        (b"\xfd\x00\x00", 12),
        (b"\xfd\xff\x00", 267),
        (b"\xfd\x00\x01", 25),
        (b"\xfd\xff\x01", 280),
    ],
)
def test_whole_frame_has_magic_and_length(head: bytes, size: int) -> None:
    sizes = [length for length in range(300) if is_whole_frame(head.ljust(length, b"\0")[:length])]
    assert sizes == [size]
    assert not is_whole_frame(b"\xfc" + head[1:].ljust(size - 1, b"\0"))
    assert not is_whole_frame(head[:2] + b"\x02" + bytes(size - 3)) or head[0] == 0xFE
