"""A hub with memory links, on virtual time: routing, queues and events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from fnmatch import fnmatchcase
from functools import wraps
from pathlib import Path
from typing import Any

import anyio
import pytest
from flight_harness import block_loop
from hub_stage import COPTER, STATION, Program, SlowLink, settle
from wrong_types import misuses

import aerokit
from aerokit import Signing, SigningKey
from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkLost, LinkOpenError
from aerokit.hub import Endpoint, EndpointStatistics, Hub, HubEvent
from aerokit.hub import message_rules as kinds
from aerokit.mavlink.dialect import STANDARD, Dialect
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import (
    Attitude,
    CommandLong,
    GlobalPositionInt,
    Heartbeat,
    LandingTarget,
    ParamRequestList,
    ParamValue,
    SetupSigning,
    Statustext,
    VisionPositionEstimate,
)
from aerokit.mavlink.tlog import read_tlog
from aerokit.testing import run_virtual
from aerokit.transport import Link, MemoryLink, Peer, memory_link_pair

KEY = SigningKey.from_passphrase("border")
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CAMERA = Heartbeat(30, 8, 0, 0, 3)
ORDER = CommandLong(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
UNKNOWN = bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34"


def virtual(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        run_virtual(test(*args, **kwargs))

    return run


@asynccontextmanager
async def joined(*programs: Program, **fields: dict[str, Any]) -> AsyncIterator[Hub]:
    """A hub whose endpoints a, b, c … have these programs behind them; ``b={…}`` are fields of an endpoint."""
    async with AsyncExitStack() as stack:
        for program in programs:
            await stack.enter_async_context(program)
        names = "abcdefgh"[: len(programs)]
        endpoints = [
            other_name.endpoint(name, **fields.get(name, {})) for name, other_name in zip(names, programs, strict=True)
        ]
        yield await stack.enter_async_context(Hub(endpoints))


def of(hub: Hub, name: str) -> EndpointStatistics:
    return next(endpoint for endpoint in hub.endpoints if endpoint.name == name)


@virtual
async def test_frames_are_forwarded_unchanged() -> None:
    copter, station, tablet = Program(1, 1), Program(255, 190), Program(254, 190, version=1)
    async with joined(copter, station, tablet) as hub:
        copter.send(COPTER, ATTITUDE)
        await settle()
        assert station.received == tablet.received == ["HEARTBEAT", "ATTITUDE"]
        assert copter.frames == []
        assert [(frame.system_id, frame.component_id, frame.sequence) for frame in station.frames] == [
            (1, 1, 0),
            (1, 1, 1),
        ]
        tablet.send(STATION)
        station.send(STATION, ORDER, ParamRequestList(7, 1))
        await settle()
        assert copter.received == ["HEARTBEAT", "HEARTBEAT", "COMMAND_LONG"]
        assert copter.frames[0].version == 1
        assert tablet.received == ["HEARTBEAT", "ATTITUDE", "HEARTBEAT"]
        assert of(hub, "b").dropped == {"no_route": 1}
        assert of(hub, "a").systems == ((1, 1),)


@virtual
async def test_commands_are_not_forwarded_after_blocked_loop() -> None:
    copter, station, events = Program(1, 1), Program(255, 190), list[HubEvent]()
    async with joined(copter, station) as hub:
        hub.on_event(events.append)
        copter.send(COPTER)
        station.send(STATION)
        await anyio.sleep(1.0)
        for blocked_s, expected in ((0.8, ["HEARTBEAT", "COMMAND_LONG"]), (10.0, ["HEARTBEAT"])):
            copter.frames.clear()
            station.send(STATION, ORDER)
            block_loop(blocked_s)
            await anyio.sleep(1.0)
            assert copter.received == expected
        assert of(hub, "b").dropped == {"late": 1}
        assert "COMMAND_LONG for 1/1 was dropped after 10.0 s: it waited too long" in events[-1].text
        station.send(ORDER)
        await settle()
        assert copter.received == ["HEARTBEAT", "COMMAND_LONG"]


@virtual
async def test_measurements_are_not_forwarded_after_blocked_loop() -> None:
    copter, companion, events = Program(1, 1), Program(1, 191), list[HubEvent]()
    async with joined(copter, companion) as hub:
        companion.send(STATION)
        await anyio.sleep(1.0)
        hub.on_event(events.append)
        for blocked_s, expected in ((0.8, 1), (10.0, 0)):
            copter.frames.clear()
            companion.send(VisionPositionEstimate(0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0))
            block_loop(blocked_s)
            await anyio.sleep(1.0)
            assert len(copter.frames) == expected
        assert of(hub, "b").dropped == {"late": 1}
        assert not events


@pytest.mark.parametrize("dialect", [STANDARD, Dialect("own", [Heartbeat, CommandLong, LandingTarget])])
@virtual
async def test_orders_of_any_dialect_are_not_forwarded_late(dialect: Dialect) -> None:
    copter, station = Program(1, 1), Program(255, 190)
    hub = Hub([copter.endpoint("a"), station.endpoint("b")], dialect=dialect)
    async with copter, station, hub:
        copter.send(COPTER)
        await anyio.sleep(1.0)
        station.send(ORDER, LandingTarget(0, 0, 12, 0.1, 0.1, 3.0, 0.0, 0.0))
        block_loop(10.0)
        await anyio.sleep(1.0)
        assert copter.received == []
        assert of(hub, "b").dropped == {"late": 2}


@virtual
async def test_vehicle_with_same_ids_gets_no_commands_after_blocked_loop() -> None:
    """The first frame after the pause is one of the other vehicle."""
    copter, other, station = Program(1, 1), Program(1, 1), Program(255, 190)
    other.encoder.sequence = 100
    async with joined(copter, other, station) as hub:
        events = list[HubEvent]()
        for _ in range(8):
            copter.send(COPTER)
            other.send(COPTER)
            station.send(STATION)
            await anyio.sleep(0.5)
        hub.on_event(events.append)
        block_loop(6.0)
        other.send(COPTER)
        copter.send(COPTER)
        await anyio.sleep(0.3)
        other.send(COPTER)
        await anyio.sleep(0.2)
        copter.send(COPTER)
        station.send(ORDER)
        await settle()
        assert "COMMAND_LONG" in copter.received
        assert "COMMAND_LONG" not in other.received
        assert not events


@virtual
async def test_queued_commands_are_dropped_when_computer_slept() -> None:
    link, station = SlowLink(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="radio"), station.endpoint("b")]) as hub:
        assert hub._switch is not None
        link.receiver.bytes_received(FrameEncoder(1, 1).encode(COPTER), None)
        await settle()
        link.unsent = 10**6
        station.send(STATION, ORDER)
        await anyio.sleep(0.2)
        assert of(hub, "radio").waiting == 2
        watch = hub._switch._loop_watch
        watch._suspended = lambda: watch._suspended_before + 600.0
        await anyio.sleep(0.2)
        assert (of(hub, "radio").waiting, of(hub, "radio").dropped["late"]) == (1, 1)


@virtual
async def test_hub_sends_nothing_of_its_own() -> None:
    programs = Program(), Program()
    async with joined(*programs):
        await anyio.sleep(60)
        assert not any(program.pieces for program in programs)


@virtual
async def test_frames_are_joined_except_to_autopilots() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    async with joined(copter, station):
        copter.send(COPTER)
        await settle()
        copter.link.write(b"".join(copter.encoder.encode(ATTITUDE) for _ in range(60)))
        station.send(STATION)
        station.link.write(b"".join(station.encoder.encode(ORDER) for _ in range(3)))
        await settle()
        assert len(copter.pieces) == len(copter.frames) == 4
        assert len(station.frames) == 61
        assert len(station.pieces) < 6
        assert max(map(len, station.pieces)) <= 1200


@virtual
async def test_noise_and_unknown_messages() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    async with joined(copter, station) as hub:
        copter.link.write(UNKNOWN)
        copter.link.write(b"booting ...\r\n")
        copter.send(COPTER)
        copter.link.write(UNKNOWN)
        copter.send(COPTER)
        await settle()
        assert b"".join(station.pieces).count(b"mine") == 1
        assert b"booting" not in b"".join(station.pieces)
        assert [frame.message_id for frame in station.frames] == [0, 51234, 0]
        assert of(hub, "a").bad_bytes == 13
        assert of(hub, "a").dropped == {"unknown": 1}


@virtual
async def test_read_only_endpoint_receives_but_is_not_forwarded() -> None:
    copter, station, onlooker = Program(1, 1), Program(255, 190), Program(254, 190)
    async with joined(copter, station, onlooker, c={"read_only": True}) as hub:
        copter.send(COPTER)
        onlooker.send(STATION, ORDER)
        await settle()
        assert onlooker.received == ["HEARTBEAT"]
        assert copter.frames == []
        assert station.received == ["HEARTBEAT"]
        assert of(hub, "c").dropped == {"read_only": 2}
        assert of(hub, "c").systems == ()
        copter.send(CommandLong(254, 190, 400, 0, 0, 0, 0, 0, 0, 0, 0))  # and it does not attract messages for others
        await settle()
        assert onlooker.received == ["HEARTBEAT"]


@virtual
async def test_filters_and_rates() -> None:
    copter, narrow, slow = Program(1, 1), Program(255, 190), Program(254, 190)
    filters = {"only": ("HEARTBEAT", "STATUSTEXT"), "block": ("STATUSTEXT",)}
    async with joined(copter, narrow, slow, b=filters, c={"rates": {"ATTITUDE": 4, "GLOBAL_*": 1}}) as hub:
        for _ in range(101):  # ten seconds
            copter.send(ATTITUDE, GlobalPositionInt(0, 0, 0, 0, 0, 0, 0, 0, 0))
            await anyio.sleep(0.1)
        copter.send(COPTER, Statustext(6, "hello"))
        await settle()
        assert narrow.received == ["HEARTBEAT"]
        assert slow.received.count("ATTITUDE") in (40, 41)
        assert slow.received.count("GLOBAL_POSITION_INT") in (10, 11)
        assert slow.received[-2:] == ["HEARTBEAT", "STATUSTEXT"]
        assert of(hub, "c").dropped["rate_limited"] == 202 - len(slow.received) + 2


@virtual
async def test_rates_apply_per_sender() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    other = Program(2, 1)
    async with joined(copter, other, station, c={"rates": {"ATTITUDE": 1}}):
        for program in (copter, other, copter, other):
            program.send(ATTITUDE)
        await settle()
        assert [frame.system_id for frame in station.frames] == [1, 2]


@virtual
async def test_keys_are_not_forwarded() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    async with joined(copter, station) as hub:
        copter.send(COPTER)
        station.send(SetupSigning(1, 1, bytes(range(32)), 7))
        await settle()
        assert copter.frames == []
        assert of(hub, "b").dropped == {"secret": 1}


# ---------------------------------------------------------------------------------------------- a full link


@asynccontextmanager
async def with_slow_link() -> AsyncIterator[tuple[Hub, SlowLink, Program, Program, list[HubEvent]]]:
    """A hub with a slow link, a vehicle and a station."""
    slow, copter, station = SlowLink(), Program(2, 1), Program(255, 190)
    async with (
        copter,
        station,
        Hub([Endpoint(slow, name="slow"), copter.endpoint("b"), station.endpoint("c")]) as hub,
    ):
        events: list[HubEvent] = []
        hub.on_event(events.append)
        speaker = Program(1, 1)
        slow.receiver.bytes_received(speaker.encoder.encode(COPTER), None)
        await settle()
        slow.unsent = 1 << 20
        yield hub, slow, copter, station, events


@virtual
async def test_slow_link_gets_newest_telemetry_and_whole_transfer() -> None:
    async with with_slow_link() as (hub, slow, copter, station, _):
        for number in range(50):
            copter.send(ATTITUDE, COPTER, ParamValue(f"P{number}", 1.0, 9, 50, number))
            await anyio.sleep(0.02)
        await settle()
        assert slow.written == []
        assert station.received.count("ATTITUDE") == 50, "other endpoints do not wait"
        assert of(hub, "slow").waiting == 52
        slow.unsent = 0
        await anyio.sleep(0.05)
        names = slow.names()
        assert (names.count("ATTITUDE"), names.count("HEARTBEAT"), names.count("PARAM_VALUE")) == (1, 1, 50)
        assert of(hub, "slow").dropped == {"superseded": 98}
        copter.send(ATTITUDE)
        await settle()
        assert slow.names()[-1] == "ATTITUDE"
        assert of(hub, "slow").waiting == 0


class BreakingLink(SlowLink):
    """A link that is lost by a write."""

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.receiver.link_lost(LinkLost("broken"))


@virtual
async def test_link_lost_by_a_write_does_not_stop_other_queues() -> None:
    copter, breaking, slow = Program(1, 1), BreakingLink("breaking:1"), SlowLink()
    async with copter, Hub([copter.endpoint("a"), Endpoint(breaking, name="b"), Endpoint(slow, name="c")]):
        breaking.unsent = slow.unsent = 1 << 20
        copter.send(ATTITUDE)
        await settle()
        breaking.unsent = 0
        await anyio.sleep(1)
        slow.unsent = 0
        await anyio.sleep(1)
        assert slow.names() == ["ATTITUDE"]


@virtual
async def test_late_order_is_dropped_and_reported() -> None:
    async with with_slow_link() as (hub, slow, _, station, events):
        station.send(ORDER, ParamRequestList(1, 1))
        await anyio.sleep(0.9)
        station.send(ORDER)
        await anyio.sleep(0.2)
        slow.unsent = 0
        await anyio.sleep(0.05)
        assert slow.names() == ["PARAM_REQUEST_LIST", "COMMAND_LONG"]
        assert of(hub, "slow").dropped == {"late": 1}
        (event,) = events
        assert (event.endpoint, event.kind) == ("slow", "order_dropped")
        assert event.text.startswith("COMMAND_LONG for 1/1 was dropped after 1.0 s: it waited too long")


@virtual
async def test_stalled_link_does_not_fill_the_memory() -> None:
    async with with_slow_link() as (hub, slow, copter, station, _):
        for number in range(2000):
            copter.send(Statustext(6, f"{number:050}"))
            if number % 100 == 0:
                await settle()
        await settle()
        assert station.received.count("STATUSTEXT") == 2000
        assert of(hub, "slow").waiting <= 1024
        assert of(hub, "slow").dropped["queue_full"] >= 900
        slow.receiver.link_lost(LinkLost("gone"))
        assert of(hub, "slow").waiting == 0


@virtual
async def test_link_events_are_reported() -> None:
    async with with_slow_link() as (hub, slow, copter, station, events):
        slow.receiver.link_stalled(77)
        slow.receiver.link_drained(2.5)
        station.send(ORDER)
        await settle()
        slow.receiver.link_lost(LinkLost("slow:1: unplugged"))
        assert [event.kind for event in events] == ["stalled", "drained", "order_dropped", "lost"]
        assert "unplugged" in events[-1].text
        assert not of(hub, "slow").is_open
        station.send(ORDER)
        copter.send(COPTER)
        await settle()
        assert of(hub, "c").dropped == {"no_route": 1}
        assert station.received[-1] == "HEARTBEAT"


# ------------------------------------------------------------------------------------------ the border


@virtual
async def test_signed_outside_and_unsigned_inside() -> None:
    copter, station = Program(1, 1, signing=Signing(KEY)), Program(255, 190)
    async with joined(copter, station, a={"signing": Signing(KEY)}) as hub:
        copter.send(COPTER)
        station.send(STATION, ORDER)
        await settle()
        assert [frame.incompat_flags for frame in station.frames] == [0]
        assert copter.received == ["HEARTBEAT", "COMMAND_LONG"]
        assert all(Signing(KEY).has_signed(frame) for frame in copter.frames)
        assert [(frame.system_id, frame.sequence) for frame in copter.frames] == [(255, 0), (255, 1)]
        assert of(hub, "a").dropped == {}


@virtual
async def test_unsigned_frames_are_refused_and_reported_once() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    async with joined(copter, station, a={"signing": Signing(KEY)}) as hub:
        events: list[HubEvent] = []
        hub.on_event(events.append)
        copter.send(COPTER, COPTER, ATTITUDE)
        await settle()
        assert station.frames == []
        assert of(hub, "a").dropped == {"refused": 3}
        assert of(hub, "a").systems == ()
        assert [event.kind for event in events] == ["refused"]
        assert "1/1" in events[0].text


@virtual
async def test_signatures_pass_where_the_hub_has_no_key() -> None:
    copter, station = Program(1, 1, signing=Signing(KEY)), Program(255, 190)
    async with joined(copter, station):
        copter.send(COPTER)
        await settle()
        assert Signing(KEY).has_signed(station.frames[0])


@virtual
async def test_exhausted_key_stops_one_endpoint_only() -> None:
    copter, station, tablet = Program(1, 1), Program(255, 190), Program(254, 190)
    async with joined(copter, station, tablet, b={"signing": Signing(KEY, timestamp=(1 << 48) - 1)}) as hub:
        events: list[HubEvent] = []
        hub.on_event(events.append)
        copter.send(COPTER)
        await settle()
        copter.send(COPTER)
        await settle()
        assert tablet.received == ["HEARTBEAT"] * 2
        assert station.received == ["HEARTBEAT"]
        assert [event.kind for event in events] == ["internal_error"]
        assert "exhausted" in events[0].text


# ------------------------------------------------------------------ adding and removing endpoints


@virtual
async def test_endpoints_are_added_and_removed() -> None:
    copter, station, late = Program(1, 1), Program(255, 190), Program(254, 190)
    async with joined(copter, station) as hub, late:
        events: list[HubEvent] = []
        detach = hub.on_event(events.append)
        reported = await hub.add(late.endpoint("late"))
        assert (reported.name, reported.is_open, reported.peers) == ("late", True, 1)
        copter.send(COPTER)
        await settle()
        assert late.received == ["HEARTBEAT"]
        await hub.remove("late")
        assert [endpoint.name for endpoint in hub.endpoints] == ["a", "b"]
        copter.send(COPTER)
        await settle()
        assert late.is_lost
        assert late.received == ["HEARTBEAT"]
        assert station.received == ["HEARTBEAT"] * 2
        assert [(event.endpoint, event.kind) for event in events] == [("late", "opened"), ("late", "removed")]
        detach()
        detach()
        with pytest.raises(InvalidArgument, match=r"no endpoint is named 'late'; endpoints: a, b"):
            await hub.remove("late")
        other = Program(3, 1)
        with pytest.raises(InvalidArgument, match="two endpoints have the name 'a'"):
            await hub.add(other.endpoint("a"))
        assert len(events) == 2


@virtual
async def test_listener_added_twice_is_removed_once_by_each_function() -> None:
    events: list[HubEvent] = []
    async with joined(Program(1, 1), Program(255, 190)) as hub:
        detach = hub.on_event(events.append)
        hub.on_event(events.append)
        detach()
        detach()
        await hub.remove("b")
    assert [event.kind for event in events] == ["removed"]


@virtual
async def test_listener_exception_does_not_affect_the_hub(caplog: pytest.LogCaptureFixture) -> None:
    copter, station, late = Program(1, 1), Program(255, 190), Program(254, 190)
    async with joined(copter, station) as hub, late:
        events: list[HubEvent] = []
        hub.on_event(lambda event: 1 / 0)
        hub.on_event(events.append)
        await hub.add(late.endpoint("late"))
        assert len(events) == 1
        assert "ZeroDivisionError" in caplog.text


@virtual
async def test_endpoint_exception_does_not_affect_others(monkeypatch: pytest.MonkeyPatch) -> None:
    copter, station = Program(1, 1), Program(255, 190)
    async with joined(copter, station) as hub:
        events: list[HubEvent] = []
        hub.on_event(events.append)
        monkeypatch.setattr(hub._switch.router, "route", lambda *_: 1 / 0)  # type: ignore[union-attr]
        copter.send(COPTER)
        await settle()
        monkeypatch.undo()
        copter.send(COPTER)
        await settle()
        assert [event.kind for event in events] == ["internal_error"]
        assert station.received == ["HEARTBEAT"]


class ReopenableLinks:
    """Links of one address: the far end of the present one, and whether another can be opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.far: list[MemoryLink] = []
        self.can_be_opened = True
        monkeypatch.setattr("aerokit.hub.running_endpoint.create_link", self.make)

    def make(self, *_: object, **__: object) -> Link:
        near, far = memory_link_pair()
        return AttachedLater(near, far, self)


