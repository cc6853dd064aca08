"""Orders: they are repeated only right after a status report of the vehicle; command limits include the last one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from parameter_channel import framed

from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandLong
from aerokit.protocols.command import (
    FLOAT32_MAX,
    MAX_ATTEMPTS,
    UNREPEATABLE_COMMANDS,
    CommandExchange,
    allowed_attempts,
    command_int,
    command_long,
    command_name,
    result_name,
)

ARM = MavCmd.COMPONENT_ARM_DISARM
ACCEPTED, DENIED, IN_PROGRESS = 0, 2, 5


class Status:
    """An order's status, set by the test."""

    heartbeat_name = "HEARTBEAT"

    def __init__(self, end: str = "", heartbeat_at: float = -1.0) -> None:
        self.end, self.heartbeat_at = end, heartbeat_at


def order(
    order_status: Status | None = None, *, component: int = 1, arm: float = 0.0, **options: Any
) -> CommandExchange:
    message = command_long(1, component, ARM, (arm,))
    machine = CommandExchange(message, own_system=255, own_component=190, order_status=order_status, **options)
    machine.start(0.0)
    return machine


def confirmations(machine: CommandExchange) -> list[int]:
    return [message.confirmation for message in machine.take_outbox() if isinstance(message, CommandLong)]


def ack(result: int, progress: int = 0) -> CommandAck:
    return CommandAck(ARM, result, progress, 0, 255, 190)


def text_of(machine: CommandExchange) -> str:
    with pytest.raises(CommandTimeout) as caught:
        machine.result()
    return str(caught.value)


# ------------------------------------------------------------------------- repeated sending


def test_order_is_resent_after_heartbeat() -> None:
    order_status = Status()
    machine = order(order_status)
    assert confirmations(machine) == [0]
    assert machine.deadline == 0.75
    order_status.heartbeat_at = 0.74
    machine.expire(0.75)
    assert confirmations(machine) == []
    assert machine.deadline == pytest.approx(0.8)
    order_status.heartbeat_at = 0.75
    machine.expire(0.8)
    assert confirmations(machine) == [1]
    assert machine.deadline == pytest.approx(1.55)
    machine.expire(1.55)  # reports from before the last sending no longer count
    assert confirmations(machine) == []


def test_ended_order_is_not_resent() -> None:
    machine = order(Status("the pilot took over", heartbeat_at=5.0))
    assert confirmations(machine) == [0]
    machine.expire(0.75)
    assert machine.done
    assert confirmations(machine) == []
    assert text_of(machine).endswith("sent once within 0.8 s; not sent again: the pilot took over")


def test_order_without_heartbeat_is_sent_once() -> None:
    machine, looked, now = order(Status(), attempts=3), 0, 0.0
    while not machine.done:
        assert machine.deadline is not None
        assert machine.deadline <= 3.0
        now = machine.deadline
        machine.expire(now)
        looked += 1
    assert now == 3.0
    assert looked <= 50
    assert confirmations(machine) == [0]
    assert "sent once within 3.0 s; not sent again: no HEARTBEAT received since then" in text_of(machine)


@pytest.mark.parametrize(("now", "expected"), [(3.2, [1]), (3.4, []), (14.0, [])])
def test_order_is_not_resent_after_old_heartbeat(now: float, expected: list[int]) -> None:
    """The event loop was blocked, and the HEARTBEAT arrived at its beginning."""
    machine = order(Status(heartbeat_at=0.8))
    assert confirmations(machine) == [0]
    machine.expire(now)
    assert confirmations(machine) == expected
    assert machine.done is (now > 4.0)


def test_order_is_not_resent_after_its_time() -> None:
    """The event loop was blocked, and a HEARTBEAT arrived after it."""
    machine = order(Status(heartbeat_at=13.9))
    assert confirmations(machine) == [0]
    machine.expire(14.0)
    assert machine.done
    assert confirmations(machine) == []


def test_order_waits_for_last_sending() -> None:
    order_status = Status(heartbeat_at=0.75)
    machine = order(order_status, attempts=2)
    machine.expire(0.75)
    assert confirmations(machine) == [0, 1]
    assert machine.deadline == 1.5
    order_status.heartbeat_at = 1.75
    machine.expire(1.75)
    assert not machine.done
    order_status.end = "the pilot took over"
    machine.expire(1.8)
    assert confirmations(machine) == []
    assert text_of(machine).endswith("sent 2 times within 1.8 s; not sent again: the pilot took over")


def test_reliability_page_lists_the_unrepeatable_commands() -> None:
    page = Path(__file__).parents[2] / "docs" / "reliability.md"
    _, _, table = page.read_text(encoding="utf-8").partition("### Commands that are never repeated")
    listed = set(re.findall(r"^\| ([A-Z_]+) ", table.partition("\n### ")[0], re.MULTILINE)) - {"MAV_CMD"}
    assert listed == {MavCmd(command).name for command in UNREPEATABLE_COMMANDS}


