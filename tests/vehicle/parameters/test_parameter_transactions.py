"""Restored parameters: `temporarily` and `transaction`, with every kind of end."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import anyio
import pytest
from flight_harness import Flight, block_loop, open_flight, open_px4

from aerokit import messages
from aerokit.errors import (
    InvalidArgument,
    LinkLost,
    OperationTimeout,
    ParameterRejected,
    ParameterTimeout,
    RollbackFailed,
    VerificationFailed,
)
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.vehicle.parameters.parameters import Parameters

pytestmark = pytest.mark.anyio


def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameter_count=100)


def values(flight: Flight) -> tuple[float, float]:
    return flight.copter.parameters["RTL_ALT"], flight.copter.parameters["LAND_SPEED"]


BEFORE: tuple[float, float] = (1500.0, 50.0)


# ---------------------------------------------------------------------------------- temporarily


async def test_temporary_values_are_restored() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        async with parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 60}) as results:
            assert values(flight) == (2000, 60)
            assert {result.outcome for result in results.values()} == {"set"}
        assert values(flight) == BEFORE
        assert parameters.table["RTL_ALT"].value == 1500


@pytest.mark.parametrize("is_received", [True, False])
async def test_value_changed_by_another_station_stays(is_received: bool, caplog: pytest.LogCaptureFixture) -> None:
    """The program has received the change, or must read it from the vehicle."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        async with parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 60}):
            flight.copter.parameters["RTL_ALT"] = 2500.0
            if is_received:
                await parameters.get("RTL_ALT")
        assert values(flight) == (2500.0, 50.0)
        assert "RTL_ALT is not restored: another station has changed it from 2000 to 2500" in caplog.text
        assert "LAND_SPEED" not in caplog.text


async def test_parameter_shown_by_another_one_is_restored() -> None:
    """Like ArduPilot's …_ENABLE: the copter has LAND_SPEED only after RTL_ALT was set."""
    simulated = copter()
    simulated.parameters.remove("LAND_SPEED")
    on_set = simulated.handlers[messages.ParamSet.ID]

    def show(message: messages.ParamSet, channel: Any) -> None:
        if message.param_id == "RTL_ALT" and "LAND_SPEED" not in simulated.parameters:
            simulated.parameters.add("LAND_SPEED", 50)
        on_set(message, channel)

    simulated.handlers[messages.ParamSet.ID] = show
    async with open_flight(simulated) as flight:
        async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 60}):
            assert values(flight) == (2000, 60)
        assert values(flight) == BEFORE


async def test_value_that_another_station_has_just_undone_is_restored() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.set("RTL_ALT", 2000)
        flight.copter.parameters["RTL_ALT"] = 1500.0
        async with parameters.temporarily({"RTL_ALT": 3000}):
            assert values(flight)[0] == 3000
        assert values(flight) == BEFORE


async def test_value_changed_by_program_is_restored() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        async with parameters.temporarily({"RTL_ALT": 2000}):
            await parameters.set("RTL_ALT", 3000)
        assert values(flight) == BEFORE


async def test_value_written_by_other_task_during_restore_is_restored(caplog: pytest.LogCaptureFixture) -> None:
    """The other task writes while the block reads the present value."""
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        parameters = flight.vehicle.parameters
        on_read = flight.copter.handlers[messages.ParamRequestRead.ID]

        def write_and_answer(message: messages.ParamRequestRead, channel: Any) -> None:
            flight.copter.handlers[messages.ParamRequestRead.ID] = on_read
            tasks.start_soon(parameters.set, "RTL_ALT", 2500)
            on_read(message, channel)

        async with parameters.temporarily({"RTL_ALT": 2000}):
            flight.copter.handlers[messages.ParamRequestRead.ID] = write_and_answer
        assert "another station" not in caplog.text
        assert flight.copter.parameters["RTL_ALT"] == 1500.0


async def test_value_of_cancelled_upload_is_restored() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        async with parameters.temporarily({"RTL_ALT": 2000}):
            flight.copter.faults.mute_parameters = {"RTL_ALT"}
            with pytest.raises(OperationTimeout):
                await parameters.upload({"RTL_ALT": 3000}, method="ftp", timeout=2.0)
            flight.copter.faults.mute_parameters = set()
            assert values(flight)[0] == 3000
        assert values(flight) == BEFORE