class AttachedLater(SlowLink):
    """Stands for ``near`` where that can be opened."""

    def __init__(self, near: MemoryLink, far: MemoryLink, phoenix: ReopenableLinks) -> None:
        super().__init__()
        self._near, self._far, self._phoenix = near, far, phoenix

    async def open(self, receiver: Any) -> None:
        if not self._phoenix.can_be_opened:
            raise LinkOpenError("cannot open it: it is not there")
        self._phoenix.far.append(self._far)
        await self._near.open(receiver)

    def write(self, data: bytes, peer: Peer = None) -> None:
        self._near.write(data, peer)

    def close(self) -> None:
        self._near.close()


@virtual
async def test_lost_link_is_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    links, copter = ReopenableLinks(monkeypatch), Program(1, 1)
    async with copter, Hub([copter.endpoint("a"), Endpoint("tcp:127.0.0.1:5760", name="b")]) as hub:
        events: list[HubEvent] = []
        hub.on_event(events.append)
        async with Program(255, 190, links.far[0]) as station:
            station.send(STATION)
            await settle()
            assert of(hub, "b").systems == ((255, 190),)
        links.can_be_opened = False
        await anyio.sleep(3)
        assert [event.kind for event in events] == ["lost"]
        assert (of(hub, "b").is_open, of(hub, "b").peers, of(hub, "b").systems) == (False, 0, ())
        links.can_be_opened = True
        copter.send(COPTER)
        await anyio.sleep(10)
        async with Program(255, 190, links.far[-1]) as station:
            copter.send(COPTER)
            await settle()
            assert station.received == ["HEARTBEAT"]
            assert [event.kind for event in events] == ["lost", "restored"]
            assert of(hub, "b").is_open
            assert of(hub, "b").frames_in == 1, "it is still counted"


