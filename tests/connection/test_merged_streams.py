"""`MergedStreams`: which frames are accepted if two links carry the same stream."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from aerokit.connection.multilink.duplicates import MergedStreams
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, CommandAck

USED, OTHER = 0, 1


def merged() -> MergedStreams:
    """Two links with the same stream of system 1; link 0 is in use."""
    used, other = SimpleNamespace(link=USED), SimpleNamespace(link=OTHER)
    choice: Any = SimpleNamespace(
        used=used,
        previous=None,
        candidates={USED: used, OTHER: other},
        may_be_used=lambda _: True,
        carries_same_stream=lambda *_: True,
        fresh_after=float("-inf"),
        switched_at=float("-inf"),
    )
    return MergedStreams(2, {1: choice})


def frames(*messages: Message) -> list[Frame]:
    """Frames with the sequence numbers 0, 1, 2 …"""
    encoder = FrameEncoder(1, 1)
    return [Frame.parse(encoder.encode(message)) for message in messages]


def test_late_answer_makes_no_older_telemetry_acceptable() -> None:
    """The link in use has lost an acknowledgement and an attitude, which the other link delivers late."""
    streams = merged()
    answer, lost, newest = frames(CommandAck(400, 0), Attitude(1, *(0.0,) * 6), Attitude(2, *(0.0,) * 6))
    assert streams.accepts(newest, USED)
    assert streams.accepts(answer, OTHER)
    assert not streams.accepts(lost, OTHER)


def test_frame_lost_on_used_link_is_accepted_from_other_link() -> None:
    streams = merged()
    first, second = frames(Attitude(1, *(0.0,) * 6), Attitude(2, *(0.0,) * 6))
    assert streams.accepts(first, USED)
    assert streams.accepts(second, OTHER)