async def test_failed_transaction_keeps_changes_of_another_station() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(ZeroDivisionError):
            async with flight.vehicle.parameters.transaction() as transaction:
                await transaction.set("RTL_ALT", 2000)
                await transaction.set("LAND_SPEED", 60)
                flight.copter.parameters["RTL_ALT"] = 2500.0
                _ = 1 / 0
        assert values(flight) == (2500.0, 50.0)


async def test_temporary_values_on_px4() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0, parameter_count=100)
    async with open_px4(px4) as flight:
        before = px4.parameters["COM_RC_IN_MODE"]
        async with flight.vehicle.parameters.temporarily({"COM_RC_IN_MODE": -5_000_000}):
            assert px4.parameters["COM_RC_IN_MODE"] == -5_000_000
        assert px4.parameters["COM_RC_IN_MODE"] == before


async def test_exception_restores_values_and_propagates() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(ZeroDivisionError):
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000}):
                _ = 1 / 0
        assert values(flight) == BEFORE


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.06, 0.11, 0.16, 0.21, 0.5])
async def test_cancellation_at_any_time_restores_values(delay_s: float) -> None:
    async with open_flight(copter(), latency_s=0.05) as flight:

        async def block() -> None:
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 60}):
                await anyio.sleep(10.0)

        task = asyncio.create_task(block())
        await anyio.sleep(delay_s)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await anyio.sleep(0.2)
        assert values(flight) == BEFORE


async def test_cancelled_scope_restores_values() -> None:
    async with open_flight(copter(), latency_s=0.05) as flight:
        with anyio.move_on_after(1.0):
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000}):
                await anyio.sleep(10.0)
        assert values(flight) == BEFORE


async def test_failed_write_restores_the_others() -> None:
    simulated = copter()
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        for name in ("LAND_SPEED", "NO_SUCH_ONE"):
            with pytest.raises(ParameterRejected):
                async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000, name: 60}):
                    pytest.fail("the block was entered")
            assert values(flight) == BEFORE


async def test_invalid_temporary_values_are_refused() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(InvalidArgument):
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 1e9}):
                pytest.fail("the block was entered")
        assert {write.param_value for write in flight.wire.all(messages.ParamSet)} <= {1500.0, 50.0}
        assert values(flight) == BEFORE


async def test_nested_and_overlapping_blocks_restore_first_value() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        async with parameters.temporarily({"RTL_ALT": 2000}):
            async with parameters.temporarily({"RTL_ALT": 3000}):
                assert values(flight)[0] == 3000
            assert values(flight)[0] == 2000
        assert values(flight) == BEFORE
        first, second = parameters.temporarily({"RTL_ALT": 2000}), parameters.temporarily({"RTL_ALT": 3000})
        await first.__aenter__()
        await second.__aenter__()
        await first.__aexit__(None, None, None)
        assert values(flight)[0] == 3000
        await second.__aexit__(None, None, None)
        assert values(flight) == BEFORE


@pytest.mark.parametrize("begins_after_s", [0.0, 0.05, 0.15, 0.25, 0.35])
async def test_block_that_begins_while_another_one_restores(begins_after_s: float) -> None:
    async with open_flight(copter(), latency_s=0.1) as flight:
        parameters = flight.vehicle.parameters

        async def change(value: float) -> None:
            async with parameters.temporarily({"RTL_ALT": value, "LAND_SPEED": 60}):
                await anyio.sleep(1.0)

        block = parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 70})
        async with anyio.create_task_group() as tasks, block:
            asyncio.get_running_loop().call_later(begins_after_s, tasks.start_soon, change, 3000)
        assert values(flight) == BEFORE


@pytest.mark.parametrize("begins_after_s", [0.0, 0.05, 0.15, 0.25, 0.35])
async def test_write_that_begins_while_a_block_restores(begins_after_s: float) -> None:
    async with open_flight(copter(), latency_s=0.1) as flight:
        parameters = flight.vehicle.parameters
        block = parameters.temporarily({"RTL_ALT": 2000, "LAND_SPEED": 70})
        async with anyio.create_task_group() as tasks, block:
            write = partial(parameters.set, "RTL_ALT", 3000)
            asyncio.get_running_loop().call_later(begins_after_s, tasks.start_soon, write)
        assert values(flight) in (BEFORE, (3000.0, BEFORE[1]))


async def test_rollback_failed_names_parameters() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(RollbackFailed, match="RTL_ALT = 1500") as failed:
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=1.0):
                flight.copter.faults.read_only_parameters = {"RTL_ALT"}
        assert failed.value.not_restored == {"RTL_ALT": 1500}


