"""Queue of a full link: telemetry is replaced, transfers are kept, orders are never late, and the size is bounded."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.hub.message_rules import _NOT_ORDERS, _TELEMETRY, ORDER_MAX_AGE_S, MessageKind, kind_of
from aerokit.hub.port import MAX_QUEUED_BYTES, MAX_QUEUED_FRAMES, FrameQueue, QueuedFrame
from aerokit.mavlink.dialect import STANDARD


def held(raw: bytes, kind: MessageKind = MessageKind.TRANSFER, since: float = 0.0) -> QueuedFrame:
    return QueuedFrame(raw, kind, 22, (0, 0), since)


def taken(frames: FrameQueue) -> list[bytes]:
    found = []
    while (raw := frames.pop()) is not None:
        found.append(raw)
    return found


def test_newer_telemetry_replaces_older() -> None:
    frames = FrameQueue()
    assert frames.put(held(b"a1", MessageKind.TELEMETRY), 1) == []
    assert frames.put(held(b"b1", MessageKind.TELEMETRY), 2) == []
    assert [why for why, _ in frames.put(held(b"a2", MessageKind.TELEMETRY), 1)] == ["superseded"]
    assert taken(frames) == [b"a2", b"b1"]


def test_transfer_frames_stay_in_order() -> None:
    frames = FrameQueue()
    pieces = [bytes([number]) for number in range(100)]
    for piece in pieces:
        assert frames.put(held(piece), 7) == []
    assert taken(frames) == pieces


def test_full_queue_drops_telemetry_first_then_new_frames() -> None:
    frames = FrameQueue()
    for number in range(MAX_QUEUED_FRAMES):
        assert frames.put(held(b"t", MessageKind.TELEMETRY), number) == []
    for _ in range(MAX_QUEUED_FRAMES):
        assert [(why, dropped.kind) for why, dropped in frames.put(held(b"x"), 0)] == [
            ("queue_full", MessageKind.TELEMETRY)
        ]
    last = held(b"last")
    assert frames.put(last, 0) == [("queue_full", last)]
    assert taken(frames) == [b"x"] * MAX_QUEUED_FRAMES


@pytest.mark.parametrize("kind", [MessageKind.ORDER, MessageKind.MEASUREMENT])
def test_late_frames_are_dropped_and_returned(kind: MessageKind) -> None:
    frames = FrameQueue()
    frames.put(held(b"first", kind, since=0.0), 0)
    frames.put(held(b"part", since=0.0), 0)
    frames.put(held(b"second", kind, since=0.5), 0)
    assert ORDER_MAX_AGE_S == 1.0, "docs/hub.md and docs/reliability.md promise one second"
    assert frames.expire(1.0) == []
    assert [(why, expired.raw) for why, expired in frames.expire(1.01)] == [("late", b"first")]
    assert taken(frames) == [b"part", b"second"]
    assert frames.expire(99.0) == []


def test_clear_returns_waiting_frames() -> None:
    frames = FrameQueue()
    frames.put(held(b"a"), 0)
    assert [why for why, _ in frames.clear()] == ["link_lost"]
    assert taken(frames) == []
    assert not frames


@given(st.lists(st.tuples(st.sampled_from(MessageKind), st.integers(0, 30), st.integers(1, 280), st.floats(0, 3))))
def test_bounds_hold_and_every_frame_is_accounted_for(
    arrivals: list[tuple[MessageKind, int, int, float]],
) -> None:
    frames, dropped, now = FrameQueue(), 0, 0.0
    for kind, key, size, later in arrivals:
        now += later
        dropped += len(frames.expire(now))
        dropped += len(frames.put(held(bytes(size) * 40, kind, now), key))
        assert len(frames) <= MAX_QUEUED_FRAMES
        assert sum(len(frame.raw) for frame in frames._frames.values()) == frames._bytes <= MAX_QUEUED_BYTES
        assert all(
            now - frame.waiting_since <= ORDER_MAX_AGE_S for frame in frames._frames.values() if frame.kind.expires
        )
    assert len(taken(frames)) + dropped == len(arrivals)
    assert frames._bytes == frames._expiring_count == frames._telemetry_count == 0


@pytest.mark.parametrize(
    ("name", "has_target", "kind"),
    [
        ("ATTITUDE", False, MessageKind.TELEMETRY),
        ("HEARTBEAT", False, MessageKind.TELEMETRY),
        ("STATUSTEXT", False, MessageKind.TRANSFER),
        ("BATTERY_STATUS", False, MessageKind.TRANSFER),
        ("NAMED_VALUE_FLOAT", False, MessageKind.TRANSFER),
        ("PARAM_VALUE", False, MessageKind.TRANSFER),
        ("MISSION_REQUEST_INT", True, MessageKind.TRANSFER),
        ("MISSION_ACK", True, MessageKind.TRANSFER),
        ("COMMAND_ACK", True, MessageKind.TRANSFER),
        ("FILE_TRANSFER_PROTOCOL", True, MessageKind.TRANSFER),
        ("LOG_DATA", False, MessageKind.TRANSFER),
        ("PARAM_REQUEST_READ", True, MessageKind.TRANSFER),
        ("COMMAND_LONG", True, MessageKind.ORDER),
        ("COMMAND_INT", False, MessageKind.ORDER),
        ("SET_MODE", True, MessageKind.ORDER),
        ("SET_POSITION_TARGET_LOCAL_NED", True, MessageKind.ORDER),
        ("MANUAL_CONTROL", True, MessageKind.ORDER),
        ("RC_CHANNELS_OVERRIDE", True, MessageKind.ORDER),
        ("MISSION_ITEM_INT", True, MessageKind.ORDER),
        ("MISSION_CLEAR_ALL", True, MessageKind.ORDER),
        ("PARAM_SET", True, MessageKind.ORDER),
        ("GIMBAL_MANAGER_SET_PITCHYAW", True, MessageKind.ORDER),
        ("GPS_INPUT", False, MessageKind.MEASUREMENT),
        ("ODOMETRY", True, MessageKind.MEASUREMENT),
        ("VISION_POSITION_DELTA", False, MessageKind.MEASUREMENT),
        ("NO_SUCH_MESSAGE", False, MessageKind.TRANSFER),
    ],
)
def test_kind_of_message(name: str, has_target: bool, kind: MessageKind) -> None:
    assert kind_of(name, has_target=has_target) is kind


def test_telemetry_is_never_an_order_and_has_no_target() -> None:
    names = {kind.NAME: kind for kind in STANDARD}
    for name in sorted(_TELEMETRY):
        assert kind_of(name, has_target=False) is MessageKind.TELEMETRY
        fields = {field.name for field in names[name].FIELDS}
        instances = {
            field
            for field in fields
            if field.endswith("_id") or field == "id" or field in ("instance", "port", "text", "name")
        }
        assert not instances or name == "MISSION_CURRENT", (name, instances)
        assert "target_system" not in fields
    assert set(names) >= _NOT_ORDERS
