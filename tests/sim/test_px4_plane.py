"""A simulated PX4 plane: messages, and flights by a client and by `aerokit.Vehicle`."""

from __future__ import annotations

import math

import anyio
import pytest
from simulated_client import Client

import aerokit
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavLandedState, MavResult, MavType
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedPx4Plane, simulated_link
from aerokit.testing import run_virtual

HOLD, MISSION, RTL, LAND = (4, 3), (4, 4), (4, 5), (4, 6)
NAN = math.nan


def ready_plane(**parameters: float) -> tuple[SimulatedPx4Plane, Client]:
    plane = SimulatedPx4Plane(fast_rate_hz=1.0, boot_time_s=1.0, parameter_count=150, parameters=parameters)
    client = Client(plane)
    client.run(2.0)
    client.clear()
    return plane, client


def flying_plane(altitude_m: float = 50.0, **parameters: float) -> tuple[SimulatedPx4Plane, Client]:
    plane, client = ready_plane(**parameters)
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 584.09 + altitude_m)
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.ACCEPTED
    client.run_until(lambda: plane.mode == HOLD, 90.0)
    return plane, client


def away_m(plane: SimulatedPx4Plane, north: float = 0.0, east: float = 0.0) -> float:
    return math.hypot(plane.motion.north - north, plane.motion.east - east)


def item(
    plane: SimulatedPx4Plane, command: int, north: float, east: float, up: float, param1: float = 0.0
) -> MissionItem:
    place = plane.frame.to_global(north, east, 0.0)
    return MissionItem(command, 3, param1, 0, 0, NAN, place.latitude_e7, place.longitude_e7, up)


def test_plane_identifies_itself() -> None:
    plane, client = ready_plane()
    client.run(1.0)
    assert client.last(m.Heartbeat).type == MavType.FIXED_WING
    assert client.last(m.VfrHud).airspeed == pytest.approx(0.0)
    assert plane.parameters["MIS_TAKEOFF_ALT"] == 25.0
    assert len(SimulatedPx4Plane().parameters) == 978


def test_orbit_of_plane_without_radius_uses_default() -> None:
    plane, client = flying_plane()
    for radius, used_radius in ((150.0, 150.0), (NAN, plane.parameters["NAV_LOITER_RAD"])):
        assert client.command(MavCmd.DO_ORBIT, radius, NAN, 0, NAN, NAN, NAN, NAN) == MavResult.ACCEPTED
        assert plane.flight.radius_m == used_radius


def test_refused_orbit_of_plane_keeps_target() -> None:
    plane, client = flying_plane()
    plane.faults.gps_lost = True
    client.run(10.0)
    target = plane.flight.target
    assert client.command(MavCmd.DO_ORBIT, 150, NAN, 0, NAN, 47.0, 8.0, 700.0) == MavResult.TEMPORARILY_REJECTED
    assert plane.flight.target == target


def test_plane_on_ground_stays_armed() -> None:
    plane, client = ready_plane()
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.ACCEPTED
    client.run(30.0)
    assert plane.is_armed
    assert away_m(plane) == 0.0


def test_take_off_climbs_out_and_circles() -> None:
    plane, client = ready_plane()
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, NAN)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.run_until(lambda: plane.mode == HOLD, 60.0)
    assert client.texts == [
        "Armed by external command\t",
        "Using default takeoff altitude: 25.0 m\t",
        "Takeoff detected\t",
    ]
    north, east, _ = plane.flight.target
    assert abs(east) < 5.0 < north
    client.run(40.0)
    for _ in range(8):
        client.run(5.0)
        assert away_m(plane, north, east) == pytest.approx(80.0, abs=8.0)
        assert plane.motion.airspeed_m_s == pytest.approx(15.0, abs=0.5)
    assert plane.altitude_m == pytest.approx(25.0, abs=2.0)
    states = [state.landed_state for state in client.all(m.ExtendedSysState)]
    assert list(dict.fromkeys(states)) == [
        MavLandedState.ON_GROUND,
        MavLandedState.TAKEOFF,
        MavLandedState.IN_AIR,
    ]