@pytest.mark.parametrize("command", UNREPEATABLE_COMMANDS)
def test_unrepeatable_order_is_sent_once(command: int) -> None:
    effect, param, value = UNREPEATABLE_COMMANDS[command]
    params = [1.0 - value] * 7
    if param is not None:
        assert allowed_attempts(command, params) == MAX_ATTEMPTS
        params[param - 1] = value
    order_status, now = Status(), 0.0
    message = command_long(1, 1, command, tuple(params))
    machine = CommandExchange(message, own_system=255, own_component=190, order_status=order_status)
    machine.start(now)
    while not machine.done:
        assert machine.deadline is not None
        now = order_status.heartbeat_at = machine.deadline
        machine.expire(now)
    assert now == 4.0
    assert confirmations(machine) == [0]
    assert text_of(machine).endswith(f"within 4.0 s; not sent again, because a repetition {effect}")


def test_unrepeatable_command_without_order_is_sent_once() -> None:
    message = command_long(1, 1, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, (1.0,))
    machine = CommandExchange(message, own_system=255, own_component=190)
    machine.start(0.0)
    assert machine.deadline == 4.0
    machine.expire(4.0)
    assert machine.done
    assert confirmations(machine) == [0]


def test_unrepeatable_order_ends_with_its_effect() -> None:
    order_status = Status()
    machine = order(order_status, arm=1.0)
    order_status.end = "its effect was reported"
    machine.expire(1.0)
    assert machine.done


def test_already_sent_order_is_not_sent_on_start() -> None:
    machine = order(sent_by_caller=True)
    assert machine.take_outbox() == []
    machine.expire(1.0)
    assert confirmations(machine) == [1]


def test_command_confirmation_is_capped() -> None:
    machine = order(attempts=258)
    for now in range(1, 258):
        machine.expire(float(now))
    assert confirmations(machine)[254:] == [254, 255, 255, 255]


# ---------------------------------------------------------------------------------- answers


def test_answers_to_earlier_command_are_ignored() -> None:
    machine = order(earlier_acks=1)
    machine.receive(ack(IN_PROGRESS), 0.1)  # not a final answer
    assert machine.deadline == 1.0
    machine.receive(ack(DENIED), 0.2)
    assert not machine.done
    assert machine.pending_acks == 1
    machine.receive(ack(ACCEPTED), 0.3)
    assert machine.result().result == ACCEPTED


@pytest.mark.parametrize("attempts", [1, 2])
def test_every_answer_counts_after_resend(attempts: int) -> None:
    machine = order(earlier_acks=3, attempts=attempts)
    for now in range(1, attempts):
        machine.expire(float(now))
    machine.receive(ack(DENIED), 2.1)
    with pytest.raises(CommandRejected):
        machine.result()


def test_pending_answers_count_sendings() -> None:
    machine = order(attempts=3)
    assert machine.pending_acks == 1
    machine.expire(1.0)
    assert machine.pending_acks == 2
    machine.receive(ack(IN_PROGRESS), 1.1)
    assert machine.pending_acks == 2
    machine.receive(ack(ACCEPTED), 1.2)
    assert machine.pending_acks == 1


def test_pending_answers_exclude_earlier_ones() -> None:
    machine = order(earlier_acks=2, acks_per_sending=2)
    for answers, to_come in [(1, 2), (2, 2), (3, 1)]:
        machine.receive(ack(ACCEPTED), 0.1)
        assert (machine.final_acks, machine.pending_acks) == (answers, to_come)
    assert machine.done


@pytest.mark.parametrize(("target", "sender", "is_ours"), [(1, 1, True), (1, 154, False), (0, 154, True)])
def test_ack_of_other_component_is_ignored(target: int, sender: int, is_ours: bool) -> None:
    machine = order(component=target)
    machine.receive(framed(ack(ACCEPTED), component_id=sender), 0.1)
    assert machine.done is is_ours


def test_progress_is_percentage_or_none() -> None:
    reported: list[int | None] = []
    machine = order(on_progress=reported.append, progress_timeout=3.0)
    for percent in (0, 1, 100, 101):
        machine.receive(ack(IN_PROGRESS, percent), 0.5)
    assert reported == [None, 1, 100, None]
    machine.expire(3.4)
    assert not machine.done
    machine.expire(3.5)
    assert text_of(machine).endswith("was in progress, then no COMMAND_ACK for 3 s")


def test_rejection_text_has_hint() -> None:
    machine = order()
    machine.receive(ack(8), 0.1)
    with pytest.raises(CommandRejected, match="it must be sent as COMMAND_INT"):
        machine.result()
    assert (command_name(54321), result_name(99)) == ("MAV_CMD 54321", "MAV_RESULT 99")


# ----------------------------------------------------------------------------------- limits


def test_command_accepts_boundary_values() -> None:
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
def test_command_int_rejects_places_beyond_type(place: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        command_int(1, 1, 192, frame=6, **({"x": 0, "y": 0, "z": 0.0} | place))


@pytest.mark.parametrize("system", [0, 256])
def test_command_target_must_be_one_system(system: int) -> None:
    for make in (
        lambda: command_long(system, 0, ARM),
        lambda: command_int(system, 0, 192, frame=6, x=0, y=0, z=0),
    ):
        with pytest.raises(InvalidArgument, match=f"target_system = {system}"):
            make()


def test_command_needs_at_least_one_attempt() -> None:
    with pytest.raises(InvalidArgument, match="attempts = 0"):
        order(attempts=0)
    assert order(attempts=1).deadline == 1.0
