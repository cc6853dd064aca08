"""Orders: sent again only right after the vehicle has told what it does; the limits of commands to the last one."""

from __future__ import annotations

from typing import Any

import pytest
from parameter_channel import framed

from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandLong
from aerokit.protocols.command import (
    ATTEMPTS,
    FLOAT32_MAX,
    SENT_ONCE,
    CommandExchange,
    attempts_of,
    command_int,
    command_long,
    command_name,
    result_name,
)

ARM = MavCmd.COMPONENT_ARM_DISARM
ACCEPTED, DENIED, IN_PROGRESS = 0, 2, 5


class Told:
    """What has been heard of the order, at the test's word."""

    def __init__(self, end: str = "", told_at: float = -1.0) -> None:
        self.end, self.told_at = end, told_at


def order(
    standing: Told | None = None, *, component: int = 1, arm: float = 0.0, **options: Any
) -> CommandExchange:
    message = command_long(1, component, ARM, (arm,))
    machine = CommandExchange(message, own_system=255, own_component=190, standing=standing, **options)
    machine.start(0.0)
    return machine


def confirmations(machine: CommandExchange) -> list[int]:
    return [each.confirmation for each in machine.take_outbox() if isinstance(each, CommandLong)]


def ack(result: int, progress: int = 0) -> CommandAck:
    return CommandAck(ARM, result, progress, 0, 255, 190)


def text_of(machine: CommandExchange) -> str:
    with pytest.raises(CommandTimeout) as caught:
        machine.result()
    return str(caught.value)


# ------------------------------------------------------------------------------- sent again


def test_it_is_sent_again_when_the_vehicle_has_told_what_it_does_for_three_quarters_of_a_second() -> None:
    standing = Told()
    machine = order(standing)
    assert confirmations(machine) == [0]
    assert machine.deadline == 0.75
    standing.told_at = 0.74
    machine.expire(0.75)
    assert confirmations(machine) == []
    assert machine.deadline == pytest.approx(0.8)
    standing.told_at = 0.75
    machine.expire(0.8)
    assert confirmations(machine) == [1]
    assert machine.deadline == pytest.approx(1.55)
    machine.expire(1.55)  # what was told before the last sending counts no more
    assert confirmations(machine) == []


def test_it_is_not_sent_again_when_it_stands_no_more_whatever_was_told() -> None:
    machine = order(Told("the pilot took over", told_at=5.0))
    assert confirmations(machine) == [0]
    machine.expire(0.75)
    assert machine.done
    assert confirmations(machine) == []
    assert text_of(machine).endswith("sent once within 0.8 s; not sent again: the pilot took over")


def test_into_a_silence_it_is_sent_once_and_ends_in_its_time() -> None:
    machine, looked, now = order(Told(), attempts=3), 0, 0.0
    while not machine.done:
        assert machine.deadline is not None
        assert machine.deadline <= 3.0
        now = machine.deadline
        machine.expire(now)
        looked += 1
    assert now == 3.0
    assert looked <= 50
    assert confirmations(machine) == [0]
    assert "sent once within 3.0 s; not sent again: the vehicle has not told since" in text_of(machine)


def test_last_sending_is_waited_for_while_the_order_stands() -> None:
    standing = Told(told_at=0.75)
    machine = order(standing, attempts=2)
    machine.expire(0.75)
    assert confirmations(machine) == [0, 1]
    assert machine.deadline == 1.5
    standing.told_at = 1.75
    machine.expire(1.75)
    assert not machine.done
    standing.end = "the pilot took over"
    machine.expire(1.8)
    assert confirmations(machine) == []
    assert text_of(machine).endswith("sent 2 times within 1.8 s; not sent again: the pilot took over")


@pytest.mark.parametrize("command", SENT_ONCE)
def test_order_that_would_be_done_twice_is_sent_once(command: int) -> None:
    what, where = SENT_ONCE[command]
    params = [0.0] * 7 if where is None else [1.0 - where[1]] * 7
    if where is not None:
        assert attempts_of(command, params) == ATTEMPTS
        params[where[0]] = where[1]
    standing, now = Told(), 0.0
    message = command_long(1, 1, command, tuple(params))
    machine = CommandExchange(message, own_system=255, own_component=190, standing=standing)
    machine.start(now)
    while not machine.done:
        assert machine.deadline is not None
        now = standing.told_at = machine.deadline
        machine.expire(now)
    assert now == 4.0
    assert confirmations(machine) == [0]
    assert text_of(machine).endswith(f"within 4.0 s; never sent again: a second one {what}")


def test_order_sent_once_ends_as_soon_as_its_effect_was_told() -> None:
    standing = Told()
    machine = order(standing, arm=1.0)
    standing.end = "its effect was told"
    machine.expire(1.0)
    assert machine.done


def test_what_was_sent_already_is_not_sent_by_the_start() -> None:
    machine = order(is_sent=True)
    assert machine.take_outbox() == []
    machine.expire(1.0)
    assert confirmations(machine) == [1]


