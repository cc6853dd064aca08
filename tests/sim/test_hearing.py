"""What the bytes on a link say, read by one vehicle or by several."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.sim.channel import Hearing, SharedHearing

HEARTBEAT = m.Heartbeat(6, 8, 0, 0, 4, 3)
PING = m.Ping(1, 2, 0, 0)


def test_only_what_is_wanted_is_told_and_who_said_it() -> None:
    encoder = FrameEncoder(255, 190)
    data = encoder.encode(HEARTBEAT) + encoder.encode(PING)
    (heard,) = Hearing({m.Ping.ID}).messages(data, 1.0, None)
    assert heard == PING
    assert heard.received_frame is not None
    assert heard.received_frame.system_id == 255
    assert Hearing(None).messages(data, 1.0, None) == [HEARTBEAT, PING]


def test_each_peer_may_be_in_the_middle_of_a_frame() -> None:
    frame, other = FrameEncoder(255, 190).encode(PING), FrameEncoder(254, 190).encode(HEARTBEAT)
    hearing = Hearing(None)
    assert hearing.messages(frame[:9], 0.0, "one") == []
    assert hearing.messages(other, 0.0, "two") == [HEARTBEAT]
    assert hearing.messages(frame[9:], 0.0, "one") == [PING]


def test_those_who_share_it_read_the_same_bytes_once() -> None:
    frame = FrameEncoder(255, 190).encode(PING)
    hearing = SharedHearing()
    for _ in range(3):
        assert hearing.messages(frame[:9], 0.0, None) == []
    hearing.forget()
    first = hearing.messages(frame[9:], 0.1, None)
    assert first == [PING]
    assert hearing.messages(frame[9:], 0.2, None) is first
    hearing.forget()
    assert hearing.messages(b"", 0.3, None) == []
