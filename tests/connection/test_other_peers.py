"""Routes, and peers that want them, without a connection, exact to the frame and the millisecond."""

from __future__ import annotations

from typing import Any

import pytest
from test_routes import COPTER, PeersLink

from aerokit import events
from aerokit.connection import routes as routes_module
from aerokit.connection.routes import OtherPeer, Routes, boot_time_ms
from aerokit.mavlink import Frame, Framer
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, Heartbeat
from aerokit.mavlink.statistics import SourceStatistics

PEER_TTL_S = 30.0
ROUTE_TIMEOUT_S = 3.5

HOME, SAME_HOST, OTHER_HOST = "1@copter", "2@copter", "1@stranger"


class Sender:
    """A sender with a frame counter, and the framer that receives its frames."""

    def __init__(self, system_id: int = 1, sequence: int = 0) -> None:
        self.encoder = FrameEncoder(system_id, 1)
        self.encoder.sequence = sequence & 0xFF
        self.framer = Framer()

    def send(self, at: float, message: Message = COPTER) -> tuple[Frame, SourceStatistics]:
        (frame,) = self.framer.receive(self.encoder.encode(message), at)
        (counters,) = self.framer.statistics.sources.values()
        return frame, counters


def attitude(boot_ms: int) -> Attitude:
    return Attitude(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Stage:
    """Routes with a vehicle that sent ten frames a second from HOME until 1 s."""

    def __init__(self, attached: set[int] | None = None, **options: Any) -> None:
        self.reported: list[events.Event] = []
        self.link = PeersLink()
        attached = {1} if attached is None else attached
        self.routes = Routes(self.link, self.reported.append, attached, **options)
        self.copter = Sender()
        assert self.routes.record_heartbeat(*self._at_home(0.0))
        for number in range(9):
            self.copter.send(number / 10)
        assert self.routes.record_heartbeat(*self._at_home(1.0))

    @property
    def next_number(self) -> int:
        return self.copter.encoder.sequence

    def moves(self, at: float, ahead: int, peer: str = OTHER_HOST, **kind: Any) -> bool:
        frame, _ = Sender(1, self.next_number + ahead).send(at, **kind)
        assert self.routes.arrived_on_other_peer(frame, peer)
        return self.routes.try_move_route(frame, peer, is_signed=False)

    def _at_home(self, at: float) -> tuple[Frame, str, SourceStatistics]:
        frame, counters = self.copter.send(at)
        return frame, HOME, counters


def names(reported: list[events.Event]) -> list[str]:
    return [type(event).__name__ for event in reported]


@pytest.mark.parametrize(("ahead", "takes"), [(0, True), (68, True), (69, False), (-1, False)])
def test_after_silence_numbers_may_be_ahead_by_lost_frames(ahead: int, takes: bool) -> None:
    """8 + 1.5 · 10 Hz · 4 s."""
    stage = Stage()
    assert stage.moves(5.0, ahead) is takes
    assert names(stage.reported) == (["RouteChanged"] if takes else ["DuplicateSender", "RouteChangeRefused"])


@pytest.mark.parametrize(("ahead", "reported"), [(9, []), (10, ["DuplicateSender"]), (-1, ["DuplicateSender"])])
def test_without_silence_numbers_may_be_slightly_ahead(ahead: int, reported: list[str]) -> None:
    """The limit is 8 + 1.5 · 10 Hz · 0.1 s. On the same host, no event is published while it may be the vehicle."""
    stage = Stage()
    assert not stage.moves(1.1, ahead, SAME_HOST)
    assert names(stage.reported) == reported


@pytest.mark.parametrize(("after_s", "takes"), [(ROUTE_TIMEOUT_S, False), (ROUTE_TIMEOUT_S + 0.01, True)])
def test_route_times_out_after_three_and_a_half_seconds(after_s: float, takes: bool) -> None:
    assert Stage().moves(1.0 + after_s, 0) is takes


def test_clock_decides_where_numbers_are_ambiguous() -> None:
    """After 8 s at 10 Hz the counter may have wrapped around."""
    assert not Stage().moves(9.1, 0)  # and there is no clock
    clocks = {(1, 1): lambda at: 1000 * at}
    for boot_ms, takes in (
        (9000 + 1900, True),
        (9000 + 1901, False),
        (9000 - 1900, True),
        (9000 - 1901, False),
    ):
        assert Stage(boot_clocks=clocks).moves(9.0, -100, message=attitude(boot_ms)) is takes


@pytest.mark.parametrize(("right", "takes"), [(True, True), (False, False)])
def test_known_clock_must_be_confirmed(right: bool, takes: bool) -> None:
    stage = Stage(boot_clocks={(1, 1): lambda at: 1000 * at})
    assert not stage.moves(5.0, 0)  # the heartbeat has no time
    assert stage.moves(5.1, 1, message=attitude(5100 if right else 99_000)) is takes


def test_rate_ignores_interval_without_counters() -> None:
    stage = Stage()
    for at, has_counters in ((2.0, False), (3.0, True)):
        for number in range(9):
            stage.copter.send(at - 0.9 + number / 10)
        frame, counters = stage.copter.send(at)
        assert stage.routes.record_heartbeat(frame, HOME, counters if has_counters else None)
    assert stage.routes._routes[1, 1].rate == pytest.approx(10.0)


def test_system_without_vehicle_object_is_taken_after_silence() -> None:
    assert Stage(attached=set()).moves(5.0, -100)
    assert not Stage(attached=set()).moves(2.0, -100)
    assert Stage(may_move=True).moves(5.0, -100)
    assert Stage().moves(5.0, -100, SAME_HOST)


def test_other_port_takes_route_with_three_frames_in_time() -> None:
    stage, other = Stage(), Sender(1, 0)
    other.encoder.sequence = stage.next_number
    takes = []
    for at in (1.1, 1.2, 1.3, 1.41):
        frame, _ = other.send(at)
        takes.append(stage.routes.try_move_route(frame, SAME_HOST, is_signed=False))
    assert takes == [False, False, False, True]
    assert names(stage.reported) == ["RouteChanged"]
    assert stage.routes.peers_of(1, 1) == (SAME_HOST,)
    (moved,) = stage.reported
    assert isinstance(moved, events.RouteChanged)
    assert moved.at == pytest.approx(1.41)


def test_other_peers_are_reported_again_after_owner_returns() -> None:
    stage = Stage()
    for at in (5.0, 5.1):
        assert not stage.moves(at, 100)
    assert names(stage.reported) == ["DuplicateSender", "RouteChangeRefused"]
    stage.routes.record_heartbeat(*stage._at_home(5.2))
    assert not stage.moves(10.0, 100)
    assert names(stage.reported) == ["DuplicateSender", "RouteChangeRefused", "RouteChangeRefused"]


def test_duplicate_behind_same_peer_is_reported_once() -> None:
    stage = Stage()
    for at in (1.1, 1.2):
        stage.routes.record_duplicate_sender(Sender().send(at)[0])
    assert names(stage.reported) == ["DuplicateSender"]


@pytest.mark.parametrize(
    ("behind", "after_s", "is_outdated"),
    [(0, 0.1, False), (1, 0.1, True), (127, 0.1, True), (128, 0.1, False), (-1, 0.1, False), (1, 3.6, False)],
)
def test_heartbeat_is_outdated_by_up_to_127_frames(behind: int, after_s: float, is_outdated: bool) -> None:
    stage = Stage()
    frame, _ = Sender(1, stage.next_number - 1 - behind).send(1.0 + after_s)
    assert stage.routes.is_outdated(frame) is is_outdated
    assert not stage.routes.is_outdated(Sender(9).send(1.0)[0])


# -------------------------------------------------------------------------------------- room


def test_peer_with_vehicle_object_is_never_evictable() -> None:
    for attached, at, forgotten in (
        ({1}, 1000.0, None),
        (set[int](), 1.0 + PEER_TTL_S, None),
        (set[int](), 1.1 + PEER_TTL_S, HOME),
    ):
        assert Stage(attached).routes.evict_idle_peer([HOME], at) == forgotten
    assert Stage().routes.evict_idle_peer([HOME, OTHER_HOST, SAME_HOST], 1.0) == OTHER_HOST


def test_full_table_drops_expired_routes_and_keeps_vehicles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes_module, "MAX_ROUTES", 3)
    stage = Stage(attached={9})
    routes = stage.routes
    assert routes.record_heartbeat(Sender(9).send(1.0)[0], OTHER_HOST, None)
    assert routes.record_heartbeat(Sender(3).send(30.0)[0], OTHER_HOST, None)
    assert not routes.record_heartbeat(Sender(4).send(30.5)[0], OTHER_HOST, None)
    assert routes.record_heartbeat(Sender(5).send(32.0)[0], OTHER_HOST, None)
    known = [system for system in range(10) if routes.has_route((system, 1))]
    assert known == [3, 5, 9]


