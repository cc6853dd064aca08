"""The rules of routing, one by one, and on random networks with circles."""

from __future__ import annotations

import heapq
import random
from collections import Counter, defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.connection.routes import MAX_ROUTES, ROUTE_TIMEOUT_S
from aerokit.hub.message_rules import TargetFields
from aerokit.hub.routing import MAX_PLANS, Ingress, Router
from aerokit.hub.senders import DUPLICATE_WINDOW_S, MAX_RECENT_FRAMES
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import (
    Attitude,
    CommandLong,
    Heartbeat,
    ParamRequestList,
    RadioStatus,
    SetupSigning,
    Statustext,
)

TARGETS = TargetFields(STANDARD)
COPTER = Heartbeat(2, 3, 81, 0, 3)
CAMERA = Heartbeat(30, 8, 0, 0, 3)
STATION = Heartbeat(6, 8, 0, 0, 4)
UNKNOWN = bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34"


def order(system: int, component: int = 1) -> CommandLong:
    return CommandLong(system, component, 400, 0, 1, 0, 0, 0, 0, 0, 0)


class Stage:
    """A router with ports a, b, c, d without filters, and senders with their own counters."""

    def __init__(self) -> None:
        self.wishes: dict[tuple[str, int], float | None] = {}
        self.router: Router[str] = Router(TARGETS, lambda port, number: self.wishes.get((port, number), 0.0))
        self.nodes: dict[str, Ingress[str]] = {name: self.router.add(name) for name in "abcd"}
        self.encoders: dict[tuple[str, int, int], FrameEncoder] = {}
        self.now = 100.0

    def receive(self, port: str, message: Message, system: int = 1, component: int = 1) -> set[str]:
        """Ports that get the frame."""
        key = port, system, component
        encoder = self.encoders.setdefault(key, FrameEncoder(system, component))
        return self.pass_on(port, encoder.encode(message))

    def pass_on(self, port: str, raw: bytes, *, is_out_of_order: bool = False) -> set[str]:
        plan = self.router.route(self.nodes[port], Frame.parse(raw), self.now, is_out_of_order=is_out_of_order)
        self.reason, self.rate_limited = plan.reason, plan.rate_limited
        assert len(set(plan.outs)) == len(plan.outs)
        return set(plan.outs)


@pytest.fixture
def stage() -> Stage:
    return Stage()


def test_broadcast_goes_to_all_other_ports(stage: Stage) -> None:
    assert stage.receive("a", COPTER) == set("bcd")
    assert stage.receive("a", ParamRequestList(0, 0)) == set("bcd")
    assert stage.receive("a", ParamRequestList(0, 1)) == set("bcd")


