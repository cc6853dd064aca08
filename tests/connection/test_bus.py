"""The bus decodes on demand, separates systems, and survives a subscriber that raises."""

from __future__ import annotations

import logging

import pytest

from aerokit.connection.bus import Bus
from aerokit.events import ArmedChanged, Event, ModeChanged
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, Heartbeat

HEARTBEAT = Heartbeat(2, 3, 0, 0, 4)


def frame(message: Message, system_id: int = 1) -> Frame:
    return Framer().receive(FrameEncoder(system_id, 1).encode(message))[0]


def test_frame_without_subscribers_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus()
    monkeypatch.setattr(bus.dialect, "decode", lambda frame: pytest.fail("decoded"), raising=False)
    bus.deliver(frame(HEARTBEAT))


def test_subscribed_frame_is_decoded_once() -> None:
    bus, observed = Bus(), list[Heartbeat]()
    bus.attach(Heartbeat, observed.append)
    bus.attach(Heartbeat, observed.append, system_id=1)
    bus.deliver(frame(HEARTBEAT))
    assert observed == [HEARTBEAT, HEARTBEAT]
    assert observed[0] is observed[1]


def test_subscribers_get_only_their_system() -> None:
    bus, one, two = Bus(), list[Heartbeat](), list[Heartbeat]()
    bus.attach(Heartbeat, one.append, system_id=1)
    bus.attach(Heartbeat, two.append, system_id=2)
    bus.deliver(frame(HEARTBEAT, 2))
    assert (len(one), len(two)) == (0, 1)


def test_create_on_first_delivers_the_first_message_once() -> None:
    bus, received, made = Bus(), list[Message](), list[object]()

    def make() -> None:
        if not made:
            made.append(bus.attach(Heartbeat, received.append))

    bus.create_on_first([Attitude.ID, Heartbeat.ID], make, system_id=1)
    bus.deliver(frame(HEARTBEAT, 2))
    assert not made
    for _ in range(2):
        bus.deliver(frame(HEARTBEAT))
    assert received == [HEARTBEAT, HEARTBEAT]
    assert set(bus.wanted) == {Heartbeat.ID}


def test_sink_attached_by_another_sink_gets_first_message() -> None:
    bus, received, made = Bus(), list[Message](), list[object]()

    def make(*_: object) -> None:
        if not made:
            made.append(bus.attach(Heartbeat, received.append))

    bus.attach(Heartbeat, make, system_id=1)
    bus.create_on_first([Heartbeat.ID], make, system_id=1)
    bus.deliver(frame(HEARTBEAT))
    bus.deliver(frame(HEARTBEAT))
    assert received == [HEARTBEAT, HEARTBEAT]


def test_failed_creation_is_retried_with_next_message(caplog: pytest.LogCaptureFixture) -> None:
    bus, received, failures = Bus(), list[Message](), [MemoryError()]

    def make() -> None:
        if failures:
            raise failures.pop()
        bus.attach(Heartbeat, received.append)

    bus.create_on_first([Heartbeat.ID], make)
    for _ in range(3):
        bus.deliver(frame(HEARTBEAT))
    assert received == [HEARTBEAT, HEARTBEAT]
    assert len(caplog.records) == 1


def test_created_sink_that_raises_keeps_first_message_for_others(caplog: pytest.LogCaptureFixture) -> None:
    bus, received = Bus(), list[Message]()

    def fail(_: Message) -> None:
        raise ValueError("the sink fails")

    def create() -> None:
        bus.attach(Heartbeat, fail)
        bus.attach(Heartbeat, received.append)

    bus.create_on_first([Heartbeat.ID], create)
    bus.deliver(frame(HEARTBEAT))
    assert received == [HEARTBEAT]
    assert "fail" in caplog.text


def test_wanted_ids_are_live() -> None:
    bus, framer = Bus(), Framer()
    framer.wanted = bus.wanted
    data = FrameEncoder(1, 1).encode(HEARTBEAT)
    assert framer.receive(data) == []
    first = bus.attach(Heartbeat, lambda message: None)
    second = bus.attach(Heartbeat, lambda message: None, system_id=3)
    assert len(framer.receive(data)) == 1
    first()
    first()
    assert Heartbeat.ID in bus.wanted
    second()
    assert not bus.wanted


def test_subscriber_exception_is_logged_and_others_continue(caplog: pytest.LogCaptureFixture) -> None:
    bus, observed = Bus(), list[Heartbeat]()

    def raising(message: Heartbeat) -> None:
        raise ValueError("mine")

    bus.attach(Heartbeat, raising)
    bus.attach(Heartbeat, observed.append)
    with caplog.at_level(logging.ERROR, "aerokit"):
        bus.deliver(frame(HEARTBEAT))
    assert len(observed) == 1
    assert "subscriber" in caplog.text


def test_detach_during_delivery() -> None:
    bus, observed = Bus(), list[str]()

    def first(message: Heartbeat) -> None:
        observed.append("first")
        detach()

    detach = bus.attach(Heartbeat, first)
    bus.attach(Heartbeat, lambda message: observed.append("second"))
    bus.deliver(frame(HEARTBEAT))
    bus.deliver(frame(HEARTBEAT))
    assert observed == ["first", "second", "second"]


def test_events_reach_subscribers_of_base_classes() -> None:
    bus, modes, everything = Bus(), list[ModeChanged](), list[Event]()
    detach = bus.attach_event(ModeChanged, modes.append)
    bus.attach_event(Event, everything.append)
    bus.publish(ModeChanged(1.0, 1, None, "GUIDED"))
    bus.publish(ArmedChanged(2.0, 1, True))
    detach()
    bus.publish(ModeChanged(3.0, 1, "GUIDED", "RTL"))
    assert [event.after for event in modes] == ["GUIDED"]
    assert [event.at for event in everything] == [1.0, 2.0, 3.0]


def test_messages_of_other_ids_are_not_delivered() -> None:
    bus, observed = Bus(), list[Attitude]()
    bus.attach(Attitude, observed.append)
    bus.deliver(frame(HEARTBEAT))
    assert observed == []
