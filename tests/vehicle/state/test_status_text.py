"""STATUSTEXT: chunks in and out of order, padding, losses, garbage."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import now, open_flight, open_px4
from hypothesis import given
from hypothesis import strategies as st

from aerokit.mavlink import STANDARD, Frame, FrameEncoder
from aerokit.mavlink.messages import Statustext
from aerokit.vehicle.state.condition import StatusText
from aerokit.vehicle.state.status_text import MAX_CHUNKS, MAX_OPEN, StatusTextAssembler

LONG = "A text much longer than the fifty characters which fit into one STATUSTEXT message, and then some more."


def chunks(text: str, number: int = 1, severity: int = 4) -> list[Statustext]:
    data = text.encode()
    parts = [data[begin : begin + 50] for begin in range(0, len(data), 50)] or [b""]
    if len(parts[-1]) == 50:
        parts.append(b"")
    return [_received(Statustext(severity, "", number, seq), part) for seq, part in enumerate(parts)]


def _received(message: Statustext, text: bytes) -> Statustext:
    """A message off the wire, whose text may be any bytes."""
    payload = bytearray(message.encode())
    payload[1:51] = text.ljust(50, b"\0")
    header = bytes((0xFD, len(payload), 0, 0, 0, 1, 1, 253, 0, 0))
    return Statustext.decode(bytes(payload), Frame.parse(header + bytes(payload)))


def test_status_text_trailing_tabs_are_removed() -> None:
    texts = StatusTextAssembler()
    assert texts.receive(Statustext(6, "Armed by external command\t"), 3.0) == [
        StatusText(6, "Armed by external command", 3.0)
    ]


def test_status_text_chunks_are_joined() -> None:
    texts = StatusTextAssembler()
    texts_read = [text for chunk in chunks(LONG) for text in texts.receive(chunk, 1.0)]
    assert texts_read == [StatusText(4, LONG, 1.0)]


@pytest.mark.anyio
async def test_first_text_of_px4_is_joined() -> None:
    async with open_px4() as flight:
        for chunk in chunks(LONG, number=0):
            flight.vehicle.telemetry.receive(chunk)
        assert flight.vehicle.status_text.value.text == LONG


def test_status_text_full_chunks_end_with_empty_chunk() -> None:
    texts = StatusTextAssembler()
    texts_read = [text.text for chunk in chunks("x" * 100) for text in texts.receive(chunk, 1.0)]
    assert texts_read == ["x" * 100]


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=300))
def test_status_text_round_trip_any_text(text: str) -> None:
    texts = StatusTextAssembler()
    texts_read = [message.text for chunk in chunks(text) for message in texts.receive(chunk, 0.0)]
    assert texts_read == [text.rstrip()]


def test_status_texts_of_components_and_ids_are_separate() -> None:
    texts = StatusTextAssembler()
    first, second = chunks(LONG, 1), chunks(LONG.upper(), 2)
    texts_read = [
        text.text for pair in zip(first, second, strict=True) for chunk in pair for text in texts.receive(chunk, 0.0)
    ]
    assert texts_read == [LONG, LONG.upper()]


def test_status_text_chunk_missing_is_marked() -> None:
    texts = StatusTextAssembler()
    first, _, last = chunks(LONG)
    assert texts.receive(first, 0.0) == []
    (text,) = texts.receive(last, 0.1)
    assert text.text == LONG[:50] + "…" + LONG[100:]


def test_status_text_first_chunk_missing_is_marked() -> None:
    texts = StatusTextAssembler()
    (text,) = texts.receive(chunks(LONG)[2], 0.1)
    assert text.text == "…" + LONG[100:]


def test_status_text_end_missing_is_delivered_after_two_seconds() -> None:
    texts = StatusTextAssembler()
    texts.receive(chunks(LONG)[0], 0.0)
    assert texts.expire(2.0) == []
    assert texts.expire(2.1) == [StatusText(4, LONG[:50].rstrip() + "…", 2.1)]
    assert texts.expire(9) == []


@pytest.mark.anyio
async def test_why_not_armable_silent_vehicle_returns_promptly() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        begin = now()
        flight.wire.deliver(FrameEncoder(1, 1).encode(Statustext(4, LONG[:50], 77, 0)))
        await anyio.sleep(4.0)
        (text,) = flight.vehicle.texts_since(begin)
        assert text.startswith(LONG[:50])


def test_status_text_id_reused_ends_previous_text() -> None:
    texts = StatusTextAssembler()
    texts.receive(chunks(LONG)[0], 0.0)
    texts.receive(chunks(LONG)[1], 0.0)
    texts_read = [text.text for chunk in chunks("Another " + LONG) for text in texts.receive(chunk, 0.5)]
    assert texts_read == [LONG[:100].rstrip() + "…", "Another " + LONG]


def test_status_text_repeated_chunk_is_used_once() -> None:
    texts = StatusTextAssembler()
    texts_read = [text.text for chunk in chunks(LONG) for _ in range(2) for text in texts.receive(chunk, 0.0)]
    assert texts_read[0] == LONG


def test_recent_texts_by_time() -> None:
    texts = StatusTextAssembler()
    for at in range(100):
        texts.receive(Statustext(6, f"text {at}"), float(at))
    assert [text.text for text in texts.recent(since=98.0)] == ["text 98", "text 99"]
    assert len(texts.recent()) == 64
    texts.clear()
    assert texts.recent() == ()


def test_invalid_chunks_do_not_accumulate() -> None:
    texts = StatusTextAssembler()
    for number in range(1, 1000):
        texts.receive(chunks("y" * 120, number)[0], 0.0)
    assert len(texts._incomplete) == MAX_OPEN
    for seq in range(100):
        texts.receive(_received(Statustext(6, "", 7, seq), b"z" * 50), 0.0)
    assert len(texts._incomplete) <= MAX_OPEN


def test_status_text_open_limit_drops_oldest() -> None:
    texts = StatusTextAssembler()
    for number in range(1, MAX_OPEN + 2):
        texts.receive(chunks("y" * 70, number)[0], 0.0)
    texts_read = [text.text for number in (2, 1) for text in texts.receive(chunks("y" * 70, number)[1], 0.1)]
    assert texts_read == ["y" * 70, "…" + "y" * 20]


def test_status_text_is_limited_to_twenty_chunks() -> None:
    texts = StatusTextAssembler()
    texts_read = [texts.receive(_received(Statustext(6, "", 7, seq), b"z" * 50), 0.0) for seq in range(MAX_CHUNKS)]
    assert texts_read[:-1] == [[]] * (MAX_CHUNKS - 1)
    assert texts_read[-1] == [StatusText(6, "z" * 50 * MAX_CHUNKS, 0.0)]


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 5), st.binary(max_size=50), st.floats(0, 1)), max_size=40))
def test_status_text_any_chunk_sequence_is_processed(sequence: list[tuple[int, int, bytes, float]]) -> None:
    texts = StatusTextAssembler()
    now = 0.0
    for number, seq, data, step in sequence:
        now += step
        for text in texts.receive(_received(Statustext(6, "", number, seq), data), now):
            assert "\0" not in text.text
    texts.expire(now + 3)
    assert not texts._incomplete


def test_severity_names() -> None:
    assert str(StatusText(2, "Preflight Fail: Yaw")) == "CRITICAL: Preflight Fail: Yaw"
    assert StatusText(3, "").is_error
    assert not StatusText(4, "").is_error
    assert str(StatusText(9, "?")) == "9: ?"


@pytest.mark.parametrize("text", ["", "\t", "   "])
def test_empty_texts(text: str) -> None:
    assert [message.text for message in StatusTextAssembler().receive(Statustext(6, text), 0.0)] == [""]


def test_every_state_message_is_in_standard_dialect() -> None:
    assert STANDARD[253] is Statustext


def test_status_text_repetition_requires_same_text_and_sequence() -> None:
    """A repeated last chunk alone is a frame that arrived over another route."""
    texts = StatusTextAssembler()
    first, second, other = chunks("a" * 50 + "b" * 50 + "c")[:2] + chunks("a" * 50 + "d" * 50)[1:2]
    assert [text for message in (first, second, second) for text in texts.receive(message, 0.0)] == []
    cut = texts.receive(other, 1.0)
    assert [text.text.startswith("a" * 50 + "b" * 50) for text in cut] == [True]
    texts = StatusTextAssembler()
    same = chunks("a" * 50 + "a" * 50 + "c")
    assert [text for message in same[:2] for text in texts.receive(message, 0.0)] == []
    assert len(texts.receive(same[0], 1.0)) == 1
