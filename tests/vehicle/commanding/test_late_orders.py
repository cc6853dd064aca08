"""Orders that wait before they are sent: a newer order, a silence or a pause in the meantime."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from itertools import count, pairwise

import anyio
import anyio.lowlevel
import pytest
from flight_harness import (
    Flight,
    HeldHeartbeats,
    block_loop,
    in_the_air,
    open_flight,
    open_px4,
    suspend_computer,
)
from plan_flights import long_mission

from aerokit import Position, StickInput, TargetMeasurement, VelocitySetpoint
from aerokit import messages as m
from aerokit.errors import (
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
    SetpointStreamStopped,
    ValueUnknownError,
)
from aerokit.mavlink.enums import CopterMode
from aerokit.mavlink.enums import MavCmd as C
from aerokit.missions import Mission, waypoint
from aerokit.sim import SimulatedCopter
from aerokit.sim.faults import CommandFault

pytestmark = pytest.mark.anyio

Fly = Callable[[Flight], Coroutine[None, None, None]]


async def test_land_while_sticks_read_parameters_stands() -> None:
    async with in_the_air(latency_s=0.6) as flight, anyio.create_task_group() as tasks:

        async def land() -> None:
            await anyio.sleep(1.0)
            with suppress(CommandTimeout):  # The link is slow, but the vehicle gets the command and lands.
                await flight.vehicle.set_mode("LAND")

        tasks.start_soon(land)
        with pytest.raises(OperationRejected, match="another order"):
            async with flight.vehicle.sticks():
                pass
        await anyio.sleep(3.0)
        assert flight.vehicle.mode_name == "LAND"
        assert not flight.wire.all(m.ManualControl)


async def test_loiter_without_target_needs_recent_position() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.drop_outgoing = 100000
        await anyio.sleep(20)
        with pytest.raises(ValueUnknownError):
            await flight.vehicle.loiter()
        assert not flight.wire.commands(C.DO_REPOSITION)


async def test_autotune_is_not_started_again_after_pause() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        asyncio.get_running_loop().call_later(2.5, block_loop, 20.0)
        with pytest.raises(CommandTimeout, match="may go on tuning"):
            await flight.vehicle.autotune()
        sent = [at for at, each in flight.wire.sent if getattr(each, "command", 0) == C.DO_AUTOTUNE_ENABLE]
        assert max(late - early for early, late in pairwise(sent)) < 3


async def test_autotune_is_not_started_again_after_computer_slept() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        asyncio.get_running_loop().call_later(2.5, suspend_computer, flight.vehicle, 20.0)
        with pytest.raises(CommandTimeout, match="may go on tuning"):
            await flight.vehicle.autotune()
        assert len(flight.wire.commands(C.DO_AUTOTUNE_ENABLE)) == 3


async def test_follow_slow_function_gives_no_velocity_peaks() -> None:
    """The function returns the latest position; a new one arrives once a second."""
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        began = anyio.current_time()

        def latest() -> Position:
            return here.offset(north_m=5.0 * int(anyio.current_time() - began))

        async with flight.vehicle.follow(latest, distance_m=10) as following:
            await following.fly(6)
        speeds = [each.vx for each in flight.wire.all(m.SetPositionTargetGlobalInt)]
        assert max(speeds) == pytest.approx(5.0, abs=1.0)


async def test_follow_jump_of_target_is_no_velocity() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        numbers = count()
        jump = lambda: here.offset(north_m=300.0 if next(numbers) >= 20 else 0.0)  # noqa: E731
        async with flight.vehicle.follow(jump, distance_m=10) as following:
            await following.fly(4)
        speeds = [abs(each.vx) for each in flight.wire.all(m.SetPositionTargetGlobalInt)]
        places = [each.lat_int for each in flight.wire.all(m.SetPositionTargetGlobalInt)]
        assert max(speeds) < 100
        assert max(places) <= here.offset(north_m=320).latitude_deg * 1e7


async def test_follow_target_without_altitude_is_no_descent() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        numbers = count()

        def place() -> Position:
            return here if next(numbers) < 20 else here.replace(altitude_amsl_m=None)

        async with flight.vehicle.follow(place, distance_m=10, height_m=5) as following:
            await following.fly(4)
        assert max(abs(each.vz) for each in flight.wire.all(m.SetPositionTargetGlobalInt)) < 1


async def test_follow_invalid_first_place_holds_the_earlier_flight() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        going = asyncio.ensure_future(flight.vehicle.go_to(here.offset(north_m=500)))
        await anyio.sleep(3)
        high = here.replace(altitude_amsl_m=200_000.0, altitude_relative_m=None)
        with pytest.raises(InvalidArgument):
            async with flight.vehicle.follow(lambda: high, height_m=5):
                pass
        with pytest.raises(OperationRejected):
            await going
        await anyio.sleep(3)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_follow_own_vehicle_is_refused() -> None:
    async with in_the_air() as flight:
        with pytest.raises(InvalidArgument, match="target"):
            async with flight.vehicle.follow(flight.vehicle) as following:
                await following.fly(10)
        assert not flight.wire.all(m.SetPositionTargetGlobalInt)


async def test_follow_function_that_raises_cancellation_holds() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        numbers = count()

        def latest() -> Position:
            if next(numbers) >= 10:
                raise asyncio.CancelledError  # as Task.result() of a task that was cancelled
            return here

        with pytest.raises(SetpointStreamStopped, match="CancelledError"):
            async with flight.vehicle.follow(latest) as following:
                await following.fly(5)
        await anyio.sleep(3)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_land_on_newer_order_before_first_sight_stands() -> None:
    simulated = SimulatedCopter(boot_time_s=0.0, parameters={"PLND_ENABLED": 1.0, "PLND_TYPE": 1.0})
    async with in_the_air(copter=simulated) as flight:
        going = asyncio.ensure_future(flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=30)))
        await anyio.sleep(1)
        sees = asyncio.Event()
        target = lambda: TargetMeasurement(0.0, 0.0, 10.0) if sees.is_set() else None  # noqa: E731
        landing = asyncio.ensure_future(flight.vehicle.land_on(target))
        await anyio.sleep(1)
        going.cancel()
        going = asyncio.ensure_future(flight.vehicle.go_to(flight.vehicle.position.value.offset(east_m=200)))
        await anyio.sleep(1)
        sees.set()
        with pytest.raises(OperationRejected, match="another order was given meanwhile; this order was not sent"):
            await landing
        assert not [each for each in flight.wire.mode_orders() if each == CopterMode.LAND]
        going.cancel()


async def test_terminated_flight_gets_no_mode_afterwards() -> None:
    async with in_the_air() as flight:

        async def fly() -> None:
            with suppress(SetpointStreamStopped, OperationRejected):
                async with flight.vehicle.guided.velocity() as stream:
                    await stream.fly(VelocitySetpoint(1, 0, 0), 20)

        task = asyncio.ensure_future(fly())
        await anyio.sleep(2)
        flight.wire.clear()
        terminating = asyncio.ensure_future(flight.vehicle.terminate(intent="terminate flight"))
        await anyio.lowlevel.checkpoint()
        task.cancel()
        await asyncio.wait([task, terminating])
        await anyio.sleep(5)
        assert not flight.wire.mode_orders()


@pytest.mark.parametrize(("blocked_s", "is_sent"), [(4.0, True), (14.0, False)])
async def test_take_off_command_after_blocked_loop_needs_heartbeat(blocked_s: float, is_sent: bool) -> None:
    """The HEARTBEAT that confirms the mode arrived before the pause; those of the pause were lost."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await flight.vehicle._session.wait_for_heartbeat()
        heartbeats = HeldHeartbeats(flight.wire)
        going = asyncio.ensure_future(flight.vehicle.take_off(10))
        await anyio.sleep(1.2)
        assert flight.wire.mode_orders() == [CopterMode.GUIDED]
        heartbeats.release_first_after(blocked_s)
        await anyio.sleep(0.1)
        assert flight.vehicle.mode_name == "GUIDED"
        assert not flight.wire.commands(C.NAV_TAKEOFF)
        await anyio.sleep(1.5)
        assert bool(flight.wire.commands(C.NAV_TAKEOFF)) is is_sent
        if not is_sent:
            with pytest.raises(OperationTimeout, match=r"set_mode\(GUIDED\): not done"):
                await going
        going.cancel()