def test_reposition_and_speed_change() -> None:
    plane, client = flying_plane()
    place = plane.frame.to_global(600.0, 300.0, 0.0)
    client.command_int(MavCmd.DO_REPOSITION, 5, -1, 1, 0, NAN, x=place.latitude_e7, y=place.longitude_e7, z=584.09 + 80)
    client.run(90.0)
    assert away_m(plane, 600.0, 300.0) == pytest.approx(80.0, abs=8.0)
    assert plane.altitude_m == pytest.approx(80.0, abs=2.0)
    client.command(MavCmd.DO_CHANGE_SPEED, 0, 25.0, -1)
    client.run(10.0)
    assert client.last(m.VfrHud).airspeed == pytest.approx(20.0, abs=0.5), "FW_AIRSPD_MAX"


def test_return_circles_above_home() -> None:
    plane, client = flying_plane()
    client.command(MavCmd.NAV_RETURN_TO_LAUNCH)
    client.run(150.0)
    assert "RTL: completed, loitering\t" in client.texts
    assert plane.mode == RTL
    assert away_m(plane) == pytest.approx(80.0, abs=10.0)
    assert plane.altitude_m == pytest.approx(100.0, abs=3.0)


def test_return_lands_if_configured() -> None:
    plane, client = flying_plane(RTL_LAND_DELAY=0.0)
    client.command(MavCmd.NAV_RETURN_TO_LAUNCH)
    client.run_until(lambda: not plane.is_armed, 300.0)
    assert client.texts[-3:] == [
        "RTL: land at destination\t",
        "Landing detected\t",
        "Disarmed by landing\t",
    ]


def test_land_mode_descends_in_circles() -> None:
    plane, client = flying_plane()
    north, east = plane.motion.north, plane.motion.east
    client.command(MavCmd.NAV_LAND)
    client.run_until(lambda: not plane.is_armed, 120.0)
    assert away_m(plane, north, east) < 250.0
    assert plane.motion.impact_speed_m_s < 1.0


@pytest.mark.exhaustive
def test_mission_from_climb_out_to_roll_out() -> None:
    plane, client = ready_plane()
    items = [
        item(plane, MavCmd.NAV_TAKEOFF, 200, 0, 40),
        item(plane, MavCmd.NAV_WAYPOINT, 500, 200, 60),
        item(plane, MavCmd.NAV_LOITER_TIME, 500, 600, 60, 20.0),
        item(plane, MavCmd.NAV_WAYPOINT, 800, 0, 50),
    ]
    assert plane.missions.replace(0, items) == 0
    client.run(0.1)
    assert client.texts == ["Mission rejected: Landing waypoint/pattern req", "uired.\t"] or not plane.mission.is_valid
    assert client.command(MavCmd.MISSION_START) == MavResult.DENIED
    plane.missions.replace(0, [*items, item(plane, MavCmd.NAV_LAND, 0, 0, 0)])
    assert client.command(MavCmd.MISSION_START) == MavResult.ACCEPTED
    client.run_until(lambda: not plane.is_armed, 400.0)
    assert list(dict.fromkeys(report.seq for report in client.all(m.MissionItemReached))) == [0, 1, 2, 3, 4]
    assert away_m(plane) < 150.0


def test_constant_wind_does_not_displace_the_circle() -> None:
    plane, client = flying_plane()
    plane.motion.wind.east_m_s = 5.0
    north, east, _ = plane.flight.target
    client.run(120.0)
    assert away_m(plane, north, east) == pytest.approx(80.0, abs=25.0)


@pytest.mark.exhaustive
def test_vehicle_object_flies_the_plane() -> None:
    async def fly() -> None:
        plane = SimulatedPx4Plane(boot_time_s=1.0, fast_rate_hz=5.0)
        async with simulated_link(plane) as link, aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(50.0)
            assert plane.altitude_m > 40.0
            place = plane.frame.to_global(500.0, 0.0, 0.0)
            target = aerokit.Position(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, altitude_relative_m=60.0)
            await vehicle.go_to(target)
            assert away_m(plane, 500.0, 0.0) < 130.0
            await vehicle.set_mode("RTL")
            await anyio.sleep(120.0)
            await vehicle.land()
            await anyio.sleep(3.0)
            assert not plane.is_armed

    run_virtual(fly())