def test_confirmation_stays_at_its_greatest_value() -> None:
    machine = order(attempts=258)
    for now in range(1, 258):
        machine.expire(float(now))
    assert confirmations(machine)[254:] == [254, 255, 255, 255]


# ---------------------------------------------------------------------------------- answers


def test_answers_to_an_earlier_command_of_the_same_number_are_not_ours() -> None:
    machine = order(answers_before_ours=1)
    machine.receive(ack(IN_PROGRESS), 0.1)  # no answer yet
    assert machine.deadline == 1.0
    machine.receive(ack(DENIED), 0.2)
    assert not machine.done
    assert machine.answers_to_come == 1
    machine.receive(ack(ACCEPTED), 0.3)
    assert machine.result().result == ACCEPTED


@pytest.mark.parametrize("attempts", [1, 2])
def test_every_answer_counts_after_the_command_was_sent_again_or_if_it_never_is(attempts: int) -> None:
    machine = order(answers_before_ours=3, attempts=attempts)
    for now in range(1, attempts):
        machine.expire(float(now))
    machine.receive(ack(DENIED), 2.1)
    with pytest.raises(CommandRejected):
        machine.result()


def test_answers_to_come_are_those_to_what_was_sent() -> None:
    machine = order(attempts=3)
    assert machine.answers_to_come == 1
    machine.expire(1.0)
    assert machine.answers_to_come == 2
    machine.receive(ack(IN_PROGRESS), 1.1)
    assert machine.answers_to_come == 2
    machine.receive(ack(ACCEPTED), 1.2)
    assert machine.answers_to_come == 1


def test_answers_to_come_are_counted_beside_those_before_ours() -> None:
    machine = order(answers_before_ours=2, answers_to_each=2)
    for answers, to_come in [(1, 2), (2, 2), (3, 1)]:
        machine.receive(ack(ACCEPTED), 0.1)
        assert (machine.answers, machine.answers_to_come) == (answers, to_come)
    assert machine.done


@pytest.mark.parametrize(("target", "sender", "is_ours"), [(1, 1, True), (1, 154, False), (0, 154, True)])
def test_only_the_component_that_was_asked_answers(target: int, sender: int, is_ours: bool) -> None:
    machine = order(component=target)
    machine.receive(framed(ack(ACCEPTED), component_id=sender), 0.1)
    assert machine.done is is_ours


def test_progress_is_a_percentage_or_not_told() -> None:
    told: list[int | None] = []
    machine = order(on_progress=told.append, progress_timeout=3.0)
    for percent in (0, 1, 100, 101):
        machine.receive(ack(IN_PROGRESS, percent), 0.5)
    assert told == [None, 1, 100, None]
    machine.expire(3.4)
    assert not machine.done
    machine.expire(3.5)
    assert text_of(machine).endswith("was in progress, then nothing came for 3 s")


def test_a_refusal_says_what_helps() -> None:
    machine = order()
    machine.receive(ack(8), 0.1)
    with pytest.raises(CommandRejected, match="it has to be sent as COMMAND_INT"):
        machine.result()
    assert (command_name(54321), result_name(99)) == ("MAV_CMD 54321", "MAV_RESULT 99")


# ----------------------------------------------------------------------------------- limits


def test_the_last_allowed_values_are_allowed() -> None:
    assert command_long(255, 0, ARM, (FLOAT32_MAX, -FLOAT32_MAX)).target_system == 255
    for x, y in ((-(2**31), 2**31 - 1), (2**31 - 1, -(2**31))):
        made: Message = command_int(1, 1, 192, (1, 2, 3, 4), frame=6, x=x, y=y, z=FLOAT32_MAX)
        assert (made.to_dict()["x"], made.to_dict()["y"]) == (x, y)


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ({"x": -(2**31) - 1}, "x = -2147483649"),
        ({"y": 2**31}, "y = 2147483648"),
        ({"y": 1.5}, r"y = 1\.5"),
        ({"z": 3.5e38}, r"z = 3\.5e\+38"),
        ({"z": float("inf")}, "z = inf"),
    ],
)
def test_places_beyond_their_type_are_refused(place: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        command_int(1, 1, 192, frame=6, **({"x": 0, "y": 0, "z": 0.0} | place))


@pytest.mark.parametrize("system", [0, 256])
def test_a_target_is_a_single_system(system: int) -> None:
    for make in (
        lambda: command_long(system, 0, ARM),
        lambda: command_int(system, 0, 192, frame=6, x=0, y=0, z=0),
    ):
        with pytest.raises(InvalidArgument, match=f"target_system = {system}"):
            make()


def test_a_command_is_sent_at_least_once() -> None:
    with pytest.raises(InvalidArgument, match="attempts = 0"):
        order(attempts=0)
    assert order(attempts=1).deadline == 1.0