async def test_block_end_is_bounded_for_silent_vehicle() -> None:
    async with open_flight(copter()) as flight:
        loop = asyncio.get_running_loop()
        ended = loop.time()
        with pytest.raises(RollbackFailed) as failed:
            async with flight.vehicle.parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=2.0):
                flight.copter.faults.silent = True
                ended = loop.time()
        assert failed.value.not_restored == {"RTL_ALT": 1500}
        assert loop.time() - ended == pytest.approx(2.0, abs=0.1)


async def test_ends_of_several_blocks_are_bounded_for_silent_vehicle() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        parameters, loop = flight.vehicle.parameters, asyncio.get_running_loop()
        not_restored: dict[str, float] = {}
        ended_at = loop.time() + 10.0

        async def change(name: str) -> None:
            with pytest.raises(RollbackFailed) as failed:
                async with parameters.temporarily({name: flight.copter.parameters[name] + 1}, idle_timeout_s=2.0):
                    await anyio.sleep(ended_at - loop.time())
            not_restored.update(failed.value.not_restored)
            assert loop.time() - ended_at <= 6.1

        names = ("RTL_ALT", "LAND_SPEED", "RTL_SPEED", "WPNAV_SPEED", "LOIT_SPEED")
        before = {name: flight.copter.parameters[name] for name in names}
        for name in before:
            tasks.start_soon(change, name)
        await anyio.sleep(9.0)
        flight.copter.faults.silent = True
        await anyio.sleep(20.0)
        assert not_restored == before


async def await_muted_parameter(parameters: Parameters) -> None:
    with pytest.raises(ParameterTimeout):
        async with parameters.temporarily({"LAND_SPEED": 60}, idle_timeout_s=30.0):
            pass


async def test_block_restores_while_another_one_waits_for_answers() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        parameters, loop = flight.vehicle.parameters, asyncio.get_running_loop()
        await parameters.download()
        flight.copter.faults.mute_parameters = {"LAND_SPEED"}

        async with parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=2.0):
            tasks.start_soon(await_muted_parameter, parameters)
            await anyio.sleep(1.0)
            ended_at = loop.time()
        assert values(flight) == BEFORE
        assert loop.time() - ended_at <= 6.0


async def test_block_restores_after_blocked_loop_while_another_one_waits() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        parameters = flight.vehicle.parameters
        await parameters.download()
        flight.copter.faults.mute_parameters = {"LAND_SPEED"}

        async with parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=2.0):
            tasks.start_soon(await_muted_parameter, parameters)
            await anyio.sleep(1.0)
            asyncio.get_running_loop().call_later(0.5, block_loop, 10.0)
        assert values(flight) == BEFORE


async def test_block_saves_no_temporary_value_of_other_block() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        parameters, faults = flight.vehicle.parameters, flight.copter.faults
        await parameters.download()

        async def change() -> None:
            async with parameters.temporarily({"RTL_ALT": 2500, "LAND_SPEED": 60}, idle_timeout_s=30.0):
                assert values(flight) == (2500, 60)

        async with parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=2.0):
            faults.mute_parameters = {"LAND_SPEED"}
            tasks.start_soon(change)
            await anyio.sleep(1.0)
        assert values(flight) == BEFORE
        faults.mute_parameters = set()
        await anyio.sleep(30.0)
        assert values(flight) == BEFORE


async def test_temporary_block_is_entered_once() -> None:
    async with open_flight(copter()) as flight:
        block = flight.vehicle.parameters.temporarily({"RTL_ALT": 2000})
        async with block:
            pass
        with pytest.raises(InvalidArgument, match="entered before"):
            async with block:
                pass


# ---------------------------------------------------------------------------------- transaction


async def test_successful_transaction_keeps_values() -> None:
    async with open_flight(copter()) as flight:
        async with flight.vehicle.parameters.transaction() as transaction:
            assert (await transaction.set("RTL_ALT", 2000)).outcome == "set"
            await transaction.set_many({"LAND_SPEED": 60, "RTL_ALT": 2500})
            assert [(change.name, change.before, change.after) for change in transaction.changes] == [
                ("RTL_ALT", 1500, 2500),
                ("LAND_SPEED", 50, 60),
            ]
            assert transaction.needs_reboot == ()
        assert values(flight) == (2500, 60)
        with pytest.raises(InvalidArgument, match="not open"):
            await transaction.set("RTL_ALT", 1)


