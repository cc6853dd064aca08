"""Flight termination and shutdown: sent once, with a stated intent, and never late."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import Wire, in_the_air, open_flight

import aerokit
from aerokit import messages as m
from aerokit.connection.cells import Source
from aerokit.errors import CommandTimeout, InvalidArgument, NotSupported, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult, MavSeverity, MavState
from aerokit.sim import SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

TERMINATE, OFF = MavCmd.DO_FLIGHTTERMINATION, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN


async def test_terminate_in_flight_stops_the_motors() -> None:
    async with in_the_air() as flight:
        await flight.vehicle.terminate(intent="terminate flight")
        assert not flight.copter.motors.is_armed
        assert flight.vehicle.armed.latest is False
        assert [command.param1 for command in flight.wire.commands(TERMINATE)] == [1]


async def test_terminate_on_px4_returns_in_its_termination_mode() -> None:
    copter = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(10.0)
        await vehicle.terminate(intent="terminate flight")
        assert copter.arming.is_terminated
        assert vehicle.mode_name == "TERMINATION"


@pytest.mark.parametrize("intent", ["", "Terminate flight", "terminate", "shut down"])
async def test_terminate_other_intent_sends_nothing(intent: str) -> None:
    async with in_the_air() as flight:
        with pytest.raises(InvalidArgument, match=r"intent = .* is not allowed: it must be one of terminate flight"):
            await flight.vehicle.terminate(intent=intent)  # type: ignore[arg-type]
        assert flight.wire.commands(TERMINATE) == []


async def test_terminate_ignores_states_before_the_command() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.refuse(TERMINATE, MavResult.ACCEPTED)  # The vehicle accepts, but does nothing.
        state = flight.vehicle.telemetry.system_status
        state.set(MavState.FLIGHT_TERMINATION, Source(1, 1, "HEARTBEAT"))
        with pytest.raises(OperationTimeout, match="still armed"):
            await flight.vehicle.terminate(intent="terminate flight", timeout=3.0)


async def test_terminate_unanswered_and_replaced_may_have_been_executed() -> None:
    async with in_the_air() as flight, anyio.create_task_group() as tasks:
        flight.copter.faults.ignore(TERMINATE)

        async def hold() -> None:
            await anyio.sleep(0.5)
            await flight.vehicle.hold()

        tasks.start_soon(hold)
        text = "no COMMAND_ACK .*another order was given.*may have been terminated nevertheless"
        with pytest.raises(OperationRejected, match=text):
            await flight.vehicle.terminate(intent="terminate flight")


async def test_terminate_unanswered_after_takeover_may_have_been_executed() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.ignore(TERMINATE)

        def take_over() -> None:
            flight.copter.set_mode(CopterMode.LOITER)
            flight.copter.send(m.Statustext(MavSeverity.WARNING, "pilot", 0, 0))

        asyncio.get_running_loop().call_later(0.5, take_over)
        text = r"no COMMAND_ACK .*may have been terminated nevertheless\n(  - .*\n)*  - pilot$"
        with pytest.raises(OperationRejected, match=text):
            await flight.vehicle.terminate(intent="terminate flight")


async def test_terminate_unanswered_is_sent_once() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.ignore(TERMINATE)
        with pytest.raises(CommandTimeout, match="may have been terminated nevertheless"):
            await flight.vehicle.terminate(intent="terminate flight")
        await anyio.sleep(10)
        assert len(flight.wire.commands(TERMINATE)) == 1


async def test_terminate_cancelled_orders_no_hold_and_no_second_one() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.ignore(TERMINATE)
        with anyio.move_on_after(0.5):
            await flight.vehicle.terminate(intent="terminate flight")
        await anyio.sleep(10)
        assert len(flight.wire.commands(TERMINATE)) == 1
        assert flight.wire.mode_orders() == []


async def test_terminate_ends_go_to_without_hold() -> None:
    async with in_the_air() as flight:
        place = flight.vehicle.position.value.offset(north_m=200)

        async def go() -> None:
            with pytest.raises(OperationRejected):
                await flight.vehicle.go_to(place)

        async with anyio.create_task_group() as group:
            group.start_soon(go)
            await anyio.sleep(3)
            await flight.vehicle.terminate(intent="terminate flight")
        await anyio.sleep(5)
        assert flight.wire.mode_orders() == []


async def test_shutdown_returns_when_heartbeats_end() -> None:
    copter = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            await vehicle.shutdown(intent="shut down")
            assert vehicle.heartbeat_age > 3.5
            assert [command.param1 for command in wire.commands(OFF)] == [2]


async def test_shutdown_while_armed_sends_nothing() -> None:
    copter = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            with pytest.raises(OperationRejected, match="shutdown: the vehicle is armed; nothing was sent"):
                await vehicle.shutdown(intent="shut down")
            assert wire.commands(OFF) == []


async def test_shutdown_of_ardupilot_is_not_supported() -> None:
    async with open_flight() as flight:
        with pytest.raises(NotSupported, match="ArduCopter cannot be switched off"):
            await flight.vehicle.shutdown(intent="shut down")
        assert flight.wire.commands(OFF) == []
