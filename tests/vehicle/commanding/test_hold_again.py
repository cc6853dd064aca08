"""Hold after an abandoned flight: sent at once, and repeated until it is executed."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_px4

from aerokit import messages as m
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.vehicle.commanding.cleanup import BackgroundTask

pytestmark = pytest.mark.anyio

BRAKE = CopterMode.BRAKE


async def give_up(flight: Flight) -> None:
    """Start a long flight, and cancel it after two seconds."""
    with anyio.move_on_after(2.0) as scope:
        await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
    assert scope.cancelled_caught


async def test_hold_is_sent_in_same_iteration() -> None:
    async with in_the_air() as flight:
        await give_up(flight)
        assert flight.wire.sent[-1][0] == now()
        assert flight.wire.mode_orders() == [BRAKE]


async def test_hold_pending_ends_with_confirmation() -> None:
    async with in_the_air() as flight:
        holding, reported = flight.vehicle._context.flight_cleanup, list[bool]()
        reported.append(holding.is_hold_pending)
        await give_up(flight)
        reported.append(holding.is_hold_pending)
        await anyio.sleep(3.0)
        reported.append(holding.is_hold_pending)
        assert flight.copter.mode.number == BRAKE
        assert reported == [False, True, False]


async def test_px4_hold_is_sent_in_same_iteration() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with anyio.move_on_after(2.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        assert len(flight.wire.commands(MavCmd.DO_REPOSITION)) == 2
        last_at, last = flight.wire.sent[-1]
        assert isinstance(last, m.CommandLong)
        assert (last_at, last.command) == (now(), MavCmd.DO_REPOSITION)


async def test_hold_lost_after_unanswered_change_of_mode_is_repeated() -> None:
    """On a link with copies, two answers to the change of mode arrive after the hold was sent, which was lost."""
    async with in_the_air(latency_s=0.5) as flight:
        flight.pilot_takes_over()
        await anyio.sleep(2.0)
        on_command = flight.copter.handlers[m.CommandLong.ID]

        def lose_first_hold(message: m.CommandLong, channel: Any) -> None:
            if message.command == MavCmd.DO_SET_MODE and message.param2 == BRAKE:
                flight.copter.handlers[m.CommandLong.ID] = on_command
            else:
                on_command(message, channel)
                on_command(message, channel)

        flight.copter.handlers[m.CommandLong.ID] = lose_first_hold
        with anyio.move_on_after(0.7):
            async with flight.vehicle.guided.velocity():
                raise AssertionError("entered too early")
        await anyio.sleep(8.0)
        assert flight.wire.mode_orders()[-2:] == [BRAKE, BRAKE]
        assert flight.copter.mode.number == BRAKE


@pytest.mark.parametrize("silent_s", [3.0, 60.0])
async def test_hold_lost_in_silence_is_repeated_after_it(silent_s: float) -> None:
    async with in_the_air() as flight:
        await give_up(flight)
        flight.copter.faults.silent = True
        await anyio.sleep(silent_s)
        assert flight.wire.mode_orders() == [BRAKE]
        flight.copter.faults.silent = False
        await anyio.sleep(4.0)
        assert flight.wire.mode_orders() == [BRAKE, BRAKE]
        assert flight.vehicle.mode_name == "BRAKE"


async def test_hold_ignored_is_repeated_three_times(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with in_the_air() as flight:
        flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
        await give_up(flight)
        await anyio.sleep(60.0)
        reported = [message for message in caplog.messages if "is not confirmed yet" in message]
        assert len(reported) == 3
        assert caplog.messages[-1].endswith("was not confirmed; aerokit does not send it again")
        flight.wire.clear()
        await anyio.sleep(60.0)
        assert not flight.wire.mode_orders()


async def test_refused_hold_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    async with in_the_air() as flight:
        flight.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.DENIED)
        await give_up(flight)
        await anyio.sleep(10.0)
        (record,) = [record for record in caplog.records if "does not hold" in record.message]
        assert record.message.startswith("the vehicle does not hold after an abandoned flight: ")
        assert flight.wire.mode_orders() == [BRAKE]


async def test_pending_hold_is_dropped_after_takeover() -> None:
    """The flight is abandoned during a silence; afterwards the vehicle reports a pilot's mode."""
    async with in_the_air() as flight:
        asyncio.get_running_loop().call_later(1.5, setattr, flight.copter.faults, "silent", True)
        with anyio.move_on_after(6.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=200))
        assert flight.vehicle.is_hold_pending
        flight.wire.clear()
        flight.pilot_takes_over()
        flight.copter.faults.silent = False
        await anyio.sleep(5.0)
        assert flight.wire.mode_orders() == []
        assert flight.copter.mode.name == "LOITER"
        assert not flight.vehicle.is_hold_pending


async def test_background_task_that_raises_is_done(caplog: pytest.LogCaptureFixture) -> None:
    async with in_the_air() as flight:
        task = BackgroundTask(flight.vehicle._context.session, "test", warning_clause="before the end")

        async def fail() -> None:
            raise ZeroDivisionError

        task.start(fail)
        started = now()
        await task.finish(5.0)
        assert not task.is_open
        assert now() == started
    assert "before the end" not in caplog.text


async def test_new_background_task_cancels_previous() -> None:
    async with in_the_air() as flight:
        task, ended = BackgroundTask(flight.vehicle._context.session, "test", warning_clause=""), list[str]()

        async def work(name: str) -> None:
            await anyio.sleep(1.0)
            ended.append(name)

        task.start(partial(work, "first"))
        await anyio.sleep(0.5)
        task.start(partial(work, "second"))
        await anyio.sleep(5.0)
        assert ended == ["second"]
