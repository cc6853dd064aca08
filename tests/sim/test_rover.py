from __future__ import annotations

import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

import aerokit
from aerokit import Position
from aerokit.errors import AerokitError, CommandRejected
from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavState, RoverMode
from aerokit.missions import Mission
from aerokit.missions.navigation import waypoint
from aerokit.sim import SimulatedRover, simulated_link
from aerokit.sim.ardupilot.telemetry import heartbeat
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def connected(**options: Any) -> AsyncIterator[tuple[SimulatedRover, aerokit.Vehicle]]:
    options.setdefault("boot_time_s", 0.0)
    rover = SimulatedRover(**options)
    async with simulated_link(rover) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        yield rover, vehicle


@asynccontextmanager
async def armed(**options: Any) -> AsyncIterator[tuple[SimulatedRover, aerokit.Vehicle]]:
    async with connected(**options) as (rover, vehicle):
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        yield rover, vehicle


def ahead(rover: SimulatedRover, north: float, east: float) -> Position:
    place = rover.navigation.frame.to_global(north, east, 0.0)
    return Position(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7)


async def test_vehicle_identifies_itself() -> None:
    async with connected() as (rover, vehicle):
        assert (rover.mode.number, len(rover.parameters)) == (RoverMode.MANUAL, 1235)
        table = await vehicle.parameters.download()
        assert len(table) == 1235
        assert table["CRUISE_SPEED"].value == 5.0


async def test_modes_and_states_match_firmware() -> None:
    async with connected() as (rover, vehicle):
        custom, manual, guided = (
            MavModeFlag.CUSTOM_MODE_ENABLED, MavModeFlag.MANUAL_INPUT_ENABLED, MavModeFlag.GUIDED_ENABLED,
        )  # fmt: skip
        assert heartbeat(rover).base_mode == custom | manual
        await vehicle.set_mode("HOLD")
        assert (heartbeat(rover).base_mode, heartbeat(rover).system_status) == (custom, MavState.STANDBY)
        await vehicle.set_mode("LOITER")
        assert heartbeat(rover).base_mode == custom | guided
        assert heartbeat(rover).system_status == MavState.ACTIVE
        for refused in (RoverMode.FOLLOW, RoverMode.DOCK, RoverMode.AUTO, RoverMode.INITIALIZING, 2):
            assert not rover.set_mode(refused)
        assert len(rover.available_modes()) == 14


async def test_take_off_and_arming_in_rtl_are_refused() -> None:
    async with connected() as (rover, vehicle):
        with pytest.raises(AerokitError):
            await vehicle.take_off(10.0)
        with pytest.raises(CommandRejected, match="UNSUPPORTED"):
            await vehicle.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10)
        await vehicle.set_mode("RTL")
        assert rover.arming.reasons() == ["Mode not armable"]
        assert not rover.arming.arm()


async def test_rover_drives_to_place_and_stops() -> None:
    async with armed() as (rover, vehicle):
        await vehicle.go_to(ahead(rover, 60.0, 20.0))
        await anyio.sleep(5.0)
        assert math.hypot(rover.motion.north - 60.0, rover.motion.east - 20.0) < 1.0
        assert abs(rover.motion.speed_m_s) < 0.01
        assert rover.motion.down == 0.0


async def test_rover_speed_and_turn_rate_are_limited() -> None:
    async with armed(parameters={"WP_SPEED": 3.0}) as (rover, _):
        rover.guided.go_to((-80.0, 0.0, 0.0))
        fastest, before = 0.0, rover.motion.yaw
        for _ in range(100):
            await anyio.sleep(0.1)
            fastest = max(fastest, rover.motion.ground_speed_m_s)
            turned = abs(math.remainder(rover.motion.yaw - before, math.tau))
            assert turned <= 0.1 * math.radians(121.0) + 0.05
            before = rover.motion.yaw
        assert 2.5 < fastest <= 3.001


async def test_velocity_target_expires_after_three_seconds() -> None:
    async with armed() as (rover, vehicle):
        async with vehicle.guided.velocity() as stream:
            await stream.fly(VelocitySetpoint(east_m_s=-2.0), 8.0)
            assert rover.motion.velocity_east == pytest.approx(-2.0, abs=0.1)
            assert abs(rover.motion.velocity_north) < 0.2
        await anyio.sleep(5.0)
        assert abs(rover.motion.speed_m_s) < 0.01


async def test_hold_stops_and_rtl_returns_home() -> None:
    async with armed() as (rover, vehicle):
        rover.guided.go_to((50.0, 0.0, 0.0))
        await anyio.sleep(10.0)
        assert rover.motion.ground_speed_m_s > 2.0
        await vehicle.hold()
        assert rover.mode.number == RoverMode.HOLD
        await anyio.sleep(4.0)
        assert rover.motion.ground_speed_m_s < 0.01
        await vehicle.set_mode("RTL")
        await anyio.sleep(60.0)
        assert math.hypot(rover.motion.north, rover.motion.east) < 1.6
        assert rover.is_armed
        await vehicle.disarm()
        assert rover.navigation.home is not None
        assert rover.navigation.home[0] == pytest.approx(rover.motion.north)


async def test_rover_follows_sticks_in_manual() -> None:
    async with connected() as (rover, vehicle):
        await vehicle.arm()
        rover.rc[2] = 1600
        await anyio.sleep(6.0)
        assert rover.motion.ground_speed_m_s > 1.0
        rover.rc[2] = 1500
        await anyio.sleep(6.0)
        assert rover.motion.ground_speed_m_s < 0.01


async def test_ground_station_failsafe_changes_to_hold() -> None:
    async with armed(parameters={"FS_GCS_ENABLE": 1}) as (rover, _):
        await anyio.sleep(2.0)
        rover.faults.drop_incoming = 1_000_000
        await anyio.sleep(8.0)
        assert rover.mode.number == RoverMode.HOLD


async def test_rover_drives_mission() -> None:
    async with armed() as (rover, vehicle):
        places = [ahead(rover, 30.0, 0.0), ahead(rover, 30.0, 30.0)]
        await vehicle.mission.upload(
            Mission([waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=0) for place in places])
        )
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=120.0)
        await anyio.sleep(3.0)
        assert math.hypot(rover.motion.north - 30.0, rover.motion.east - 30.0) < 1.6
        assert rover.mode.number == RoverMode.AUTO