async def test_arm_after_blocked_loop_needs_heartbeat() -> None:
    """The vehicle has disarmed by itself during the pause, but HEARTBEATs were lost."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle._session.wait_for_heartbeat()
        heartbeats = HeldHeartbeats(flight.wire)
        arming = asyncio.ensure_future(flight.vehicle.arm())
        await anyio.sleep(1.2)
        flight.copter.arming.disarm()
        heartbeats.release_first_after(14.0)
        assert flight.vehicle.is_armed
        with pytest.raises(OperationTimeout, match=r"arm\(\): not done within 10 s"):
            await arming


async def test_mode_after_blocked_loop_needs_recent_report() -> None:
    """A pilot may have changed the mode again during the pause."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle._session.wait_for_heartbeat()
        heartbeats = HeldHeartbeats(flight.wire)
        changing = asyncio.ensure_future(flight.vehicle.set_mode("GUIDED"))
        await anyio.sleep(1.2)
        assert flight.copter.set_mode(CopterMode.ALT_HOLD)
        heartbeats.release_first_after(14.0)
        assert flight.vehicle.mode_name == "GUIDED"
        with pytest.raises(OperationTimeout, match=r"set_mode\(GUIDED\): not done"):
            await changing


async def test_setpoints_after_blocked_loop_need_heartbeat() -> None:
    async with in_the_air() as flight:
        await flight.vehicle.set_mode("LOITER")
        heartbeats = HeldHeartbeats(flight.wire)

        async def fly() -> None:
            async with flight.vehicle.guided.velocity() as stream:
                await stream.fly(VelocitySetpoint(3, 0, 0), 20)

        flying = asyncio.ensure_future(fly())
        await anyio.sleep(1.2)
        heartbeats.release_first_after(14.0)
        with pytest.raises(OperationTimeout, match=r"set_mode\(GUIDED\): not done"):
            await flying
        assert not flight.wire.setpoints()


