"""Unknown senders at a hub: impostors, full tables and forged ids."""

from __future__ import annotations

import asyncio
import math
import random
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import pytest
from hub_stage import COPTER, STATION, Program, SlowLink, settle, until
from test_hub import KEY, virtual
from test_hub_sockets import ORDER, of, to
from test_routing import Stage, order

from aerokit import Signing
from aerokit.connection.frame_receiver import MAX_PEERS, MAX_UNVERIFIED_PEERS
from aerokit.connection.routes import MAX_ROUTES, PEER_TTL_S, ROUTE_TIMEOUT_S
from aerokit.hub import Endpoint, Hub, HubEvent, switch
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, ParamRequestList, RadioStatus
from aerokit.transport import Peer

MAX_CLIENTS = 64

ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def anyio_backend() -> str:
    """Real sockets and the real clock."""
    return "asyncio"


# ----------------------------------------------------------------- senders with the vehicle's ids


@asynccontextmanager
async def udp_hub() -> AsyncIterator[tuple[Hub, list[HubEvent], Program, Program]]:
    """A hub on UDP and TCP, with a live copter on UDP and a station on TCP."""
    events: list[HubEvent] = []
    async with Hub(
        [Endpoint("udpin:127.0.0.1:0", name="radio"), Endpoint("tcpin:127.0.0.1:0", name="stations")]
    ) as hub:
        hub.on_event(events.append)
        async with (
            Program(1, 1, to(of(hub, "radio"), "udpout")) as copter,
            Program(255, 190, to(of(hub, "stations"), "tcp")) as station,
        ):
            copter.send(COPTER)
            await until(lambda: of(hub, "radio").systems == ((1, 1),))
            station.send(STATION)
            await until(lambda: copter.frames)
            yield hub, events, copter, station


@pytest.mark.anyio
async def test_udp_impostors_get_no_orders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three hundred ports, more than the hub's peer limit; the vehicle keeps its entry."""
    monkeypatch.setattr(switch, "ORDER_MAX_AGE_S", math.inf)  # A busy machine may block the event loop.
    async with udp_hub() as (hub, events, copter, station), AsyncExitStack() as stack:
        strangers = [await stack.enter_async_context(Program(1, 1, to(of(hub, "radio"), "udpout"))) for _ in range(300)]
        for count in range(2):
            for number, stranger in enumerate(strangers, 1):
                stranger.send(COPTER)
                if number % 50 == 0:  # a socket of this machine keeps some hundred datagrams at most
                    said = 1 + count * 301 + number
                    await until(lambda: of(hub, "radio").frames_in >= said)  # noqa: B023
            copter.send(ATTITUDE)
            station.send(ORDER)
            await until(lambda: copter.received.count("COMMAND_LONG") == count + 1)  # noqa: B023
        assert not any("COMMAND_LONG" in stranger.received for stranger in strangers)
        assert [event.kind for event in events if event.kind == "duplicate_sender"] == ["duplicate_sender"], (
            "reported once, not 300 times"
        )
        assert of(hub, "radio").dropped["foreign"] == 600
        assert of(hub, "radio").peers <= MAX_PEERS
        assert station.received.count("HEARTBEAT") <= 1, "and their messages are not forwarded"


@pytest.mark.anyio
async def test_silent_tcp_clients_evict_no_active_peer() -> None:
    async with udp_hub() as (hub, events, copter, station):
        port = int(of(hub, "stations").address.rpartition(":")[2])
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MAX_CLIENTS + 5)]
        try:
            await until(lambda: sum(event.kind == "client_joined" for event in events) >= MAX_CLIENTS + 5)
            assert of(hub, "stations").peers == MAX_CLIENTS
            copter.send(ATTITUDE)
            station.send(ORDER)
            await until(lambda: "COMMAND_LONG" in copter.received and "ATTITUDE" in station.received)
            assert not station.is_lost
        finally:
            for _, writer in silent:
                writer.close()


@pytest.mark.anyio
async def test_disconnected_clients_leave_nothing() -> None:
    async with udp_hub() as (hub, events, copter, station):
        router, port = hub._switch.router, int(of(hub, "stations").address.rpartition(":")[2])  # type: ignore[union-attr]
        for number in range(200):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(FrameEncoder(1 + number % 250, 7).encode(STATION))
            await writer.drain()
            writer.close()
        await until(lambda: sum(event.kind == "client_left" for event in events) == 200)
        assert (len(router._ingresses), len(router._senders)) == (2, 2)
        assert len(list(hub._running_endpoints["stations"]._peers)) == 1
        station.send(ORDER)
        await until(lambda: "COMMAND_LONG" in copter.received)


