"""What waits for a link: telemetry is replaced, transfers are not, orders never arrive late, and nothing grows."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.hub.outgoing import (
    _ANSWERS,
    _SENT_AGAIN_AND_AGAIN,
    MOST_BYTES,
    MOST_FRAMES,
    ORDERS_WAIT_S,
    Held,
    HeldFrames,
    Kind,
    kind_of,
)
from aerokit.mavlink.dialect import STANDARD


def held(raw: bytes, kind: Kind = Kind.TRANSFER, since: float = 0.0) -> Held:
    return Held(raw, kind, 22, (0, 0), since)


def taken(frames: HeldFrames) -> list[bytes]:
    found = []
    while (raw := frames.next()) is not None:
        found.append(raw)
    return found


def test_newer_telemetry_takes_the_place_of_older() -> None:
    frames = HeldFrames()
    assert frames.put(held(b"a1", Kind.TELEMETRY), 1) == []
    assert frames.put(held(b"b1", Kind.TELEMETRY), 2) == []
    assert [why for why, _ in frames.put(held(b"a2", Kind.TELEMETRY), 1)] == ["superseded"]
    assert taken(frames) == [b"a2", b"b1"]


def test_parts_of_transfers_all_stay_in_order() -> None:
    frames = HeldFrames()
    pieces = [bytes([number]) for number in range(100)]
    for piece in pieces:
        assert frames.put(held(piece), 7) == []
    assert taken(frames) == pieces


def test_telemetry_makes_room_and_then_what_comes_last_is_dropped() -> None:
    frames = HeldFrames()
    for number in range(MOST_FRAMES):
        assert frames.put(held(b"t", Kind.TELEMETRY), number) == []
    for _ in range(MOST_FRAMES):
        assert [(why, each.kind) for why, each in frames.put(held(b"x"), 0)] == [
            ("queue_full", Kind.TELEMETRY)
        ]
    last = held(b"last")
    assert frames.put(last, 0) == [("queue_full", last)]
    assert taken(frames) == [b"x"] * MOST_FRAMES


def test_orders_that_waited_too_long_are_dropped_and_named() -> None:
    frames = HeldFrames()
    frames.put(held(b"first", Kind.ORDER, since=0.0), 0)
    frames.put(held(b"part", since=0.0), 0)
    frames.put(held(b"second", Kind.ORDER, since=0.5), 0)
    assert ORDERS_WAIT_S == 1.0, "docs/hub.md and docs/reliability.md promise a second"
    assert frames.expire(1.0) == []
    assert [(why, each.raw) for why, each in frames.expire(1.01)] == [("late", b"first")]
    assert taken(frames) == [b"part", b"second"]
    assert frames.expire(99.0) == []


def test_what_waits_is_dropped_with_its_link() -> None:
    frames = HeldFrames()
    frames.put(held(b"a"), 0)
    assert [why for why, _ in frames.clear()] == ["away"]
    assert taken(frames) == []
    assert not frames


@given(st.lists(st.tuples(st.sampled_from(Kind), st.integers(0, 30), st.integers(1, 280), st.floats(0, 3))))
def test_whatever_comes_bounds_hold_and_every_frame_is_accounted_for(
    arrivals: list[tuple[Kind, int, int, float]],
) -> None:
    frames, dropped, now = HeldFrames(), 0, 0.0
    for kind, key, size, later in arrivals:
        now += later
        dropped += len(frames.expire(now))
        dropped += len(frames.put(held(bytes(size) * 40, kind, now), key))
        assert len(frames) <= MOST_FRAMES
        assert sum(len(each.raw) for each in frames._frames.values()) == frames._bytes <= MOST_BYTES
        assert all(
            now - each.since <= ORDERS_WAIT_S for each in frames._frames.values() if each.kind is Kind.ORDER
        )
    assert len(taken(frames)) + dropped == len(arrivals)
    assert frames._bytes == frames._orders == frames._telemetry == 0


@pytest.mark.parametrize(
    ("name", "is_for_one", "kind"),
    [
        ("ATTITUDE", False, Kind.TELEMETRY),
        ("HEARTBEAT", False, Kind.TELEMETRY),
        ("STATUSTEXT", False, Kind.TRANSFER),
        ("BATTERY_STATUS", False, Kind.TRANSFER),
        ("NAMED_VALUE_FLOAT", False, Kind.TRANSFER),
        ("PARAM_VALUE", False, Kind.TRANSFER),
        ("MISSION_REQUEST_INT", True, Kind.TRANSFER),
        ("MISSION_ACK", True, Kind.TRANSFER),
        ("COMMAND_ACK", True, Kind.TRANSFER),
        ("FILE_TRANSFER_PROTOCOL", True, Kind.TRANSFER),
        ("LOG_DATA", False, Kind.TRANSFER),
        ("PARAM_REQUEST_READ", True, Kind.TRANSFER),
        ("COMMAND_LONG", True, Kind.ORDER),
        ("COMMAND_INT", False, Kind.ORDER),
        ("SET_MODE", True, Kind.ORDER),
        ("SET_POSITION_TARGET_LOCAL_NED", True, Kind.ORDER),
        ("MANUAL_CONTROL", True, Kind.ORDER),
        ("RC_CHANNELS_OVERRIDE", True, Kind.ORDER),
        ("MISSION_ITEM_INT", True, Kind.ORDER),
        ("MISSION_CLEAR_ALL", True, Kind.ORDER),
        ("PARAM_SET", True, Kind.ORDER),
        ("GIMBAL_MANAGER_SET_PITCHYAW", True, Kind.ORDER),
        ("NO_SUCH_MESSAGE", False, Kind.TRANSFER),
    ],
)
def test_what_a_message_is(name: str, is_for_one: bool, kind: Kind) -> None:
    assert kind_of(name, is_for_one=is_for_one) is kind


def test_telemetry_is_never_an_order_and_is_for_everybody() -> None:
    names = {each.NAME: each for each in STANDARD}
    for name in _SENT_AGAIN_AND_AGAIN.split():
        assert kind_of(name, is_for_one=False) is Kind.TELEMETRY
        fields = {field.name for field in names[name].FIELDS}
        instances = {
            each
            for each in fields
            if each.endswith("_id") or each == "id" or each in ("instance", "port", "text", "name")
        }
        assert not instances or name == "MISSION_CURRENT", (name, instances)
        assert "target_system" not in fields
    assert set(_ANSWERS.split()) <= set(names)
