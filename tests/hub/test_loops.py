"""Hubs in a loop: looping frames are dropped at any delay, and a vehicle on two radios is not taken for a loop."""

from __future__ import annotations

import asyncio

import pytest
from hub_stage import STATION, Program
from hypothesis import given
from test_routing import COPTER, Network, Stage, networks, order

import aerokit
from aerokit.hub import Endpoint, Hub, HubEvent
from aerokit.hub.senders import LOOP_WINDOW_S, MIN_LOOP_FRAMES
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import Attitude, Heartbeat, SysStatus
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair

SLOW_S = (0.05, 0.9, 1.2, 1.6, 5.0, 20.0)


def circle(latency_s: float, near: Endpoint, far: Endpoint) -> tuple[Hub, Hub]:
    """Two hubs joined by two links."""
    (one_a, one_b), (two_a, two_b) = (memory_link_pair(latency_s=latency_s) for _ in range(2))
    return (
        Hub([near, Endpoint(one_a, name="one"), Endpoint(two_a, name="two")]),
        Hub([far, Endpoint(one_b, name="one"), Endpoint(two_b, name="two")]),
    )


@pytest.mark.sampled(6)
@pytest.mark.parametrize("latency_s", SLOW_S)
def test_dead_vehicle_behind_hub_loop_is_silent(latency_s: float) -> None:
    async def main() -> None:
        program_link, far = memory_link_pair()
        copter, events = SimulatedCopter(boot_time_s=0.0), list[HubEvent]()
        async with simulated_link(copter) as link:
            near_hub, far_hub = circle(latency_s, Endpoint(far, name="program"), Endpoint(link, name="vehicle"))
            far_hub.on_event(events.append)
            async with near_hub, far_hub, aerokit.connect(program_link) as vehicle:
                await asyncio.sleep(10 + 10 * latency_s)
                assert vehicle.heartbeat_age < latency_s + 2
                copter.faults.silent = True
                await asyncio.sleep(latency_s + 5)
                assert vehicle.is_silent
                await asyncio.sleep(200)
                assert vehicle.heartbeat_age > 195
                assert vehicle.position.age > 195
        loops = [event for event in events if event.kind == "loop"]
        assert bool(loops) == (latency_s > 1)
        assert len(loops) <= 4, "once for each end and sender"
        assert not loops or "1/1" in loops[0].text

    run_virtual(main())


@pytest.mark.sampled(3)
@pytest.mark.parametrize("latency_s", SLOW_S)
def test_dead_station_behind_hub_loop_is_silent(latency_s: float) -> None:
    """It looped identical heartbeats; a vehicle that still received them would not detect the loss of its station."""

    async def main() -> None:
        station, copter = Program(255, 190), Program(1, 1)
        hubs = circle(latency_s, station.endpoint("station"), copter.endpoint("copter"))
        async with station, copter, hubs[0], hubs[1]:
            for _ in range(40):
                station.send(STATION)
                await asyncio.sleep(1.0)
            await asyncio.sleep(20 * latency_s + 1)  # a few rounds of those that passed before it was clear
            frames_before = len(copter.frames)
            await asyncio.sleep(200)
            assert len(copter.frames) == frames_before
            assert 40 <= frames_before <= 40 + 4 * MIN_LOOP_FRAMES

    run_virtual(main())


def test_vehicle_that_left_its_port_does_not_circulate() -> None:
    stage, reported = Stage(), list[str]()
    stage.router.on_change = lambda kind, source, port, before: reported.append(f"{kind} {port} {before}")
    encoder = FrameEncoder(1, 1)
    raws = [encoder.encode(Attitude(number, 0, 0, 0, 0, 0, 0)) for number in range(20)]
    for raw in raws:
        stage.pass_on("a", raw)
    stage.router.remove(stage.nodes["a"])
    passed = 0
    for _ in range(5):
        stage.now += 10
        passed = sum(bool(stage.pass_on("b", raw)) for raw in raws)
        assert passed < MIN_LOOP_FRAMES
    assert passed == 0
    assert stage.reason == "loop"
    assert reported == ["loop b None"]


