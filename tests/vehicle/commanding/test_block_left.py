"""Warnings when a program leaves the block of a flying vehicle unintentionally."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest
from flight_harness import Wire, attached_sinks, in_the_air, open_flight

import aerokit
from aerokit.errors import AerokitError, ConnectionClosed, OperationRejected, SetpointStreamStopped
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.mavlink.messages import CameraInformation, Heartbeat, SetMode, Statustext
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.connect import vehicles_on

pytestmark = pytest.mark.anyio


async def fly_up(vehicle: aerokit.Vehicle) -> None:
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(10.0)


async def test_block_left_after_cancelled_flight_warns_that_vehicle_holds(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with anyio.move_on_after(30) as scope:
        async with in_the_air() as flight:
            scope.deadline = anyio.current_time() + 2
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
    assert scope.cancelled_caught
    (record,) = [record for record in caplog.records if "was left: " in record.message]
    assert (record.name, record.levelname) == ("aerokit", "WARNING")
    assert record.message.startswith("the async with block of vehicle 1 was left: holding in BRAKE, still armed, ")


async def test_block_left_holds_although_callback_raises(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    flights: list[Any] = []
    with anyio.move_on_after(30) as scope:
        async with in_the_air() as flight:
            flights.append(flight)
            flight.vehicle._context.on_finish(fail)
            scope.deadline = anyio.current_time() + 2
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(flight.vehicle.go_to, flight.vehicle.position.value.offset(north_m=500))
    assert flights[0].wire.mode_orders() == [CopterMode.BRAKE]
    assert "a callback at the end of the async with block of this vehicle failed" in caplog.text


async def test_block_left_by_exception_in_flight_warns(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air():
            raise ZeroDivisionError
    assert "vehicle 1 was left: in GUIDED, still armed, 10." in caplog.text


async def test_block_left_on_ground_or_deliberately_is_silent(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            raise ZeroDivisionError
    async with in_the_air():
        pass
    assert "was left: " not in caplog.text


async def test_block_left_warns_only_with_active_order(
    caplog: pytest.LogCaptureFixture,
) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:  # another program, as it were
            await fly_up(vehicle)

        async def log_after(*orders: Callable[[aerokit.Vehicle], Awaitable[object]]) -> str:
            caplog.clear()
            with pytest.raises(ZeroDivisionError):
                async with aerokit.connect(connection) as vehicle:
                    for order in orders:
                        await order(vehicle)
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

        assert "was left: " not in await log_after(lambda vehicle: vehicle.why_not_armable())
        async with vehicles_on(connection) as vehicles:  # as `aerokit status` does it
            await anyio.sleep(2)
            assert list(vehicles) == [1]
        assert "was left: " not in caplog.text
        assert "was left: in LOITER" in await log_after(lambda vehicle: vehicle.set_mode("LOITER"))
        assert "was left: " not in await log_after(lambda vehicle: vehicle.set_mode("GUIDED"), pilot_takes)
        assert "was left: in GUIDED" in await log_after(send_mode)
        assert "was left: " not in await log_after(lambda vehicle: vehicle.set_speed(5.0))
        assert "was left: " not in await log_after(send_mode, pilot_takes)


async def test_block_left_warns_program_that_armed(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air() as flight:
            flight.pilot_takes_over()
            await anyio.sleep(3)
            assert flight.vehicle.taken_over
            raise ZeroDivisionError
    assert "vehicle 1 was left: in LOITER, still armed, " in caplog.text


async def test_block_left_after_landing_says_on_the_ground(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air() as flight:
            await flight.vehicle.land()
            raise ZeroDivisionError
    assert "vehicle 1 was left: on the ground in LAND, still armed, " in caplog.text


async def test_orders_before_disarming_do_not_count(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            await flight.vehicle.arm()
            await flight.vehicle.disarm()
            flight.copter.set_mode(CopterMode.STABILIZE)
            assert flight.copter.arming.arm(force=True)
            await flight.vehicle.armed.wait_until(bool)
            raise ZeroDivisionError
    assert "was left: " not in caplog.text


async def test_vehicle_block_leaves_nothing_on_connection() -> None:
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
            wire.clear()
            assert attached_sinks(connection) == before
            assert not connection.boot_clocks
            await anyio.sleep(5.0)
            assert {type(message) for _, message in wire.sent} == {Heartbeat}


async def test_block_left_with_stream_in_other_task_holds() -> None:
    """The stream ends with a reason, the vehicle holds, and the task of the stream gets the error."""
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        async with aerokit.connect(link) as vehicle:
            await fly_up(vehicle)
            stream = await vehicle.guided.velocity().__aenter__()
        with pytest.raises(SetpointStreamStopped, match="the async with block of its vehicle was left"):
            stream.set(VelocitySetpoint())
        with pytest.raises(ConnectionClosed, match="the async with block of this vehicle was left; nothing was sent"):
            vehicle.send(Heartbeat(6, 8, 0, 0, 4))
        await anyio.sleep(1.0)
        assert copter.mode.number == CopterMode.BRAKE


async def test_block_left_with_flight_in_other_task_holds(caplog: pytest.LogCaptureFixture) -> None:
    """The flight's task has ended: aerokit commands a hold before it closes the connection."""
    ended: list[Exception] = []
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, anyio.create_task_group() as tasks:
        async with aerokit.connect(link) as vehicle:
            await fly_up(vehicle)

            async def go() -> None:
                try:
                    await vehicle.go_to(vehicle.position.value.offset(north_m=300))
                except AerokitError as error:
                    ended.append(error)

            tasks.start_soon(go)
            await anyio.sleep(3.0)
        assert copter.mode.name == "BRAKE"
    assert isinstance(ended[0], (ConnectionClosed, OperationRejected))
    assert "vehicle 1 was left: holding in BRAKE" in caplog.text


