"""No datagram older than two seconds is accepted, for any network delays and clocks."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from itertools import count, repeat
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.transport.zenoh.control_lease import (
    BEACON_INTERVAL_S,
    MAX_DELAY_S,
    DelayEstimator,
    FreshnessChecker,
    ServerTracker,
)
from aerokit.transport.zenoh.keys import Beacon, SendTime, Stamp

Event = tuple[float, int, str, Any]
Holds = tuple[Sequence[tuple[float, float]], Sequence[tuple[float, float]]]

clocks = st.tuples(st.floats(-1e6, 1e6), st.sampled_from([1.0, 0.9999, 1.0001]))  # its offset and its rate
delays = st.one_of(st.floats(0, 0.5), st.floats(0, 20))
holds = st.lists(st.tuples(st.floats(0, 12), st.floats(0, 10)), max_size=3)  # begins, lasts


class SimulatedNetwork:
    """A server that sends beacons, a client that sends continuously, and a network with arbitrary delays."""

    def __init__(
        self,
        vehicle: tuple[float, float],
        client: tuple[float, float],
        delays: Iterator[float],
        holds: Holds = ((), ()),
    ) -> None:
        self.checker, self.tracker = FreshnessChecker(7), ServerTracker(1)
        self.vehicle_clock, self.client_clock = vehicle, client
        self.delays, self.holds = delays, holds
        self.events: list[Event] = []
        self.order = count()
        self.accepted: list[tuple[float, float]] = []  # sent, accepted: in true time
        self.refused: list[tuple[float, float]] = []
        self.unsent: list[float] = []

    def at(self, when: float, kind: str, what: Any = None) -> None:
        heapq.heappush(self.events, (when, next(self.order), kind, what))

    def arrival(self, now: float, way: int) -> float:
        """Data that arrives during a hold is delivered at its end, in order."""
        when = now + next(self.delays)
        for begins, lasts in sorted(self.holds[way]):
            if begins <= when < begins + lasts:
                when = begins + lasts
        return when

    def run(self, until: float) -> None:
        for number in range(int(until / BEACON_INTERVAL_S)):
            self.at(number * BEACON_INTERVAL_S, "beacon")
        for number in range(int(until / 0.3)):
            self.at(number * 0.3, "send", number)
        while self.events:
            now, _, kind, what = heapq.heappop(self.events)
            (begun, rate), (begun_too, rate_too) = self.vehicle_clock, self.client_clock
            vehicle, client = begun + rate * now, begun_too + rate_too * now
            if kind == "beacon":
                self.at(self.arrival(now, 0), "received", self.checker.make_beacon(vehicle))
            elif kind == "received":
                self.tracker.receive_beacon(what, client)
            elif kind == "send":
                stamp = self.tracker.make_stamp(client)
                if stamp is None:
                    self.unsent.append(now)
                else:
                    self.at(self.arrival(now, 1), "came", (now, stamp))
            else:
                sent, stamp = what
                accepted = accepts(self.checker, stamp, vehicle)
                (self.accepted if accepted else self.refused).append((sent, now))


def accepts(checker: FreshnessChecker, stamp: Stamp | None, now: float) -> bool:
    return checker.is_fresh(stamp, now) and stamp is not None and checker.is_new("ground", stamp)


@given(clocks, clocks, st.lists(delays, min_size=120, max_size=120))
def test_accepted_datagrams_are_at_most_two_seconds_old(
    vehicle: tuple[float, float], client: tuple[float, float], delays: list[float]
) -> None:
    world = SimulatedNetwork(vehicle, client, iter(delays))
    world.run(15)
    for sent, accepted in world.accepted:
        assert accepted - sent <= MAX_DELAY_S * 1.001
    times = [sent for sent, _ in world.accepted]
    assert times == sorted(set(times))  # none twice, none behind a later one


@given(clocks, clocks, st.floats(0, 0.1), st.tuples(holds, holds))
def test_datagrams_delayed_by_partition_are_refused(
    vehicle: tuple[float, float], client: tuple[float, float], delay: float, holds: Holds
) -> None:
    world = SimulatedNetwork(vehicle, client, repeat(delay), holds)
    world.run(25)
    for sent, accepted in world.accepted:
        assert accepted - sent <= MAX_DELAY_S * 1.001
    healed = 1 + max((begins + lasts for way in holds for begins, lasts in way), default=0)
    assert [sent for sent, _ in world.accepted if sent > healed] == [
        number * 0.3 for number in range(83) if number * 0.3 > healed
    ]


@given(clocks, clocks, st.lists(st.floats(0, 0.7), min_size=1, max_size=120))
def test_working_network_accepts_everything(
    vehicle: tuple[float, float], client: tuple[float, float], delays: list[float]
) -> None:
    steady = max(delays)  # in order
    world = SimulatedNetwork(vehicle, client, iter([steady] * 200))
    world.run(15)
    assert world.refused == []
    assert all(sent <= steady for sent in world.unsent)  # before the first beacon
    assert len(world.accepted) + len(world.unsent) == 50


def test_nothing_is_sent_in_silence_and_held_back_refused() -> None:
    checker, tracker = FreshnessChecker(7), ServerTracker(1)
    assert tracker.make_stamp(0.0) is None  # no beacon was received
    assert tracker.receive_beacon(checker.make_beacon(100.0), 0.0)
    held = tracker.make_stamp(1.9)
    assert held is not None
    assert tracker.make_stamp(2.1) is None  # the beacon is too old by our own clock
    assert not accepts(checker, held, 102.1)
    assert checker.late == 1
    beacon = checker.make_beacon(110.0)
    assert not tracker.receive_beacon(beacon, 20.0)  # ten seconds late: it was held back, too
    assert tracker.late == 1
    assert tracker.make_stamp(20.0) is None
    assert tracker.receive_beacon(checker.make_beacon(120.0), 20.0)
    fresh = tracker.make_stamp(20.1)
    assert accepts(checker, fresh, 120.1)
    assert not accepts(checker, fresh, 120.1)  # the same once more
    assert checker.duplicates == 1


def test_second_server_with_same_name() -> None:
    first, second, tracker = FreshnessChecker(1), FreshnessChecker(2), ServerTracker(1)
    assert tracker.receive_beacon(first.make_beacon(0.0), 0.0)
    assert not tracker.receive_beacon(second.make_beacon(50.0), 0.1)  # the first one is active
    assert not tracker.accepts(SendTime(2, 50.0), 0.1)
    assert tracker.foreign == 2
    stamp = tracker.make_stamp(0.2)
    assert accepts(first, stamp, 0.2)
    assert not accepts(second, stamp, 50.2)
    assert tracker.receive_beacon(second.make_beacon(53.0), 3.0)  # the first one is silent: this is its successor
    assert accepts(second, tracker.make_stamp(3.1), 53.1)
    tracker.reset()
    assert tracker.make_stamp(3.2) is None
    assert tracker.receive_beacon(first.make_beacon(3.3), 3.3)


@pytest.mark.parametrize("stamp", [None, Stamp(8, 1, 1, 1), Stamp(7, 0, 1, 1), Stamp(7, 2, 1, 1)])
def test_datagram_without_valid_stamp_is_refused(stamp: Stamp | None) -> None:
    checker = FreshnessChecker(7)
    checker.make_beacon(0.0)
    assert not accepts(checker, stamp, 0.1)
    assert checker.late == 1
    assert accepts(checker, Stamp(7, 1, 1, 1), 0.1)


def test_checker_bounds_remembered_clients() -> None:
    checker = FreshnessChecker(7)
    checker.make_beacon(0.0)
    for nonce in range(1000):
        assert accepts(checker, Stamp(7, 1, nonce, 1), 0.1)
    assert len(checker._sequences) == 256


@given(
    clocks,
    clocks,
    st.lists(st.tuples(st.floats(0, 30), st.floats(0, 60)), min_size=1, max_size=40),
)
def test_estimated_delay_never_exceeds_the_real_one(
    theirs: tuple[float, float], ours: tuple[float, float], sent: list[tuple[float, float]]
) -> None:
    estimator = DelayEstimator()
    for delay, at in sorted(sent, key=lambda times: sum(times)):
        now = at + delay
        late = estimator.delay(theirs[0] + theirs[1] * at, ours[0] + ours[1] * now)
        assert 0 <= late <= delay + 0.02


def test_delay_after_a_faster_datagram() -> None:
    estimator = DelayEstimator()
    assert estimator.delay(1000.0, 5.0) == 0.0
    assert estimator.delay(1001.0, 9.0) == pytest.approx(3.0, abs=0.01)
    assert estimator.delay(1005.0, 9.9) == 0.0  # quicker still


def test_overtaken_beacon_is_ignored() -> None:
    tracker = ServerTracker(1)
    assert tracker.receive_beacon(Beacon(7, 2, 1.0), 1.0)
    assert not tracker.receive_beacon(Beacon(7, 1, 0.5), 1.1)
    assert not tracker.receive_beacon(Beacon(7, 2, 1.0), 1.2)
