"""Modes in which a vehicle does not arm: left before arming, named in the reasons, and not waited for."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import Flight, Px4Flight, in_the_air, now, open_flight, open_px4

from aerokit import connect, missions
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    LinkLost,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import CopterMode, MavCmd, PlaneMode
from aerokit.sim import SimulatedPlane, simulated_link
from aerokit.sim.px4 import modes

pytestmark = pytest.mark.anyio

ARM = MavCmd.COMPONENT_ARM_DISARM


async def test_program_runs_twice_in_one_process() -> None:
    """After the first flight a copter is on the ground in RTL."""
    async with open_flight() as flight:
        for _ in range(2):
            await flight.vehicle.wait_ready()
            await flight.vehicle.arm()
            await flight.vehicle.take_off(5.0)
            await flight.vehicle.return_to_launch()
            await flight.vehicle.armed.wait_until(lambda armed: not armed)
            assert flight.vehicle.mode_name == "RTL"


async def test_arm_with_mode_changes_mode_first() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm(mode="LOITER")
        assert flight.copter.mode.number == CopterMode.LOITER
        assert flight.vehicle.is_armed


async def test_arm_in_unarmable_mode_raises_before_sending() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        with pytest.raises(InvalidArgument, match=r"mode = 'LAND' .*cannot arm in LAND, only in ACRO, .*GUIDED"):
            await flight.vehicle.arm(mode="LAND")
        with pytest.raises(InvalidArgument, match="NOWHERE"):
            await flight.vehicle.arm(mode="NOWHERE")
        assert not flight.wire.commands(ARM)
        assert not flight.wire.mode_orders()


async def interrupt_mission_by_return(flight: Px4Flight) -> None:
    """Fly a mission, and return when another station orders it. PX4 then disarms and changes back to MISSION."""
    vehicle = flight.vehicle
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(5.0)
    far = vehicle.position.value.offset(north_m=200)
    await vehicle.mission.upload(missions.Mission([missions.waypoint(far, altitude_relative_m=20)]))
    await vehicle.mission.start()
    flight.px4.change_mode(modes.RTL)
    await vehicle.mode.wait_until(lambda mode: mode.name == "RTL")


async def test_px4_arm_after_interrupted_mission_stays_on_ground() -> None:
    async with open_px4() as flight:
        await interrupt_mission_by_return(flight)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "MISSION")
        await flight.vehicle.arm()
        assert flight.px4.is_armed
        assert flight.px4.mode == modes.HOLD
        await anyio.sleep(8)
        assert flight.px4.is_landed


@pytest.mark.parametrize("is_explicit", [False, True])
async def test_px4_arm_in_ordered_mission_starts_it(is_explicit: bool) -> None:
    async with open_px4() as flight:
        await interrupt_mission_by_return(flight)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "MISSION")
        if not is_explicit:
            await flight.vehicle.set_mode("MISSION")
        await flight.vehicle.arm(mode="MISSION" if is_explicit else None)
        await anyio.sleep(8)
        assert not flight.px4.is_landed


async def test_px4_arm_during_disarming_sends_nothing() -> None:
    """The last HEARTBEAT reports armed in RTL, but the vehicle has disarmed and changed to MISSION."""
    async with open_px4() as flight:
        await interrupt_mission_by_return(flight)
        while flight.px4.is_armed:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        assert flight.vehicle.is_armed
        flight.wire.clear()
        with pytest.raises(OperationRejected, match="has just disarmed; nothing was sent: call again"):
            await flight.vehicle.arm()
        assert not flight.wire.commands(ARM)
        await flight.vehicle.arm()
        assert flight.px4.mode == modes.HOLD


async def test_px4_arm_of_armed_vehicle_sends_nothing() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        flight.wire.clear()
        await flight.vehicle.arm()
        assert not flight.wire.commands(ARM)
        assert flight.vehicle.is_armed


async def test_px4_arm_in_foreign_take_off_mode_stays_on_ground() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.change_mode(modes.TAKEOFF)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "TAKEOFF")
        await flight.vehicle.arm()
        assert flight.px4.mode == modes.HOLD


async def test_px4_mission_started_by_arm_command_ends_in_hold(caplog: pytest.LogCaptureFixture) -> None:
    """Another station changes to MISSION right before the command arrives, and the vehicle flies at the next report."""
    async with open_px4() as flight:
        await interrupt_mission_by_return(flight)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "MISSION")
        await flight.vehicle.set_mode("LOITER")
        flight.px4.change_mode(modes.MISSION)
        with pytest.raises(OperationRejected, match="mode changed to MISSION; a vehicle armed in MISSION takes off"):
            await flight.vehicle.arm()
        await anyio.sleep(10)
        assert flight.px4.mode == modes.HOLD
        assert flight.px4.is_armed
        assert "the abandoned arm command has started a flight in" in caplog.text


async def test_arm_in_flight_keeps_mode() -> None:
    async with in_the_air() as flight:
        await flight.vehicle.set_mode("LAND")
        flight.wire.clear()
        await flight.vehicle.arm()
        with pytest.raises(OperationRejected, match="arm: the vehicle is armed already, in LAND; nothing was sent"):
            await flight.vehicle.arm(mode="GUIDED")
        assert not flight.wire.mode_orders()
        assert flight.copter.mode.number == CopterMode.LAND


async def test_why_not_armable_names_mode_and_alternatives() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("RTL")
        (reason,) = await flight.vehicle.why_not_armable()
        assert reason.startswith("ArduCopter cannot arm in RTL, only in ACRO")
        assert reason.endswith("arm() changes to GUIDED first")


async def test_mission_is_flown_twice() -> None:
    """After a mission ArduCopter is in AUTO, where it refuses to arm unless AUTO_OPTIONS allows it."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        place = flight.vehicle.position.value.offset(north_m=10)
        items = [
            missions.take_off(10),
            missions.waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=10),
            missions.land(place.latitude_deg, place.longitude_deg),
        ]
        await flight.vehicle.mission.upload(missions.Mission(items))
        for _ in range(2):
            await flight.vehicle.arm()
            await flight.vehicle.mission.start()
            await flight.vehicle.mission.wait_finished(timeout=120)
            await flight.vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        assert flight.vehicle.mode_name == "AUTO"
        (reason,) = await flight.vehicle.why_not_armable()
        assert (
            reason
            == "ArduCopter cannot arm in AUTO unless AUTO_OPTIONS allows it; arm() changes to GUIDED after a refusal"
        )
        flight.wire.clear()
        with pytest.raises(CommandRejected, match="AUTO mode not armable"):
            await flight.vehicle.arm(mode="AUTO")
        assert not flight.wire.mode_orders()