@pytest.mark.parametrize("call", ["go_to", "loiter", "orbit"])
async def test_block_left_before_order_is_acknowledged_holds(call: str) -> None:
    simulated = SimulatedPx4(boot_time_s=0.0) if call == "orbit" else SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(simulated, latency_s=0.3) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await fly_up(vehicle)
            place = vehicle.position.value.offset(north_m=300)
            arguments = {"radius_m": 10} if call == "orbit" else {}
            task = asyncio.create_task(getattr(vehicle, call)(place, **arguments))
            await anyio.sleep(0.2)
        with pytest.raises(AerokitError):
            await task
        await anyio.sleep(10.0)
        assert simulated.motion.north < 5.0


async def test_block_left_while_follow_waits_for_target_ends_earlier_flight() -> None:
    async def follow(vehicle: aerokit.Vehicle) -> None:
        async with vehicle.follow(lambda: None):
            pass

    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await fly_up(vehicle)
            flight = asyncio.create_task(vehicle.go_to(vehicle.position.value.offset(north_m=300)))
            await anyio.sleep(1.0)
            following = asyncio.create_task(follow(vehicle))
            await anyio.sleep(1.0)
        await anyio.sleep(5.0)
        assert copter.mode.number == CopterMode.BRAKE
        for task in (flight, following):
            with pytest.raises(AerokitError):
                await task


async def test_block_left_before_hold_of_stream_is_acknowledged_holds() -> None:
    async def fly(vehicle: aerokit.Vehicle) -> None:
        async with vehicle.guided.velocity() as stream:
            await stream.fly(VelocitySetpoint(5.0), 2.0)

    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await fly_up(vehicle)
            task = asyncio.create_task(fly(vehicle))
            await anyio.sleep(1.9)
            copter.faults.ignore(MavCmd.DO_SET_MODE, times=1)
            await anyio.sleep(0.2)
        with pytest.raises(AerokitError):
            await task
        assert copter.mode.number == CopterMode.BRAKE


async def test_block_left_while_other_task_arms_disarms(caplog: pytest.LogCaptureFixture) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter, latency_s=0.3) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await vehicle.wait_ready()
            task = asyncio.create_task(vehicle.arm())
            await anyio.sleep(0.2)
        await asyncio.wait((task,))
        await anyio.sleep(3.0)
        assert not copter.is_armed
    assert "an abandoned arm command has armed the vehicle: aerokit disarms it again" in caplog.text