def test_targeted_message_goes_to_its_port(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", STATION, 255, 190)
    assert stage.receive("b", order(1), 255, 190) == {"a"}
    assert stage.receive("b", order(1, 0), 255, 190) == {"a"}
    assert stage.receive("a", order(255, 190)) == {"b"}


def test_message_for_unknown_target_is_dropped(stage: Stage) -> None:
    assert stage.receive("a", order(7)) == set()
    assert stage.reason == "no_route"


def test_unknown_component_is_reached_by_its_system(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", CAMERA, 1, 100)
    assert stage.receive("c", order(1, 154), 255, 190) == {"a", "b"}
    assert stage.receive("c", order(1, 0), 255, 190) == {"a", "b"}
    assert stage.receive("c", order(1, 100), 255, 190) == {"b"}
    assert stage.receive("c", order(1, 1), 255, 190) == {"a"}
    assert stage.receive("b", order(1, 1), 1, 100) == {"a"}


def test_radio_status_makes_and_moves_no_route(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.now += 10
    stage.receive("b", RadioStatus(0, 0, 0, 0, 0, 0, 0))
    stage.receive("b", RadioStatus(0, 0, 0, 0, 0, 0, 0), 7)
    assert stage.receive("c", order(1), 255, 190) == {"a"}
    assert stage.receive("c", order(7), 255, 190) == set()


def test_frame_never_goes_back(stage: Stage) -> None:
    stage.receive("a", COPTER)
    assert stage.receive("a", order(1), 255, 190) == set()
    assert stage.reason == ""


def test_ground_stations_with_shared_ids_all_receive(stage: Stage) -> None:
    stage.receive("b", STATION, 255, 190)
    stage.receive("c", STATION.__class__(6, 8, 0, 1, 4), 255, 190)
    assert stage.receive("a", order(255, 190)) == {"b", "c"}


def test_vehicle_on_two_links_gets_an_order_once(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", Heartbeat(2, 3, 81, 5, 3))
    assert stage.receive("c", order(1), 255, 190) == {"a"}
    assert stage.receive("c", order(1, 0), 255, 190) == {"a"}
    stage.now += ROUTE_TIMEOUT_S + 0.1
    stage.receive("b", Heartbeat(2, 3, 81, 6, 3))
    assert stage.receive("c", order(1), 255, 190) == {"b"}
    stage.receive("a", Heartbeat(2, 3, 81, 7, 3))  # it is back; there is no need to change again
    assert stage.receive("c", order(1), 255, 190) == {"b"}
    stage.router.remove(stage.nodes["b"])
    assert stage.receive("c", order(1), 255, 190) == {"a"}


def test_station_with_ids_of_vehicle_gets_no_orders(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", STATION)
    assert stage.receive("c", order(1), 255, 190) == {"a"}
    assert stage.receive("c", order(1, 0), 255, 190) == {"a"}
    stage.now += ROUTE_TIMEOUT_S + 0.1
    stage.receive("b", STATION)
    assert stage.receive("c", order(1), 255, 190) == {"a", "b"}  # The route to a has timed out.


@pytest.mark.parametrize("other", [STATION, CAMERA])
def test_autopilot_has_priority_over_earlier_sender_with_its_ids(other: Heartbeat, stage: Stage) -> None:
    stage.receive("b", other)
    for port in "aba":
        stage.receive(port, COPTER if port == "a" else other)
        stage.receive("d", Heartbeat(2, 3, 81, 5, 3))  # the second link of the vehicle
    assert stage.receive("c", order(1), 255, 190) == {"a"}


def test_copy_at_other_port_is_dropped_without_effect(stage: Stage) -> None:
    raw = FrameEncoder(1, 1).encode(COPTER)
    assert stage.pass_on("a", raw) == set("bcd")
    for port in "bcd":
        assert stage.pass_on(port, raw) == set()
        assert stage.reason == "duplicate"
    assert stage.receive("c", order(1), 255, 190) == {"a"}
    assert stage.router.senders_at(stage.nodes["b"]) == []


def test_repeated_frame_is_forwarded_once(stage: Stage) -> None:
    raw = FrameEncoder(1, 1).encode(COPTER)
    assert stage.pass_on("a", raw) == set("bcd")
    assert stage.pass_on("a", raw, is_out_of_order=True) == set()
    # An equal frame in sequence is a new frame: the sender's sequence numbers have wrapped.
    assert stage.pass_on("a", raw) == set("bcd")


def test_equal_frame_later_is_another_frame(stage: Stage) -> None:
    raw = FrameEncoder(1, 1).encode(COPTER)
    stage.pass_on("a", raw)
    stage.now += 2 * DUPLICATE_WINDOW_S + 0.1
    assert stage.pass_on("b", raw) == set("acd")


def test_duplicate_window_has_at_least_its_length(stage: Stage) -> None:
    encoder = FrameEncoder(1, 1)
    for _ in range(50):
        raw = encoder.encode(COPTER)
        stage.pass_on("a", raw)
        stage.now += DUPLICATE_WINDOW_S - 0.01
        assert stage.pass_on("b", raw) == set()


def test_removed_port_is_forgotten(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", STATION, 255, 190)
    assert stage.receive("b", order(1), 255, 190) == {"a"}
    stage.router.remove(stage.nodes["a"])
    assert stage.receive("b", order(1), 255, 190) == set()
    assert stage.reason == "no_route"
    assert stage.receive("b", STATION, 255, 190) == {"c", "d"}


def test_added_port_gets_broadcasts(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.router.add("e")
    assert stage.receive("a", COPTER) == set("bcde")


def test_keys_are_dropped(stage: Stage) -> None:
    stage.receive("a", COPTER)
    assert stage.receive("b", SetupSigning(1, 1, bytes(32), 0), 255, 190) == set()
    assert stage.reason == "secret"


def test_radio_status_does_not_go_to_vehicles(stage: Stage) -> None:
    stage.receive("a", COPTER)
    stage.receive("b", STATION, 255, 190)
    stage.receive("d", Heartbeat(2, 12, 0, 0, 3), 2, 1)
    assert stage.receive("a", RadioStatus(0, 0, 0, 0, 0, 0, 0), 51, 68) == {"b", "c"}


def test_unknown_messages_of_known_senders_are_forwarded(stage: Stage) -> None:
    assert stage.pass_on("a", UNKNOWN) == set()
    assert stage.reason == "unknown"
    stage.receive("a", COPTER)
    assert stage.pass_on("a", UNKNOWN) == set("bcd")
    assert stage.pass_on("b", UNKNOWN) == set()


def test_ports_filter_messages(stage: Stage) -> None:
    stage.wishes = {("b", Attitude.ID): None, ("c", Attitude.ID): 0.5, ("c", CommandLong.ID): 0.5}
    assert stage.receive("a", Attitude(0, 0, 0, 0, 0, 0, 0)) == {"d"}
    assert stage.rate_limited == (("c", 0.5),)
    stage.receive("c", COPTER, 3)
    assert stage.receive("a", order(3)) == {"c"}  # targeted messages are not rate-limited
    stage.wishes[("c", CommandLong.ID)] = None
    stage.router.forget_plans()
    assert stage.receive("a", order(3)) == set()


def test_vehicle_is_reported_once_per_port(stage: Stage) -> None:
    events: list[str] = []
    stage.router.on_autopilot = events.append
    for _ in range(3):
        stage.receive("a", COPTER)
        stage.receive("b", STATION, 255, 190)
        stage.receive("c", CAMERA, 1, 100)
    assert events == ["a"]


@pytest.mark.exhaustive
def test_flooded_tables_affect_no_known_sender(stage: Stage) -> None:
    stage.receive("a", COPTER)
    for number in range(3 * MAX_ROUTES):
        stage.now += 0.001
        stage.receive("b", Statustext(6, "x"), 2 + number % 250, number // 250)
        if number % 100 == 0:
            stage.receive("a", COPTER)
    assert len(stage.router._senders) <= MAX_ROUTES
    assert stage.receive("c", order(1), 255, 190) == {"a"}
    for target in range(1, 256):
        for component in range(40):
            stage.receive("b", order(target, component), 255, 190)
    assert len(stage.nodes["b"].plans) <= MAX_PLANS


@pytest.mark.exhaustive
def test_recent_frames_are_bounded(stage: Stage) -> None:
    encoder = FrameEncoder(1, 1)
    for number in range(2 * MAX_RECENT_FRAMES + 100):
        stage.pass_on("a", encoder.encode(Statustext(6, str(number))))
    recent = stage.router._recent
    assert len(recent.newer) + len(recent.older) <= 2 * MAX_RECENT_FRAMES


# ------------------------------------------------------------------------------- random networks


class Network:
    """Hubs joined by edges, several between two of them, too, and one program at each hub; frames take their time."""

    def __init__(self, hubs: int, edges: list[tuple[int, int]], seed: int, slowest_s: float = 0.2) -> None:
        self.slowest_s = slowest_s
        self.random = random.Random(seed)
        self.now = 10.0
        self.heap: list[tuple[float, int, int, tuple[int, int], bytes]] = []
        self.count = self.hops = 0
        self.got: dict[int, Counter[bytes]] = defaultdict(Counter)
        self.routers: list[Router[tuple[int, int]]] = [Router(TARGETS, lambda port, number: 0.0) for _ in range(hubs)]
        self.nodes: list[dict[tuple[int, int], Ingress[tuple[int, int]]]] = [{} for _ in range(hubs)]
        self.far: dict[tuple[int, tuple[int, int]], tuple[int, tuple[int, int]]] = {}
        for hub in range(hubs):
            self._port(hub, (-1, 0))
        for number, (one, other) in enumerate(edges):
            self._port(one, (number, 0))
            self._port(other, (number, 1))
            self.far[one, (number, 0)] = other, (number, 1)
            self.far[other, (number, 1)] = one, (number, 0)
        self.encoders = [FrameEncoder(1 + hub, 1) for hub in range(hubs)]

    def _port(self, hub: int, name: tuple[int, int]) -> None:
        self.nodes[hub][name] = self.routers[hub].add(name)

    def send(self, hub: int, message: Message) -> bytes:
        raw = self.encoders[hub].encode(message)
        self._post(hub, (-1, 0), raw)
        return raw

    def _post(self, hub: int, port: tuple[int, int], raw: bytes) -> None:
        self.count += 1
        heapq.heappush(self.heap, (self.now + self.random.uniform(0.001, self.slowest_s), self.count, hub, port, raw))

    def run(self) -> None:
        while self.heap:
            self.now, _, hub, port, raw = heapq.heappop(self.heap)
            self.hops += 1
            assert self.hops < 20_000, "frames loop"
            for out in self.routers[hub].route(self.nodes[hub][port], Frame.parse(raw), self.now).outs:
                if out == (-1, 0):
                    self.got[hub][raw] += 1
                else:
                    self._post(*self.far[hub, out], raw)


@st.composite
def networks(draw: st.DrawFn, slowest_s: float = 0.2) -> Network:
    hubs = draw(st.integers(2, 6))
    tree = [(draw(st.integers(0, hub - 1)), hub) for hub in range(1, hubs)]
    pairs = st.tuples(st.integers(0, hubs - 1), st.integers(0, hubs - 1)).filter(lambda pair: pair[0] != pair[1])
    return Network(hubs, tree + draw(st.lists(pairs, max_size=6)), draw(st.integers(0, 2**32)), slowest_s)


@given(networks(), st.booleans(), st.data())
def test_each_target_receives_once_on_any_network(network: Network, vehicles: bool, data: st.DataObject) -> None:
    hubs = range(len(network.routers))
    hello = COPTER if vehicles else STATION
    for _ in range(2):
        said = {hub: network.send(hub, hello) for hub in hubs}
        network.run()
        for hub in hubs:
            assert network.got[hub] == {raw: 1 for other, raw in said.items() if other != hub}
        network.got.clear()
    sender = data.draw(st.sampled_from(hubs))
    target = data.draw(st.sampled_from([hub for hub in hubs if hub != sender]))
    raws = [network.send(sender, order(1 + target, component)) for component in (1, 0, 1)]
    unused = network.send(sender, order(200))
    network.run()
    assert network.got[target] == dict.fromkeys(raws, 1)
    assert not any(network.got[hub] for hub in hubs if hub != target)
    assert unused not in network.got[target]
