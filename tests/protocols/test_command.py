"""The command protocol without IO: each case by name, and arbitrary sequences of acks by hypothesis."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import CommandRejected, CommandTimeout, ConnectionClosed, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong, Heartbeat
from aerokit.protocols.command import CommandExchange, command_int, command_long

ARM = MavCmd.COMPONENT_ARM_DISARM


def exchange(attempts: int = 4, progress: list[int | None] | None = None) -> CommandExchange:
    return CommandExchange(
        command_long(1, 1, ARM, (1.0,)),
        own_system=255,
        own_component=190,
        attempts=attempts,
        attempt_timeout=1.0,
        progress_timeout=10.0,
        on_progress=None if progress is None else progress.append,
    )


def ack(result: int, command: int = ARM, *, progress: int = 0, system: int = 255, component: int = 190) -> CommandAck:
    return CommandAck(command, result, progress, 0, system, component)


def confirmations(machine: CommandExchange) -> list[int]:
    return [message.confirmation for message in machine.take_outbox() if isinstance(message, CommandLong)]


def test_command_ends_with_accepted_ack() -> None:
    machine = exchange()
    machine.start(0.0)
    assert confirmations(machine) == [0]
    machine.receive(ack(MavResult.ACCEPTED), 0.1)
    assert machine.done
    assert machine.result().result == MavResult.ACCEPTED
    assert machine.deadline is None


def test_command_retries_with_rising_confirmation_then_fails() -> None:
    machine = exchange(attempts=3)
    machine.start(0.0)
    observed = confirmations(machine)
    for now in (1.0, 2.0):
        machine.expire(now)
        observed += confirmations(machine)
    assert observed == [0, 1, 2]
    assert not machine.done
    machine.expire(3.0)
    with pytest.raises(CommandTimeout, match=r"MAV_CMD_COMPONENT_ARM_DISARM, sent 3 times within 3\.0 s"):
        machine.result()


def test_command_ignores_early_expiry() -> None:
    machine = exchange()
    machine.start(0.0)
    machine.take_outbox()
    machine.expire(0.5)
    assert machine.take_outbox() == []
    assert machine.deadline == 1.0


def test_command_progress_extends_deadline() -> None:
    progress: list[int | None] = []
    machine = exchange(progress=progress)
    machine.start(0.0)
    machine.receive(ack(MavResult.IN_PROGRESS, progress=40), 0.5)
    machine.receive(ack(MavResult.IN_PROGRESS, progress=255), 0.6)
    assert progress == [40, None]
    assert not machine.done
    assert machine.deadline == pytest.approx(10.6)
    machine.receive(ack(MavResult.ACCEPTED), 9.0)
    assert machine.done


def test_command_stopped_progress_times_out() -> None:
    machine = exchange()
    machine.start(0.0)
    machine.take_outbox()
    machine.receive(ack(MavResult.IN_PROGRESS), 0.5)
    machine.expire(10.5)
    assert machine.take_outbox() == []
    with pytest.raises(CommandTimeout, match="was in progress"):
        machine.result()


@pytest.mark.parametrize("result", [r for r in MavResult if r not in (MavResult.ACCEPTED, MavResult.IN_PROGRESS)])
def test_command_result_becomes_error(result: MavResult) -> None:
    machine = exchange()
    machine.start(0.0)
    machine.receive(ack(result), 0.1)
    with pytest.raises(CommandRejected, match=result.name) as caught:
        machine.result()
    assert (caught.value.command, caught.value.result) == (ARM, result)


@pytest.mark.parametrize(
    "stray",
    [
        ack(MavResult.ACCEPTED, MavCmd.NAV_TAKEOFF),
        ack(MavResult.ACCEPTED, system=254),
        ack(MavResult.ACCEPTED, component=1),
        Heartbeat(2, 3, 0, 0, 4),
    ],
    ids=["other command", "other ground station", "other component of ours", "no ack at all"],
)
def test_command_ignores_unrelated_acks(stray: CommandAck | Heartbeat) -> None:
    machine = exchange()
    machine.start(0.0)
    machine.receive(stray, 0.1)
    assert not machine.done


def test_command_accepts_ack_without_target() -> None:
    machine = exchange()
    machine.start(0.0)
    machine.receive(ack(MavResult.ACCEPTED, system=0, component=0), 0.1)
    assert machine.done


def test_command_first_result_counts() -> None:
    machine = exchange()
    machine.start(0.0)
    machine.receive(ack(MavResult.ACCEPTED), 0.1)
    machine.receive(ack(MavResult.DENIED), 0.2)
    machine.abort(ConnectionClosed("gone"))
    assert machine.result().result == MavResult.ACCEPTED


@pytest.mark.parametrize("attempts", [1, 4])
def test_command_that_no_link_accepted_takes_no_ack(attempts: int) -> None:
    """An acknowledgement can only be that of an earlier command, which the other end executes."""
    machine = exchange(attempts)
    machine.start(0.0)
    machine.take_outbox()
    machine.message_dropped()
    machine.receive(ack(MavResult.ACCEPTED), 0.1)
    assert not machine.done
    assert machine.pending_acks == 0
    for _ in range(attempts):
        assert machine.deadline is not None
        machine.expire(machine.deadline)
        for _ in machine.take_outbox():
            machine.message_dropped()
    with pytest.raises(CommandTimeout, match=r"^MAV_CMD_COMPONENT_ARM_DISARM was not sent, because") as raised:
        machine.result()
    assert not raised.value.was_sent


def test_command_counts_only_transmissions_that_link_accepted() -> None:
    machine = exchange(attempts=2)
    machine.start(0.0)
    machine.take_outbox()
    machine.message_dropped()
    for now in (1.0, 2.0):
        machine.expire(now)
    with pytest.raises(CommandTimeout, match=r"^no COMMAND_ACK for .*, sent once within 2.0 s") as raised:
        machine.result()
    assert raised.value.was_sent


def test_command_abort() -> None:
    machine = exchange()
    machine.start(0.0)
    machine.abort(ConnectionClosed("gone"))
    with pytest.raises(ConnectionClosed):
        machine.result()


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["ack", "expire"]),
            st.sampled_from(list(MavResult)),
            st.sampled_from([0, 254, 255]),
            st.floats(0, 20),
        ),
        max_size=40,
    ),
    st.integers(1, 6),
)
def test_command_any_traffic_ends_once(steps: list[tuple[str, MavResult, int, float]], attempts: int) -> None:
    machine = exchange(attempts=attempts)
    machine.start(0.0)
    now, sent, ends = 0.0, len(machine.take_outbox()), 0
    for kind, result, system, wait in steps:
        now += wait
        was_done = machine.done
        machine.receive(ack(result, system=system), now) if kind == "ack" else machine.expire(now)
        sent += len(machine.take_outbox())
        ends += machine.done and not was_done
        assert (machine.deadline is None) == machine.done
    assert 1 <= sent <= attempts
    assert ends <= 1


@given(st.integers(1, 255), st.integers(0, 255), st.lists(st.floats(width=32, allow_infinity=False), max_size=7))
def test_command_params_are_unchanged(system: int, component: int, params: list[float]) -> None:
    message = command_long(system, component, ARM, tuple(params))
    decoded = CommandLong.decode(message.encode())
    values = [getattr(decoded, f"param{i}") for i in range(1, 8)]
    expected = params + [0.0] * (7 - len(params))
    assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(values, expected, strict=True))


def test_command_int_is_resent_unchanged() -> None:
    message = command_int(1, 1, MavCmd.DO_REPOSITION, (-1, 1), frame=6, x=473977420, y=85455940, z=20.0)
    machine = CommandExchange(message, own_system=255, own_component=190)
    machine.start(0.0)
    machine.expire(1.0)
    assert machine.take_outbox() == [message, message]
    assert isinstance(message, CommandInt)


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ((math.inf,), "param1 = inf is not a finite 32-bit float"),
        ((1e39,), "is not a finite 32-bit float"),
        ((10**400,), "is not a finite 32-bit float"),
        ((0, "up"), "param2 = 'up' is not a number"),
        (tuple(range(8)), "at most 7 parameters"),
    ],
)
def test_command_rejects_invalid_params(params: tuple[float, ...], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        command_long(1, 1, ARM, params)


def test_command_rejects_broadcast_target() -> None:
    with pytest.raises(InvalidArgument, match="target_system = 0"):
        command_long(0, 0, ARM, (1.0,))


def test_command_int_rejects_large_integers() -> None:
    with pytest.raises(InvalidArgument, match="x = 2147483648"):
        command_int(1, 1, MavCmd.DO_REPOSITION, frame=6, x=2**31, y=0, z=0.0)
    with pytest.raises(InvalidArgument, match="at most 4"):
        command_int(1, 1, MavCmd.DO_REPOSITION, (0,) * 5, frame=6, x=0, y=0, z=0.0)


@pytest.mark.parametrize("field", ["attempt_timeout", "progress_timeout"])
@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_command_rejects_invalid_timeout(field: str, seconds: float) -> None:
    arguments: dict[str, float] = {field: seconds}
    with pytest.raises(InvalidArgument, match=field):
        CommandExchange(
            command_long(1, 1, ARM),
            own_system=255,
            own_component=190,
            attempt_timeout=arguments.get("attempt_timeout", 1.0),
            progress_timeout=arguments.get("progress_timeout", 1.0),
        )
