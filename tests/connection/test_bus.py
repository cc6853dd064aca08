"""The bus decodes on interest, keeps systems apart, and survives a subscriber that raises."""

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


def test_a_frame_nobody_wants_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus()
    monkeypatch.setattr(bus.dialect, "decode", lambda frame: pytest.fail("decoded"), raising=False)
    bus.deliver(frame(HEARTBEAT))


def test_a_wanted_frame_is_decoded_once_and_shared() -> None:
    bus, seen = Bus(), list[Heartbeat]()
    bus.attach(Heartbeat, seen.append)
    bus.attach(Heartbeat, seen.append, system_id=1)
    bus.deliver(frame(HEARTBEAT))
    assert seen == [HEARTBEAT, HEARTBEAT]
    assert seen[0] is seen[1]


def test_systems_are_kept_apart() -> None:
    bus, one, two = Bus(), list[Heartbeat](), list[Heartbeat]()
    bus.attach(Heartbeat, one.append, system_id=1)
    bus.attach(Heartbeat, two.append, system_id=2)
    bus.deliver(frame(HEARTBEAT, 2))
    assert (len(one), len(two)) == (0, 1)


def test_what_is_made_for_the_first_message_gets_it_once() -> None:
    bus, heard, made = Bus(), list[Message](), list[object]()

    def make() -> None:
        if not made:
            made.append(bus.attach(Heartbeat, heard.append))

    bus.attach_first([Attitude.ID, Heartbeat.ID], make, system_id=1)
    bus.deliver(frame(HEARTBEAT, 2))
    assert not made
    for _ in range(2):
        bus.deliver(frame(HEARTBEAT))
    assert heard == [HEARTBEAT, HEARTBEAT]
    assert set(bus.wanted) == {Heartbeat.ID}


def test_what_another_sink_makes_meanwhile_gets_the_first_message_too() -> None:
    bus, heard, made = Bus(), list[Message](), list[object]()

    def make(*_: object) -> None:
        if not made:
            made.append(bus.attach(Heartbeat, heard.append))

    bus.attach(Heartbeat, make, system_id=1)
    bus.attach_first([Heartbeat.ID], make, system_id=1)
    bus.deliver(frame(HEARTBEAT))
    bus.deliver(frame(HEARTBEAT))
    assert heard == [HEARTBEAT, HEARTBEAT]


def test_what_could_not_be_made_is_made_for_the_next_message(caplog: pytest.LogCaptureFixture) -> None:
    bus, heard, failures = Bus(), list[Message](), [MemoryError()]

    def make() -> None:
        if failures:
            raise failures.pop()
        bus.attach(Heartbeat, heard.append)

    bus.attach_first([Heartbeat.ID], make)
    for _ in range(3):
        bus.deliver(frame(HEARTBEAT))
    assert heard == [HEARTBEAT, HEARTBEAT]
    assert len(caplog.records) == 1


def test_wanted_is_live_and_shared_with_the_framer() -> None:
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


def test_a_subscriber_that_raises_is_logged_and_the_others_go_on(caplog: pytest.LogCaptureFixture) -> None:
    bus, seen = Bus(), list[Heartbeat]()

    def raising(message: Heartbeat) -> None:
        raise ValueError("mine")

    bus.attach(Heartbeat, raising)
    bus.attach(Heartbeat, seen.append)
    with caplog.at_level(logging.ERROR, "aerokit"):
        bus.deliver(frame(HEARTBEAT))
    assert len(seen) == 1
    assert "a subscriber" in caplog.text


def test_detaching_while_a_message_is_delivered() -> None:
    bus, seen = Bus(), list[str]()

    def first(message: Heartbeat) -> None:
        seen.append("first")
        detach()

    detach = bus.attach(Heartbeat, first)
    bus.attach(Heartbeat, lambda message: seen.append("second"))
    bus.deliver(frame(HEARTBEAT))
    bus.deliver(frame(HEARTBEAT))
    assert seen == ["first", "second", "second"]


def test_events_reach_those_who_want_their_class_or_a_class_above() -> None:
    bus, modes, everything = Bus(), list[ModeChanged](), list[Event]()
    detach = bus.attach_event(ModeChanged, modes.append)
    bus.attach_event(Event, everything.append)
    bus.publish(ModeChanged(1.0, 1, None, "GUIDED"))
    bus.publish(ArmedChanged(2.0, 1, True))
    detach()
    bus.publish(ModeChanged(3.0, 1, "GUIDED", "RTL"))
    assert [event.after for event in modes] == ["GUIDED"]
    assert [event.at for event in everything] == [1.0, 2.0, 3.0]


def test_messages_of_other_ids_are_left_alone() -> None:
    bus, seen = Bus(), list[Attitude]()
    bus.attach(Attitude, seen.append)
    bus.deliver(frame(HEARTBEAT))
    assert seen == []
