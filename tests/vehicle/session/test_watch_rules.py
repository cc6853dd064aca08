"""Reboots, silence, loss, round trips, standing still: the rules by themselves, on a clock of the test's own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from aerokit import Position
from aerokit.connection.cells import Source, StateCell
from aerokit.connection.connection import Connection
from aerokit.errors import LinkLost
from aerokit.events import LinkInterrupted, LinkReport, VehicleRebooted, VehicleRecovered, VehicleSilent
from aerokit.mavlink import STANDARD, Frame, FrameEncoder, Framer, Message
from aerokit.mavlink.messages import Attitude, Heartbeat, SystemTime, Timesync
from aerokit.vehicle.commanding.context import VehicleContext
from aerokit.vehicle.commanding.progress import StallDetector
from aerokit.vehicle.commanding.setpoints import (
    MAX_RESTING_RADII,
    SLOW_M_S,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    VelocitySetpoint,
    wants_motion,
)
from aerokit.vehicle.session.session import VehicleSession
from aerokit.vehicle.session.watch import LinkWatch, VehicleWatch
from aerokit.vehicle.state.movement import LocalPosition

HEARTBEAT = Heartbeat(2, 3, 81, 0, 3)


class Bus:
    """Delivers frames and messages to attached sinks, as the real bus does."""

    def __init__(self) -> None:
        self.sinks: dict[type[Any], list[Callable[[Any], object]]] = {}
        self.takers: dict[type[Any], list[Callable[[Any], object]]] = {}
        self.published: list[Any] = []

    def attach(self, kind: type[Any], sink: Callable[[Any], object], **_: object) -> Callable[[], None]:
        self.sinks.setdefault(kind, []).append(sink)
        return lambda: self.sinks[kind].remove(sink)

    attach_event = attach

    def attach_frames(self, kind: type[Any], taker: Callable[[Any], object], **_: object) -> Callable[[], None]:
        self.takers.setdefault(kind, []).append(taker)
        return lambda: self.takers[kind].remove(taker)

    def publish(self, event: Any) -> None:
        self.published.append(event)


class Stage:
    """A fake connection, and the messages of a vehicle on it."""

    def __init__(self) -> None:
        self.at, self.counted, self.bytes = 0.0, (0, 0), 0
        self.sleeps = list[tuple[float, float]]()  # (time of waking up, seconds)
        self.bus, self.boot_clocks, self.sent = Bus(), dict[tuple[int, int], Any](), list[Message]()
        self.connection = cast(
            "Connection",
            SimpleNamespace(
                bus=self.bus,
                boot_clocks=self.boot_clocks,
                now=lambda: self.at,
                counts=lambda _: self.counted,
                _slept_since=lambda at: sum(seconds for woke_at, seconds in self.sleeps if woke_at > at),
                statistics=lambda: [SimpleNamespace(bytes=self.bytes)],
                send=lambda message, to: self.sent.append(message),
                hold_back=self._hold_back,
            ),
        )
        self.held_back: Callable[[Frame], object] | None = None
        self.encoder = FrameEncoder(1, 1)

    def _hold_back(self, _: int, on_frame: Callable[[Frame], object]) -> Callable[[], None]:
        self.held_back = on_frame

        def deliver_again() -> None:
            self.held_back = None

        return deliver_again

    def sleep(self, seconds: float) -> None:
        """Suspend the computer. The clock of the event loop stands still."""
        self.at += 0.1
        self.sleeps.append((self.at, seconds))

    def receive(self, message: Message, *, component_id: int = 1, received_at: float | None = None) -> None:
        encoder = self.encoder if component_id == 1 else FrameEncoder(1, component_id)
        (frame,) = Framer().receive(encoder.encode(message), self.at if received_at is None else received_at)
        if self.held_back is not None:
            self.held_back(frame)
        if self.held_back is not None:
            return
        for take in self.bus.takers.get(type(message), ()):
            take(frame)
        for sink in self.bus.sinks.get(type(message), ()):
            sink(self._decoded(frame))

    @staticmethod
    def _decoded(frame: Frame) -> Message:
        return STANDARD.decode(frame)

    def event_counts(self) -> Counter[type[Any]]:
        return Counter(map(type, self.bus.published))


def attitude(boot_ms: int) -> Attitude:
    return Attitude(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


# ----------------------------------------------------------------------------------- reboots


class Watched(Stage):
    def __init__(self) -> None:
        super().__init__()
        self.reported_reboots = 0
        self.watch = VehicleWatch(self.connection, 1, 1, self._count, heartbeat_at=self.at)

    def _count(self) -> None:
        self.reported_reboots += 1

    def lose_link(self) -> None:
        (interrupt,) = self.bus.sinks[LinkInterrupted]
        interrupt(LinkInterrupted(self.at, system_id=0, error=LinkLost("unplugged")))

    def clock(self, boot_ms: int, *, after: float = 0.1) -> int:
        self.at += after
        self.receive(attitude(boot_ms))
        return self.watch.reboots


def test_decreased_running_time_is_reboot() -> None:
    stage = Watched()
    stage.clock(100_000)
    assert stage.clock(50) == 0
    assert stage.clock(150) == 0
    assert stage.clock(250, after=0.11) == 1
    assert stage.clock(350) == 1
    assert (stage.reported_reboots, stage.event_counts()[VehicleRebooted]) == (1, 1)


def test_time_three_seconds_earlier_is_late_message() -> None:
    stage = Watched()
    stage.clock(100_000)
    for boot_ms in (97_000, 97_100, 97_200, 97_400):
        assert stage.clock(boot_ms) == 0


def test_late_messages_with_different_times_are_no_reboot() -> None:
    stage = Watched()
    for seconds in range(100, 130):
        stage.clock(seconds * 1000, after=1.0)
        if seconds % 10 == 0:
            assert stage.clock(seconds * 1000 - 8000, after=0.0) == 0


def test_several_decreased_times_earliest_must_persist() -> None:
    """Late messages may have another time than those of the rebooted vehicle."""
    stage = Watched()
    stage.clock(100_000)
    assert stage.clock(90_000) == 0
    assert stage.clock(50, after=1.0) == 0
    assert stage.clock(150) == 0
    assert stage.clock(350, after=0.21) == 1


def test_decreased_time_repeated_counts_from_first() -> None:
    stage = Watched()
    stage.clock(100_000)
    assert stage.clock(50) == 0
    assert stage.clock(50, after=0.15) == 0
    assert stage.clock(300, after=0.1) == 1


def test_decreased_constant_time_is_no_reboot() -> None:
    stage = Watched()
    stage.clock(100_000)
    for _ in range(20):
        assert stage.clock(5000) == 0


def test_boot_clock_that_wraps_after_49_days_is_no_reboot() -> None:
    stage, days = Watched(), 1 << 32
    for running_ms in range(days - 2000, days + 20_000, 100):
        assert stage.clock(running_ms % days) == 0
    assert stage.boot_clocks[1, 1](stage.at) == 19_900
    stage.clock(50)  # This is a reboot.
    assert stage.clock(350, after=0.3) == 1


def test_messages_of_other_components_are_ignored() -> None:
    stage = Watched()
    stage.clock(100_000)
    stage.receive(Timesync(100_000_000_000, 5))
    for count in range(10):
        stage.at += 0.1
        stage.receive(attitude(100 * count + 1), component_id=154)
        stage.receive(SystemTime(0, 100 * count + 1), component_id=154)
        stage.receive(Timesync((100 * count + 1) * 1_000_000, 5), component_id=154)
    assert stage.watch.reboots == 0


def test_boot_time_is_extrapolated() -> None:
    stage = Watched()
    clock = stage.boot_clocks[1, 1]
    assert clock(0.0) is None
    stage.at = 100.0
    stage.receive(SystemTime(1_700_000_000_000_000, 5000))
    assert clock(101.5) == 6500.0
    stage.clock(65_000, after=6.0)  # ten times as fast
    assert clock(107.0) == 75_000.0
    stage.watch.close()
    assert stage.boot_clocks == {}


def test_ordered_reboot_is_detected_immediately() -> None:
    stage = Watched()
    stage.clock(3000)
    with stage.watch.expecting_reboot():
        assert stage.clock(5010, after=4.0) == 0  # two seconds late may be the radio's doing
        assert stage.clock(7000, after=4.0) == 1
        assert stage.clock(7100, after=9.0) == 1  # it was that one
    assert stage.clock(7200, after=10.0) == 1


def test_late_message_after_order_to_reboot_is_no_reboot() -> None:
    stage = Watched()
    stage.clock(60_000)
    with stage.watch.expecting_reboot():
        stage.clock(61_000, after=1.0)
        assert stage.clock(61_100, after=4.1) == 0  # the link holds all messages back for four seconds
        assert stage.clock(70_000, after=5.0) == 0


def watched_without_link(speed: int = 1) -> Watched:
    """Return a stage whose link was lost 50 s (by the vehicle's clock) after the boot."""
    stage = Watched()
    for running_s in (40, 50):
        stage.clock(1000 * running_s * speed, after=10.0)
    stage.lose_link()
    return stage


@pytest.mark.parametrize("speed", [1, 10])
@pytest.mark.parametrize(
    ("back_s", "reboots"),
    # Limits of a continued clock: 60 s ± 1.5 s ± 20 % of 10 s, because after 10 s the speed is known to 15 %.
    [(56.6, 0), (63.4, 0), (56.0, 1), (64.0, 1), (20.0, 1), (900.0, 1)],
)
def test_clock_that_does_not_continue_after_lost_link_is_reboot(speed: int, back_s: float, reboots: int) -> None:
    stage = watched_without_link(speed)
    stage.clock(round(1000 * back_s * speed), after=10.0)
    assert stage.clock(round(1000 * (back_s + 0.9) * speed), after=0.9) == (back_s == 20.0)  # earlier than before
    assert stage.clock(round(1000 * (back_s + 1.1) * speed), after=0.2) == reboots


@pytest.mark.parametrize(("first_late_s", "last_waited_s"), [(1.0, 0.0), (0.0, 5.0)])
def test_late_message_before_lost_link_is_no_reboot(first_late_s: float, last_waited_s: float) -> None:
    """The first message waited in a radio, or the last one while the program blocked the event loop."""
    stage = Watched()
    stage.at = 100.0
    stage.clock(round(1000 * (stage.at - first_late_s)), after=0.0)
    for _ in range(51):
        stage.clock(round(1000 * stage.at) + 100)
    received_at = stage.at + 0.1
    stage.at = received_at + last_waited_s
    stage.receive(attitude(round(1000 * received_at)), received_at=received_at)
    stage.lose_link()
    stage.at += 60.0
    assert [stage.clock(round(1000 * stage.at) + 100) for _ in range(20)] == [0] * 20


def test_time_asleep_during_lost_link_is_no_reboot() -> None:
    stage = watched_without_link()
    stage.sleep(3600.0)
    assert [stage.clock(1000 * running_s, after=10.0) for running_s in (3660, 3670, 3680)] == [0, 0, 0]


def test_sleep_before_lost_link_does_not_change_clock_speed() -> None:
    """The computer slept for an hour while the vehicle was connected, and its own clock stood still."""
    stage = Watched()
    stage.clock(40_000, after=10.0)
    stage.sleep(3600.0)
    for running_s in (3650, 3660):
        stage.clock(1000 * running_s, after=10.0)
    assert stage.boot_clocks[1, 1](stage.at + 1.0) == pytest.approx(3_661_000, abs=1)
    stage.lose_link()
    assert [stage.clock(1000 * running_s, after=10.0) for running_s in (3670, 3680)] == [0, 0]


def test_late_messages_after_lost_link_are_no_reboot() -> None:
    stage = watched_without_link()
    assert [stage.clock(1000 * running_s, after=10.0) for running_s in (51, 70, 90)] == [0, 0, 0]


def test_backlog_after_lost_link_is_no_reboot() -> None:
    """A server that has kept the messages of the interruption delivers them within three seconds."""
    stage = watched_without_link()
    stage.at += 30.0
    for number in range(30):
        assert stage.clock(50_000 + 1100 * number) == 0
    assert [stage.clock(83_100 + 100 * number) for number in range(20)] == [0] * 20


@pytest.mark.parametrize(("speed", "reboots"), [(1, 0), (1.1, 0), (2, 1), (20, 1)])
def test_lost_link_soon_after_connect_real_time_is_recognised(speed: float, reboots: int) -> None:
    stage = Watched()
    stage.clock(100_000)
    stage.clock(100_000 + round(800 * speed), after=0.8)
    stage.lose_link()
    assert stage.clock(110_800, after=10.0) == reboots


def test_clock_read_once_before_lost_link_must_continue() -> None:
    for continues in (True, False):
        stage = Watched()
        stage.clock(100_000)
        stage.lose_link()
        resumed_ms = 110_000 if continues else 150_000
        stage.clock(resumed_ms, after=10.0)
        assert stage.clock(resumed_ms + 1100, after=1.1) == (not continues)


def test_lost_link_without_clock_afterwards_is_reboot() -> None:
    stage = watched_without_link()
    for at in (10.0, 5.0, 0.1):
        stage.at += at
        stage.receive(HEARTBEAT)
        stage.watch.check()
        assert stage.watch.reboots == (at == 0.1)
    assert stage.watch.last_heartbeat_at < 20.0  # Until then, no message counts.


@pytest.mark.parametrize(("booted_at", "reboots"), [(0.0, 0), (-1.7e9, 1)])
def test_timesync_answer_shows_same_boot_after_lost_link(booted_at: float, reboots: int) -> None:
    """The time of day shows nothing, because all vehicles have the same."""
    stage = Watched()
    for _ in range(2):
        stage.at += 10.0
        stage.receive(Timesync(round((stage.at - booted_at) * 1e9), 5))
    stage.lose_link()
    stage.at += 10.0
    stage.receive(Timesync(round((stage.at - booted_at) * 1e9), 5))
    stage.receive(HEARTBEAT)
    assert (stage.watch.reboots, stage.watch.last_heartbeat_at) == (reboots, stage.at)


def test_timesync_request_of_vehicle_is_ignored() -> None:
    stage = Watched()
    stage.receive(Timesync(100_000_000_000, 5))
    with stage.watch.expecting_reboot():
        stage.at += 1.0
        stage.receive(Timesync(0, 6))
    assert stage.watch.reboots == 0


def test_timesync_earlier_time_is_reboot_if_requested_later() -> None:
    stage = Watched()
    stage.at = 10.0
    stage.watch.on_time_answer(9.9, 5000)
    stage.at = 11.0
    stage.watch.on_time_answer(10.0, 4000)  # asked when the other one had not come yet
    assert stage.watch.reboots == 0
    stage.watch.on_time_answer(10.5, 5000)
    assert stage.watch.reboots == 0
    stage.at = 12.0
    stage.watch.on_time_answer(11.5, 4999)
    assert stage.watch.reboots == 1
    stage.at = 13.0
    stage.watch.on_time_answer(12.5, 0)  # of its first millisecond: the same reboot
    assert stage.watch.reboots == 1


# ----------------------------------------------------------------------------------- silence


def test_silence_event_is_published_once_after_limit() -> None:
    stage = Watched()
    for at, silent in ((3.5, False), (3.6, True), (9.0, True)):
        stage.at = at
        stage.watch.check()
        assert stage.watch.is_silent is silent
    for component_id, silent in ((154, True), (1, False)):
        stage.receive(HEARTBEAT, component_id=component_id)
        assert stage.watch.is_silent is silent
    assert (stage.event_counts()[VehicleSilent], stage.event_counts()[VehicleRecovered]) == (1, 1)
    (back,) = [event for event in stage.bus.published if isinstance(event, VehicleRecovered)]
    assert back.silent_for_s == 9.0


# ---------------------------------------------------------------------------------- the link


class Measured(Stage):
    def __init__(self) -> None:
        super().__init__()
        self.reports, self.answers = list[LinkReport](), list[tuple[float, int]]()
        self.watch = LinkWatch(self.connection, 1, 1, self.reports.append, lambda *answer: self.answers.append(answer))

    def request_time(self) -> Timesync:
        self.watch.request_time()
        question = self.sent[-1]
        assert isinstance(question, Timesync)
        return question

    def report(self, counted: tuple[int, int], total: int) -> LinkReport:
        self.at, self.counted, self.bytes = self.at + 1.0, counted, total
        self.watch._report()
        return self.reports[-1]


def test_round_trip_uses_first_answer() -> None:
    stage = Measured()
    stage.at = 5.0
    question = stage.request_time()
    assert (question.tc1, question.ts1) == (0, 5_000_000_000)
    answer = Timesync(77_000_000, question.ts1)
    stage.at = 5.1
    stage.receive(answer, component_id=154)
    stage.receive(Timesync(0, question.ts1))
    stage.receive(Timesync(77_000_000, 12345))
    assert stage.watch.round_trip_s is None
    stage.receive(answer)
    stage.at = 5.9
    stage.receive(answer)  # a second copy of it
    assert stage.watch.round_trip_s == pytest.approx(0.1)
    assert stage.answers == [(5.0, 77)]


def test_round_trip_without_further_answers_is_unknown_again() -> None:
    stage = Measured()
    question = stage.request_time()
    stage.at = 1.0
    stage.receive(Timesync(77_000_000, question.ts1))
    reported = []
    for stage.at in (10.0, 10.1):  # The report follows a second later.
        reported.append(stage.report((0, 0), 0).round_trip_s)
    assert reported == [1.0, None]


def test_loss_and_rates_of_a_second() -> None:
    stage = Measured()
    report = stage.report((75, 25), 4000)
    assert (report.loss_percent, report.frames_per_s, report.bytes_per_s) == (25.0, 75.0, 4000.0)
    report = stage.report((75, 25), 4000)
    assert (report.loss_percent, report.frames_per_s, report.bytes_per_s) == (None, 0.0, 0.0)
    report = stage.report((10, 20), 4000)  # a peer that was forgotten takes its counters along
    assert (report.loss_percent, report.frames_per_s) == (None, 0.0)
    report = stage.report((5, 30), 4000)
    assert (report.loss_percent, report.frames_per_s) == (100.0, 0.0)


# ------------------------------------------------------------------------------------------- stalls


class StallStage:
    def __init__(self) -> None:
        self.at = 0.0
        self.cell = StateCell[Position]("position", lambda: self.at, "GLOBAL_POSITION_INT")
        unknown = SimpleNamespace(latest=None)
        telemetry = SimpleNamespace(position=self.cell, velocity=unknown, armed=unknown)
        session = SimpleNamespace(connection=SimpleNamespace(now=lambda: self.at), telemetry=telemetry)
        self.stillness = StallDetector(cast("VehicleSession", session))

    def receive(self, place: Position | None, at: float) -> str | None:
        self.at = at
        if place is not None:
            self.cell.set(place, Source(1, 1, "GLOBAL_POSITION_INT"))
        return self.stillness()


HERE = Position(47.0, 8.0)


@pytest.mark.parametrize("altitudes", [{}, {"altitude_relative_m": 5.0}, {"altitude_amsl_m": 5.0}])
def test_stall_detector_reports_after_twelve_seconds(altitudes: dict[str, float]) -> None:
    order_status, here = StallStage(), Position(47.0, 8.0, **altitudes)
    for at in range(12):
        assert order_status.receive(here, float(at)) is None
    assert order_status.receive(here, 12.0) == "the vehicle has not moved for 12 s"


@pytest.mark.parametrize(
    ("further", "moves"),
    [
        (HERE.offset(north_m=0.29), False),
        (HERE.offset(north_m=0.31), True),
        (Position(47.0, 8.0, altitude_amsl_m=5.31), True),
        (Position(47.0, 8.0, altitude_amsl_m=4.69), True),
        (Position(47.0, 8.0, altitude_amsl_m=5.29), False),
        (Position(47.0, 8.0, altitude_amsl_m=5.0, altitude_relative_m=9.0), False),
    ],
)
def test_stall_detector_small_movement_counts(further: Position, moves: bool) -> None:
    order_status = StallStage()
    here = HERE if further.altitude_amsl_m is None else HERE.replace(altitude_amsl_m=5.0, altitude_relative_m=5.0)
    for at in range(12):
        order_status.receive(here, float(at))
    assert (order_status.receive(further, 12.0) is None) is moves
    assert (order_status.receive(further, 23.0) is None) is moves


def test_position_older_than_two_seconds_is_unknown() -> None:
    order_status = StallStage()
    assert order_status.receive(None, 0.0) is None
    assert order_status.receive(HERE, 1.0) is None
    assert order_status.receive(None, 3.1) is None
    for at in range(4, 16):
        assert order_status.receive(HERE, float(at)) is None
    assert order_status.receive(None, 17.0) is not None
    assert order_status.receive(None, 17.1) is None


@pytest.mark.parametrize(("speed_m_s", "wanted"), [(SLOW_M_S, True), (0.99 * SLOW_M_S, False)])
def test_stall_velocity_threshold(speed_m_s: float, wanted: bool) -> None:
    unused = cast("VehicleContext", None)  # A velocity needs no context.
    assert wants_motion(VelocitySetpoint(east_m_s=speed_m_s), unused) is wanted
    assert wants_motion(BodyVelocitySetpoint(right_m_s=speed_m_s), unused) is wanted


@pytest.mark.parametrize(
    ("away_m", "wanted"), [(0.0, False), (3.0, False), (3.1, True), (1e7, True), (math.inf, False)]
)
def test_stall_global_position_requires_distance(away_m: float, wanted: bool) -> None:
    session = SimpleNamespace(autopilot=SimpleNamespace(arrival_radius_m=3.0 / MAX_RESTING_RADII))
    where = SimpleNamespace(distance_to=lambda _: away_m)  # infinite while the position is unknown
    context = cast("VehicleContext", SimpleNamespace(session=session, vehicle_position=where))
    assert wants_motion(PositionSetpoint(HERE), context) is wanted


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("off_m", "wanted"), [(0.0, False), (2.9, False), (3.1, True), (-3.1, True)])
def test_stall_local_position_requires_distance(axis: int, off_m: float, wanted: bool) -> None:
    """The distance along each axis counts."""
    here = LocalPosition(-5.0, 7.0, -10.0, 0.0, 0.0, 0.0)
    telemetry = SimpleNamespace(local_position=SimpleNamespace(latest=here))
    session = SimpleNamespace(autopilot=SimpleNamespace(arrival_radius_m=3.0 / MAX_RESTING_RADII), telemetry=telemetry)
    place = [here.north_m, here.east_m, here.down_m]
    place[axis] += off_m
    context = cast("VehicleContext", SimpleNamespace(session=session))
    assert wants_motion(LocalPositionSetpoint(*place), context) is wanted
    telemetry.local_position.latest = None
    assert wants_motion(LocalPositionSetpoint(*place), context) is False