@virtual
async def test_duplicate_sender_gets_nothing_and_passes_once() -> None:
    """No amplification: a frame goes to each other endpoint at most once, and the hub sends no replies."""
    link, station = PeersLink(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]):
        for number in range(10):
            link.send(f"{number}@host", FrameEncoder(100 + number, 1), COPTER)
        await settle()
        link.sent.clear()
        encoder = FrameEncoder(9, 9)
        link.send("stranger@elsewhere", encoder, STATION, ParamRequestList(0, 0), ORDER)
        await settle()
        assert Counter(link.sent) == {(f"{number}@host", kind): 1 for number in range(10) for kind in (0, 21)}


class PeersLink(SlowLink):
    """A listening link in memory whose peers are called "port@host"."""

    def __init__(self) -> None:
        super().__init__("udpin:memory")
        self.sent: list[tuple[Peer, int]] = []

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.sent += [(peer, frame.message_id) for frame in Framer().receive(data)]

    def has_peer(self, peer: Peer) -> bool:
        return peer is not None

    def host_of(self, peer: Peer) -> object:
        return str(peer).rpartition("@")[2]

    def send(self, peer: str, encoder: FrameEncoder, *messages: Message) -> None:
        for message in messages:
            self.receiver.bytes_received(encoder.encode(message), peer)


async def ordered(link: PeersLink, station: Program) -> list[Peer]:
    """Peers that get an order to 1/1."""
    link.sent.clear()
    station.send(ORDER)
    await settle()
    return [peer for peer, message_id in link.sent if message_id == ORDER.ID]


@virtual
async def test_frame_signed_by_hub_is_refused_if_replayed_to_it() -> None:
    """A stranger that hears the radio sends a command back to the hub, which must not sign it again."""
    link, station = PeersLink(), Program(255, 190)
    written: list[bytes] = []
    link.write = lambda data, peer=None: written.append(data)  # type: ignore[method-assign]
    async with station, Hub([Endpoint(link, name="radio", signing=Signing(KEY)), station.endpoint("station")]) as hub:
        vehicle = FrameEncoder(1, 1)
        vehicle.signing = Signing(KEY)
        link.receiver.bytes_received(vehicle.encode(COPTER, time.time()), "14550@copter")
        station.send(STATION, ORDER)
        await settle()
        replayed = tuple(written)
        assert len(replayed) == 2
        written.clear()
        for data in replayed:
            link.receiver.bytes_received(data, "666@stranger")
        await settle()
        assert written == []
        assert hub.endpoints[0].dropped == {"refused": 2}


@virtual
async def test_radio_status_moves_no_route() -> None:
    """Radios send it unsigned, so anyone can forge it."""
    link, station = PeersLink(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="radio"), station.endpoint("station")]):
        link.send("14550@copter", FrameEncoder(1, 1), COPTER)
        await settle()
        await asyncio.sleep(5)
        link.send("666@stranger", FrameEncoder(1, 1), RadioStatus(1, 2, 3, 4, 5, 6, 7))
        assert await ordered(link, station) == ["14550@copter"]


@virtual
async def test_silent_vehicle_is_followed_to_its_new_port() -> None:
    link, station, events = PeersLink(), Program(255, 190), list[HubEvent]()
    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]) as hub:
        hub.on_event(events.append)
        first, second = FrameEncoder(1, 1), FrameEncoder(1, 1)
        link.send("1@drone", first, COPTER)
        link.send("2@drone", second, COPTER, ATTITUDE)
        assert await ordered(link, station) == ["1@drone"]
        assert station.received == ["HEARTBEAT"], "no message of the second sender"
        await asyncio.sleep(ROUTE_TIMEOUT_S + 0.1)
        link.send("2@drone", second, COPTER)
        assert await ordered(link, station) == ["2@drone"]
        assert [event.kind for event in events] == ["duplicate_sender", "route_changed"]
        assert "1/1" in events[1].text
        link.send("1@drone", first, COPTER)
        assert [event.kind for event in events] == ["duplicate_sender", "route_changed", "duplicate_sender"]
        assert await ordered(link, station) == ["2@drone"]


@virtual
async def test_full_endpoint_rejects_new_peer() -> None:
    link, events = PeersLink(), list[HubEvent]()
    async with Hub([Endpoint(link, name="udp")]) as hub:
        hub.on_event(events.append)
        for number in range(MAX_PEERS):
            link.send(f"{number}@host", FrameEncoder(255, 190), STATION)
        newcomer = FrameEncoder(1, 1)
        for _ in range(3):
            link.send("1@drone", newcomer, COPTER)
        assert [event.kind for event in events] == ["peer_rejected"], "reported once"
        assert of(hub, "udp").peers == MAX_PEERS
        assert (1, 1) not in of(hub, "udp").systems
        await asyncio.sleep(PEER_TTL_S + 1)
        link.send("1@drone", newcomer, COPTER)
        assert (1, 1) in of(hub, "udp").systems
        assert of(hub, "udp").peers == MAX_PEERS


