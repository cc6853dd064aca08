"""Frames that arrive together are forwarded like frames that arrive alone."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

import pytest
from hub_stage import COPTER, STATION, SlowLink, settle
from test_hub import KEY, ORDER, UNKNOWN, virtual
from test_routing import TARGETS, Stage

from aerokit import Signing
from aerokit.connection.routes import ROUTE_TIMEOUT_S
from aerokit.hub import Endpoint, Hub, HubEvent
from aerokit.hub.port import MAX_JOINED_BYTES
from aerokit.hub.routing import ForwardingPlan, Router
from aerokit.hub.senders import DUPLICATE_WINDOW_S
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, CommandAck, ParamRequestList, RadioStatus, Statustext, SystemTime
from aerokit.transport import Peer

PEER = ("10.0.0.1", 14550)
OTHER_PEER = ("10.0.0.2", 14550)


class BurstLink(SlowLink):
    """A link that reads bursts of datagrams from several peers, like ``udpin:``."""

    @property
    def reports_bursts(self) -> bool:
        return True

    def has_peer(self, peer: Peer) -> bool:
        return peer is not None

    def read(self, *datagrams: bytes) -> None:
        """Deliver one burst of a peer."""
        self.read_from([(PEER, datagram) for datagram in datagrams])

    def read_from(self, burst: Sequence[tuple[Peer, bytes]]) -> None:
        for peer, datagram in burst:
            self.receiver.bytes_received(datagram, peer)
        self.receiver.burst_ended()


class LoneLink(BurstLink):
    """A link that delivers each datagram in a burst of its own."""

    def read_from(self, burst: Sequence[tuple[Peer, bytes]]) -> None:
        for one in burst:
            super().read_from([one])


@asynccontextmanager
async def known_vehicle(
    station: SlowLink | None = None, **fields: Any
) -> AsyncIterator[tuple[Hub, BurstLink, SlowLink, FrameEncoder]]:
    """A hub that knows a vehicle; links of vehicles and station, and the vehicle's encoder.

    The station's link starts with nothing written. ``fields`` are those of its endpoint.
    """
    vehicles, station, vehicle = BurstLink(), station or SlowLink(), FrameEncoder(1, 1)
    async with Hub([Endpoint(vehicles, name="a"), Endpoint(station, name="b", **fields)]) as hub:
        vehicles.read(vehicle.encode(COPTER))
        station.written.clear()
        yield hub, vehicles, station, vehicle


def frames_of(link: SlowLink) -> list[bytes]:
    framer = Framer()
    framer.keep_unknown = True
    return [frame.raw for frame in framer.receive(b"".join(link.written))]


def encoded(encoder: FrameEncoder, *messages: Message) -> list[bytes]:
    return [encoder.encode(message) for message in messages]


def telemetry(count: int) -> list[Message]:
    return [SystemTime(number, number) for number in range(count)]


# --------------------------------------------------------------------------- what leaves, by example


@virtual
async def test_mixed_destinations_of_one_datagram_are_separated() -> None:
    vehicles, one, two = BurstLink(), SlowLink("slow:1"), SlowLink("slow:2")
    async with Hub([Endpoint(vehicles, name="a"), Endpoint(one, name="b"), Endpoint(two, name="c")]):
        vehicle = FrameEncoder(1, 1)
        one.receiver.bytes_received(FrameEncoder(255, 190).encode(STATION), None)
        vehicles.read(vehicle.encode(COPTER))
        await settle()
        one.written.clear()
        two.written.clear()
        first, answer, last = encoded(vehicle, telemetry(1)[0], CommandAck(400, 0, 0, 0, 255, 190), Statustext(6, "x"))
        vehicles.read(first + answer + last)
        assert one.written == [first + answer + last]
        assert two.written == [first + last]


@virtual
async def test_burst_leaves_in_one_unchanged_datagram() -> None:
    async with known_vehicle() as (hub, vehicles, station, vehicle):
        old = FrameEncoder(1, 1, version=1)
        old.sequence = 1
        vehicle.sequence = 2
        frames = [old.encode(Statustext(6, "x")), *encoded(vehicle, *telemetry(4))]
        vehicles.read(*frames[:3], frames[3] + frames[4])
        assert station.written == [b"".join(frames)]
        statistics = hub.endpoints[1]
        assert (statistics.frames_out, statistics.bytes_out) == (6, sum(map(len, frames)) + 21)


@virtual
async def test_long_burst_leaves_in_bounded_datagrams() -> None:
    async with known_vehicle() as (hub, vehicles, station, vehicle):
        frames = encoded(vehicle, *[Attitude(number, 1, 2, 3, 4, 5, 6) for number in range(200)])
        vehicles.read(*frames[:100], b"".join(frames[100:]))
        assert b"".join(station.written) == b"".join(frames)
        assert max(map(len, station.written)) <= MAX_JOINED_BYTES
        assert all(len(datagram) % len(frames[0]) == 0 for datagram in station.written), "no frame is cut"
        assert hub.endpoints[1].frames_out == 201


@virtual
async def test_malformed_datagram_between_good_ones_is_dropped() -> None:
    async with known_vehicle() as (hub, vehicles, station, vehicle):
        good = encoded(vehicle, *telemetry(5))
        damaged = good[1][:-1] + bytes((good[1][-1] ^ 1,))
        vehicles.read(good[0], damaged, good[2] + b"noise" + good[3], good[4])
        assert frames_of(station) == [good[0], *good[2:]]
        assert hub.endpoints[0].bad_bytes == len(damaged) + 5
        assert hub.endpoints[1].bytes_out == sum(map(len, frames_of(station))) + 21


@virtual
async def test_halves_of_a_frame_leave_together() -> None:
    async with known_vehicle() as (_, vehicles, station, vehicle):
        frames = encoded(vehicle, *telemetry(4))
        stream = b"".join(frames)
        cuts = 5, len(frames[0]) + 5, len(frames[0] + frames[1]), len(stream)
        for begin, end in zip((0, *cuts), cuts, strict=False):
            vehicles.read(stream[begin:end])
        assert b"".join(station.written) == stream
        assert [len(Framer().receive(datagram)) for datagram in station.written] == [1, 1, 2]


@virtual
async def test_noise_after_a_completed_frame_is_not_forwarded() -> None:
    """The noise is as long as the part of the frame that was read before."""
    async with known_vehicle() as (_, vehicles, station, vehicle):
        (frame,) = encoded(vehicle, *telemetry(1))
        vehicles.read(frame[:7])
        vehicles.read(frame[7:] + bytes(7))
        assert station.written == [frame]


@virtual
async def test_vehicle_gets_single_frames_of_a_burst() -> None:
    stations, vehicle = BurstLink(), SlowLink()
    async with Hub([Endpoint(stations, name="a"), Endpoint(vehicle, name="b")]):
        vehicle.receiver.bytes_received(FrameEncoder(1, 1).encode(COPTER), None)
        station = FrameEncoder(255, 190)
        stations.read(station.encode(STATION))
        await settle()
        vehicle.written.clear()
        frames = encoded(station, ORDER, ParamRequestList(1, 1), STATION)
        stations.read(*frames)
        assert vehicle.written == frames


@virtual
async def test_frames_of_full_link_are_queued_singly() -> None:
    async with known_vehicle(SlowLink("serial:x")) as (hub, vehicles, station, vehicle):
        station.unsent = 10_000
        frames = encoded(vehicle, Statustext(6, "one"), *telemetry(3), Statustext(6, "two"))
        vehicles.read(*frames)
        statistics = hub.endpoints[1]
        assert (statistics.waiting, statistics.dropped["superseded"], station.written) == (3, 2, [])


@virtual
async def test_signing_link_signs_each_frame_of_a_burst() -> None:
    async with known_vehicle(signing=Signing(KEY)) as (_, vehicles, station, vehicle):
        vehicles.read(*encoded(vehicle, *telemetry(3)))
        checker = Signing(KEY)
        received = Framer().receive(b"".join(station.written))
        assert [checker.check(frame, 1e9) is None for frame in received] == [True] * 3


@virtual
async def test_signatures_of_a_burst_are_removed() -> None:
    vehicles, station = BurstLink(), SlowLink()
    signed = Endpoint(vehicles, name="a", signing=Signing(KEY))
    async with Hub([signed, Endpoint(station, name="b")]):
        vehicle = FrameEncoder(1, 1)
        vehicle.signing = Signing(KEY)
        vehicles.read(*(vehicle.encode(message, time.time()) for message in (COPTER, *telemetry(3))))
        assert [len(frame.signature) for frame in Framer().receive(b"".join(station.written))] == [0] * 4


# --------------------------------------------------------------------------- links that close


@virtual
async def test_port_that_closes_in_mid_burst_gets_nothing() -> None:
    """A program that hears of a loop closes the port to which an earlier frame of the same burst goes."""
    vehicles, one, two = BurstLink(), SlowLink("slow:1"), SlowLink("slow:2")
    async with Hub([Endpoint(vehicles, name="a"), Endpoint(one, name="b"), Endpoint(two, name="c")]) as hub:
        vehicle = FrameEncoder(1, 1)
        vehicles.read(vehicle.encode(COPTER))
        frames = encoded(vehicle, *telemetry(12))
        vehicles.read(*frames[:10])
        await asyncio.sleep(DUPLICATE_WINDOW_S + 1)
        for link in (vehicles, one, two):
            link.written.clear()

        def close_port(event: HubEvent) -> None:
            if event.kind == "loop":
                hub._running_endpoints["b"]._on_down()

        hub.on_event(close_port)
        new = FrameEncoder(255, 190).encode(STATION)
        two.receiver.bytes_received(new + b"".join(frames[:10]), None)
        await settle()
        assert not hub._running_endpoints["b"].is_open, "the loop was reported"
        assert new in frames_of(vehicles)
        vehicles.read(*frames[10:])
        assert one.written == []
        assert two.written == [b"".join(frames[10:])]


@virtual
async def test_port_that_closes_while_its_frames_are_checked() -> None:
    """A program that hears of a second sender with the same ids closes the endpoint."""
    kinds: list[str] = []
    vehicles = BurstLink()
    async with Hub([Endpoint(vehicles, name="a"), Endpoint(SlowLink(), name="b")]) as hub:
        vehicle, twin = FrameEncoder(1, 1), FrameEncoder(1, 1)
        vehicles.read(vehicle.encode(COPTER))

        def close(event: HubEvent) -> None:
            kinds.append(event.kind)
            if event.kind == "duplicate_sender":
                hub._running_endpoints["a"]._on_down()

        hub.on_event(close)
        while "duplicate_sender" not in kinds:
            vehicles.read(vehicle.encode(COPTER))
            vehicles.read_from([(OTHER_PEER, twin.encode(COPTER))])
        assert kinds == ["duplicate_sender"]


@virtual
async def test_frames_before_the_loss_of_a_link_are_forwarded() -> None:
    async with known_vehicle() as (hub, vehicles, station, vehicle):
        frames = encoded(vehicle, *telemetry(2))
        for frame in frames:
            vehicles.receiver.bytes_received(frame, PEER)
        hub._running_endpoints["a"]._on_down()  # as after a read error in mid-burst
        await settle()
        assert frames_of(station) == frames


# --------------------------------------------------------------------------- equal to single frames


def damaged(chance: random.Random, raw: bytes) -> bytes:
    """A datagram that was cut, has a wrong byte, or has noise around it; usually none of them."""
    kind = chance.randrange(12)
    if kind == 0:
        return raw[: chance.randrange(1, len(raw))]
    if kind == 1:
        at = chance.randrange(len(raw))
        return raw[:at] + bytes((raw[at] ^ 1 << chance.randrange(8),)) + raw[at + 1 :]
    if kind == 2:
        return chance.randbytes(chance.randrange(4)) + raw + chance.randbytes(chance.randrange(4))
    return raw


def random_bursts(chance: random.Random) -> list[list[tuple[Peer, bytes]]]:
    """Bursts of two peers: vehicles and a station, old and new frames, copies, unknown messages and damage."""
    encoders = {
        PEER: [FrameEncoder(1, 1), FrameEncoder(1, 100), FrameEncoder(2, 1, version=1)],
        OTHER_PEER: [FrameEncoder(255, 190), FrameEncoder(3, 1)],
    }
    makers: list[Callable[[], Message]] = [
        lambda: SystemTime(chance.getrandbits(30), 7),
        lambda: Statustext(6, "text"),
        lambda: RadioStatus(1, 2, 3, 4, 5, 6, 7),
        lambda: COPTER,
        lambda: STATION,
        lambda: CommandAck(400, 0, 0, 0, 255, 190),
        lambda: ParamRequestList(chance.choice((0, 1, 9)), 1),
    ]
    sent: list[bytes] = [UNKNOWN]
    bursts: list[list[tuple[Peer, bytes]]] = []
    for _ in range(40):
        peers, burst = chance.choice(((PEER,), (PEER, PEER, OTHER_PEER))), list[tuple[Peer, bytes]]()
        for _ in range(chance.randrange(1, 12)):
            peer = chance.choice(peers)
            raws = [
                chance.choice(encoders[peer]).encode(chance.choice(makers)()) for _ in range(chance.choice((1, 1, 4)))
            ]
            sent += raws
            if chance.random() < 0.05:
                raws.append(chance.choice(sent[-20:]))
            burst.append((peer, damaged(chance, b"".join(raws))))
        bursts.append(burst)
    return bursts


async def outcome(link: BurstLink, bursts: list[list[tuple[Peer, bytes]]], **fields: Any) -> list[object]:
    """Frames that left at each endpoint, and all counters, after these bursts."""
    one, two = BurstLink("slow:1"), SlowLink("slow:2")
    events: list[str] = []
    async with Hub([Endpoint(link, name="a"), Endpoint(one, name="b"), Endpoint(two, name="c", **fields)]) as hub:
        hub.on_event(lambda event: events.append(f"{event.kind} {event.text}"))
        two.receiver.bytes_received(FrameEncoder(9, 1).encode(COPTER), None)
        one.read(FrameEncoder(254, 190).encode(STATION))
        for burst in bursts:
            link.read_from(burst)
            await settle()
        return [
            *(sorted(frames_of(each)) if each is link else frames_of(each) for each in (link, one, two)),
            *(str(statistics) for statistics in hub.endpoints),
            events,
        ]


@pytest.mark.sampled(5)
@pytest.mark.parametrize("seed", range(20))
def test_burst_has_the_outcome_of_single_datagrams(seed: int) -> None:
    filters: tuple[dict[str, Any], ...] = {}, {"rates": {"SYSTEM_TIME": 10}}, {"block": ("STATUSTEXT",)}

    @virtual
    async def compare() -> None:
        bursts = random_bursts(random.Random(seed))
        together, alone = [
            await outcome(link, bursts, **filters[seed % 3]) for link in (BurstLink("s:0"), LoneLink("s:0"))
        ]
        assert together == alone
        assert len(together[1]) > 100  # type: ignore[arg-type]

    compare()


@pytest.mark.parametrize("seed", range(5))
def test_plans_of_a_burst_equal_plans_of_single_frames(seed: int) -> None:
    chance = random.Random(seed)
    stages = Stage(), Stage()
    sent: list[bytes] = []
    encoders = [FrameEncoder(system, component) for system in (1, 2) for component in (1, 190)]
    makers = [COPTER, STATION, ParamRequestList(1, 1), Statustext(6, "x"), RadioStatus(1, 2, 3, 4, 5, 6, 7)]
    reasons = set()
    for _ in range(300):
        name, now = chance.choice("aaabcd"), stages[0].now + chance.choice((0.001, 0.1, 2.0))
        sent += [chance.choice(encoders).encode(chance.choice(makers)) for _ in range(chance.randrange(4))]
        raws = [chance.choice(sent[-12:]) for _ in range(chance.randrange(1, 9))] if sent else [UNKNOWN]
        if chance.random() < 0.4:
            raws = sent[-len(raws) :] or raws
        frames = [Frame.parse(raw) for raw in raws]
        late = [frame for frame in frames if chance.random() < 0.02]
        both: list[list[ForwardingPlan[str]]] = []
        for number, stage in enumerate(stages):
            stage.now = now
            node, router = stage.nodes[name], stage.router
            both.append(
                router.route_all(node, frames, now, late)
                if number
                else [router.route(node, frame, now, is_out_of_order=frame in late) for frame in frames]
            )
        for plan, other in zip(*both, strict=True):
            assert (plan.outs, plan.rate_limited, plan.reason, plan.key) == (
                other.outs,
                other.rate_limited,
                other.reason,
                other.key,
            )
            reasons.add(plan.reason)
        one, two = stages
        reasons |= {"echo"} if one.nodes[name].echoes else set()
        assert one.nodes[name].echoes == two.nodes[name].echoes
        assert one.router._recent.newer == two.router._recent.newer
        assert [sender.received_at for sender in one.router._senders.values()] == [
            sender.received_at for sender in two.router._senders.values()
        ]
    assert {"", "duplicate", "echo"} <= reasons


def test_plans_follow_a_removed_port_within_a_burst() -> None:
    router: Router[str] = Router(TARGETS, lambda port, number: 0.0)
    nodes = {name: router.add(name) for name in "abc"}
    router.on_autopilot = lambda port: router.remove(nodes["c"])
    encoder = FrameEncoder(1, 1)
    frames = [Frame.parse(encoder.encode(message)) for message in (*telemetry(2), COPTER, *telemetry(2))]
    plans = router.route_all(nodes["a"], frames, 1.0, [])
    assert [plan.outs for plan in plans] == [("b", "c"), ("b", "c"), ("b",), ("b",), ("b",)]


def test_new_frame_offsets_an_echo_of_the_same_burst() -> None:
    """The vehicle has moved to another radio, which repeats one of its earlier frames."""
    stage = Stage()
    encoder, node = FrameEncoder(1, 1), stage.nodes["c"]
    old, *new = [encoder.encode(Statustext(6, str(number))) for number in range(4)]
    stage.pass_on("a", old)
    stage.now += ROUTE_TIMEOUT_S + 1
    for raw in new[:2]:
        stage.pass_on("c", raw)
    stage.router.route_all(node, [Frame.parse(old)], stage.now, [])
    assert list(node.echoes.values()) == [1]
    node.echoes.clear()
    stage.now += DUPLICATE_WINDOW_S + 1
    stage.router.route_all(node, [Frame.parse(old), Frame.parse(new[2])], stage.now, [])
    assert node.echoes == {}