async def test_hold_after_blocked_loop_needs_heartbeat() -> None:
    """The ground station failsafe acted during the pause, and HEARTBEAT reported that after the socket was full."""
    async with in_the_air() as flight:
        going = asyncio.ensure_future(flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500)))
        await anyio.sleep(2)
        flight.copter.faults.silent = True
        await anyio.sleep(3)
        flight.wire.clear()
        going.cancel()
        await asyncio.wait([going])
        assert flight.vehicle.is_hold_pending
        heartbeats = HeldHeartbeats(flight.wire)
        flight.copter.faults.silent = False
        await anyio.sleep(1.5)
        assert flight.copter.set_mode(CopterMode.RTL)
        heartbeats.release_first_after(14.0)
        await anyio.sleep(5)
        assert flight.vehicle.mode_name == "RTL"
        assert not flight.wire.mode_orders()


async def test_order_is_not_repeated_after_computer_slept() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.commands[C.DO_SET_MODE] = CommandFault(ignore=True)
        landing = asyncio.ensure_future(flight.vehicle.set_mode("LAND"))
        await anyio.sleep(0.3)
        suspend_computer(flight.vehicle, 600.0)
        with pytest.raises(CommandTimeout, match="not sent again: the computer slept"):
            await landing
        assert flight.wire.mode_orders() == [CopterMode.LAND]


async def test_setpoints_end_when_computer_slept() -> None:
    """The pilot or a failsafe may fly the vehicle since."""
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped, match="the computer slept for 60 s"):
            async with flight.vehicle.guided.velocity() as stream:
                await stream.fly(VelocitySetpoint(3, 0, 0), 2.0)
                flight.copter.faults.silent = True
                flight.wire.clear()
                suspend_computer(flight.vehicle, 60.0)
                await stream.fly(VelocitySetpoint(3, 0, 0), 5.0)
        assert not flight.wire.setpoints()
        assert not flight.wire.mode_orders()
        flight.copter.faults.silent = False
        await anyio.sleep(3.0)
        assert flight.vehicle.mode_name == "BRAKE"


async def _fly_sticks(flight: Flight) -> None:
    async with flight.vehicle.sticks() as sticks:
        await sticks.move(StickInput(forward=0.5), 1.0)
        flight.copter.faults.drop_incoming = 3


async def _fly_velocity(flight: Flight) -> None:
    async with flight.vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(3, 0, 0), 2.0)
        flight.copter.faults.drop_incoming = 3


@pytest.mark.parametrize("fly", [_fly_sticks, _fly_velocity])
async def test_lost_hold_of_cancelled_block_waits_for_heartbeat(
    fly: Callable[[Flight], Coroutine[None, None, None]],
) -> None:
    async with in_the_air() as flight:
        task = asyncio.ensure_future(fly(flight))
        while not flight.copter.faults.drop_incoming:  # noqa: ASYNC110
            await anyio.sleep(0.05)
        await anyio.sleep(0.1)
        orders_before, heartbeats = flight.wire.mode_orders(), HeldHeartbeats(flight.wire)
        assert orders_before[-1] == CopterMode.BRAKE
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()
        await anyio.sleep(0.9)
        assert flight.wire.mode_orders() == orders_before  # The hold is not sent again before the next HEARTBEAT.
        heartbeats.stop()
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_take_off_command_is_not_sent_after_computer_slept() -> None:
    """After the sleep, the vehicle is still armed in the mode that the first step ordered."""
    async with open_flight() as flight:
        flight.copter.parameters["DISARM_DELAY"] = 0.0
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await flight.vehicle._session.wait_for_heartbeat()
        heartbeats = HeldHeartbeats(flight.wire)
        going = asyncio.ensure_future(flight.vehicle.take_off(10))
        await anyio.sleep(1.2)
        assert flight.wire.mode_orders() == [CopterMode.GUIDED]
        suspend_computer(flight.vehicle, 600.0)
        heartbeats.stop()
        with pytest.raises(OperationRejected, match="the computer slept; the rest of the order was not sent"):
            await going
        assert not flight.wire.commands(C.NAV_TAKEOFF)


