"""Commands between our machine and simulated vehicles over bad radios: results, progress, rates, cameras, clocks."""

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

# Without shrinking: what fails says radio and seed, and a transfer that hangs would take minutes to shrink.
few = settings(max_examples=8, phases=[Phase.generate])
each = pytest.mark.parametrize("kind", KINDS)


def order(command: int, *params: float) -> CommandExchange:
    """Asked for so often that the worst of the radios lets one through, with what it caused."""
    return CommandExchange(
        command_long(1, 1, command, params), own_system=255, own_component=190, attempts=60
    )


@each
@few
@given(radio=radios, seed=seeds, armed=st.lists(st.booleans(), min_size=1, max_size=4))
def test_what_was_accepted_was_done(kind: str, radio: FaultModel, seed: int, armed: list[bool]) -> None:
    vehicle = vehicle_of(kind)
    pair = Pair(vehicle, radio, seed)
    for wanted in armed:
        assert pair.run(order(MavCmd.COMPONENT_ARM_DISARM, wanted)).result == MavResult.ACCEPTED
        assert vehicle.is_armed is wanted
        pair.wait(2.0)  # repetitions of the order that are still under way
        assert vehicle.is_armed is wanted


@each
@few
@given(radio=radios, seed=seeds)
def test_a_refusal_arrives_as_one(kind: str, radio: FaultModel, seed: int) -> None:
    vehicle = vehicle_of(kind)
    vehicle.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.DENIED)
    with pytest.raises(CommandRejected) as caught:
        Pair(vehicle, radio, seed).run(order(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10))
    assert caught.value.result == MavResult.DENIED
    assert not vehicle.is_armed


@each
@few
@given(radio=radios, seed=seeds, percents=st.lists(st.integers(1, 99), max_size=5).map(sorted))
def test_progress_is_told_and_then_the_result(
    kind: str, radio: FaultModel, seed: int, percents: list[int]
) -> None:
    vehicle = vehicle_of(kind)
    vehicle.faults.report_progress(MavCmd.PREFLIGHT_CALIBRATION, tuple(percents))
    told: list[int | None] = []
    exchange = CommandExchange(
        command_long(1, 1, MavCmd.PREFLIGHT_CALIBRATION, (0, 0, 1)),
        own_system=255,
        own_component=190,
        attempts=60,
        on_progress=told.append,
    )
    try:
        result = Pair(vehicle, radio, seed).run(exchange).result
    except TimeoutError:
        assert told  # it was in progress, and the radio swallowed the end: nobody may order it again
    except CommandRejected:  # the radio swallowed IN_PROGRESS: it was ordered again while it was being done
        assert not told
    else:
        assert result == MavResult.ACCEPTED
    assert set(told) <= set(percents)


@each
@few
@given(radio=radios, seed=seeds, rate_hz=st.integers(1, 20))
def test_a_rate_that_was_accepted_is_kept(kind: str, radio: FaultModel, seed: int, rate_hz: int) -> None:
    vehicle = vehicle_of(kind)
    pair = Pair(vehicle, radio, seed)
    pair.run(order(MavCmd.SET_MESSAGE_INTERVAL, Attitude.ID, 1e6 // rate_hz))
    assert vehicle.channels[0].streams.interval(Attitude.ID) == pytest.approx(1 / rate_hz, rel=0.05)


class ClockQuestion(Exchange[Timesync]):
    """TIMESYNC again and again until an answer to any of ours comes."""

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
def test_clocks_are_answered_with_the_question_in_them(kind: str, radio: FaultModel, seed: int) -> None:
    pair = Pair(vehicle_of(kind), radio, seed)
    asked_at = pair.now
    answer = pair.run(ClockQuestion())
    assert asked_at - 0.001 <= answer.tc1 / 1e9 <= pair.now
