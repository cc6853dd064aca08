"""A QuadPlane completes its take-off, and returns in QRTL, which lands. Q_RTL_MODE may change RTL to QRTL."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, ClassVar

import pytest

from aerokit import Vehicle, connect
from aerokit.errors import OperationTimeout
from aerokit.mavlink.enums import MavLandedState, MavVtolState, PlaneMode
from aerokit.mavlink.messages import ExtendedSysState
from aerokit.missions import Mission
from aerokit.missions.navigation import return_to_launch, waypoint
from aerokit.sim import SimulatedPlane, simulated_link
from aerokit.sim.ardupilot.host import ArduPilotMode, variant
from aerokit.sim.ardupilot.plane_modes import PlaneRtl
from aerokit.sim.ardupilot.telemetry import Builders

pytestmark = pytest.mark.anyio

HOME_RADIUS_M = 150.0


def _extended_sys_state(plane: SimulatedPlane) -> ExtendedSysState:
    landed_state = MavLandedState.ON_GROUND if plane.is_landed else MavLandedState.IN_AIR
    return ExtendedSysState(MavVtolState.FW, landed_state)


class FlyingQuadPlane(SimulatedPlane):
    """A QuadPlane that flies on its wings: it circles at home in QRTL, and lands when the test says so."""

    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]] = (
        *SimulatedPlane.MODES,
        variant(PlaneRtl, PlaneMode.QRTL, "QRTL"),
    )
    BUILDERS: ClassVar[Builders] = {**SimulatedPlane.BUILDERS, ExtendedSysState.ID: _extended_sys_state}

    def land(self) -> None:
        self.is_landed, self.motion.down = True, 0.0
        asyncio.get_running_loop().call_later(0.3, self._disarm)

    def _disarm(self) -> None:
        self.arming.disarm()
        self.mission.reset()  # as ArduPlane does when it disarms in another mode than AUTO


@asynccontextmanager
async def flying(plane: FlyingQuadPlane) -> AsyncIterator[Vehicle]:
    """300 m from home, in the air."""
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.set_mode("TAKEOFF")
        await vehicle.arm()
        await vehicle.position.wait_until(lambda place: (place.altitude_relative_m or 0.0) > 40, timeout=60)
        home = vehicle.home.value.position
        there = waypoint(home.offset(north_m=300), altitude_relative_m=60)
        await vehicle.mission.upload(Mission([there, return_to_launch()]))
        yield vehicle


async def test_cancelled_take_off_of_standing_quadplane_is_completed() -> None:
    """In LOITER, the hold mode, it lifts off as well, and flies forward near the ground."""
    plane = FlyingQuadPlane(boot_time_s=1.0)
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        task = asyncio.create_task(vehicle.take_off(20))
        await vehicle.mode.wait_until(lambda mode: mode.name == "GUIDED")
        task.cancel()
        await asyncio.sleep(5.0)
        assert vehicle.mode_name == "GUIDED"


def distance_from_home_m(vehicle: Vehicle) -> float:
    return vehicle.home.value.position.distance_to(vehicle.position.value)


async def test_return_to_launch_waits_for_landing() -> None:
    plane = FlyingQuadPlane(boot_time_s=1.0)
    async with flying(plane) as vehicle:
        with pytest.raises(OperationTimeout):
            await vehicle.return_to_launch(timeout=60)
        assert distance_from_home_m(vehicle) < HOME_RADIUS_M
        asyncio.get_running_loop().call_later(5.0, plane.land)
        await vehicle.return_to_launch(timeout=60)
        assert plane.is_landed


async def test_mission_with_return_in_rtl_ends_above_home() -> None:
    async with flying(FlyingQuadPlane(boot_time_s=1.0)) as vehicle:
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=200)
        assert vehicle.mode_name == "RTL"
        assert distance_from_home_m(vehicle) < HOME_RADIUS_M
        assert vehicle.mission.explains_mode


async def test_mission_with_return_in_qrtl_ends_after_landing() -> None:
    plane = FlyingQuadPlane(boot_time_s=1.0)
    async with flying(plane) as vehicle:
        await vehicle.mission.start()
        finished = asyncio.create_task(vehicle.mission.wait_finished(timeout=300))
        await vehicle.mode.wait_until(lambda mode: mode.name == "RTL", timeout=100)
        await vehicle.position.wait_until(lambda _: distance_from_home_m(vehicle) < 80, timeout=100)
        plane.change_to(PlaneMode.QRTL)
        await asyncio.sleep(60.0)
        assert not finished.done()
        plane.land()
        await finished
        assert not plane.is_armed
