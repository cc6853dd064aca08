"""Reactions of Plane, Rover and Sub to fence breaches; see test_copter_fence for the fence itself."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client, set_mode
from vehicles import (
    ARM,
    arm,
    armed_sub,
    driving_rover,
    flying_plane,
    healthy,
    rally_points,
    ready_plane,
    ready_rover,
    ready_sub,
)

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import FenceBreach, FenceMitigate, MavCmd, MavResult, PlaneMode, RoverMode, SubMode
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedPlane, SimulatedRover

FENCE = MavCmd.DO_FENCE_ENABLE
HIGH_FENCE = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 7.0, "FENCE_RADIUS": 2000.0}
SMALL_CIRCLE = {"FENCE_ENABLE": 1.0, "FENCE_RADIUS": 20.0}


def lower_max_altitude(client: Client, plane: SimulatedPlane) -> None:
    plane.parameters["FENCE_ALT_MAX"] = 30.0
    client.run(0.6)


# ------------------------------------------------------------------------------------------- plane


@pytest.mark.parametrize(
    ("action", "mode"),
    [(1, PlaneMode.RTL), (6, PlaneMode.GUIDED), (7, PlaneMode.GUIDED), (8, PlaneMode.AUTOLAND)],
)
def test_plane_breach_executes_fence_action(action: int, mode: int) -> None:
    plane, client = flying_plane(**HIGH_FENCE, FENCE_ACTION=float(action))
    lower_max_altitude(client, plane)
    assert plane.mode.number == mode
    assert client.texts == ["Max Alt fence breached", "Manual recovery started"]
    status = client.last(m.FenceStatus)
    assert (status.breach_status, status.breach_count, status.breach_type) == (1, 1, FenceBreach.MAXALT)
    assert status.breach_mitigation == FenceMitigate.UNKNOWN
    assert not healthy(client, Sensor.MAV_SYS_STATUS_GEOFENCE)


def test_plane_report_only_keeps_mode() -> None:
    plane, client = flying_plane(**HIGH_FENCE, FENCE_ACTION=0.0)
    lower_max_altitude(client, plane)
    assert plane.mode.number == PlaneMode.LOITER
    assert client.texts == ["Max Alt fence breached"]
    plane.parameters["FENCE_ALT_MAX"] = 100.0
    client.run(0.6)
    assert client.texts[1:] == ["Fence breach cleared"]


def test_plane_breach_refuses_mode_changes_and_clears_silently() -> None:
    plane, client = flying_plane(**HIGH_FENCE)
    lower_max_altitude(client, plane)
    client.clear()
    assert set_mode(client, PlaneMode.LOITER) == MavResult.FAILED
    assert client.texts == ["Mode change to LOITER denied, in fence recovery"]
    plane.parameters["FENCE_ALT_MAX"] = 100.0
    client.run(0.6)
    assert len(client.texts) == 1, "no further reports during the return"
    assert set_mode(client, PlaneMode.LOITER) == MavResult.ACCEPTED


def test_plane_mode_change_suspends_fence_ten_seconds() -> None:
    plane, client = flying_plane(**HIGH_FENCE, FENCE_OPTIONS=0.0)
    lower_max_altitude(client, plane)
    assert set_mode(client, PlaneMode.LOITER) == MavResult.ACCEPTED
    assert client.texts[-1] == "Manual recovery started"
    plane.parameters["FENCE_RADIUS"] = 10.0
    client.run(8.0)
    assert plane.mode.number == PlaneMode.LOITER
    plane.parameters["FENCE_RADIUS"] = 2000.0
    client.run(3.0)
    plane.parameters["FENCE_RADIUS"] = 10.0
    client.run(0.6)
    assert plane.mode.number == PlaneMode.RTL
    assert "Circle fence breached" in client.texts


def test_plane_return_place_depends_on_parameters() -> None:
    plane, client = flying_plane(**HIGH_FENCE, FENCE_ACTION=6.0)
    lower_max_altitude(client, plane)
    home = plane.navigation.home
    assert home is not None
    assert plane.guided.destination == pytest.approx((home[0], home[1], home[2] - 10.0)), "between -8 and 28"
    plane.parameters["FENCE_RET_ALT"] = 70.0
    place = plane.frame.to_global(300.0, 100.0, 0.0)
    point = MissionItem(MavCmd.NAV_FENCE_RETURN_POINT, 0, x=place.latitude_e7, y=place.longitude_e7)
    plane.missions.fence.replace([point], lambda _: None)
    assert plane.fence.return_place() == pytest.approx((300.0, 100.0, home[2] - 70.0), abs=0.1)
    plane.parameters["FENCE_RET_RALLY"] = 1.0
    plane.parameters["RTL_ALTITUDE"] = -1.0
    assert plane.fence.return_place() == pytest.approx((home[0], home[1], plane.motion.down), abs=0.1)
    rally_points(plane, (500.0, 0.0, 60.0))
    assert plane.fence.return_place() == pytest.approx((500.0, 0.0, home[2] - 60.0), abs=0.1)


def test_plane_disabled_fence_restores_mode() -> None:
    plane, client = flying_plane(PlaneMode.CRUISE, **HIGH_FENCE, FENCE_ACTION=6.0)
    lower_max_altitude(client, plane)
    assert plane.mode.number == PlaneMode.GUIDED
    assert client.command(FENCE, 0) == MavResult.ACCEPTED
    client.run(0.6)
    assert plane.mode.number == PlaneMode.CRUISE


def test_plane_fence_autoenable_follows_arming() -> None:
    _, client = ready_plane(FENCE_TYPE=7.0, FENCE_AUTOENABLE=3.0)
    arm(client, PlaneMode.FLY_BY_WIRE_A)
    client.run(0.1)
    assert client.texts == ["Max Alt, Circle and Polygon fences auto-enabled", "Throttle armed"]
    assert client.command(ARM, 0) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts[2:] == ["Max Alt, Circle and Polygon fences auto-disabled", "Throttle disarmed"]


# ------------------------------------------------------------------------------------------- rover


def drive_out_of_circle(action: int) -> tuple[SimulatedRover, Client]:
    rover, client = driving_rover(60.0, **SMALL_CIRCLE, FENCE_ACTION=float(action))
    client.run_until(lambda: rover.fence.breached != 0)
    client.run(0.2)
    return rover, client


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (1, RoverMode.RTL),
        (2, RoverMode.HOLD),
        (3, RoverMode.SMART_RTL),
        (4, RoverMode.SMART_RTL),
        (6, RoverMode.LOITER),
    ],
)
def test_rover_breach_executes_fence_action_silently(action: int, mode: int) -> None:
    rover, client = drive_out_of_circle(action)
    assert rover.mode.number == mode
    assert client.texts == ["Manual recovery started"]
    status = client.last(m.FenceStatus)
    assert (status.breach_status, status.breach_type) == (1, FenceBreach.BOUNDARY)
    assert status.breach_mitigation == FenceMitigate.NONE


def test_rover_report_only_keeps_mode() -> None:
    rover, client = drive_out_of_circle(0)
    assert (client.texts, rover.mode.number) == ([], RoverMode.GUIDED)
    assert client.last(m.FenceStatus).breach_status == 1


def test_rover_disarmed_outside_fence_refuses_arming() -> None:
    rover, client = drive_out_of_circle(5)
    assert client.texts[0] == "Throttle disarmed"
    rover.navigation.set_home((0.0, 0.0, 0.0), lock=True)
    client.run(0.2)
    assert rover.arming.reasons() == ["Vehicle breaching Circle fence"]


def test_rover_far_outside_fence_holds() -> None:
    rover, client = ready_rover(**SMALL_CIRCLE)
    rover.motion.north = 150.0
    arm(client, RoverMode.GUIDED)
    rover.navigation.set_home((0.0, 0.0, 0.0), lock=True)
    client.run(0.3)
    assert rover.mode.number == RoverMode.HOLD


def test_rover_mode_change_suspends_fence() -> None:
    rover, client = drive_out_of_circle(2)
    assert set_mode(client, RoverMode.GUIDED) == MavResult.ACCEPTED
    client.run(0.5)
    assert client.texts == ["Manual recovery started"] * 2
    assert rover.mode.number == RoverMode.GUIDED


# --------------------------------------------------------------------------------------------- sub


def test_sub_breach_is_reported_only() -> None:
    sub, client = armed_sub(FENCE_ENABLE=1.0, FENCE_TYPE=2.0, FENCE_RADIUS=3.0, FENCE_MARGIN=1.0)
    sub.motion.north = 10.0
    client.run(0.6)
    assert (client.texts, sub.mode.number) == ([], SubMode.ALT_HOLD)
    status = client.last(m.FenceStatus)
    assert (status.breach_status, status.breach_type) == (1, FenceBreach.BOUNDARY)
    assert not healthy(client, Sensor.MAV_SYS_STATUS_GEOFENCE)
    assert client.command(ARM, 0) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: Vehicle breaching Circle fence"


def test_sub_fence_is_checked_only_while_armed() -> None:
    sub, client = ready_sub(FENCE_ENABLE=1.0, FENCE_TYPE=2.0, FENCE_RADIUS=3.0, FENCE_MARGIN=1.0)
    sub.motion.north = 10.0
    client.run(1.0)
    assert not any(status.breach_status for status in client.all(m.FenceStatus))
    assert math.isclose(sub.fence.beyond_m(2), 7.0, abs_tol=0.1)
