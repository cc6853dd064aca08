"""Behaviour that all simulated vehicles share, tested with a copter."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from simulated_client import Client, flying_copter, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavDataStream, MavType
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.sim import ExtraComponent, SimulatedCopter, SimulatedWind
from aerokit.sim.channel import datagrams


def recorded(steps: list[float]) -> bytes:
    """Return everything that a copter sends during a take-off at fixed times, with these steps in between."""
    copter = SimulatedCopter(boot_time_s=1.0, seed=7, wind=SimulatedWind(3.0, 1.0, gusts_m_s=1.0))
    encoder = FrameEncoder(255, 190)
    commands = [
        (1.5, m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1)),
        (1.5, m.CommandLong(1, 1, MavCmd.DO_SET_MODE, 0, 1, 4, 0, 0, 0, 0, 0)),
        (2.0, m.CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)),
        (2.5, m.CommandLong(1, 1, MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 5)),
    ]
    sent = b""
    moments = sorted({sum(steps[: i + 1]) for i in range(len(steps))} | {0.0, 8.0})
    events: list[tuple[float, Message | None]] = [(t, None) for t in moments if t <= 8.0]
    for now, message in sorted([*events, *commands], key=lambda pair: pair[0]):
        if message is None:
            copter.step(now)
        else:
            copter.receive(encoder.encode(message), now)
        sent += copter.take_outbox()
    return sent


@settings(max_examples=10)
@given(st.lists(st.floats(0.001, 3.0), max_size=10))
def test_step_size_changes_nothing(steps: list[float]) -> None:
    assert recorded(steps) == recorded([0.013] * 620)


def test_next_due_is_never_in_the_past() -> None:
    copter, client = flying_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 10, 1))
    for _ in range(200):
        due = copter.next_due
        assert due > copter.now
        copter.step(due)


def test_disarmed_vehicle_is_idle_between_heartbeats() -> None:
    copter, client = ready_copter()
    wakes = 0
    while copter.now < client.now + 10.0:
        copter.step(copter.next_due)
        wakes += 1
    assert wakes < 350  # Failsafes and GPS at 10 Hz, heartbeat and arming checks at 1 Hz.


def test_messages_to_others_are_ignored() -> None:
    _, client = ready_copter(components=[ExtraComponent(154)])
    for target in ((2, 1), (1, 154), (2, 0)):
        client.send(m.CommandLong(*target, MavCmd.DO_SEND_BANNER, 0, 0, 0, 0, 0, 0, 0, 0))
    assert client.all(m.CommandAck) == []
    for target in ((1, 1), (1, 0), (0, 0), (1, 99)):
        client.send(m.CommandLong(*target, MavCmd.DO_SEND_BANNER, 0, 0, 0, 0, 0, 0, 0, 0))
    assert len(client.all(m.CommandAck)) == 4, "ArduPilot also executes messages for a missing component"


def test_answers_are_addressed_to_the_sender() -> None:
    copter, client = ready_copter()
    other = Client(copter, system_id=42, component_id=191)
    other.now = client.now
    other.command(MavCmd.DO_SEND_BANNER)
    ack = other.last(m.CommandAck)
    assert (ack.target_system, ack.target_component) == (42, 191)


def test_long_texts_are_sent_in_chunks() -> None:
    copter, client = ready_copter()
    copter.send_text(4, "a" * 100)
    copter.send_text(4, "b" * 60)
    copter.send_text(4, "c" * 50)
    client.run(0.1)
    texts = [(t.text, t.id, t.chunk_seq) for t in client.all(m.Statustext)]
    assert texts[:3] == [("a" * 50, 1, 0), ("a" * 50, 1, 1), ("", 1, 2)]
    assert texts[3:5] == [("b" * 50, 2, 0), ("b" * 10, 2, 1)]
    assert texts[5:] == [("c" * 50, 0, 0)]


def test_channels_have_separate_rates() -> None:
    copter, client = ready_copter()
    second = copter.open_channel(version=1)
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 10, 1))
    client.run(2.5)
    received = [STANDARD.decode(frame) for frame in Framer().receive(second.take_outbox())]
    assert len(client.all(m.Attitude)) >= 24
    assert {type(message) for message in received} == {m.Heartbeat}
    assert all(message.received_frame and message.received_frame.version == 1 for message in received)


def test_datagrams_hold_whole_frames() -> None:
    copter, _ = ready_copter()
    channel = copter.channels[0]
    for _ in range(100):
        copter.send_text(6, "x" * 45)
    copter.step(copter.now)
    sent = datagrams(channel.take_pieces())
    assert len(sent) > 3
    assert all(len(data) <= 1200 for data in sent)
    assert sum(len(Framer().receive(data)) for data in sent) == 100


def test_extra_components_send_heartbeats() -> None:
    gimbal = ExtraComponent(154)
    tracker = ExtraComponent(1, type=MavType.ANTENNA_TRACKER, system_id=7)
    _, client = ready_copter(components=(gimbal, tracker))
    client.run(3.0)
    senders = {(f.system_id, f.component_id) for h in client.all(m.Heartbeat) if (f := h.received_frame)}
    assert senders == {(1, 1), (1, 154), (7, 1)}


# ------------------------------------------------------------------------------------------ faults


def test_lost_frames_leave_gaps_in_the_sequence() -> None:
    copter, client = ready_copter()
    client.framer = Framer()
    client.run(1.0)
    copter.faults.drop_outgoing = 3
    client.run(5.0)
    statistics = client.framer.statistics
    assert copter.faults.drop_outgoing == 0
    assert sum(source.lost for source in statistics.sources.values()) == 3


def test_seed_determines_random_loss() -> None:
    counts = []
    for _ in range(2):
        copter, client = ready_copter(seed=3)
        client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 10, 1))
        copter.faults.loss = 0.3
        client.run(10.0)
        counts.append(len(client.received))
    assert counts[0] == counts[1]
    assert 0.6 < counts[0] / (10 * 10 * 27) < 0.8


def test_silent_and_frozen_faults() -> None:
    copter, client = flying_copter()
    copter.faults.silent = True
    client.run(3.0)
    assert client.command(MavCmd.DO_SEND_BANNER) is None
    assert client.received == []
    copter.faults.silent, copter.faults.frozen = False, True
    uptime = copter.uptime
    client.run(3.0)
    assert client.received == []
    assert copter.uptime > uptime
    copter.faults.frozen = False
    client.run(1.5)
    assert 1 <= len(client.all(m.Heartbeat)) <= 2
    assert client.command(MavCmd.DO_SEND_BANNER) == 0


def test_missed_calls_do_not_follow_a_freeze() -> None:
    copter, client = ready_copter(components=(ExtraComponent(154),))
    copter.faults.frozen = True
    client.run(10.0)
    copter.faults.frozen = False
    client.run(3.0)
    components = [h.received_frame.component_id for h in client.all(m.Heartbeat) if h.received_frame]
    assert components.count(154) == 3


def test_heartbeats_stop_alone() -> None:
    copter, client = ready_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 4, 1))
    copter.faults.heartbeats_stopped = True
    client.run(3.0)
    assert client.all(m.Heartbeat) == []
    assert len(client.all(m.Attitude)) >= 12


def test_command_faults() -> None:
    copter, client = ready_copter()
    banner = MavCmd.DO_SEND_BANNER
    copter.faults.refuse(banner, 1, "PreArm: not today", times=1)
    assert client.command(banner) == 1
    assert client.texts == ["PreArm: not today"]
    assert client.command(banner) == 0
    copter.faults.ignore(banner, times=1)
    assert client.command(banner) is None
    client.clear()
    copter.faults.lose_ack(banner)
    assert client.command(banner) is None
    assert len(client.texts) == 3, "it was executed nevertheless"
    copter.faults.repeat_ack(banner, 2, times=1)
    client.clear()
    client.command(banner)
    assert len(client.all(m.CommandAck)) == 2


def test_delayed_and_progressing_answers() -> None:
    copter, client = ready_copter()
    banner = MavCmd.DO_SEND_BANNER
    copter.faults.delay_ack(banner, 2.0, times=1)
    assert client.command(banner) is None
    client.run(1.9)
    assert client.all(m.CommandAck) == []
    client.run(0.2)
    assert client.last(m.CommandAck).result == 0
    client.clear()
    copter.faults.report_progress(banner, (10, 90), interval_s=0.5)
    client.command(banner)
    client.run(2.0)
    assert [(a.result, a.progress) for a in client.all(m.CommandAck)] == [(5, 10), (5, 90), (0, 0)]
    copter.faults.clear()
    assert client.command(banner) == 0


# -------------------------------------------------------------------------------------- robustness


@given(st.binary(max_size=400))
def test_random_bytes_are_handled(data: bytes) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.receive(data, 1.0)
    copter.receive(data, 2.0, peer="other")
    copter.step(3.0)


FLOATS = st.floats(width=32)


@given(
    command=st.sampled_from([int(c) for c in MavCmd]),
    numbers=st.tuples(*(FLOATS,) * 7),
    flying=st.booleans(),
)
def test_any_command_is_answered_once(command: int, numbers: tuple[float, ...], flying: bool) -> None:
    copter, client = flying_copter() if flying else ready_copter()
    client.command(command, *numbers)
    client.run(2.0)
    assert len(client.all(m.CommandAck)) == 1
    client.run(3.0)
    assert client.framer.statistics.bad_crcs == 0
    assert abs(copter.motion.down) < 100


@pytest.mark.exhaustive
@given(
    mask=st.integers(0, 0xFFF),
    frame=st.integers(0, 21),
    numbers=st.tuples(*(FLOATS,) * 11),
)
@example(mask=9, frame=0, numbers=(*(0.0,) * 6, math.inf, *(0.0,) * 4))
@example(mask=9, frame=18, numbers=(0.0, 0.0, 0.0, -6e16, 6e16, -4e16, math.nan, 6e16, 0.0, 8e37, -5e16))
def test_any_setpoint_is_handled(mask: int, frame: int, numbers: tuple[float, ...]) -> None:
    rates_and_thrust = numbers[4], numbers[5], numbers[6], numbers[7]
    copter, client = flying_copter()
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, frame, mask, *numbers))
    client.send(m.SetAttitudeTarget(0, 1, 1, mask & 0xFF, numbers[:4], *rates_and_thrust))
    client.send(m.SetPositionTargetGlobalInt(0, 1, 1, frame, mask, 473_000_000, 85_000_000, *numbers[2:]))
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
    client.run(2.0)
    assert copter.motion.north == pytest.approx(copter.motion.north)  # Not NaN.
    assert client.all(m.GlobalPositionInt)