async def test_arm_command_is_not_sent_after_computer_slept() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("LAND")
        await flight.vehicle._session.wait_for_heartbeat()
        heartbeats = HeldHeartbeats(flight.wire)
        arming = asyncio.ensure_future(flight.vehicle.arm(mode="GUIDED"))
        await anyio.sleep(1.2)
        suspend_computer(flight.vehicle, 600.0)
        heartbeats.stop()
        with pytest.raises(OperationRejected, match="the computer slept"):
            await arming
        assert not flight.wire.commands(C.COMPONENT_ARM_DISARM)


async def test_vehicle_in_mode_of_stream_holds_when_computer_slept() -> None:
    """The mode was changed, but no value may be sent after the sleep."""
    async with in_the_air() as flight:
        await flight.vehicle.set_mode("LOITER")
        heartbeats = HeldHeartbeats(flight.wire)
        entering = asyncio.ensure_future(flight.vehicle.guided.velocity().__aenter__())
        await anyio.sleep(1.2)
        suspend_computer(flight.vehicle, 600.0)
        heartbeats.stop()
        with pytest.raises(OperationRejected, match="the computer slept; the rest of the order was not sent"):
            await entering
        await anyio.sleep(3.0)
        assert flight.vehicle.mode_name == "BRAKE"
        assert not flight.wire.setpoints()


async def test_go_to_holds_when_computer_slept_before_its_speed() -> None:
    async with in_the_air(latency_s=0.2) as flight:
        going = flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500), speed_m_s=3.0)
        task = asyncio.ensure_future(going)
        await anyio.sleep(0.1)
        suspend_computer(flight.vehicle, 600.0)
        with pytest.raises(OperationRejected, match="the computer slept; the rest of the order was not sent"):
            await task
        await anyio.sleep(4.0)
        assert not flight.wire.commands(C.DO_CHANGE_SPEED)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_hold_at_end_of_orbit_is_sent_although_computer_slept() -> None:
    """The vehicle still flies the circle, so that the hold only stops it."""
    async with open_px4() as flight:
        await flight.take_off()
        center = flight.vehicle.position.value
        orbit = flight.vehicle.orbit(center, radius_m=12, speed_m_s=4, turns=0.5, max_silence_s=None)
        orbiting = asyncio.ensure_future(orbit)
        await anyio.sleep(6.0)
        suspend_computer(flight.vehicle, 600.0)
        await orbiting
        assert flight.vehicle.mode_name == "LOITER"


async def test_item_is_not_set_after_transfer_and_silence() -> None:
    async with open_px4() as flight:
        items = [waypoint(47.4, 8.55, altitude_relative_m=20.0), waypoint(47.41, 8.55, altitude_relative_m=20.0)]
        await flight.vehicle.mission.upload(Mission(items), max_distance_m=1e8)
        await flight.vehicle.mission._context.lock.acquire()
        setting = asyncio.ensure_future(flight.vehicle.mission.set_current(1, timeout=10.0))
        await anyio.sleep(1.0)
        flight.px4.faults.silent = True
        await anyio.sleep(4.0)
        flight.vehicle.mission._context.lock.release()
        with pytest.raises(HeartbeatTimeout, match="the rest of the order was not sent"):
            await setting
        assert not flight.wire.all(m.MissionSetCurrent)


async def test_upload_and_parameter_write_continue_after_computer_slept() -> None:
    """An upload that ended in the middle would leave a mixture of two missions on ArduPilot."""
    async with open_flight(latency_s=0.1) as flight:
        vehicle, faults = flight.vehicle, flight.copter.faults
        await vehicle.wait_ready()
        await vehicle.parameters.download()
        mission = long_mission(40)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(partial(vehicle.mission.upload, mission, method="items"))
            await anyio.sleep(0.5)
            faults.silent = True
            tasks.start_soon(vehicle.parameters.set, "RTL_ALT", 2500.0)
            await anyio.sleep(0.1)
            suspend_computer(vehicle, 600.0)
            flight.wire.clear()
            await anyio.sleep(0.5)
            faults.silent = False
        assert flight.wire.all(m.MissionItemInt)
        assert flight.wire.all(m.ParamSet)
        assert flight.copter.parameters["RTL_ALT"] == 2500.0
        assert mission.matches(await vehicle.mission.download())