async def test_block_exit_waits_briefly_for_unanswered_hold() -> None:
    async with in_the_air() as flight:
        with anyio.move_on_after(1.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
        with anyio.move_on_after(1.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        left_at = anyio.current_time()
    assert 1.0 < anyio.current_time() - left_at < 3.0


async def test_block_left_by_two_cancellations_warns(caplog: pytest.LogCaptureFixture) -> None:
    is_flying = asyncio.Event()

    async def fly() -> None:
        async with in_the_air() as flight:
            flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
            is_flying.set()
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))

    task = asyncio.create_task(fly())
    await is_flying.wait()
    await anyio.sleep(2.0)
    for _ in range(2):  # The second cancellation arrives while the exit of the block waits for the hold.
        task.cancel()
        await anyio.sleep(0.5)
    with pytest.raises(asyncio.CancelledError):
        await task
    assert "vehicle 1 was left: in GUIDED, still armed, " in caplog.text


async def test_old_height_is_described_with_its_age() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.drop_outgoing = 100_000
        await anyio.sleep(20.0)
        assert " 10.0 m above home 20 s ago," in flight.vehicle._context.describe_now()


@pytest.mark.parametrize(
    "call",
    [
        lambda vehicle: vehicle.land(timeout=None, max_silence_s=None),
        lambda vehicle: vehicle.set_heading(180.0),
        lambda vehicle: vehicle.mission.wait_finished(max_silence_s=None),
        lambda vehicle: vehicle.parameters.download(method="list"),
        lambda vehicle: vehicle.files.read("@PARAM/param.pck"),
    ],
    ids=["land", "set_heading", "wait_finished", "parameters", "file"],
)
async def test_call_that_outlives_block_ends_with_it(call: Callable[[aerokit.Vehicle], Awaitable[object]]) -> None:
    async def run(vehicle: aerokit.Vehicle) -> None:
        await call(vehicle)

    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await fly_up(vehicle)
            task = asyncio.create_task(run(vehicle))
            await anyio.sleep(0.01)
        left_at = anyio.current_time()
        with pytest.raises(ConnectionClosed, match="the async with block of this vehicle was left"):
            await task
        assert anyio.current_time() - left_at < 0.1


@pytest.mark.parametrize("component_id", [1, 100])
async def test_subscription_ends_with_vehicle_block(component_id: int) -> None:
    async def read(source: Any) -> None:
        with source.subscribe(CameraInformation) as messages:
            await messages.get(30.0)

    async with simulated_link(SimulatedCopter()) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            reader = asyncio.create_task(read(vehicle if component_id == 1 else vehicle.component(component_id)))
            await anyio.sleep(1.0)
        with pytest.raises(ConnectionClosed):
            await reader


async def test_wait_ready_ends_with_vehicle_block() -> None:
    async with simulated_link(SimulatedCopter()) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            task = asyncio.create_task(vehicle.wait_ready())
            await anyio.sleep(1.0)
        left_at = anyio.current_time()
        with pytest.raises(ConnectionClosed):
            await task
        assert anyio.current_time() - left_at < 0.1


async def test_autotune_polls_no_more_after_block() -> None:
    async with simulated_link(SimulatedPx4()) as link:
        wire = Wire(link)
        async with aerokit.open_connection(wire) as connection:
            async with aerokit.connect(connection) as vehicle:
                await fly_up(vehicle)
                task = asyncio.create_task(vehicle.autotune())
                await anyio.sleep(3.0)
            wire.clear()
            with pytest.raises(ConnectionClosed):
                await task
            assert not wire.commands(MavCmd.DO_AUTOTUNE_ENABLE)


async def test_call_on_left_vehicle_disturbs_no_other_flight() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        async with aerokit.open_connection(wire) as connection:
            async with aerokit.connect(connection) as left_vehicle:
                await fly_up(left_vehicle)
            async with aerokit.connect(connection) as vehicle:
                await vehicle.armed.wait_until(bool)
                wire.clear()
                with pytest.raises(SetpointStreamStopped):
                    async with left_vehicle.guided.velocity() as stream:
                        stream.set(VelocitySetpoint())
                with pytest.raises(ConnectionClosed, match="nothing was sent"):
                    await left_vehicle.arm(reason="by mistake")
                assert not wire.mode_orders()
                assert not wire.all(Statustext)


async def test_streams_that_outlive_block_keep_connection_open() -> None:
    async def stream(vehicle: aerokit.Vehicle) -> None:
        with vehicle.streams(4.0):
            await anyio.sleep(60.0)

    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            copter.faults.drop_outgoing = 100_000
            task = asyncio.create_task(stream(vehicle))
            await anyio.sleep(1.0)
        await anyio.sleep(30.0)
        assert connection.is_open
        task.cancel()