def test_full_table_is_swept_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes_module, "MAX_ROUTES", 1)
    routes = Stage(attached=set()).routes
    assert not routes.record_heartbeat(Sender(2).send(30.5)[0], OTHER_HOST, None)
    assert not routes.record_heartbeat(Sender(2).send(31.4)[0], OTHER_HOST, None)
    assert routes.record_heartbeat(Sender(2).send(31.5)[0], OTHER_HOST, None)


# ------------------------------------------------------------------------------------- other peers


def test_other_peer_is_judged_by_first_frame_after_owner() -> None:
    other, (frame, _) = OtherPeer(), Sender().send(1.0)

    def is_same_sender() -> bool | None:
        return other.is_same_sender

    assert is_same_sender() is None
    other.add(frame, 10, False, True)
    other.add(frame, 10, True, True)
    assert is_same_sender() is False
    other.is_refusal_reported = True
    other.add(frame, 11, True, None)
    assert is_same_sender() is None
    assert not other.is_refusal_reported
    other.add(frame, 11, True, True)
    assert is_same_sender() is True
    other.add(frame, 11, True, False)
    other.add(frame, 11, True, True)
    assert is_same_sender() is False


def test_other_peer_needs_three_frames_in_the_time_of_three() -> None:
    other, (frame, _) = OtherPeer(), Sender().send(1.0)
    for frames in (1, 2, 3):
        other.add(frame, 10, True, True)
        assert other.has_replaced_route_peer(9.0, 10.0) is (frames == 3)
    assert not other.has_replaced_route_peer(1.29, 10.0)
    assert other.has_replaced_route_peer(1.5, 6.0)
    assert not other.has_replaced_route_peer(9.0, 0.0)


def test_boot_time_of_a_frame() -> None:
    assert boot_time_ms(Sender().send(0.0, attitude(123_456_789))[0]) == 123_456_789
    assert boot_time_ms(Sender().send(0.0, Heartbeat(2, 3, 81, 0, 3))[0]) is None