@virtual
async def test_endpoint_with_retry_open_may_open_later(monkeypatch: pytest.MonkeyPatch) -> None:
    links, copter = ReopenableLinks(monkeypatch), Program(1, 1)
    links.can_be_opened = False
    with pytest.raises(LinkOpenError, match="not there"):
        await Hub(["tcp:127.0.0.1:5760"]).__aenter__()
    async with (
        copter,
        Hub([copter.endpoint("a"), Endpoint("tcp:127.0.0.1:5760", name="b", retry_open=True)]) as hub,
    ):
        await anyio.sleep(20)
        assert not of(hub, "b").is_open
        links.can_be_opened = True
        await anyio.sleep(6)
        assert of(hub, "b").is_open
        async with Program(255, 190, links.far[0]) as station:
            copter.send(COPTER)
            await settle()
            assert station.received == ["HEARTBEAT"]


@virtual
async def test_removed_endpoint_with_retry_open_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    links = ReopenableLinks(monkeypatch)
    links.can_be_opened = False
    async with Hub([Endpoint("tcp:127.0.0.1:5760", name="b", retry_open=True)]) as hub:
        await anyio.sleep(1)
        await hub.remove("b")
        links.can_be_opened = True
        await anyio.sleep(20)
        assert links.far == []
        assert hub.endpoints == ()