# Around a circle of six hubs, a frame takes less than the minute for which a hub remembers it.
@pytest.mark.exhaustive
@given(networks(slowest_s=9.0))
def test_frames_do_not_circulate_on_any_slow_network(network: Network) -> None:
    for number in range(20):
        for hub in range(len(network.routers)):
            network.send(hub, COPTER if number % 5 == 0 else Attitude(number, 0, 0, 0, 0, 0, 0))
        network.now += 0.1
    network.run()  # which fails after 20,000 hops


# -------------------------------------------------------------------- two radios are not a loop


def two_radios(stage: Stage, seconds: int, first: FrameEncoder, second: FrameEncoder, ports: str) -> set[str]:
    """A disarmed vehicle with a sequence counter for each port; returns the drop reasons of port b."""
    reasons = set()
    for _ in range(seconds):
        for step in range(4):
            stage.now += 0.25
            clock = Attitude(round(stage.now * 1000), 0, 0, 0, 0, 0, 0)
            for port, encoder in zip("ab", (first, second), strict=True):
                for message in (COPTER, SysStatus(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)) if step == 0 else (clock,):
                    raw = encoder.encode(message)
                    if port in ports:
                        stage.pass_on(port, raw)
                        if port == "b":
                            reasons.add(stage.reason)
    return reasons


@pytest.mark.parametrize("ahead", range(15, 256, 15))
def test_vehicle_on_two_radios_is_no_loop(ahead: int) -> None:
    stage, reported = Stage(), list[str]()
    stage.router.on_change = lambda kind, source, port, before: reported.append(kind)
    first, second = FrameEncoder(1, 1), FrameEncoder(1, 1)
    second.sequence = ahead
    reasons = two_radios(stage, 200, first, second, "ab")
    assert "loop" not in reasons
    assert reported == ["duplicate_sender"]
    two_radios(stage, 5, first, second, "b")
    assert reported == ["duplicate_sender", "route_changed"]
    stage.receive("c", STATION, 255, 190)
    assert stage.receive("c", order(1), 255, 190) == {"b"}


def test_equal_frames_at_two_ports_are_forwarded_once() -> None:
    """Two receivers of one radio: the same numbers, a little later."""
    stage, encoder = Stage(), FrameEncoder(1, 1)
    for number in range(1000):
        raw = encoder.encode(Attitude(number, 0, 0, 0, 0, 0, 0))
        stage.now += 0.02
        assert stage.pass_on("a", raw) == set("bcd")
        stage.now += 0.02
        assert stage.pass_on("b", raw) == set()
        assert stage.reason == "duplicate"
    assert stage.pass_on("b", encoder.encode(COPTER)) == set("acd")


def test_heartbeats_over_two_radios_fall_back_to_second() -> None:
    """Equal bytes and numbers ten seconds later look like a loop until the first radio is silent."""
    stage, first, second = Stage(), FrameEncoder(1, 1), FrameEncoder(1, 1)
    for count in range(60):
        stage.now += 1.0
        stage.pass_on("a", first.encode(COPTER))
        if count >= 10:
            stage.pass_on("b", second.encode(COPTER))
    passed = []
    for _ in range(20):
        stage.now += 1.0
        passed.append(bool(stage.pass_on("b", second.encode(COPTER))))
    assert passed == [False] * 10 + [True] * 10


def test_frame_received_once_elsewhere_is_no_loop() -> None:
    stage = Stage()
    raw = FrameEncoder(1, 1).encode(Heartbeat(2, 3, 81, 0, 3))
    for _ in range(20):
        stage.pass_on("a", raw)
        stage.now += 5
        assert stage.pass_on("b", raw) == set("acd")
        stage.receive("b", COPTER)  # something new each time
        stage.now += LOOP_WINDOW_S


def test_restarted_program_with_equal_frames_is_no_loop() -> None:
    """Each time a new TCP client with sequence numbers from 0: its orders are new."""
    stage = Stage()
    stage.receive("a", COPTER)
    encoder = FrameEncoder(255, 190)
    raws = [encoder.encode(message) for message in [STATION, order(1)] * 20]
    for name in ("e", "f", "g"):
        stage.nodes[name] = stage.router.add(name)
        assert [stage.reason for raw in raws if not stage.pass_on(name, raw)] == []
        stage.now += 10
