"""Several vehicles, components and ground stations on one link never change each other's state."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import NamedTuple

import anyio
import pytest
from flight_harness import Wire, now

import aerokit
from aerokit import messages as m
from aerokit.connection.opening import open_connection
from aerokit.errors import BusyError, CommandTimeout, ConnectFailed
from aerokit.events import ArmedChanged, ModeChanged, StatusTextReceived, VehicleFound, VehicleSilent
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavAutopilot, MavCmd, MavResult, MavState, MavType
from aerokit.sim import ExtraComponent, SimulatedCopter, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

HERE, THERE = (-35.3632610, 149.1652299, 584.09), (47.3977420, 8.5455940, 488.0)


class Two(NamedTuple):
    first: SimulatedCopter
    second: SimulatedCopter
    one: aerokit.Vehicle
    two: aerokit.Vehicle
    wire: Wire


@asynccontextmanager
async def two_vehicles() -> AsyncIterator[Two]:
    first = SimulatedCopter(system_id=1, boot_time_s=0.0, home=HERE)
    second = SimulatedCopter(system_id=2, boot_time_s=0.0, home=THERE, seed=1)
    async with simulated_link([first, second]) as link:
        wire = Wire(link)
        async with (
            open_connection(wire) as connection,
            aerokit.connect(connection, system_id=1) as one,
            aerokit.connect(connection, system_id=2) as two,
        ):
            await one.wait_ready()
            await two.wait_ready()
            wire.clear()
            yield Two(first, second, one, two, wire)


async def test_states_of_two_vehicles_are_separate() -> None:
    async with two_vehicles() as both:
        for vehicle, home in ((both.one, HERE), (both.two, THERE)):
            assert vehicle.position.value.latitude_deg == pytest.approx(home[0], abs=1e-4)
            assert vehicle.home.value.longitude_deg == pytest.approx(home[1], abs=1e-4)
            source = vehicle.position.source
            assert source is not None
            assert source.system_id == vehicle.system_id
        await both.two.set_mode("GUIDED")
        await both.two.arm()
        await anyio.sleep(2.0)
        assert (both.one.mode_name, both.two.mode_name) == ("STABILIZE", "GUIDED")
        assert (both.one.is_armed, both.two.is_armed) == (False, True)


async def test_commands_reach_only_addressed_vehicle() -> None:
    async with two_vehicles() as both:
        await both.two.arm()
        assert not both.first.is_armed
        assert {command.target_system for command in both.wire.commands(MavCmd.COMPONENT_ARM_DISARM)} == {2}
        await both.one.set_mode("ALT_HOLD")
        assert both.second.mode.number == CopterMode.STABILIZE
        sent = [message for _, message in both.wire.sent if not isinstance(message, m.Timesync)]
        assert {getattr(message, "target_system", None) for message in sent} == {None, 1, 2}  # no broadcasts


async def test_both_vehicles_fly_concurrently() -> None:
    async with two_vehicles() as both:

        async def fly(vehicle: aerokit.Vehicle, altitude_m: float) -> None:
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()
            await vehicle.take_off(altitude_m)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(fly, both.one, 10.0)
            tasks.start_soon(fly, both.two, 20.0)
        await anyio.sleep(3.0)
        assert both.first.altitude_m == pytest.approx(10.0, abs=0.6)
        assert both.second.altitude_m == pytest.approx(20.0, abs=1.1)


async def test_equal_commands_to_two_vehicles_are_concurrent() -> None:
    async with two_vehicles() as both:
        both.first.faults.ignore(MavCmd.DO_SEND_BANNER)
        async with anyio.create_task_group() as tasks:

            async def command_without_answer() -> None:
                with pytest.raises(CommandTimeout):
                    await both.one.command(MavCmd.DO_SEND_BANNER)

            tasks.start_soon(command_without_answer)
            await anyio.sleep(0.01)
            started = now()
            ack = await both.two.command(MavCmd.DO_SEND_BANNER)
            assert now() - started < 0.1
            assert ack.received_frame is not None
            assert ack.received_frame.system_id == 2


async def test_refusal_of_one_vehicle_does_not_affect_other() -> None:
    async with two_vehicles() as both:
        both.first.faults.refuse(MavCmd.DO_SET_MODE, MavResult.DENIED)
        async with anyio.create_task_group() as tasks:

            async def refused() -> None:
                with pytest.raises(aerokit.errors.CommandRejected):
                    await both.one.set_mode("GUIDED")

            tasks.start_soon(refused)
            await both.two.set_mode("GUIDED")
        assert (both.one.mode_name, both.two.mode_name) == ("STABILIZE", "GUIDED")


async def test_subscription_separates_events_and_messages() -> None:
    async with two_vehicles() as both:
        with (
            both.one.subscribe(ModeChanged, ArmedChanged, StatusTextReceived, VehicleSilent, capacity=50) as of_one,
            both.two.subscribe(ModeChanged, ArmedChanged, VehicleSilent, capacity=50) as of_two,
            both.two.subscribe(m.Attitude, capacity=100) as attitudes,
        ):
            await both.two.set_mode("GUIDED")
            await both.two.arm()
            both.second.faults.silent = True
            await anyio.sleep(6.0)
            assert of_one.get_nowait() is None
            kinds = {type(event) for event in iter(of_two.get_nowait, None)}
            assert kinds == {ModeChanged, ArmedChanged, VehicleSilent}
            systems = {a.received_frame.system_id for a in iter(attitudes.get_nowait, None) if a.received_frame}
            assert systems == {2}
        assert both.two.is_silent
        assert not both.one.is_silent


async def test_reboot_of_one_vehicle_keeps_other() -> None:
    async with two_vehicles() as both:
        await anyio.sleep(8.0)
        both.wire.clear()
        await both.two.reboot()
        await anyio.sleep(5.0)
        assert both.one.position.fresh(within=0.5)
        assert both.first.uptime > 10.0
        requests = both.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)
        asked = {request.target_system for request in requests if request.param1 != m.DistanceSensor.ID}
        assert asked == {2}


async def test_closing_one_vehicle_keeps_other() -> None:
    first = SimulatedCopter(system_id=1, boot_time_s=0.0)
    second = SimulatedCopter(system_id=2, boot_time_s=0.0)
    async with (
        simulated_link([first, second]) as link,
        open_connection(link) as connection,
        aerokit.connect(connection, system_id=1) as one,
    ):
        async with aerokit.connect(connection, system_id=2) as two:
            await two.wait_ready()
            with pytest.raises(BusyError):
                async with aerokit.connect(connection, system_id=2):
                    raise AssertionError
        await one.wait_ready()
        await one.set_mode("GUIDED")
        async with aerokit.connect(connection, system_id=2) as two:
            assert two.system_id == 2


async def test_error_in_one_block_is_no_exception_group_in_other() -> None:
    copters = [SimulatedCopter(system_id=1, boot_time_s=0.0), SimulatedCopter(system_id=2, boot_time_s=0.0)]
    with pytest.raises(ZeroDivisionError):
        async with (
            simulated_link(copters) as link,
            open_connection(link) as connection,
            aerokit.connect(connection, system_id=1),
            aerokit.connect(connection, system_id=2),
        ):
            _ = 1 / 0


async def test_copter_and_px4_on_one_connection_both_connect() -> None:
    copter, px4 = SimulatedCopter(system_id=1, boot_time_s=0.0), SimulatedPx4(system_id=2, boot_time_s=1.0)
    async with (
        simulated_link([copter, px4]) as link,
        open_connection(link) as connection,
        aerokit.connect(connection, system_id=2) as two,
        aerokit.connect(connection, system_id=1) as one,
    ):
        await one.wait_ready()
        await two.wait_ready()
        assert (one.autopilot.name, two.autopilot.name) == ("ArduPilot", "PX4")
        await two.set_mode("POSCTL")
        await one.set_mode("POSHOLD")
        assert (one.mode_name, two.mode_name) == ("POSHOLD", "POSCTL")


# -------------------------------------------------------------- other components, ground stations

GIMBAL = ExtraComponent(154, type=MavType.GIMBAL, base_mode=0x80, custom_mode=9)
CAMERA = ExtraComponent(100, type=MavType.CAMERA, autopilot=MavAutopilot.GENERIC, system_status=MavState.EMERGENCY)
ADSB = ExtraComponent(156, type=MavType.ADSB, base_mode=0xFF)
COMPANION = ExtraComponent(191, type=MavType.ONBOARD_CONTROLLER, custom_mode=6)
GROUND_STATION = ExtraComponent(190, type=MavType.GCS, system_id=254, base_mode=0xD9, custom_mode=4)
SECOND_AUTOPILOT = ExtraComponent(
    2, type=MavType.QUADROTOR, autopilot=MavAutopilot.ARDUPILOTMEGA, base_mode=0xD9, custom_mode=6
)


@pytest.mark.parametrize(
    "component",
    [GIMBAL, CAMERA, ADSB, COMPANION, GROUND_STATION, SECOND_AUTOPILOT],
    ids=lambda c: str(c.component_id),
)
async def test_heartbeats_of_others_are_ignored(component: ExtraComponent) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, components=[component])
    async with simulated_link(copter) as link, aerokit.connect(link, system_id=1) as vehicle:
        assert (vehicle.system_id, vehicle.component_id) == (1, 1)
        await vehicle.wait_ready()
        with vehicle.subscribe(ModeChanged, ArmedChanged, capacity=50) as events:
            await anyio.sleep(5.0)
            assert events.get_nowait() is None
        assert (vehicle.mode_name, vehicle.is_armed, vehicle.system_status.value) == ("STABILIZE", False, 3)
        copter.faults.heartbeats_stopped = True
        await anyio.sleep(6.0)


async def test_autopilot_with_other_component_id_is_accepted() -> None:
    """It is the only autopilot: after its third heartbeat it is the vehicle."""
    async with simulated_link([]) as link:
        wire = Wire(link)
        odd = FrameEncoder(5, 7)
        async with anyio.create_task_group() as tasks:

            async def beat() -> None:
                while True:
                    await anyio.sleep(1.0)
                    wire.deliver(odd.encode(m.Heartbeat(MavType.QUADROTOR, MavAutopilot.PX4, 1, 0, 3, 3)))

            tasks.start_soon(beat)
            async with aerokit.connect(wire, timeout=5.0, rates={}) as vehicle:
                assert (vehicle.system_id, vehicle.component_id) == (5, 7)
                tasks.cancel_scope.cancel()


async def test_gimbal_works_while_autopilot_is_silent() -> None:
    """Its heartbeats come from the same system, but the vehicle counts as silent."""
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            copter.faults.silent = True
            gimbal = FrameEncoder(1, 154)
            with vehicle.subscribe(VehicleSilent, capacity=2) as events:
                for _ in range(6):
                    await anyio.sleep(1.0)
                    wire.deliver(gimbal.encode(m.Heartbeat(MavType.GIMBAL, MavAutopilot.INVALID, 0, 0, 4, 3)))
                assert events.get_nowait() is not None


async def test_telemetry_of_other_component_or_system_is_ignored() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            await vehicle.set_mode("GUIDED")
            for sender in ((1, 154), (7, 1), (255, 190)):
                encoder = FrameEncoder(*sender)
                for message in (
                    m.Attitude(1, 3.0, 1.0, 1.0, 0.0, 0.0, 0.0),
                    m.GlobalPositionInt(1, 10, 10, 10, 10, 0, 0, 0, 0),
                    m.Statustext(0, "Crash!"),
                    m.Heartbeat(2, 3, 0xD9, 9, 6, 3),
                    m.CommandAck(MavCmd.DO_SET_MODE, MavResult.DENIED),
                    m.SystemTime(0, 1),
                    m.Timesync(1, 1),
                    m.HomePosition(0, 0, 0, 0, 0, 0, (1, 0, 0, 0), 0, 0, 0),
                ):
                    wire.deliver(encoder.encode(message))
            assert abs(vehicle.attitude.value.roll_deg) < 20.0
            assert vehicle.position.value.latitude_deg < -35.0
            assert vehicle.home.value.latitude_deg < -35.0
            assert vehicle.mode_name == "GUIDED"
            assert not vehicle.is_armed
            assert "Crash!" not in vehicle.texts_since(0.0)
            assert vehicle._session.watch.reboots == 0


async def test_ack_of_other_system_is_ignored() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            copter.faults.ignore(MavCmd.DO_SEND_BANNER)
            stranger = FrameEncoder(9, 1)
            async with anyio.create_task_group() as tasks:

                async def answer() -> None:
                    await anyio.sleep(0.5)
                    wire.deliver(stranger.encode(m.CommandAck(MavCmd.DO_SEND_BANNER, 0, 0, 0, 255, 190)))

                tasks.start_soon(answer)
                with pytest.raises(CommandTimeout):
                    await vehicle.command(MavCmd.DO_SEND_BANNER, retries=1)


async def test_found_event_is_published_once_per_autopilot() -> None:
    first, second = SimulatedCopter(boot_time_s=0.0), SimulatedPx4(system_id=2, boot_time_s=0.0)
    async with simulated_link([first, second]) as link, open_connection(link) as connection:
        with connection.subscribe(VehicleFound, capacity=10) as found:
            async with aerokit.connect(connection, system_id=1):
                await anyio.sleep(5.0)
            reported = [await found.get(timeout=1.0), await found.get(timeout=1.0)]
            assert [(event.system_id, event.component_id) for event in reported] == [(1, 1), (2, 1)]
            assert found.get_nowait() is None


@pytest.mark.parametrize(("silent_s", "is_found"), [(1.5, True), (2.5, False)])
async def test_connect_uses_recent_heartbeat_only(silent_s: float, is_found: bool) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, open_connection(link) as connection:
        await anyio.sleep(3.2)
        copter.faults.silent = True
        heard_at = max(
            heartbeat.received_frame.received_at
            for heartbeat in connection.heartbeats.values()
            if heartbeat.received_frame
        )
        await anyio.sleep(heard_at + silent_s - now())
        try:
            async with aerokit.connect(connection, timeout=1.0):
                assert is_found
        except ConnectFailed:
            assert not is_found
