"""Rovers and submarines: a rover's altitude has no meaning, a submarine lands at the surface."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import anyio
import pytest
from flight_harness import Wire

from aerokit import (
    LocalPositionSetpoint,
    Position,
    PositionSetpoint,
    Vehicle,
    VelocitySetpoint,
    connect,
)
from aerokit.connection.cells import StateCell
from aerokit.errors import OperationRejected, OperationTimeout, SetpointStreamStopped
from aerokit.mavlink.enums import MavResult, SubMode
from aerokit.mavlink.messages import SetPositionTargetLocalNed
from aerokit.missions import Mission
from aerokit.missions.navigation import return_to_launch, take_off, waypoint
from aerokit.sim import (
    SimulatedCopter,
    SimulatedPlane,
    SimulatedPx4Plane,
    SimulatedRover,
    SimulatedSub,
    SimulatedVehicle,
    simulated_link,
)
from aerokit.vehicle.state.movement import Home

pytestmark = pytest.mark.anyio

DO_SET_HOME = 179


@asynccontextmanager
async def guided(simulated: SimulatedVehicle) -> AsyncIterator[Vehicle]:
    async with simulated_link(simulated) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        yield vehicle


async def test_rover_go_to_with_home_at_sea_level_arrives() -> None:
    """Home was set before the altitude was known, as with real rovers."""
    async with guided(SimulatedRover(boot_time_s=1.0)) as vehicle:
        here = vehicle.position.value
        x, y = round(here.latitude_deg * 1e7), round(here.longitude_deg * 1e7)
        await vehicle.command_int(DO_SET_HOME, frame=0, x=x, y=y, z=0.0)
        there = here.offset(north_m=15)
        await vehicle.position.wait_until(lambda p: (p.altitude_relative_m or 0.0) > 100, timeout=5)
        await vehicle.go_to(Position(there.latitude_deg, there.longitude_deg, altitude_relative_m=0), timeout=60)
        assert here.distance_to(vehicle.position.value) > 10


async def test_sub_land_ends_at_surface() -> None:
    async with guided(SimulatedSub(boot_time_s=1.0)) as vehicle:
        here = vehicle.position.value
        await vehicle.go_to(Position(here.latitude_deg, here.longitude_deg, altitude_relative_m=-5), timeout=120)
        await vehicle.land(timeout=120)
        assert vehicle.mode_name == "ALT_HOLD"
        height_m = vehicle.position.value.altitude_relative_m
        assert height_m is not None
        assert abs(height_m) < 1.5
        assert vehicle.is_armed


async def test_sub_land_at_surface_returns_immediately() -> None:
    """SURFACE is over before a heartbeat reports it."""
    async with guided(SimulatedSub(boot_time_s=1.0)) as vehicle:
        await vehicle.set_mode("MANUAL")
        await vehicle.land(timeout=5)
        assert vehicle.mode_name == "ALT_HOLD"


async def test_sub_land_takeover_at_depth_raises() -> None:
    """SURFACE ends in ALT_HOLD, a mode that a pilot may also choose during the ascent."""
    sub = SimulatedSub(boot_time_s=1.0)
    async with guided(sub) as vehicle, anyio.create_task_group() as tasks:
        here = vehicle.position.value
        await vehicle.go_to(Position(here.latitude_deg, here.longitude_deg, altitude_relative_m=-20), timeout=120)

        async def take_over() -> None:
            await anyio.sleep(4)
            sub.set_mode(SubMode.ALT_HOLD)

        tasks.start_soon(take_over)
        with pytest.raises(OperationRejected, match=r"the mode changed to ALT_HOLD at -1\d\.\d m"):
            await vehicle.land(timeout=120)


async def test_sub_land_accepted_not_executed_raises_after_three_seconds() -> None:
    sub = SimulatedSub(boot_time_s=1.0)
    async with guided(sub) as vehicle:
        sub.set_mode_from = lambda *_: MavResult.ACCEPTED  # type: ignore[method-assign]
        started = anyio.current_time()
        with pytest.raises(OperationRejected, match="the vehicle stayed in GUIDED"):
            await vehicle.land(timeout=60)
        assert 3.0 < anyio.current_time() - started < 4.5


@pytest.mark.parametrize("kind", ["local", "global"])
async def test_sub_position_stream_arrives(kind: str) -> None:
    """Each position set-point restarts the path, so the same set-point is not sent ten times a second."""
    async with guided(SimulatedSub(boot_time_s=1.0)) as vehicle:
        here = vehicle.position.value
        await vehicle.local_position.wait_until(lambda _: True)
        local = LocalPositionSetpoint(8.0, 0.0, 2.0)
        place = PositionSetpoint(
            Position(here.latitude_deg, here.longitude_deg, altitude_relative_m=-2.0).offset(north_m=8.0)
        )
        if kind == "local":
            async with vehicle.guided.local_position(local) as stream:
                await stream.fly(local, 20.0)
        else:
            async with vehicle.guided.position(place) as places:
                await places.fly(place, 20.0)
        assert here.distance_to(vehicle.position.value) == pytest.approx(8.0, abs=1.0)


async def test_sub_position_is_sent_three_times_then_every_five_seconds() -> None:
    async with simulated_link(SimulatedSub(boot_time_s=1.0)) as link:
        wire = Wire(link)
        async with connect(wire) as vehicle:
            await vehicle.wait_ready()
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()
            await vehicle.local_position.wait_until(lambda _: True)
            local = LocalPositionSetpoint(30.0, 0.0, 2.0)
            async with vehicle.guided.local_position(local) as stream:
                await stream.fly(local, 12.0)
    times = wire.times(SetPositionTargetLocalNed)
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert gaps == pytest.approx([0.1, 0.1, 5.0, 5.0], abs=0.11)


async def test_go_to_vehicle_does_not_move_times_out() -> None:
    """Its thrusters have no effect: neither an order nor a stream waits without a limit."""
    sub = SimulatedSub(boot_time_s=1.0)
    async with guided(sub) as vehicle:
        there = vehicle.position.value.offset(north_m=30)
        sub.guided.update = lambda dt: None  # type: ignore[method-assign]
        with pytest.raises(OperationTimeout, match=r"has not moved for 1[23] s"):
            await vehicle.go_to(Position(there.latitude_deg, there.longitude_deg, altitude_relative_m=-1))
        with pytest.raises(SetpointStreamStopped, match=r"not moved for 1[23] s"):
            async with vehicle.guided.velocity() as stream:
                await stream.fly(VelocitySetpoint(north_m_s=1.0), 30.0)


async def fall(copter: SimulatedCopter, begin: Callable[[], None], height_m: float = 20) -> None:
    """Go somewhere at this height, and call ``begin`` two seconds later."""
    async with guided(copter) as vehicle:
        await vehicle.take_off(height_m)
        asyncio.get_running_loop().call_later(2.0, begin)
        await vehicle.go_to(vehicle.position.value.offset(north_m=100))


async def test_go_to_slow_fall_error_names_descent() -> None:
    """A fall from this height ends below 6 m/s, so it may be a hard landing."""
    copter = SimulatedCopter(boot_time_s=1.0)
    descent = r"not moved for 1[23] s, after it descended [12]\.\d m at up to [345]\.\d m/s; the vehicle is"
    with pytest.raises(OperationTimeout, match=descent):
        await fall(copter, lambda: setattr(copter.faults, "motor_failed", True), 1.6)


async def test_go_to_vehicle_disarmed_in_air_error_names_height() -> None:
    copter = SimulatedCopter(boot_time_s=1.0)
    with pytest.raises(OperationRejected, match=r"the vehicle disarmed 1\d\.\d m above home"):
        await fall(copter, lambda: copter.motors.set_armed(armed=False))


async def test_rover_return_to_launch_ends_at_home() -> None:
    """A rover stays armed at home."""
    rover = SimulatedRover(boot_time_s=1.0)
    async with guided(rover) as vehicle:
        home = vehicle.home.value.position
        await vehicle.go_to(vehicle.position.value.offset(north_m=30), timeout=60)
        await vehicle.return_to_launch(timeout=60)
        assert home.distance_to(vehicle.position.value) <= vehicle.autopilot.arrival_radius_m
        assert vehicle.is_armed
        await vehicle.set_mode("GUIDED")
        await vehicle.go_to(vehicle.position.value.offset(north_m=30), timeout=60)
        with pytest.raises(OperationTimeout, match=r"return_to_launch: .*; the vehicle is \d+\.\d m from home"):
            await vehicle.return_to_launch(timeout=2)


async def test_rover_returns_although_home_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    async with guided(SimulatedRover(boot_time_s=1.0)) as vehicle:
        monkeypatch.setattr(vehicle.telemetry, "home", StateCell[Home]("home", anyio.current_time, "nothing"))
        with pytest.raises(OperationTimeout, match="the distance from home is unknown"):
            await vehicle.return_to_launch(timeout=2)
        assert vehicle.mode_name == "RTL"


async def test_rover_mission_with_return_ends_at_home() -> None:
    async with guided(SimulatedRover(boot_time_s=1.0)) as vehicle:
        home = vehicle.home.value.position
        far = home.offset(north_m=25)
        there = waypoint(far.latitude_deg, far.longitude_deg, altitude_relative_m=0)
        await vehicle.mission.upload(Mission([there, there, return_to_launch()]))
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=120)
        assert home.distance_to(vehicle.position.value) <= vehicle.autopilot.arrival_radius_m


async def test_rover_mission_starts_again_in_its_mode() -> None:
    """After a mission, a rover stays in AUTO, where MISSION_START has no effect."""
    async with guided(SimulatedRover(boot_time_s=1.0)) as vehicle:
        home = vehicle.home.value.position
        away, back = (waypoint(home.offset(north_m=north_m), altitude_relative_m=0) for north_m in (20, 0))
        await vehicle.mission.upload(Mission([away]))
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=60)
        assert vehicle.mode_name == "AUTO"
        await vehicle.mission.upload(Mission([back]))
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=60)
        assert home.distance_to(vehicle.position.value) < 5


async def test_rover_mission_is_resumed_in_its_mode() -> None:
    async with guided(SimulatedRover(boot_time_s=1.0)) as vehicle:
        home = vehicle.home.value.position
        places = [home.offset(north_m=north_m) for north_m in (10, 20, 30)]
        await vehicle.mission.upload(Mission([waypoint(place, altitude_relative_m=0) for place in places]))
        await vehicle.mission.start()
        await vehicle.mission.resume()  # The mission is running: nothing changes.
        await vehicle.mission.wait_finished(timeout=60)
        await vehicle.mission.set_current(1)
        await vehicle.mission.resume()
        await vehicle.position.wait_until(lambda place: places[1].distance_to(place) < 5, timeout=30)
        await vehicle.mission.wait_finished(timeout=60)
        await vehicle.mission.resume()
        await vehicle.position.wait_until(lambda place: places[0].distance_to(place) < 5, timeout=60)


@pytest.mark.exhaustive
async def test_px4_plane_mission_with_return_ends_above_home() -> None:
    await anyio.sleep(1000.0)  # a loop's clock may start at any value
    async with simulated_link(SimulatedPx4Plane()) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.parameters.set("MIS_TKO_LAND_REQ", 0)
        await vehicle.arm()
        await vehicle.take_off(40)
        home = vehicle.home.value.position
        far = home.offset(north_m=400)
        up = take_off(home.latitude_deg, home.longitude_deg, altitude_relative_m=40)
        there = waypoint(far.latitude_deg, far.longitude_deg, altitude_relative_m=40)
        await vehicle.mission.upload(Mission([up, there, return_to_launch()]))
        await vehicle.mission.start()
        await vehicle.position.wait_until(lambda place: home.distance_to(place) > 300, timeout=120)
        await vehicle.mission.wait_finished(timeout=200)
        assert home.distance_to(vehicle.position.value) < 150
        assert vehicle.is_armed


@pytest.mark.exhaustive
async def test_arduplane_mission_with_return_ends_above_home() -> None:
    """The mission does not complete: the plane changes to RTL, which stops the mission."""
    async with simulated_link(SimulatedPlane(boot_time_s=1.0)) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        home = vehicle.position.value
        far = home.offset(north_m=600)
        there = waypoint(far.latitude_deg, far.longitude_deg, altitude_relative_m=60)
        await vehicle.mission.upload(Mission([take_off(altitude_relative_m=50), there, return_to_launch()]))
        await vehicle.arm()
        await vehicle.mission.start()
        await vehicle.position.wait_until(lambda place: home.distance_to(place) > 500, timeout=120)
        await vehicle.mission.wait_finished(timeout=200)
        assert vehicle.mode_name == "RTL"
        assert home.distance_to(vehicle.position.value) < 150
        assert vehicle.is_armed


@pytest.mark.parametrize(("after_s", "mode"), [(0.0, "LOITER"), (4.0, "TAKEOFF")])
async def test_arduplane_completes_cancelled_take_off_if_it_moves(after_s: float, mode: str) -> None:
    """A plane that has just lifted off hits the ground in LOITER, the hold mode. TAKEOFF ends in a circle as well."""
    plane = SimulatedPlane(boot_time_s=1.0)
    async with simulated_link(plane) as link, connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.position.wait_until(lambda _: True)
        await vehicle.arm()
        with anyio.move_on_after(10.0) as scope:
            task = asyncio.create_task(vehicle.take_off(50))
            await vehicle.mode.wait_until(lambda reported: reported.name == "TAKEOFF")
            await anyio.sleep(after_s)
            task.cancel()
        assert not scope.cancelled_caught
        await anyio.sleep(30.0)
        assert vehicle.mode_name == mode
        assert plane.is_landed is (mode == "LOITER")