@virtual
async def test_noise_sender_is_not_remembered() -> None:
    link = PeersLink()
    async with Hub([Endpoint(link, name="udp")]) as hub:
        link.send("1@drone", FrameEncoder(1, 1), COPTER)
        for number in range(MAX_PEERS + 10):
            link.receiver.bytes_received(b"\xfd\x00 noise", f"{number}@stranger")
        assert of(hub, "udp").peers == 1
        assert of(hub, "udp").systems == ((1, 1),)
        assert len(list(hub._running_endpoints["udp"]._peers)) == 1 + MAX_UNVERIFIED_PEERS


@virtual
async def test_stations_with_shared_ids_both_pass() -> None:
    """Only an autopilot's route is reserved for one peer; the hub forwards messages of two stations with equal ids."""
    link, copter = PeersLink(), Program(1, 1)
    async with copter, Hub([Endpoint(link, name="udp"), copter.endpoint("copter")]):
        copter.send(COPTER)
        await settle()
        encoders = FrameEncoder(255, 190), FrameEncoder(255, 190)
        encoders[1].sequence = 100
        for number, encoder in enumerate(encoders):
            link.send(f"{number}@station", encoder, STATION, ORDER)
        await settle()
        assert copter.received == ["HEARTBEAT", "COMMAND_LONG"] * 2


# ----------------------------------------------------------------------------- forged senders


@pytest.mark.parametrize("message", [COPTER, STATION, ATTITUDE], ids=lambda message: type(message).__name__)
def test_flood_of_senders_keeps_routes_of_known_ones(message: Message) -> None:
    """Three thousand names in the second between two heartbeats."""
    stage = Stage()
    for _ in range(3):
        stage.receive("a", COPTER)
        stage.receive("c", STATION, 255, 190)
        for number in range(3 * MAX_ROUTES):
            stage.now += 1 / (3 * MAX_ROUTES)
            stage.receive("b", message, 2 + number % 250, 1 + number // 250)
        assert stage.receive("c", order(1), 255, 190) == {"a"}
        assert stage.receive("a", order(255, 190)) == {"c"}
    assert len(stage.router._senders) == MAX_ROUTES


def test_silent_sender_makes_room_in_a_full_table() -> None:
    stage = Stage()
    for number in range(MAX_ROUTES):
        stage.receive("b", COPTER, 2 + number % 250, 1 + number // 250)
    assert stage.receive("a", COPTER) == set("bcd"), "forwarded, but not recorded"
    assert stage.receive("c", order(1), 255, 190) == set()
    stage.now += PEER_TTL_S + 1
    stage.receive("a", COPTER)
    assert stage.receive("c", order(1), 255, 190) == {"a"}


# ------------------------------------------------------------------------------------ the rule


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(6))
@virtual
async def test_orders_reach_vehicle_despite_random_impostors(seed: int) -> None:
    """Noise, made-up senders, the vehicle's own name, numbers that go on where it is, from any port and host."""
    rng, link, station = random.Random(seed), PeersLink(), Program(255, 190)
    copter, others = FrameEncoder(1, 1), dict[str, FrameEncoder]()

    def stranger() -> None:
        peer = f"{rng.randrange(400)}@{rng.choice(['drone', 'near', 'far'])}"
        encoder = others.setdefault(f"{peer} {rng.random() < 0.5}", FrameEncoder(1, 1))
        match rng.randrange(6):
            case 0:
                link.receiver.bytes_received(rng.randbytes(40), peer)
            case 1:
                link.send(peer, FrameEncoder(rng.randrange(2, 250), rng.randrange(1, 250)), COPTER)
            case 2:
                link.send(peer, FrameEncoder(255, 190), STATION)
            case 3:
                encoder.sequence = copter.sequence
                link.send(peer, encoder, ATTITUDE)
            case _:
                link.send(peer, encoder, COPTER, ATTITUDE)

    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]):
        link.send("14550@drone", copter, COPTER)
        station.send(STATION)
        for step in range(60):
            await asyncio.sleep(0.25)
            link.send("14550@drone", copter, ATTITUDE, *([COPTER] if step % 4 == 0 else []))
            for _ in range(rng.choice([1, 20, 100])):
                stranger()
            assert await ordered(link, station) == ["14550@drone"]
            station.frames.clear()
            link.send("14550@drone", copter, ORDER.__class__(255, 190, 400, 0, 1, 0, 0, 0, 0, 0, 0))
            await settle()
            assert station.received.count("COMMAND_LONG") == 1, "messages for the station reach it"
