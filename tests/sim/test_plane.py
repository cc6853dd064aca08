"""A simulated ArduPlane, flown by the library in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import aerokit
from aerokit import Position
from aerokit.errors import CommandRejected
from aerokit.events import StatusTextReceived
from aerokit.mavlink.enums import MavCmd, MavResult, MavType, PlaneMode
from aerokit.mavlink.messages import Heartbeat
from aerokit.missions import Mission, MissionItem
from aerokit.sim import SimulatedWind, simulated_link
from aerokit.sim.ardupilot import SimulatedPlane
from aerokit.testing import VIRTUAL_BACKEND

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> object:
    return VIRTUAL_BACKEND


@asynccontextmanager
async def flown(plane: SimulatedPlane) -> AsyncIterator[aerokit.Vehicle]:
    async with simulated_link(plane) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        yield vehicle


async def take_off(vehicle: aerokit.Vehicle) -> None:
    await vehicle.set_mode("TAKEOFF")
    await vehicle.arm()
    await vehicle.take_off(40.0)


def item(plane: SimulatedPlane, command: int, *place: float, turns: float = 0.0) -> MissionItem:
    """Return an item at metres north, east and up from the power-on location."""
    north, east, up = place
    point = plane.navigation.frame.to_global(north, east, 0.0)
    x, y = point.latitude_e7, point.longitude_e7
    return MissionItem(command=command, frame=3, param1=turns, x=x, y=y, z=up)


async def test_plane_identifies_itself_on_ground() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        assert (vehicle.autopilot.firmware, vehicle.mode.value.name) == ("ArduPlane", "MANUAL")
        heartbeat = plane.build(Heartbeat.ID)
        assert isinstance(heartbeat, Heartbeat)
        assert (heartbeat.type, heartbeat.base_mode, heartbeat.system_status) == (MavType.FIXED_WING, 81, 3)


async def test_plane_flies_from_take_off_to_landing() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        await take_off(vehicle)
        home = vehicle.telemetry.home.value
        there = Position(home.latitude_deg + 0.005, home.longitude_deg, altitude_relative_m=80.0)
        await vehicle.go_to(there)
        assert plane.mode.number == PlaneMode.GUIDED
        assert plane.wing.airspeed_m_s == pytest.approx(22.0, abs=1.0)
        await vehicle.hold()
        assert plane.mode.number == PlaneMode.LOITER
        await vehicle.return_to_launch()
        await asyncio.sleep(60.0)
        assert plane.altitude_m == pytest.approx(100.0, abs=2.0)
        assert vehicle.distance_to(Position(home.latitude_deg, home.longitude_deg)) == pytest.approx(80.0, abs=8.0)
        await vehicle.land()
        assert plane.is_landed
        assert plane.wing.impact_speed_m_s < 1.0
        await asyncio.sleep(25.0)
        assert not plane.is_armed


async def test_change_speed_sets_airspeed_within_limits() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        await take_off(vehicle)
        await vehicle.set_mode("GUIDED")
        await vehicle.command(MavCmd.DO_CHANGE_SPEED, 0, 28.0)
        await asyncio.sleep(10.0)
        assert plane.wing.airspeed_m_s == pytest.approx(28.0, abs=0.5)
        with pytest.raises(CommandRejected) as error:
            await vehicle.command(MavCmd.DO_CHANGE_SPEED, 0, 60.0)
        assert error.value.result == MavResult.FAILED


async def test_autoland_on_ground_is_refused() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        await vehicle.arm()
        with pytest.raises(CommandRejected, match="Must already be flying"):
            await vehicle.set_mode("AUTOLAND")


@pytest.mark.exhaustive
async def test_arming_after_autoland_disarms_again() -> None:
    """Match the firmware, where the landing is still complete. `arm` leaves the mode first."""
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        await take_off(vehicle)
        await vehicle.set_mode("AUTOLAND")
        await vehicle.armed.wait_until(lambda armed: not armed, timeout=300)
        await asyncio.sleep(5.0)
        with vehicle.subscribe(StatusTextReceived, capacity=20) as texts:
            ack = await vehicle.command(MavCmd.COMPONENT_ARM_DISARM, 1)
            assert ack.result == MavResult.ACCEPTED
            await asyncio.sleep(2.0)
            received = [text.text for text in iter(texts.get_nowait, None)]
        assert received == ["Throttle armed", "Throttle disarmed", "Auto disarmed"]
        assert (plane.is_armed, vehicle.mode_name) == (False, "AUTOLAND")
        await vehicle.arm()
        await asyncio.sleep(5.0)
        assert (plane.is_armed, vehicle.mode_name) == (True, "FBWA")


@pytest.mark.exhaustive
async def test_loiter_circle_is_kept_in_wind() -> None:
    plane = SimulatedPlane(boot_time_s=1.0, wind=SimulatedWind(4.0, -3.0))
    async with flown(plane) as vehicle:
        await take_off(vehicle)
        await vehicle.set_mode("LOITER")
        await asyncio.sleep(60.0)
        middle = plane.mode.destination
        assert middle is not None
        off = ((plane.wing.north - middle[0]) ** 2 + (plane.wing.east - middle[1]) ** 2) ** 0.5
        assert off == pytest.approx(80.0, abs=8.0)


@pytest.mark.exhaustive
async def test_plane_flies_mission_and_lands() -> None:
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        mission = Mission(
            [
                item(plane, MavCmd.NAV_TAKEOFF, 0, 0, 40),
                item(plane, MavCmd.NAV_WAYPOINT, 400, 0, 60),
                item(plane, MavCmd.NAV_LOITER_TURNS, 400, 400, 60, turns=1),
                item(plane, MavCmd.NAV_WAYPOINT, -700, 0, 40),
                item(plane, MavCmd.NAV_LAND, 0, 0, 0),
            ]
        )
        await vehicle.mission.upload(mission)
        await vehicle.set_mode("AUTO")
        await vehicle.arm()
        await asyncio.sleep(200.0)
        assert plane.is_landed
        assert not plane.is_armed
        assert abs(plane.wing.east) < 20.0
        assert abs(plane.wing.north) < 60.0


@pytest.mark.parametrize(
    ("command", "keeps_place", "keeps_altitude"),
    [
        (MavCmd.NAV_WAYPOINT, False, False),
        (MavCmd.NAV_WAYPOINT, True, True),
        (MavCmd.NAV_LOITER_UNLIM, False, True),
        (MavCmd.NAV_LOITER_UNLIM, True, True),
    ],
)
async def test_mission_item_with_zero_altitude(command: int, keeps_place: bool, keeps_altitude: bool) -> None:
    """Match ArduPlane's set_next_WP (commands.cpp) and Location::sanitize."""
    plane = SimulatedPlane(boot_time_s=1.0)
    async with flown(plane) as vehicle:
        await take_off(vehicle)
        zero = MissionItem(command=command, frame=3) if keeps_place else item(plane, command, 9000, 0, 0)
        await vehicle.mission.upload(Mission([item(plane, MavCmd.NAV_WAYPOINT, 9000, 0, 300), zero]))
        await vehicle.set_mode("AUTO")
        await asyncio.sleep(5.0)
        down = plane.wing.down
        assert plane.mission.set_current(2)
        destination = plane.mode.destination
        assert destination is not None
        assert destination[2] == pytest.approx(down if keeps_altitude else 0.0)


async def test_arming_sends_throttle_armed_text() -> None:
    async with flown(SimulatedPlane(boot_time_s=1.0)) as vehicle:
        with vehicle.subscribe(StatusTextReceived, capacity=10) as texts:
            await vehicle.arm()
            await vehicle.disarm()
            assert [(await anext(texts)).text for _ in range(2)] == ["Throttle armed", "Throttle disarmed"]
