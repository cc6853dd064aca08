"""Commands between the client's protocol machine and simulated vehicles over bad radios."""

from __future__ import annotations

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from protocol_pair import KINDS, Pair, radios, seeds, vehicle_of

from aerokit.errors import CommandRejected
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, Timesync
from aerokit.protocols.command import CommandExchange, command_long
from aerokit.protocols.exchange import Exchange
from aerokit.testing.fault_model import FaultModel

# No shrinking: a failure reports radio and seed, and shrinking a transfer that hangs would take minutes.
few = settings(max_examples=8, phases=[Phase.generate])
each = pytest.mark.parametrize("kind", KINDS)


def execute(command: int, *params: float) -> CommandExchange:
    """Send a command often enough for the worst radio, and return the result and the effect."""
    return CommandExchange(command_long(1, 1, command, params), own_system=255, own_component=190, attempts=60)


@each
@few
@given(radio=radios, seed=seeds, armed=st.lists(st.booleans(), min_size=1, max_size=4))
def test_accepted_command_was_executed(kind: str, radio: FaultModel, seed: int, armed: list[bool]) -> None:
    vehicle = vehicle_of(kind)
    pair = Pair(vehicle, radio, seed)
    for wanted in armed:
        assert pair.run(execute(MavCmd.COMPONENT_ARM_DISARM, wanted)).result == MavResult.ACCEPTED
        assert vehicle.is_armed is wanted
        pair.wait(2.0)  # Repetitions of the command are still in transit.
        assert vehicle.is_armed is wanted


@each
@few
@given(radio=radios, seed=seeds)
def test_refusal_arrives(kind: str, radio: FaultModel, seed: int) -> None:
    vehicle = vehicle_of(kind)
    vehicle.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.DENIED)
    with pytest.raises(CommandRejected) as caught:
        Pair(vehicle, radio, seed).run(execute(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10))
    assert caught.value.result == MavResult.DENIED
    assert not vehicle.is_armed


@each
@few
@given(radio=radios, seed=seeds, percents=st.lists(st.integers(1, 99), max_size=5).map(sorted))
def test_progress_precedes_the_result(kind: str, radio: FaultModel, seed: int, percents: list[int]) -> None:
    vehicle = vehicle_of(kind)
    vehicle.faults.report_progress(MavCmd.PREFLIGHT_CALIBRATION, tuple(percents))
    reported: list[int | None] = []
    exchange = CommandExchange(
        command_long(1, 1, MavCmd.PREFLIGHT_CALIBRATION, (0, 0, 1)),
        own_system=255,
        own_component=190,
        attempts=60,
        on_progress=reported.append,
    )
    result: int = MavResult.ACCEPTED
    try:
        result = Pair(vehicle, radio, seed).run(exchange).result
    except TimeoutError:
        assert reported  # A command in progress whose result was lost must not be sent again.
    except CommandRejected as refusal:
        # The command arrived twice, by a retry or a duplicated frame, which cancels PX4's calibration.
        result = refusal.result
    assert result in (MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED)
    assert set(reported) <= set(percents)


@each
@few
@given(radio=radios, seed=seeds, rate_hz=st.integers(1, 20))
def test_accepted_rate_is_streamed(kind: str, radio: FaultModel, seed: int, rate_hz: int) -> None:
    vehicle = vehicle_of(kind)
    pair = Pair(vehicle, radio, seed)
    pair.run(execute(MavCmd.SET_MESSAGE_INTERVAL, Attitude.ID, 1e6 // rate_hz))
    assert vehicle.channels[0].streams.interval(Attitude.ID) == pytest.approx(1 / rate_hz, rel=0.05)


class ClockQuestion(Exchange[Timesync]):
    """Send TIMESYNC until one of the requests is answered."""

    expects = (Timesync,)

    def start(self, now: float) -> None:
        self.asked = {int(now * 1e9) + 1}
        self._outbox.append(Timesync(0, max(self.asked)))
        self.deadline = now + 1.0

    def receive(self, message: Message, now: float) -> None:
        if isinstance(message, Timesync) and message.tc1 != 0:
            assert message.ts1 in self.asked
            self._finish(message)

    def expire(self, now: float) -> None:
        self.asked.add(int(now * 1e9) + 1)
        self._outbox.append(Timesync(0, max(self.asked)))
        self.deadline = now + 1.0


@each
@few
@given(radio=radios, seed=seeds)
def test_timesync_reply_contains_the_request(kind: str, radio: FaultModel, seed: int) -> None:
    pair = Pair(vehicle_of(kind), radio, seed)
    asked_at = pair.now
    answer = pair.run(ClockQuestion())
    assert asked_at - 0.001 <= answer.tc1 / 1e9 <= pair.now
