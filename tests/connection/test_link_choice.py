"""The choice among several links, and copies of frames, by any history."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from aerokit import messages as m
from aerokit.connection.multilink.duplicates import Copies
from aerokit.connection.multilink.link_choice import MIN_CLOCK_MATCHES, PROBED_TIMEOUT_S, LinkChoice
from aerokit.connection.multilink.vehicle_clock import ClockSample, HardwareId, VehicleClock
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame

STEP_KINDS = (
    "heartbeat",
    "counts",
    "answer",
    "there",
    "gone",
    "stalled",
    "drained",
    "look",
    "hardware",
    "pause",
    "reboot",
)
STEPS = st.lists(
    st.tuples(
        st.sampled_from(STEP_KINDS),
        st.integers(0, 2),
        st.floats(0.01, 1.5),
        st.floats(0.0, 0.5),
    ),
    max_size=80,
)


@given(STEPS)
def test_unproven_link_is_never_used(
    steps: list[tuple[str, int, float, float]],
) -> None:
    """Link 2 leads to another vehicle: its clock is 300 s ahead, or more when ours has paused or rebooted.

    Both are simulated on one machine, so they report the same hardware id.
    """
    choice, now, begin = LinkChoice(has_autopilot=True), 1.0, -50.0
    choice.record_heartbeat(0, now, is_costly=False)
    assert choice.choose(now) == "first heard"
    received = 0
    for what, link, later, round_trip in steps:
        now += later
        candidate = (
            choice.record_heartbeat(link, now, is_costly=link == 1)
            if what == "heartbeat"
            else choice.candidates.get(link)
        )
        if candidate is None:
            continue
        if what == "counts":
            received += 5
            candidate.record_counts(received, 1, now)
        elif what == "answer":
            boot_s = now + 350.0 if link == 2 else max(0.0, now - begin)
            choice.record_answer(link, ClockSample(now - round_trip / 2, boot_s, round_trip), now)
        elif what == "hardware":
            choice.record_hardware(link, HardwareId(b"A" * 18, 0))
        elif what == "pause":
            begin += later
        elif what == "reboot":
            begin = now
        elif what in ("there", "gone"):
            candidate.is_available = what == "there"
        elif what in ("stalled", "drained"):
            candidate.is_stalled = what == "stalled"
        before = choice.used
        reason = choice.choose(now)
        assert choice.used is not None
        assert choice.used.link != 2
        if reason is not None:
            assert choice.used is not before
            assert choice.used.is_alive(now)
            if before is not None and before.is_alive(now):
                assert reason in ("better", "cheaper")
        elif choice.used is before and before is not None and not before.is_alive(now):
            others = [
                candidate
                for candidate in choice.candidates.values()
                if candidate is not before and candidate.is_same_vehicle
            ]
            assert not any(other.is_alive(now) for other in others), "a live link was not selected"


@given(st.floats(0.2, 20.0), st.floats(-1e5, 1e5), st.lists(st.floats(0.0, 0.4), min_size=3, max_size=30))
def test_clock_continues_at_any_speed(speed: float, begin: float, round_trips: list[float]) -> None:
    """Answers come with delays that are not the same both ways."""
    clock, now = VehicleClock(), 100.0
    for index, round_trip in enumerate(round_trips):
        now += 0.5
        boot_s = begin + speed * (now - round_trip / 2 + (round_trip / 2) * 0.2 * (-1) ** index)
        at = now - round_trip / 2
        assert clock.matches(ClockSample(at, boot_s, round_trip)) is not False
        assert not clock.matches(ClockSample(at, boot_s + 60.0 * max(1.0, speed), round_trip))
        assert clock.add(ClockSample(at, boot_s, round_trip))


def test_reboot_resets_proof_until_clock_matches_again() -> None:
    choice = LinkChoice(has_autopilot=True)
    for link in (0, 1):
        choice.record_heartbeat(link, 0.0, is_costly=False)
    choice.choose(0.0)
    for step in range(MIN_CLOCK_MATCHES + 1):
        for link in (0, 1):
            choice.record_answer(link, ClockSample(step, step + 70.0, 0.01), step)
    second = choice.candidates[1]
    proofs = [second.is_same_vehicle]
    choice.record_answer(0, ClockSample(5.0, 1.0, 0.01), 5.0)
    assert [*proofs, second.is_same_vehicle] == [True, None]
    choice.record_answer(0, ClockSample(6.0, 2.0, 0.01), 6.0)
    for step in range(MIN_CLOCK_MATCHES):
        choice.record_answer(1, ClockSample(6.0 + step, 2.0 + step, 0.01), 6.0 + step)
    assert choice.candidates[1].is_same_vehicle


def test_paused_clock_continues_at_the_same_speed() -> None:
    clock = VehicleClock()
    for step in range(10):
        assert clock.add(ClockSample(step, 70.0 + step, 0.01))
    assert clock.add(ClockSample(11.5, 79.0 + 1.0, 0.01)), "it stood still for 1.5 s"
    assert clock.matches(ClockSample(12.5, 81.0, 0.01))
    assert not clock.matches(ClockSample(12.5, 82.5, 0.01))
    assert not clock.add(ClockSample(13.0, 3.0, 0.01)), "it has rebooted"
    assert clock.matches(ClockSample(14.0, 4.0, 0.01))


@given(st.floats(0.2, 20.0), st.floats(0.2, 20.0))
def test_changed_clock_speed_is_measured_again(before: float, after: float) -> None:
    clock, boot_s = VehicleClock(), 0.0
    for step in range(40):
        boot_s += 0.5 * (before if step < 10 else after)
        clock.add(ClockSample(step / 2, boot_s, 0.01))
    assert clock.matches(ClockSample(21.0, boot_s + 1.5 * after, 0.01))


def test_hardware_alone_proves_only_previously_proven_link() -> None:
    """The link in use fails during the reboot, and a pause makes the clock of the other link useless."""
    for was_proven in (True, False):
        choice = LinkChoice(has_autopilot=True)
        for link in (0, 1):
            choice.record_heartbeat(link, 0.0, is_costly=False)
        choice.choose(0.0)
        for step in range(10):
            for link in (0, 1) if was_proven else (0,):
                choice.record_answer(link, ClockSample(step, step + 70.0, 0.01), step)
        choice.record_hardware(0, HardwareId(b"A" * 18, 0))
        choice.record_answer(0, ClockSample(10.0, 1.0, 0.01), 10.0)
        second = choice.candidates[1]
        assert (second.is_same_vehicle, second.was_same_vehicle) == (None, was_proven)
        for step in range(11, 20):
            choice.record_hardware(1, HardwareId(b"A" * 18, 0))
            choice.record_answer(1, ClockSample(step, step - 11.0, 0.01), step)
        assert bool(second.is_same_vehicle) is was_proven
        choice.record_hardware(1, HardwareId(b"B" * 18, 0))
        assert not choice.may_be_used(second)


def test_other_hardware_after_reboot_outweighs_the_clock() -> None:
    """Two vehicles are switched off and on together; the link in use fails before ours has reported its id again."""
    choice = LinkChoice(has_autopilot=True)
    for link in (0, 1):
        choice.record_heartbeat(link, 0.0, is_costly=False)
    choice.choose(0.0)
    for step in range(10):
        choice.record_answer(0, ClockSample(step, step + 70.0, 0.01), step)
    choice.record_hardware(0, HardwareId(b"A" * 18, 0))
    choice.record_answer(0, ClockSample(10.0, 1.0, 0.01), 10.0)
    for step in range(11, 20):
        choice.record_hardware(1, HardwareId(b"B" * 18, 0))
        choice.record_answer(1, ClockSample(step, step - 9.0, 0.01), step)
    assert not choice.may_be_used(choice.candidates[1])


def test_silence_counts_from_the_last_frame() -> None:
    choice = LinkChoice(has_autopilot=False)
    first = choice.record_heartbeat(0, 0.0, is_costly=False)
    second = choice.record_heartbeat(1, 0.0, is_costly=False)
    choice.choose(0.0)
    first.record_round_trip(0.05, 1.0)
    second.received_at = 1.0 + PROBED_TIMEOUT_S
    assert choice.choose(1.0 + PROBED_TIMEOUT_S) is None
    assert choice.choose(1.01 + PROBED_TIMEOUT_S) == "silent"
    assert choice.used is second
    assert math.isclose(choice.fresh_after, 1.0 - 0.025 + 0.05)


def frame_of(sequence: int, at: float, value: int = 0) -> Frame:
    encoder = FrameEncoder(1, 1)
    raw = bytearray(encoder.encode(m.SystemTime(0, value)))
    raw[4] = sequence
    return Frame.parse(bytes(raw), at)


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(0.0, 2.0)), max_size=6), st.integers(0, 255))
def test_one_copy_of_each_frame_is_accepted(rest: list[tuple[int, float]], sequence: int) -> None:
    copies, observed = Copies(), set[int]()
    taken = 0
    for link, delay in sorted(rest, key=lambda copy: copy[1]):
        if link in observed:
            continue  # the same link again: another frame
        observed.add(link)
        if not copies.record(frame_of(sequence, 10.0 + delay), link):
            taken += 1
            copies.current.is_delivered = True
        else:
            assert copies.current.is_delivered
    assert taken == (1 if observed else 0)


def test_equal_bytes_same_link_or_later_are_not_copies() -> None:
    copies = Copies()
    assert not copies.record(frame_of(7, 0.0), 0)
    assert not copies.record(frame_of(7, 0.1), 0)
    assert copies.record(frame_of(7, 0.2), 1)
    assert not copies.record(frame_of(7, 4.0), 1)
    for number in range(130):
        assert not copies.record(frame_of((8 + number) % 256, 4.1, number + 1), 0)
    assert not copies.record(frame_of(7, 4.2), 0), "its sequence numbers have wrapped around"


def test_copies_are_bounded() -> None:
    copies = Copies()
    for number in range(20_000):
        copies.record(frame_of(number % 256, 0.0, number), 0)
    assert len(copies._seen) <= 4096