@pytest.mark.parametrize("armed_before_s", [None, 0.3])
async def test_arm_where_option_allows_it_keeps_mode(armed_before_s: float | None) -> None:
    """Another station may have armed, so that the vehicle already flies its mission."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.parameters.set("AUTO_OPTIONS", 1)
        await flight.vehicle.mission.upload(missions.Mission([missions.take_off(10)]))
        await flight.vehicle.set_mode("AUTO")
        if armed_before_s is not None:
            flight.copter.arming.arm()
            await anyio.sleep(armed_before_s)
        flight.wire.clear()
        await flight.vehicle.arm()
        assert flight.vehicle.is_armed
        assert not flight.wire.mode_orders()


async def test_unanswered_arm_in_auto_is_not_repeated() -> None:
    """Only a refusal shows that the vehicle is still disarmed."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.mission.upload(missions.Mission([missions.take_off(10)]))
        await flight.vehicle.set_mode("AUTO")
        flight.wire.clear()
        flight.copter.faults.ignore(ARM)
        with pytest.raises(CommandTimeout):
            await flight.vehicle.arm()
        assert len(flight.wire.commands(ARM)) == 1
        assert not flight.wire.mode_orders()


async def test_pilot_between_refusal_and_repetition_ends_arming() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.mission.upload(missions.Mission([missions.take_off(10)]))
        await flight.vehicle.set_mode("AUTO")
        flight.wire.clear()
        flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
        async with anyio.create_task_group() as group:
            group.start_soon(take_over_later, flight)
            with pytest.raises(OperationRejected):
                await flight.vehicle.arm()
        assert len(flight.wire.commands(ARM)) == 1


async def test_disarm_after_refusal_in_auto_ends_arming() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("AUTO")
        arming = asyncio.create_task(flight.vehicle.arm())
        await anyio.sleep(0.1)  # The call waits for the texts that explain the refusal.
        await flight.vehicle.disarm()
        with pytest.raises(CommandRejected):
            await arming
        assert len(flight.wire.commands(ARM)) == 2
        assert flight.copter.mode.number == CopterMode.AUTO


async def take_over_later(flight: Flight) -> None:
    await anyio.sleep(0.2)
    flight.copter.set_mode(CopterMode.LOITER)


