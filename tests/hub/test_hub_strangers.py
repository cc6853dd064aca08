"""Unknown senders at a hub: impostors, full tables and forged ids."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import pytest
from exhaustive import sampled
from hub_stage import COPTER, STATION, Program, SlowLink, settle, until
from test_hub import virtual
from test_hub_sockets import ORDER, of, to
from test_routing import Stage, order

from aerokit.connection.frame_receiver import MAX_PEERS, MAX_UNVERIFIED_PEERS
from aerokit.connection.routes import MAX_ROUTES, PEER_TTL_S, ROUTE_TIMEOUT_S
from aerokit.hub import Endpoint, Hub, HubEvent
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, ParamRequestList
from aerokit.transport import Peer

MAX_CLIENTS = 64

ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def anyio_backend() -> str:
    """Real sockets and the real clock."""
    return "asyncio"


# ---------------------------------------------------------------------- who speaks as the vehicle


@asynccontextmanager
async def udp_hub() -> AsyncIterator[tuple[Hub, list[HubEvent], Program, Program]]:
    """A hub on UDP and TCP, with a live copter on UDP and a station on TCP."""
    told: list[HubEvent] = []
    async with Hub(
        [Endpoint("udpin:127.0.0.1:0", name="radio"), Endpoint("tcpin:127.0.0.1:0", name="stations")]
    ) as hub:
        hub.on_event(told.append)
        async with (
            Program(1, 1, to(of(hub, "radio"), "udpout")) as copter,
            Program(255, 190, to(of(hub, "stations"), "tcp")) as station,
        ):
            copter.say(COPTER)
            await until(lambda: of(hub, "radio").systems == ((1, 1),))
            station.say(STATION)
            await until(lambda: copter.frames)
            yield hub, told, copter, station


@pytest.mark.anyio
async def test_udp_impostors_get_no_orders() -> None:
    """Three hundred ports, as many as the hub has places and more; the vehicle keeps its own."""
    async with udp_hub() as (hub, told, copter, station), AsyncExitStack() as stack:
        strangers = [await stack.enter_async_context(Program(1, 1, to(of(hub, "radio"), "udpout"))) for _ in range(300)]
        for count in range(2):
            for number, stranger in enumerate(strangers, 1):
                stranger.say(COPTER)
                if number % 50 == 0:  # a socket of this machine keeps some hundred datagrams at most
                    said = 1 + count * 301 + number
                    await until(lambda: of(hub, "radio").frames_in >= said)  # noqa: B023
            copter.say(ATTITUDE)
            station.say(ORDER)
            await until(lambda: copter.heard.count("COMMAND_LONG") == count + 1)  # noqa: B023
        assert not any("COMMAND_LONG" in stranger.heard for stranger in strangers)
        assert [event.kind for event in told if event.kind == "duplicate_sender"] == ["duplicate_sender"], (
            "told once, not 300 times"
        )
        assert of(hub, "radio").dropped["foreign"] == 600
        assert of(hub, "radio").peers <= MAX_PEERS
        assert station.heard.count("HEARTBEAT") <= 1, "and what they say goes nowhere"


@pytest.mark.anyio
async def test_silent_tcp_clients_evict_no_active_peer() -> None:
    async with udp_hub() as (hub, told, copter, station):
        port = int(of(hub, "stations").address.rpartition(":")[2])
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MAX_CLIENTS + 5)]
        try:
            await until(lambda: sum(event.kind == "client_joined" for event in told) >= MAX_CLIENTS + 5)
            assert of(hub, "stations").peers == MAX_CLIENTS
            copter.say(ATTITUDE)
            station.say(ORDER)
            await until(lambda: "COMMAND_LONG" in copter.heard and "ATTITUDE" in station.heard)
            assert not station.is_lost
        finally:
            for _, writer in silent:
                writer.close()


@pytest.mark.anyio
async def test_disconnected_clients_leave_nothing() -> None:
    async with udp_hub() as (hub, told, copter, station):
        router, port = hub._switch.router, int(of(hub, "stations").address.rpartition(":")[2])  # type: ignore[union-attr]
        for number in range(200):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(FrameEncoder(1 + number % 250, 7).encode(STATION))
            await writer.drain()
            writer.close()
        await until(lambda: sum(event.kind == "client_left" for event in told) == 200)
        assert (len(router._nodes), len(router._senders)) == (2, 2)
        assert len(list(hub._attachments["stations"]._peers)) == 1
        station.say(ORDER)
        await until(lambda: "COMMAND_LONG" in copter.heard)


@virtual
async def test_duplicate_sender_gets_nothing_and_passes_once() -> None:
    """No amplification: a frame goes to each other place at most once, and the hub answers nothing."""
    link, station = PeersLink(), Program(255, 190)
    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]):
        for number in range(10):
            link.say(f"{number}@host", FrameEncoder(100 + number, 1), COPTER)
        await settle()
        link.sent.clear()
        encoder = FrameEncoder(9, 9)
        link.say("stranger@elsewhere", encoder, STATION, ParamRequestList(0, 0), ORDER)
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

    def say(self, peer: str, encoder: FrameEncoder, *messages: Message) -> None:
        for message in messages:
            self.receiver.bytes_received(encoder.encode(message), peer)


async def ordered(link: PeersLink, station: Program) -> list[Peer]:
    """Peers that get an order to 1/1."""
    link.sent.clear()
    station.say(ORDER)
    await settle()
    return [peer for peer, message_id in link.sent if message_id == ORDER.ID]


@virtual
async def test_silent_vehicle_is_followed_to_its_new_port() -> None:
    link, station, told = PeersLink(), Program(255, 190), list[HubEvent]()
    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]) as hub:
        hub.on_event(told.append)
        first, second = FrameEncoder(1, 1), FrameEncoder(1, 1)
        link.say("1@drone", first, COPTER)
        link.say("2@drone", second, COPTER, ATTITUDE)
        assert await ordered(link, station) == ["1@drone"]
        assert station.heard == ["HEARTBEAT"], "nothing of the second one's"
        await asyncio.sleep(ROUTE_TIMEOUT_S + 0.1)
        link.say("2@drone", second, COPTER)
        assert await ordered(link, station) == ["2@drone"]
        assert [event.kind for event in told] == ["duplicate_sender", "route_changed"]
        assert "1/1" in told[1].text
        link.say("1@drone", first, COPTER)
        assert [event.kind for event in told] == ["duplicate_sender", "route_changed", "duplicate_sender"]
        assert await ordered(link, station) == ["2@drone"]


@virtual
async def test_full_endpoint_rejects_new_peer() -> None:
    link, told = PeersLink(), list[HubEvent]()
    async with Hub([Endpoint(link, name="udp")]) as hub:
        hub.on_event(told.append)
        for number in range(MAX_PEERS):
            link.say(f"{number}@host", FrameEncoder(255, 190), STATION)
        newcomer = FrameEncoder(1, 1)
        for _ in range(3):
            link.say("1@drone", newcomer, COPTER)
        assert [event.kind for event in told] == ["peer_rejected"], "told once"
        assert of(hub, "udp").peers == MAX_PEERS
        assert (1, 1) not in of(hub, "udp").systems
        await asyncio.sleep(PEER_TTL_S + 1)
        link.say("1@drone", newcomer, COPTER)
        assert (1, 1) in of(hub, "udp").systems
        assert of(hub, "udp").peers == MAX_PEERS


@virtual
async def test_noise_sender_is_not_remembered() -> None:
    link = PeersLink()
    async with Hub([Endpoint(link, name="udp")]) as hub:
        link.say("1@drone", FrameEncoder(1, 1), COPTER)
        for number in range(MAX_PEERS + 10):
            link.receiver.bytes_received(b"\xfd\x00 noise", f"{number}@stranger")
        assert of(hub, "udp").peers == 1
        assert of(hub, "udp").systems == ((1, 1),)
        assert len(list(hub._attachments["udp"]._peers)) == 1 + MAX_UNVERIFIED_PEERS


@virtual
async def test_stations_with_shared_ids_both_pass() -> None:
    """Only an autopilot's place is kept for one peer: a hub passes on what two stations of the same ids say."""
    link, copter = PeersLink(), Program(1, 1)
    async with copter, Hub([Endpoint(link, name="udp"), copter.endpoint("copter")]):
        copter.say(COPTER)
        await settle()
        encoders = FrameEncoder(255, 190), FrameEncoder(255, 190)
        encoders[1].sequence = 100
        for number, encoder in enumerate(encoders):
            link.say(f"{number}@station", encoder, STATION, ORDER)
        await settle()
        assert copter.heard == ["HEARTBEAT", "COMMAND_LONG"] * 2


