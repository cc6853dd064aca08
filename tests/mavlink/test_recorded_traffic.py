"""Every recorded frame that pymavlink accepts is decoded with the same fields."""

from __future__ import annotations

import random
from functools import cache
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega, development
from recorded import LONG, recording
from wire_samples import added_peer, peer_fields, same

from aerokit.mavlink import STANDARD, Frame, Framer, read_tlog
from aerokit.mavlink import messages as m

FLIGHTS = ("ardupilot-copter", "ardupilot-plane", "ardupilot-rover", "px4-quad")
COUNTS = {
    "ardupilot-copter": 33_910,
    "ardupilot-plane": 50_669,
    "ardupilot-rover": 17_446,
    "px4-quad": 35_528,
}
"""Number of frames in each complete flight, from its README."""
SHORT_COUNTS = {"ardupilot-copter": 2_820, "px4-quad": 2_388}
KINDS = {"ardupilot-copter": 48, "ardupilot-plane": 50, "ardupilot-rover": 45, "px4-quad": 44}
BOOT = "ardupilot-copter-serial-boot.raw"


NOT_IN_PYMAVLINK = {
    m.LinkNodeStatus.ID,
    m.TimeEstimateToTarget.ID,
    m.Event.ID,
    m.CurrentEventSequence.ID,
}
"""Messages that PX4 sends and only MAVLink's own definitions have."""


@cache
def records(flight: str) -> tuple[bytes, ...]:
    return tuple(raw for _, raw in read_tlog(recording(f"{flight}.tlog")))


def is_whole(flight: str) -> bool:
    return recording(f"{flight}.tlog").parent == LONG


def message_id(raw: bytes) -> int:
    return int.from_bytes(raw[7:10], "little")


@pytest.mark.sampled(6)
@pytest.mark.parametrize("flight", FLIGHTS)
def test_recorded_frames_match_pymavlink(flight: str) -> None:
    added = added_peer()
    framer, peers = Framer(), [module.MAVLink(None) for module in (added, ardupilotmega, development)]
    for raw in records(flight):
        theirs: Any = next(filter(is_known, (peer.parse_buffer(raw)[0] for peer in peers)))
        (frame,) = framer.receive(raw)
        assert frame.raw == raw
        assert (frame.system_id, frame.component_id) == (theirs.get_srcSystem(), theirs.get_srcComponent())
        assert (frame.message_id, frame.sequence) == (theirs.get_msgId(), theirs.get_seq())
        assert same(STANDARD.decode(frame).to_dict(), peer_fields(theirs))


def is_known(theirs: Any) -> bool:
    return type(theirs).__name__ != "MAVLink_unknown"


@pytest.mark.parametrize("flight", FLIGHTS)
def test_recorded_frame_counts(flight: str) -> None:
    raws = records(flight)
    framer = Framer()
    frame_count = sum(len(framer.receive(raw)) for raw in raws)
    statistics = framer.statistics
    assert len(raws) == (COUNTS if is_whole(flight) else SHORT_COUNTS)[flight]
    assert len({message_id(raw) for raw in raws}) == KINDS[flight]
    assert statistics.frames == frame_count == len(raws)
    assert (statistics.bad_bytes, statistics.bad_crcs, statistics.unknown_ids) == (0, 0, 0)
    assert flight != "px4-quad" or {message_id(raw) for raw in raws} >= NOT_IN_PYMAVLINK
    if is_whole(flight):
        assert [source.lost for source in statistics.sources.values()] == [0, 0]


@pytest.mark.parametrize("flight", FLIGHTS)
def test_recorded_stream_in_pieces(flight: str) -> None:
    raws = records(flight)
    stream, framer, chance = b"".join(raws), Framer(), random.Random(flight)
    found: list[Frame] = []
    place = 0
    while place < len(stream):
        size = chance.choice((1, 2, 7, 30, 300, 3000))
        found += framer.receive(stream[place : place + size])
        place += size
    assert [frame.raw for frame in found] == list(raws)
    assert framer.statistics.bad_bytes == 0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("size", [1, 13, 64, 4096])
def test_recorded_serial_boot_text_is_skipped(size: int) -> None:
    path = recording(BOOT)
    stream = path.read_bytes() if size > 1 else path.read_bytes()[:4096]
    framer = Framer()
    frames = [frame for i in range(0, len(stream), size) for frame in framer.receive(stream[i : i + size])]
    assert len(frames) == (33_760 if len(stream) > 4096 else 106)
    assert [frame.sequence for frame in frames[:100]] == list(range(100))
    assert STANDARD.decode(frames[0]).to_dict()["text"] == "RCInput: decoding UDP (Pulses)"
    assert framer.statistics.bad_bytes >= 152  # the text in front of the first frame
    assert framer.statistics.bad_crcs == 0