class LateLink(SlowLink):
    """A link that opens when a test allows it."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self.may_open = asyncio.Event()

    async def open(self, receiver: Any) -> None:
        await self.may_open.wait()
        await super().open(receiver)


@virtual
async def test_endpoint_removed_while_it_opens_is_closed_again() -> None:
    link, other = LateLink("late:1"), SlowLink("other:1")
    async with Hub() as hub:
        adding = asyncio.create_task(hub.add(Endpoint(link, name="b")))
        await settle()
        await hub.remove("b")
        await hub.add(Endpoint(other, name="b"))
        link.may_open.set()
        with pytest.raises(ConnectionClosed, match="b was removed while it was being opened"):
            await adding
        assert link.receiver is None
        assert [endpoint.address for endpoint in hub.endpoints] == ["other:1"]


@virtual
async def test_endpoint_opened_after_the_hub_has_closed_is_closed_again() -> None:
    link = LateLink("late:1")
    async with Hub() as hub:
        adding = asyncio.create_task(hub.add(link))
        await settle()
    link.may_open.set()
    with pytest.raises(ConnectionClosed):
        await adding
    assert link.receiver is None


class Broadcast(SlowLink):
    """A link with a single peer that has an address, like `UdpBroadcast`."""

    kept: list[Peer]

    def keep_peer(self, peer: Peer) -> None:
        self.kept = [*getattr(self, "kept", []), peer]


@virtual
async def test_link_with_one_named_peer() -> None:
    link, station = Broadcast(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="a"), station.endpoint("b")]) as hub:
        link.receiver.bytes_received(b"noise", ("10.0.0.9", 1))
        assert not hasattr(link, "kept")
        link.receiver.bytes_received(Program(1, 1).encoder.encode(COPTER), ("10.0.0.7", 14550))
        assert link.kept[-1] == ("10.0.0.7", 14550)
        station.send(ORDER)
        await settle()
        assert link.names() == ["COMMAND_LONG"], "once, not as a broadcast as well"
        assert of(hub, "a").peers == 1


class ManyPeersLink(SlowLink):
    """A link with any number of peers."""

    forgotten: int = 0

    def has_peer(self, peer: Peer) -> bool:
        return peer is not None

    def forget_peer(self, peer: Peer) -> None:
        self.forgotten += 1


@pytest.mark.exhaustive
@virtual
async def test_many_peers_are_bounded_and_silent_ones_evicted() -> None:
    link, station = ManyPeersLink(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="a"), station.endpoint("b")]) as hub:
        receive, copter = link.receiver.bytes_received, Program(1, 1)
        for number in range(600):
            await anyio.sleep(0.01)
            receive(copter.encoder.encode(COPTER), "copter")
            receive(b"noise", ("noise", number))
            receive(FrameEncoder(2 + number % 200, 1).encode(ATTITUDE), ("peer", number))
        await settle()
        statistics = of(hub, "a")
        assert statistics.peers == 256
        assert link.forgotten == 601 - 256
        assert statistics.frames_in == 1200
        assert (1, 1) in statistics.systems
        assert station.received.count("HEARTBEAT") == 600


@virtual
async def test_failed_open_closes_all_endpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    links, copter = ReopenableLinks(monkeypatch), Program(1, 1)
    links.can_be_opened = False
    async with copter:
        hub = Hub([copter.endpoint("a"), "tcp:127.0.0.1:5760"])
        with pytest.raises(LinkOpenError):
            async with hub:
                pass
        await settle()
        assert copter.is_lost
        assert hub.endpoints == ()


@virtual
async def test_hub_can_be_entered_once() -> None:
    hub = Hub()
    with pytest.raises(ConnectionClosed, match="enter the hub first"):
        await hub.add(SlowLink())
    async with hub:
        with pytest.raises(BusyError):
            await hub.__aenter__()
        assert hub.endpoints == ()
    with pytest.raises(ConnectionClosed, match="the hub is closed"):
        await hub.add(SlowLink())
    with pytest.raises(ConnectionClosed):
        hub.record("x.tlog")
    with pytest.raises(BusyError):
        await hub.__aenter__()


@virtual
async def test_block_exception_passes_unchanged() -> None:
    copter, station = Program(1, 1), Program(255, 190)
    with pytest.raises(KeyError):
        async with joined(copter, station):
            raise KeyError
    before = asyncio.all_tasks()
    with anyio.move_on_after(1.0):
        async with Hub([Program().endpoint("a")]):
            await anyio.sleep(10)
    assert asyncio.all_tasks() == before


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"address": "nonsense:1:2"}, "nonsense"),
        ({"address": 5}, "address = 5 is not allowed"),
        (
            {"address": "pty", "only": "HEARTBEAT"},
            "only = 'HEARTBEAT' is not allowed: it must be a tuple of message names",
        ),
        ({"address": "pty", "block": [5]}, "block = "),
        ({"address": "pty", "rates": ["ATTITUDE"]}, "rates = "),
        ({"address": "pty", "rates": {"ATTITUDE": "5"}}, "rates = "),
        ({"address": "pty", "baud": 0}, "baud = 0 is not allowed"),
        ({"address": "pty", "name": 7}, "name = 7 is not allowed"),
        ({"address": SlowLink(), "retry_open": True}, "retry_open"),
        ({"address": SlowLink(), "peers": ["10.0.0.1"]}, "peers"),
    ],
)
def test_wrong_endpoints_are_refused(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        Endpoint(**fields)


def test_wrong_hub_arguments_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="a list of addresses"):
        Hub("udpin:0.0.0.0:14550")
    with pytest.raises(InvalidArgument):
        Hub(["no address"])
    with pytest.raises(InvalidArgument):
        Hub([5])  # type: ignore[list-item]


# ------------------------------------------------------------------------------------- recording


@virtual
async def test_recording_has_every_frame_once(tmp_path: Path) -> None:
    path = tmp_path / "hub.tlog"
    copter, station, onlooker = Program(1, 1), Program(255, 190), Program(254, 1)
    async with joined(copter, station, onlooker, c={"read_only": True}) as hub:
        hub.record(path)
        with pytest.raises(BusyError):
            hub.record(path)
        copter.send(COPTER, ATTITUDE)
        station.send(STATION, ORDER, SetupSigning(1, 1, bytes(range(32)), 7))
        onlooker.send(STATION)
        station.send(ParamRequestList(77, 1))  # There is no such system.
        station.link.write(copter.encoder.encode(COPTER))
        await anyio.sleep(1.5)
        copter.encoder.sequence -= 1
        copter.send(COPTER)  # the same frame by another way
        await settle()
        assert of(hub, "a").dropped == {"duplicate": 1}
        assert path.stat().st_size > 0, "the file is flushed periodically"
    assert [raw[7] for _, raw in read_tlog(path)] == [0, 30, 0, 76, 0], "only forwarded frames"


@virtual
async def test_unwritable_recording(tmp_path: Path) -> None:
    async with Hub() as hub:
        with pytest.raises(LinkOpenError):
            hub.record(tmp_path / "no" / "hub.tlog")


def test_names_of_the_package() -> None:
    assert aerokit.Hub is Hub
    assert aerokit.Endpoint is Endpoint


@virtual
async def test_arguments_of_wrong_types_are_refused() -> None:
    async with Hub() as hub:
        for wrong in (None, "pty", 5):
            with pytest.raises(InvalidArgument, match="connection = "):
                await hub.share(wrong)  # type: ignore[arg-type]
        for misuse in misuses(hub, leave_out=frozenset({"share"})):
            error: BaseException | None = None
            try:
                result = misuse.call()
                if asyncio.iscoroutine(result):
                    await result
            except InvalidArgument as refusal:
                error = refusal
            assert error is not None, misuse
            assert misuse.parameter in str(error) or "address" in str(error)
        assert hub.endpoints == ()


@virtual
async def test_sixty_full_clients_cost_no_search_per_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kind of a message is determined once, not for each queued frame."""
    matched: list[str] = []

    def match(name: str, pattern: str) -> bool:
        matched.append(name)
        return fnmatchcase(name, pattern)

    monkeypatch.setattr(kinds, "fnmatchcase", match)
    kinds.kind_of.cache_clear()
    deaf, copter = [SlowLink(f"slow:{number}") for number in range(60)], Program(1, 1)
    async with copter, Hub([copter.endpoint("copter"), *(Endpoint(link) for link in deaf)]) as hub:
        for link in deaf:
            link.unsent = 1 << 20
        for number in range(200):
            copter.send(Statustext(6, f"{number}"), ATTITUDE)
        await settle()
        assert sum(endpoint.waiting for endpoint in hub.endpoints) == 60 * 201
        for deaf_link in deaf:
            deaf_link.receiver.link_lost(LinkLost("gone"))
        assert sum(endpoint.dropped["link_lost"] for endpoint in hub.endpoints[1:]) == 60 * 201
    assert len(matched) < 100


@virtual
async def test_broadcast_order_reaches_each_vehicle_once() -> None:
    """One vehicle has two radios, another has one; a program and a camera also receive it; its sender does not."""
    first, second = Program(1, 1), Program(1, 1)
    second.encoder.sequence = 100
    other, camera, station, program = Program(2, 1), Program(1, 100), Program(255, 190), Program(250, 190)
    everyone = first, second, other, camera, station, program
    async with joined(*everyone):
        for client, heartbeat in zip(everyone, [COPTER] * 3 + [CAMERA] + [STATION] * 2, strict=True):
            client.send(heartbeat)
        await settle()
        for target in (0, 1), (0, 0):
            station.send(CommandLong(*target, 400, 0, 1, 0, 0, 0, 0, 0, 0))
            await settle()
            assert [client.received.count("COMMAND_LONG") for client in everyone] == [1, 0, 1, 1, 0, 1]
            for client in everyone:
                client.frames.clear()
