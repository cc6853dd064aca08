"""Several peers on one link: destinations of messages, accepted senders, and loss."""

from __future__ import annotations

from collections.abc import AsyncIterator

import anyio
import pytest

from aerokit import connect, events, open_connection
from aerokit.connection.connection import Connection
from aerokit.errors import ConnectFailed
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import x25
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import (
    Attitude,
    CommandLong,
    Heartbeat,
    ParamRequestList,
    RequestDataStream,
    Timesync,
)
from aerokit.transport import MemoryLink, Peer

MAX_PEERS = 256

pytestmark = pytest.mark.anyio

COPTER = Heartbeat(2, 3, 81, 0, 3)
GIMBAL = Heartbeat(26, 8, 0, 0, 4)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class PeersLink(MemoryLink):
    """A listening link whose peers are names."""

    def __init__(self) -> None:
        super().__init__("memory:peers")
        self.sent: list[tuple[Peer, int]] = []
        self.gone: set[Peer] = set()
        self._encoders: dict[tuple[int, int, Peer], FrameEncoder] = {}
        self.connection: Connection | None = None

    async def open(self, receiver: object) -> None:
        assert isinstance(receiver, Connection)
        self.connection = receiver

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.sent += [(peer, frame.message_id) for frame in Framer().receive(data)]

    def has_peer(self, peer: Peer) -> bool:
        return peer not in self.gone

    def host_of(self, peer: Peer) -> object:
        """Peers are called "port", or "port@host"."""
        return str(peer).partition("@")[2] or peer

    def frame(self, peer: Peer, source: tuple[int, int], message: Message) -> bytes:
        encoder = self._encoders.setdefault((*source, peer), FrameEncoder(*source))
        return encoder.encode(message)

    def receive(self, peer: Peer, source: tuple[int, int], *messages: Message, lost: int = 0) -> None:
        """Receive messages from this peer, after ``lost`` lost ones."""
        assert self.connection is not None
        for _ in range(lost):
            self.frame(peer, source, ATTITUDE)
        for message in messages:
            self.connection.bytes_received(self.frame(peer, source, message), peer)

    def peers_of(self, message_type: type[Message]) -> list[Peer]:
        """Peers that were sent such a message since the last call."""
        found = [peer for peer, message_id in self.sent if message_id == message_type.ID]
        self.sent.clear()
        return found


@pytest.fixture
async def link() -> PeersLink:
    return PeersLink()


@pytest.fixture
async def connection(link: PeersLink) -> AsyncIterator[Connection]:
    async with open_connection(link) as connection:
        yield connection


def command(system_id: int, component_id: int) -> CommandLong:
    return CommandLong(system_id, component_id, 400, 0, *(0.0,) * 7)


async def test_command_goes_to_the_peer_of_its_component(link: PeersLink, connection: Connection) -> None:
    """An autopilot on one port, its companion on another, a second vehicle on a third."""
    link.receive("autopilot", (1, 1), COPTER)
    link.receive("companion", (1, 191), Heartbeat(18, 8, 0, 0, 4))
    link.receive("other", (2, 1), COPTER)
    for _ in range(2):
        connection.send(command(1, 1))
        assert link.peers_of(CommandLong) == ["autopilot"]
        connection.send(command(1, 191))
        assert link.peers_of(CommandLong) == ["companion"]
        connection.send(command(2, 1))
        assert link.peers_of(CommandLong) == ["other"]
        link.receive("companion", (1, 191), Heartbeat(18, 8, 0, 0, 4))


async def test_system_broadcast_goes_to_all_peers_of_system(link: PeersLink, connection: Connection) -> None:
    link.receive("autopilot", (1, 1), COPTER)
    link.receive("companion", (1, 191), Heartbeat(18, 8, 0, 0, 4))
    link.receive("companion", (1, 192), Heartbeat(18, 8, 0, 0, 4))
    link.receive("other", (2, 1), COPTER)
    connection.send(ParamRequestList(1, 0))
    assert sorted(map(str, link.peers_of(ParamRequestList))) == ["autopilot", "companion"]
    connection.send(command(1, 154))  # an unknown component
    assert sorted(map(str, link.peers_of(CommandLong))) == ["autopilot", "companion"]
    connection.send(Timesync(0, 1), to=2)
    assert link.peers_of(Timesync) == ["other"]


async def test_system_broadcast_goes_to_all_peers_despite_component_0(link: PeersLink, connection: Connection) -> None:
    link.receive("autopilot", (1, 1), COPTER)
    link.receive("companion", (1, 0), Heartbeat(18, 8, 0, 0, 4))
    connection.send(command(1, 0))
    assert sorted(map(str, link.peers_of(CommandLong))) == ["autopilot", "companion"]


async def test_broadcast_and_unknown_targets_go_to_all_peers(link: PeersLink, connection: Connection) -> None:
    link.receive("one", (1, 1), COPTER)
    connection.send(RequestDataStream(9, 1, 0, 4, 1))
    assert link.peers_of(RequestDataStream) == [None]
    connection.send(RequestDataStream(0, 0, 0, 4, 1))
    assert link.peers_of(RequestDataStream) == [None]
    connection.send(COPTER)
    assert link.peers_of(Heartbeat)[-1] is None


