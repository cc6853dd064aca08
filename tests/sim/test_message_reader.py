"""Decoding of the bytes of a link by one vehicle or by several."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.sim.channel import MessageReader, SharedMessageReader

HEARTBEAT = m.Heartbeat(6, 8, 0, 0, 4, 3)
PING = m.Ping(1, 2, 0, 0)


def test_reader_returns_wanted_messages_with_their_sender() -> None:
    encoder = FrameEncoder(255, 190)
    data = encoder.encode(HEARTBEAT) + encoder.encode(PING)
    (received,) = MessageReader({m.Ping.ID}).messages(data, 1.0, None)
    assert received == PING
    assert received.received_frame is not None
    assert received.received_frame.system_id == 255
    assert MessageReader(None).messages(data, 1.0, None) == [HEARTBEAT, PING]


def test_reader_keeps_partial_frames_by_peer() -> None:
    frame, other = FrameEncoder(255, 190).encode(PING), FrameEncoder(254, 190).encode(HEARTBEAT)
    reader = MessageReader(None)
    assert reader.messages(frame[:9], 0.0, "one") == []
    assert reader.messages(other, 0.0, "two") == [HEARTBEAT]
    assert reader.messages(frame[9:], 0.0, "one") == [PING]


def test_shared_reader_decodes_once() -> None:
    frame = FrameEncoder(255, 190).encode(PING)
    reader = SharedMessageReader()
    for _ in range(3):
        assert reader.messages(frame[:9], 0.0, None) == []
    reader.forget()
    first = reader.messages(frame[9:], 0.1, None)
    assert first == [PING]
    assert reader.messages(frame[9:], 0.2, None) is first
    reader.forget()
    assert reader.messages(b"", 0.3, None) == []