async def test_transaction_changes_include_cancelled_call() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.parameters.transaction() as transaction:
        await transaction.set("LAND_SPEED", 60)
        flight.copter.faults.mute_parameters = {"LAND_SPEED"}
        with anyio.move_on_after(1.0) as scope:
            await transaction.set_many({"RTL_ALT": 2000, "LAND_SPEED": 70})
        assert scope.cancelled_caught
        assert [change.name for change in transaction.changes] == ["LAND_SPEED", "RTL_ALT"]


async def fail_after_writing(parameters: Parameters, error: Exception) -> None:
    async with parameters.transaction() as transaction:
        await transaction.set("RTL_ALT", 2000)
        await transaction.set("LAND_SPEED", 60)
        raise error


async def test_transaction_exception_rolls_back() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(KeyError, match="mine"):
            await fail_after_writing(flight.vehicle.parameters, KeyError("mine"))
        assert values(flight) == BEFORE


async def test_transaction_cancelled_rolls_back() -> None:
    async with open_flight(copter(), latency_s=0.05) as flight:
        with anyio.move_on_after(1.0):
            async with flight.vehicle.parameters.transaction() as transaction:
                await transaction.set("RTL_ALT", 2000)
                await anyio.sleep(10.0)
        assert values(flight) == BEFORE


async def test_transaction_refused_write_rolls_back() -> None:
    simulated = copter()
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        with pytest.raises(ParameterRejected):
            async with flight.vehicle.parameters.transaction() as transaction:
                await transaction.set("RTL_ALT", 2000)
                await transaction.set("LAND_SPEED", 60)
        assert values(flight) == BEFORE


async def test_transaction_clamped_write_rolls_back() -> None:
    simulated = copter()
    simulated.faults.parameter_limits = {"LAND_SPEED": (0, 55)}
    async with open_flight(simulated) as flight:
        with pytest.raises(VerificationFailed, match="requested 60, is 55"):
            async with flight.vehicle.parameters.transaction() as transaction:
                await transaction.set_many({"RTL_ALT": 2000, "LAND_SPEED": 60})
        assert values(flight) == BEFORE


async def test_transaction_write_of_other_task_does_not_outlive_it() -> None:
    """`asyncio.gather` raises the first error and lets the other calls continue."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.get("RTL_ALT")
        writes = []
        with pytest.raises(InvalidArgument, match="RTL_ALT"):
            async with parameters.transaction() as transaction:
                writes += [asyncio.create_task(transaction.set("RTL_ALT", 1e12))]
                writes += [asyncio.create_task(transaction.set("WPNAV_SPEED", 700))]
                await asyncio.gather(*writes)
        _, slow_write = writes
        with pytest.raises(InvalidArgument, match="block has ended; the remaining parameters were not set"):
            await slow_write
        assert flight.copter.parameters["WPNAV_SPEED"] == 1000.0


async def test_transaction_continues_after_caught_error() -> None:
    async with open_flight(copter()) as flight:
        async with flight.vehicle.parameters.transaction() as transaction:
            await transaction.set("RTL_ALT", 2000)
            with pytest.raises(ParameterRejected):
                await transaction.set("NO_SUCH_ONE", 1)
        assert values(flight) == (2000, 50)


async def test_lost_link_names_written_parameters() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(RollbackFailed) as failed:
            async with flight.vehicle.parameters.transaction() as transaction:
                await transaction.set("RTL_ALT", 2000)
                flight.wire.lose()
                await transaction.set("LAND_SPEED", 60)
        assert failed.value.not_restored == {"RTL_ALT": 1500}
        assert isinstance(failed.value.__cause__, LinkLost)
        assert values(flight) == (2000, 50)


async def test_outer_transaction_undoes_inner_one() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        with pytest.raises(ZeroDivisionError):
            async with parameters.transaction() as outer:
                await outer.set("RTL_ALT", 2000)
                async with parameters.transaction() as inner:
                    await inner.set("RTL_ALT", 3000)
                assert values(flight)[0] == 3000
                _ = 1 / 0
        assert values(flight) == BEFORE


async def test_transaction_is_entered_once() -> None:
    async with open_flight(copter()) as flight:
        transaction = flight.vehicle.parameters.transaction()
        async with transaction:
            with pytest.raises(InvalidArgument, match="already"):
                await transaction.__aenter__()


async def test_transaction_reads_before_writing() -> None:
    """The table may be outdated: another station has written the parameter, and the message was lost."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        flight.copter.parameters["RTL_ALT"] = 1800
        async with parameters.temporarily({"RTL_ALT": 2000}):
            pass
        assert values(flight)[0] == 1800