async def test_only_heartbeats_make_routes(link: PeersLink, connection: Connection) -> None:
    link.receive("forwarder", (1, 1), ATTITUDE)
    connection.send(command(1, 1))
    assert link.peers_of(CommandLong) == [None]


async def test_vehicle_returns_from_another_port(link: PeersLink, connection: Connection) -> None:
    link.receive("old@host", (1, 1), COPTER)
    async with connect(connection, rates={}) as vehicle:
        with vehicle.subscribe(events.VehicleSilent, events.VehicleRecovered, capacity=9) as received:
            await anyio.sleep(5)
            link.sent.clear()
            link.receive("new@host", (1, 1), COPTER)
            connection.send(command(1, 1))
            assert link.peers_of(CommandLong) == ["new@host"]
            assert type(await received.get(1)) is events.VehicleSilent
            assert type(await received.get(1)) is events.VehicleRecovered
        assert vehicle.heartbeat_age < 1


async def test_returning_client_is_not_a_second_vehicle(link: PeersLink, connection: Connection) -> None:
    """A TCP client's new connection is a new peer; the old one is reported as closed."""
    doubles: list[events.DuplicateSender] = []
    connection.bus.attach_event(events.DuplicateSender, doubles.append)
    attitudes: list[Message] = []
    connection.bus.attach(Attitude, attitudes.append)
    link.receive("old", (1, 1), COPTER)
    link.gone.add("old")
    link.receive("new", (1, 1), ATTITUDE, COPTER)
    connection.send(command(1, 1))
    assert (link.peers_of(CommandLong), len(attitudes), doubles) == (["new"], 1, [])


async def test_many_peers_do_not_evict_the_vehicle(link: PeersLink, connection: Connection) -> None:
    """A scanner, or a program that sends each datagram from a new port."""
    link.receive("vehicle", (1, 1), *[COPTER] * 5)
    for port in range(2 * MAX_PEERS):
        link.receive(port, (250, 1), ATTITUDE)
    assert len(list(connection.statistics())) == MAX_PEERS
    assert connection.counts(1) == (5, 0)


# ---------------------------------------------------------------------------- loss


async def test_loss_is_counted_per_component(link: PeersLink, connection: Connection) -> None:
    link.receive("one", (1, 1), *[ATTITUDE] * 10)
    link.receive("one", (1, 154), GIMBAL)  # its own sequence: no gap in that of the autopilot
    link.receive("one", (1, 1), *[ATTITUDE] * 10, lost=5)
    link.receive("one", (1, 154), GIMBAL, lost=2)
    link.receive("two", (2, 1), *[ATTITUDE] * 3)
    link.receive("two", (2, 1), ATTITUDE, lost=40)
    assert connection.counts(1) == (22, 7)
    assert connection.counts(2) == (4, 40)
    assert connection.counts(3) == (0, 0)


async def test_loss_is_counted_per_peer_of_one_vehicle(link: PeersLink, connection: Connection) -> None:
    """Each has its own sequence; duplicates are delivered once."""
    attitudes: list[Message] = []
    connection.bus.attach(Attitude, attitudes.append)
    link.receive("radio", (1, 1), COPTER)
    link.receive("modem", (1, 1), COPTER)
    for _ in range(10):
        link.receive("radio", (1, 1), ATTITUDE)
        link.receive("modem", (1, 1), ATTITUDE, lost=1)
    assert len(attitudes) == 10
    assert connection.counts(1) == (22, 10)


async def test_loss_is_reported_every_second(link: PeersLink, connection: Connection) -> None:
    link.receive("one", (1, 1), COPTER)
    async with connect(connection, rates={}) as vehicle:
        reports: list[events.LinkReport] = []
        connection.bus.attach_event(events.LinkReport, reports.append)
        for lost in (0, 5, 0):
            await anyio.sleep(0.5)
            link.receive("one", (1, 1), *[ATTITUDE] * 14)
            link.receive("one", (1, 1), ATTITUDE, lost=lost)
            await anyio.sleep(0.5)
        await anyio.sleep(1.1)
        assert [report.loss_percent for report in reports[:4]] == pytest.approx([0, 25, 0, None])
        assert vehicle.link_quality.value.frames_per_s == 0


async def test_system_0_is_never_a_vehicle(link: PeersLink, connection: Connection) -> None:
    unused = from_system_0(FrameEncoder(1, 1).encode(COPTER))
    assert Framer().receive(unused)[0].system_id == 0
    connection.bytes_received(unused, "zero")
    assert connection.heartbeats == {}
    with pytest.raises(ConnectFailed, match="system id 0"):
        async with connect(connection, timeout=2):
            pytest.fail("system 0 is no vehicle")


def from_system_0(frame: bytes) -> bytes:
    """Return a frame of system 0, which our encoder refuses to make."""
    body = frame[1:5] + b"\0" + frame[6:-2]
    return frame[:1] + body + x25(body + bytes((Heartbeat.CRC_EXTRA,))).to_bytes(2, "little")
