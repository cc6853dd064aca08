"""What a program is told of a vehicle that it lets go in flight without having meant to."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import anyio
import pytest
from flight_harness import Wire, attached_sinks, in_the_air, open_flight

import aerokit
from aerokit.errors import AerokitError, ConnectionClosed, OperationRejected, SetpointStreamStopped
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.mavlink.messages import Heartbeat, SetMode
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.connect import vehicles_on

pytestmark = pytest.mark.anyio


async def test_a_cancelled_flight_says_that_the_vehicle_holds(caplog: pytest.LogCaptureFixture) -> None:
    with anyio.move_on_after(30) as scope:
        async with in_the_air() as flight:
            scope.deadline = anyio.current_time() + 2
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
    assert scope.cancelled_caught
    (record,) = [each for each in caplog.records if "let go" in each.message]
    assert (record.name, record.levelname) == ("aerokit", "WARNING")
    assert record.message.startswith("vehicle 1 is let go: holding in BRAKE, still armed, ")


async def test_a_mistake_of_the_program_in_flight(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air():
            raise ZeroDivisionError
    assert "vehicle 1 is let go: in GUIDED, still armed, 10." in caplog.text


async def test_nothing_is_said_on_the_ground_or_when_it_was_meant(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            raise ZeroDivisionError
    async with in_the_air():
        pass
    assert "let go" not in caplog.text


async def test_only_who_has_ordered_something_that_still_holds_is_warned(
    caplog: pytest.LogCaptureFixture,
) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:  # another program, as it were
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(10.0)

        async def left_after(*orders: Callable[[aerokit.Vehicle], Awaitable[object]]) -> str:
            caplog.clear()
            with pytest.raises(ZeroDivisionError):
                async with aerokit.connect(connection) as vehicle:
                    for each in orders:
                        await each(vehicle)
                    raise ZeroDivisionError
            return caplog.text

        async def pilot_takes(_: object) -> None:
            copter.rc[2] = 1500
            copter.set_mode(CopterMode.ALT_HOLD)
            await anyio.sleep(3)

        async def send_mode(vehicle: aerokit.Vehicle) -> None:
            vehicle.send(SetMode(1, 1, CopterMode.GUIDED))
            await anyio.sleep(3)
            assert vehicle.mode_name == "GUIDED"
            assert vehicle.taken_over == ""

        assert "let go" not in await left_after(lambda vehicle: vehicle.why_not_armable())
        async with vehicles_on(connection) as vehicles:  # as `aerokit status` does it
            await anyio.sleep(2)
            assert list(vehicles) == [1]
        assert "let go" not in caplog.text
        assert "let go: in LOITER" in await left_after(lambda vehicle: vehicle.set_mode("LOITER"))
        assert "let go" not in await left_after(lambda vehicle: vehicle.set_mode("GUIDED"), pilot_takes)
        assert "let go: in GUIDED" in await left_after(send_mode)
        assert "let go" not in await left_after(lambda vehicle: vehicle.set_speed(5.0))
        assert "let go" not in await left_after(send_mode, pilot_takes)


async def test_who_has_armed_it_is_warned_whoever_steers_it_since(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air() as flight:
            flight.pilot_takes_over()
            await anyio.sleep(3)
            assert flight.vehicle.taken_over
            raise ZeroDivisionError
    assert "vehicle 1 is let go: in LOITER, still armed, " in caplog.text


async def test_what_was_ordered_before_it_disarmed_does_not_count(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            await flight.vehicle.arm()
            await flight.vehicle.disarm()
            flight.copter.set_mode(CopterMode.STABILIZE)
            assert flight.copter.arming.arm(force=True)
            await flight.vehicle.armed.wait_until(bool)
            raise ZeroDivisionError
    assert "let go" not in caplog.text


async def test_of_a_vehicle_nothing_is_left_on_a_connection_that_goes_on() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        async with aerokit.open_connection(wire) as connection:
            await anyio.sleep(2.0)
            before = attached_sinks(connection)
            async with aerokit.connect(connection) as vehicle:
                await vehicle.wait_ready()
                await vehicle.parameters.get("RTL_ALT")
                await vehicle.mission.download()
                await vehicle.fence.download()
                await vehicle.logs.list()
                assert vehicle.gimbal.attitude.latest is None
                assert vehicle.mission.count.value == 0
                assert attached_sinks(connection) > before
                assert connection.boot_clocks
            await anyio.sleep(2.0)
            wire.forget()
            assert attached_sinks(connection) == before
            assert not connection.boot_clocks
            await anyio.sleep(5.0)
            assert {type(message) for _, message in wire.sent} == {Heartbeat}


async def test_the_block_is_left_while_a_stream_is_open_elsewhere() -> None:
    """It ends, says why, and the vehicle holds; whoever feeds it is told."""
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        async with aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(10.0)
            stream = await vehicle.guided.velocity().__aenter__()
        with pytest.raises(SetpointStreamStopped, match="the block of its vehicle was left"):
            stream.set(VelocitySetpoint())
        with pytest.raises(ConnectionClosed, match="the block of this vehicle was left; nothing was sent"):
            vehicle.send(Heartbeat(6, 8, 0, 0, 4))
        await anyio.sleep(1.0)
        assert copter.mode.number == CopterMode.BRAKE


async def test_the_block_is_left_while_another_task_flies(caplog: pytest.LogCaptureFixture) -> None:
    """Nobody waits for the flight any more: the vehicle is told to hold before the connection ends."""
    ended: list[Exception] = []
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, anyio.create_task_group() as tasks:
        async with aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(10.0)

            async def go() -> None:
                try:
                    await vehicle.go_to(vehicle.position.value.offset(north_m=300))
                except AerokitError as error:
                    ended.append(error)

            tasks.start_soon(go)
            await anyio.sleep(3.0)
        assert copter.mode.name == "BRAKE"
    assert isinstance(ended[0], (ConnectionClosed, OperationRejected))
    assert "vehicle 1 is let go: holding in BRAKE" in caplog.text


async def test_end_of_block_waits_a_moment_for_an_unanswered_hold() -> None:
    async with in_the_air() as flight:
        with anyio.move_on_after(1.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
        with anyio.move_on_after(1.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        left_at = anyio.current_time()
    assert 1.0 < anyio.current_time() - left_at < 3.0