# ---------------------------------------------------------------------------- made-up senders


@pytest.mark.parametrize("message", [COPTER, STATION, ATTITUDE], ids=lambda message: type(message).__name__)
def test_flood_of_senders_keeps_routes_of_known_ones(message: Message) -> None:
    """Three thousand names in the second between two heartbeats."""
    stage = Stage()
    for _ in range(3):
        stage.hear("a", COPTER)
        stage.hear("c", STATION, 255, 190)
        for number in range(3 * MAX_ROUTES):
            stage.now += 1 / (3 * MAX_ROUTES)
            stage.hear("b", message, 2 + number % 250, 1 + number // 250)
        assert stage.hear("c", order(1), 255, 190) == {"a"}
        assert stage.hear("a", order(255, 190)) == {"c"}
    assert len(stage.router._senders) == MAX_ROUTES


def test_silent_sender_makes_room_in_a_full_table() -> None:
    stage = Stage()
    for number in range(MAX_ROUTES):
        stage.hear("b", COPTER, 2 + number % 250, 1 + number // 250)
    assert stage.hear("a", COPTER) == set("bcd"), "passed on, but not remembered"
    assert stage.hear("c", order(1), 255, 190) == set()
    stage.now += PEER_TTL_S + 1
    stage.hear("a", COPTER)
    assert stage.hear("c", order(1), 255, 190) == {"a"}


# ------------------------------------------------------------------------------------ the rule


@pytest.mark.parametrize("seed", sampled(range(6), 6))
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
                link.say(peer, FrameEncoder(rng.randrange(2, 250), rng.randrange(1, 250)), COPTER)
            case 2:
                link.say(peer, FrameEncoder(255, 190), STATION)
            case 3:
                encoder.sequence = copter.sequence
                link.say(peer, encoder, ATTITUDE)
            case _:
                link.say(peer, encoder, COPTER, ATTITUDE)

    async with station, Hub([Endpoint(link, name="udp"), station.endpoint("station")]):
        link.say("14550@drone", copter, COPTER)
        station.say(STATION)
        for step in range(60):
            await asyncio.sleep(0.25)
            link.say("14550@drone", copter, ATTITUDE, *([COPTER] if step % 4 == 0 else []))
            for _ in range(rng.choice([1, 20, 100])):
                stranger()
            assert await ordered(link, station) == ["14550@drone"]
            station.frames.clear()
            link.say("14550@drone", copter, ORDER.__class__(255, 190, 400, 0, 1, 0, 0, 0, 0, 0, 0))
            await settle()
            assert station.heard.count("COMMAND_LONG") == 1, "what is for the station reaches it"
