"""Frames for programs that forward, log or show all traffic: observers, raw frames, the version of sent frames."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator

import anyio
import pytest

from aerokit import connect, open_connection
from aerokit.connection.connection import Connection
from aerokit.errors import ConnectionClosed, InvalidArgument, LinkLost
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude, Heartbeat, ParamRequestList, PlayTune
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.transport import MemoryLink, Peer, memory_link_pair

pytestmark = pytest.mark.anyio

COPTER = Heartbeat(2, 3, 81, 0, 3)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
UNKNOWN = bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34"  # message 51234


class TwoPeers(MemoryLink):
    """A link with two peers by name."""

    def __init__(self) -> None:
        super().__init__("memory:two")
        self.sent: list[tuple[bytes, Peer]] = []
        self.connection: Connection | None = None

    async def open(self, receiver: object) -> None:
        assert isinstance(receiver, Connection)
        self.connection = receiver

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.sent.append((data, peer))

    def receive(self, data: bytes, peer: Peer) -> None:
        assert self.connection is not None
        self.connection.bytes_received(data, peer)


@pytest.fixture
async def link() -> TwoPeers:
    return TwoPeers()


@pytest.fixture
async def connection(link: TwoPeers) -> AsyncIterator[Connection]:
    async with open_connection(link) as connection:
        await anyio.sleep(0.1)
        link.sent.clear()
        yield connection


# ------------------------------------------------------------------------------------- taps


async def test_frame_observer_gets_all_frames_in_order(link: TwoPeers, connection: Connection) -> None:
    encoder, received = FrameEncoder(1, 1), list[tuple[int, Peer]]()
    link.receive(encoder.encode(COPTER), "one")
    detach = connection.observe_frames(lambda frame, peer: received.append((frame.message_id, peer)))
    link.receive(encoder.encode(ATTITUDE) + UNKNOWN + encoder.encode(COPTER), "one")
    link.receive(FrameEncoder(2, 1).encode(ATTITUDE), "another, new one")
    assert received == [(30, "one"), (51234, "one"), (0, "one"), (30, "another, new one")]
    detach()
    detach()
    link.receive(encoder.encode(ATTITUDE), "one")
    assert len(received) == 4
    assert all(framer.wanted is connection.bus.wanted for framer in connection._receiver.framers.values())
    assert not any(framer.keep_unknown for framer in connection._receiver.framers.values())


async def test_subscribers_are_called_before_observers(link: TwoPeers, connection: Connection) -> None:
    order: list[str] = []
    connection.observe_frames(lambda frame, peer: order.append(f"tap, {len(connection.heartbeats)} known"))
    connection.attach([Heartbeat], lambda heartbeat: order.append("subscriber"))
    link.receive(FrameEncoder(1, 1).encode(COPTER), "one")
    assert order == ["subscriber", "tap, 1 known"]


async def test_observer_exception_is_logged_and_others_continue(
    link: TwoPeers, connection: Connection, caplog: pytest.LogCaptureFixture
) -> None:
    received: list[Frame] = []
    connection.observe_frames(lambda frame, peer: 1 / 0)
    connection.observe_frames(lambda frame, peer: received.append(frame))
    with caplog.at_level(logging.CRITICAL, "aerokit"):
        link.receive(FrameEncoder(1, 1).encode(COPTER), "one")
    assert len(received) == 1
    assert connection.is_open


async def test_duplicate_vehicle_is_observed_once(link: TwoPeers, connection: Connection) -> None:
    received: list[Peer] = []
    link.receive(FrameEncoder(1, 1).encode(COPTER), "one")
    connection.observe_frames(lambda frame, peer: received.append(peer))
    for peer in ("one", "two"):
        link.receive(FrameEncoder(1, 1).encode(ATTITUDE), peer)
    assert received == ["one"]


# --------------------------------------------------------------------------------- raw frames


async def test_raw_frame_goes_unchanged_to_its_target(link: TwoPeers, connection: Connection) -> None:
    link.receive(FrameEncoder(1, 1).encode(COPTER), "one")
    link.receive(FrameEncoder(2, 1).encode(COPTER), "two")
    asked, answers = (
        FrameEncoder(77, 7).encode(ParamRequestList(2, 1)),
        FrameEncoder(77, 7, version=1).encode(COPTER),
    )
    for raw in (asked, answers, UNKNOWN):
        connection.write_raw(raw)
    assert link.sent == [(asked, "two"), (answers, None), (UNKNOWN, None)]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello, world",
        UNKNOWN[:-1],
        UNKNOWN + UNKNOWN,
        UNKNOWN[:2] + b"\x02" + UNKNOWN[3:],
        b"\xfe\x00\x00",
    ],
    ids=["nothing", "text", "a part", "two", "unknown flags", "a part of version 1"],
)
async def test_invalid_raw_frame_is_refused(link: TwoPeers, connection: Connection, data: bytes) -> None:
    with pytest.raises(InvalidArgument, match=f"{len(data)} bytes"):
        connection.write_raw(data)
    assert link.sent == []


async def test_closed_connection_writes_nothing(link: TwoPeers, connection: Connection) -> None:
    connection.close()
    with pytest.raises(ConnectionClosed):
        connection.write_raw(UNKNOWN)


async def test_ground_station_behind_a_forwarding_program() -> None:
    """Frame observers and raw frames both ways: the far ground station talks to the vehicle as if it were near."""
    near, far = memory_link_pair(latency_s=0.01)
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0)) as link,
        open_connection(link, source_system=254) as to_vehicle,
        open_connection(near, source_system=253) as to_station,
    ):
        to_vehicle.observe_frames(lambda frame, peer: to_station.write_raw(frame.raw))
        to_station.observe_frames(lambda frame, peer: to_vehicle.write_raw(frame.raw))
        async with connect(far, system_id=1) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            assert vehicle.is_armed


# ------------------------------------------------------------------------------ version and source


class FrameRecorder:
    """The far end of a link, which records received frames."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self._framer = Framer()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.frames += self._framer.receive(data)

    def link_lost(self, error: LinkLost) -> None:
        """Ignore it."""


async def test_version_can_be_changed_while_open() -> None:
    near, far = memory_link_pair()
    ear = FrameRecorder()
    await far.open(ear)
    async with open_connection(near) as connection:
        await anyio.sleep(0.5)
        assert connection.mavlink_version == 2
        connection.mavlink_version = 1
        await anyio.sleep(1)
        assert [(frame.version, frame.sequence) for frame in ear.frames] == [(2, 0), (1, 1)]
        with pytest.raises(InvalidArgument, match="PLAY_TUNE"):
            connection.send(PlayTune(1, 1, "A"))
        with pytest.raises(InvalidArgument, match="mavlink_version = 3 is not allowed: it must be 1 or 2"):
            connection.mavlink_version = 3
        assert connection.mavlink_version == 1
    far.close()


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("make", [SimulatedCopter, SimulatedPx4])
async def test_component_0_is_answered(make: type[SimulatedCopter] | type[SimulatedPx4], version: int) -> None:
    """Commands, parameters, missions and files of a program that calls itself (255, 0)."""
    async with (
        simulated_link(make()) as link,
        connect(link, source_component=0, mavlink_version=version) as vehicle,
    ):
        assert vehicle.connection.source_component == 0
        await vehicle.wait_ready()
        await vehicle.arm()
        mission = await vehicle.mission.download(method="items")
        await vehicle.mission.upload(mission)
        table = await vehicle.parameters.download(method="list")
        assert len(table) > 100
        assert await vehicle.files.list("/")
