"""RTCM 3 messages: checks of complete messages, and fragments, compared with pymavlink's frames."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.protocols.rtcm import RtcmReader, crc24q, fragments, message_number, rtcm_messages

# The example of RTCM 10403: message 1005, with its CRC-24Q.
EXAMPLE_1005 = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")


def rtcm(size: int) -> bytes:
    """A message of this size with its CRC."""
    body = bytes([0xD3, size - 6 >> 8, size - 6 & 0xFF]) + bytes(i % 251 for i in range(size - 6))
    return body + crc24q(body).to_bytes(3, "big")


def test_crc_of_published_example_is_right() -> None:
    assert crc24q(EXAMPLE_1005) == 0
    assert crc24q(EXAMPLE_1005[:-3]) == 0x360B98
    assert message_number(EXAMPLE_1005) == 1005
    assert message_number(rtcm(6)) is None


@pytest.mark.parametrize(
    ("size", "lengths"),
    [
        (6, [6]),
        (180, [180]),
        (181, [180, 1]),
        (360, [180, 180, 0]),
        (719, [180, 180, 180, 179]),
        (720, [180] * 4),
    ],
)
def test_fragments_end_with_short_or_fourth_one(size: int, lengths: list[int]) -> None:
    pieces = fragments(bytes(size), 37)
    assert [piece.len for piece in pieces] == lengths
    assert {piece.flags >> 3 for piece in pieces} == {37 & 31}
    assert [piece.flags & 1 for piece in pieces] == [int(len(lengths) > 1)] * len(lengths)
    assert [piece.flags >> 1 & 3 for piece in pieces] == list(range(len(lengths)))


@pytest.mark.parametrize("size", [25, 180, 181, 200, 500, 720])
def test_frames_equal_those_of_mavsdk_rule_by_pymavlink(size: int) -> None:
    """The rule of rtk_impl.cpp: 180 bytes; flags: bit 0 for several fragments, then fragment and sequence number."""
    mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
    message, sequence = rtcm(size), 5
    sender = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    pieces = [message[begin : begin + 180] for begin in range(0, size, 180)]
    expected = []
    for number, piece in enumerate(pieces):
        flags = (len(pieces) > 1) | number << 1 | sequence << 3
        expected.append(mavlink.MAVLink_gps_rtcm_data_message(flags, len(piece), list(piece.ljust(180, b"\0"))))
    frames = []
    for number, data in enumerate(expected):
        sender.seq = number
        frames.append(bytes(data.pack(sender)))
    encoder = FrameEncoder(255, 190)
    assert [encoder.encode(piece) for piece in fragments(message, sequence)] == frames


def test_several_messages_are_split() -> None:
    assert rtcm_messages(EXAMPLE_1005 + rtcm(100)) == [EXAMPLE_1005, rtcm(100)]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no RTCM 3 message begins there"),
        (b"no rtcm at all", "no RTCM 3 message begins there"),
        (EXAMPLE_1005[:-1], "25 bytes, but only 24 were given"),
        (b"\xd3\xff\x00\x00", "all begin with 0xD3 and six zero bits"),
        (EXAMPLE_1005 + b"\xd3", "at least 6 bytes, but only 1 were given"),
        (EXAMPLE_1005[:3], "at least 6 bytes, but only 3 were given"),
        (EXAMPLE_1005[:-1] + b"\0", "CRC-24Q"),
        (rtcm(721), "721 bytes"),
    ],
)
def test_incomplete_or_damaged_message_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(InvalidArgument, match=reason):
        rtcm_messages(data)


@given(st.lists(st.integers(6, 1029), max_size=6), st.binary(max_size=40), st.lists(st.integers(1, 400)))
def test_reader_finds_messages_in_any_pieces(sizes: list[int], noise: bytes, cuts: list[int]) -> None:
    noise = noise.replace(b"\xd3", b"")
    messages = [rtcm(size) for size in sizes]
    stream, reader = noise.join([b"", *messages, b""]), RtcmReader()
    found: list[bytes] = []
    while stream:
        size = cuts.pop() if cuts else len(stream)
        found += reader.feed(stream[:size])
        stream = stream[size:]
    assert found == messages
    assert reader.skipped_bytes == len(noise) * (len(messages) + 1)


def test_reader_keeps_incomplete_message_if_caller_stops_early() -> None:
    reader = RtcmReader()
    for _ in reader.feed(EXAMPLE_1005 + rtcm(100)[:50]):
        break
    assert list(reader.feed(rtcm(100)[50:])) == [rtcm(100)]


@given(st.lists(st.binary(max_size=2000), max_size=5))
def test_reader_keeps_at_most_one_message(pieces: list[bytes]) -> None:
    reader = RtcmReader()
    for piece in pieces:
        for message in reader.feed(piece):
            assert crc24q(message) == 0
        assert len(reader._buffer) < 1029