@pytest.mark.parametrize(
    ("mode", "name"), [(modes.OFFBOARD, "OFFBOARD"), (modes.ORBIT, "ORBIT"), (modes.FOLLOW_TARGET, "FOLLOWME")]
)
async def test_px4_left_in_unarmable_mode_arms(mode: modes.Px4Mode, name: str) -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.switch_to(mode)
        await flight.vehicle.mode.wait_until(lambda reported: reported.name == name)
        await anyio.sleep(1.0)
        (reason,) = await flight.vehicle.why_not_armable()
        assert f"PX4 cannot arm in {name}" in reason
        await flight.vehicle.wait_ready(timeout=5.0)
        await flight.vehicle.arm()
        assert flight.vehicle.mode_name == "LOITER"


async def test_plane_in_autoland_arms_in_passive_mode() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        plane.set_mode(PlaneMode.RTL)
        await vehicle.mode.wait_until(lambda mode: mode.name == "RTL")
        await vehicle.arm()
        assert vehicle.mode_name == "FBWA"
        assert vehicle.is_armed


@pytest.mark.parametrize("is_ordered", [False, True])
@pytest.mark.parametrize("flight_mode", ["TAKEOFF", "AUTO"])
async def test_plane_keeps_mode_that_starts_flight_only_if_ordered(is_ordered: bool, flight_mode: str) -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.mission.upload(missions.Mission([missions.take_off(50)]))
        plane.set_mode(PlaneMode[flight_mode])
        await vehicle.mode.wait_until(lambda mode: mode.name == flight_mode)
        if is_ordered:
            await vehicle.set_mode(flight_mode)
        await vehicle.arm()
        assert vehicle.mode_name == (flight_mode if is_ordered else "FBWA")
        assert vehicle.is_armed


async def test_plane_whose_cancelled_arming_began_flight_continues_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A QuadPlane whose motors had started refused to disarm, and hit the ground in LOITER, the hold mode."""
    plane = SimulatedPlane(boot_time_s=1.0)
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.set_mode("TAKEOFF")
        monkeypatch.setattr(plane.arming, "disarm", lambda **_: False)
        task = asyncio.create_task(vehicle.arm())
        await anyio.sleep(0.001)
        task.cancel()
        await anyio.sleep(10.0)
        assert plane.motors.is_armed
        assert vehicle.mode_name == "TAKEOFF"
        assert "the vehicle continues it, because a hold could make it descend" in caplog.text


async def test_wait_ready_names_unarmable_mode_after_the_list() -> None:
    """The mode is not missing, because arm() changes it."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.prearm_failures.append("Compass not healthy")
        flight.pilot_takes_over(CopterMode.LAND)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "LAND")
        await anyio.sleep(2.0)
        with pytest.raises(OperationTimeout, match=r"still missing:(\n  - .*)+\nArduCopter cannot arm in LAND, only"):
            await flight.vehicle.wait_ready(timeout=1.0)


async def test_wait_ready_returns_if_vehicle_becomes_ready_at_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        ready_at = now() + 1.0
        health = flight.vehicle._context.health
        monkeypatch.setattr(health, "missing_for_flight", lambda: ["a position"] if now() < ready_at else [])
        await flight.vehicle.wait_ready(timeout=1.0)


async def test_missing_for_flight_names_lost_link() -> None:
    """A result that is based on old values contains the lost link."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.silent = True
        await anyio.sleep(20.0)
        reasons = await flight.vehicle.why_not_armable()
        assert any("heartbeats (the last one 2" in reason for reason in reasons)
        assert any("position (no GLOBAL_POSITION_INT" in reason for reason in reasons)


async def test_missing_for_flight_without_link_lists_all() -> None:
    """The link is lost at once although values are recent, and only a later heartbeat restores it."""
    async with open_flight() as flight:
        vehicle, connection = flight.vehicle, flight.vehicle.connection
        await vehicle.wait_ready()
        flight.copter.faults.silent = True
        connection.link_interrupted(LinkLost("unplugged"))
        await anyio.sleep(0.5)
        with pytest.raises(OperationTimeout, match=r"heartbeats \(the last one .* s ago, the link is lost\)"):
            await vehicle.wait_ready(timeout=2.0)
        assert any("the link is lost" in reason for reason in await vehicle.why_not_armable())
        connection.link_restored(3.0)
        with pytest.raises(OperationTimeout, match="the link is lost"):
            await vehicle.wait_ready(timeout=0.2)
        flight.copter.faults.silent = False
        await vehicle.wait_ready(timeout=5.0)
        assert await vehicle.why_not_armable() == []


async def test_abandoned_arm_of_armed_vehicle_does_not_disarm() -> None:
    """The vehicle is armed on the ground; a second arm() is cancelled at once."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        flight.wire.clear()
        with anyio.move_on_after(0.001):
            await flight.vehicle.arm()
        await anyio.sleep(5.0)
        assert [command.param1 for command in flight.wire.commands(ARM)] == [1.0]
        assert flight.vehicle.is_armed
