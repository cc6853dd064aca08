from __future__ import annotations

import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

import aerokit
from aerokit import Position
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavModeFlag, MavState, SubMode
from aerokit.missions import Mission
from aerokit.missions.navigation import waypoint
from aerokit.sim import SimulatedSub, simulated_link
from aerokit.sim.ardupilot.host import RC_THROTTLE
from aerokit.sim.ardupilot.telemetry import heartbeat
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def connected(**options: Any) -> AsyncIterator[tuple[SimulatedSub, aerokit.Vehicle]]:
    options.setdefault("boot_time_s", 0.0)
    options.setdefault("home", (33.810313, -118.393867, 0.0))
    sub = SimulatedSub(**options)
    async with simulated_link(sub) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        yield sub, vehicle


@asynccontextmanager
async def diving(depth_m: float = 5.0) -> AsyncIterator[tuple[SimulatedSub, aerokit.Vehicle]]:
    async with connected() as (sub, vehicle):
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        sub.guided.go_to((0.0, 0.0, depth_m))
        await anyio.sleep(15.0)
        yield sub, vehicle


def place(sub: SimulatedSub, north: float, east: float, depth: float) -> Position:
    found = sub.navigation.frame.to_global(north, east, 0.0)
    return Position(found.latitude_e7 / 1e7, found.longitude_e7 / 1e7, altitude_relative_m=-depth)


def where(sub: SimulatedSub) -> tuple[float, float, float]:
    return (sub.motion.north, sub.motion.east, sub.motion.down)


async def test_vehicle_identifies_itself() -> None:
    async with connected() as (sub, vehicle):
        assert (sub.mode.number, len(sub.parameters), len(sub.available_modes())) == (
            SubMode.MANUAL,
            1386,
            11,
        )
        custom = int(MavModeFlag.CUSTOM_MODE_ENABLED | MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED)
        assert (heartbeat(sub).base_mode, heartbeat(sub).system_status) == (custom, MavState.STANDBY)
        await vehicle.set_mode("POSHOLD")
        assert heartbeat(sub).base_mode == custom | MavModeFlag.GUIDED_ENABLED
        assert not sub.set_mode(SubMode.AUTO)
        assert not sub.set_mode(5)
        with pytest.raises(AerokitError):
            await vehicle.take_off(10.0)


async def test_arming_in_manual_needs_no_position() -> None:
    sub = SimulatedSub(boot_time_s=40.0)
    async with simulated_link(sub) as link, aerokit.connect(link) as vehicle:
        await anyio.sleep(14.0)
        assert not sub.navigation.has_position
        await vehicle.arm()
        assert heartbeat(sub).system_status == MavState.ACTIVE
        assert not sub.set_mode(SubMode.GUIDED)


async def test_sub_dives_to_place_and_stays() -> None:
    async with diving() as (sub, vehicle):
        assert math.dist(where(sub), (0.0, 0.0, 5.0)) < 0.2
        await vehicle.go_to(place(sub, 10.0, 5.0, 8.0))
        await anyio.sleep(6.0)
        assert math.dist(where(sub), (10.0, 5.0, 8.0)) < 0.3
        assert sub.altitude_m == pytest.approx(-8.0, abs=0.3)
        assert sub.motion.ground_speed_m_s < 0.05


@pytest.mark.exhaustive
async def test_sub_target_above_surface_stays_at_surface() -> None:
    async with diving(1.0) as (sub, _):
        sub.guided.go_to((3.0, 0.0, -10.0))
        await anyio.sleep(20.0)
        assert sub.motion.down == pytest.approx(0.0, abs=0.01)
        sub.motion.bottom_down = 6.0
        sub.guided.go_to((3.0, 0.0, 50.0))
        await anyio.sleep(30.0)
        assert sub.motion.down <= 6.0


async def test_velocity_target_expires_after_three_seconds() -> None:
    async with diving() as (sub, vehicle):
        async with vehicle.guided.velocity() as stream:
            await stream.fly(VelocitySetpoint(north_m_s=0.5, down_m_s=0.2), 5.0)
            assert sub.motion.velocity_north == pytest.approx(0.5, abs=0.05)
            assert sub.motion.velocity_down == pytest.approx(0.2, abs=0.05)
        await anyio.sleep(5.0)
        assert sub.motion.ground_speed_m_s < 0.02


async def test_poshold_keeps_place_and_depth() -> None:
    async with diving() as (sub, vehicle):
        sub.guided.go_to((30.0, 0.0, 5.0))
        await anyio.sleep(5.0)
        await vehicle.hold()
        assert sub.mode.number == SubMode.POSHOLD
        await anyio.sleep(3.0)
        held = where(sub)
        await anyio.sleep(10.0)
        assert math.dist(where(sub), held) < 0.1


async def test_surface_mode_ends_in_alt_hold() -> None:
    async with diving() as (sub, vehicle):
        await vehicle.set_mode("SURFACE")
        await anyio.sleep(10.0)
        assert sub.mode.number == SubMode.ALT_HOLD
        assert sub.motion.down < 0.3
        assert sub.is_armed


async def test_disarmed_sub_draws_no_current() -> None:
    async with connected() as (sub, vehicle):
        await vehicle.arm()
        sub.rc.override({RC_THROTTLE: 1900})
        await anyio.sleep(0.5)
        assert sub.battery.current_a > 0.0
        await vehicle.disarm()
        await anyio.sleep(1.0)
        assert sub.battery.current_a == 0.0


@pytest.mark.exhaustive
async def test_buoyancy_lifts_disarmed_sub() -> None:
    async with diving() as (sub, vehicle):
        await vehicle.disarm()
        await anyio.sleep(20.0)
        assert 2.7 < sub.motion.down < 3.5
        await anyio.sleep(60.0)
        assert sub.motion.is_still


async def test_sub_dives_mission() -> None:
    async with diving() as (sub, vehicle):
        legs = [place(sub, 8.0, 0.0, 4.0), place(sub, 8.0, 8.0, 6.0)]
        items = [waypoint(leg.latitude_deg, leg.longitude_deg, altitude_relative_m=-depth)
                 for leg, depth in zip(legs, (4.0, 6.0), strict=True)]  # fmt: skip
        await vehicle.mission.upload(Mission(items))
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=120.0)
        assert math.dist(where(sub), (8.0, 8.0, 6.0)) < 2.1
        assert sub.mode.number == SubMode.AUTO


async def test_ground_station_failsafe_disarms() -> None:
    async with diving() as (sub, _):
        sub.faults.drop_incoming = 1_000_000
        await anyio.sleep(8.0)
        assert not sub.is_armed
