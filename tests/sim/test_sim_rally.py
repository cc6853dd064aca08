"""Rally points as destinations of Plane, Copter and Rover."""

from __future__ import annotations

import math

import pytest
from simulated_client import flying_copter, set_mode
from vehicles import driving_rover, flying_plane, rally_points, ready_plane

from aerokit.mavlink.enums import CopterMode, MavResult, PlaneMode, RoverMode
from aerokit.sim.ardupilot.navigation import best_return_place

HOME = (0.0, 0.0, 0.0)


def test_without_rally_points_return_goes_home() -> None:
    plane, _ = ready_plane()
    assert best_return_place(plane, HOME) == HOME


def test_return_uses_nearest_rally_point_and_its_altitude() -> None:
    plane, _ = ready_plane()
    rally_points(plane, (1000.0, 300.0, 80.0), (-2000.0, 0.0, 70.0))
    assert best_return_place(plane, HOME) == pytest.approx((1000.0, 300.0, -80.0), abs=0.1)
    plane.motion.north = -1500.0
    assert best_return_place(plane, HOME) == pytest.approx((-2000.0, 0.0, -70.0), abs=0.1)


def test_rally_point_beyond_the_limit_is_ignored() -> None:
    plane, _ = ready_plane(RALLY_LIMIT_KM=0.5)
    rally_points(plane, (1000.0, 0.0, 80.0))
    assert best_return_place(plane, HOME) == HOME
    plane.parameters["RALLY_LIMIT_KM"] = 0.0
    assert best_return_place(plane, HOME) != HOME, "0 is no limit"


def test_home_is_a_rally_point_if_configured() -> None:
    plane, _ = ready_plane(RALLY_INCL_HOME=1.0)
    rally_points(plane, (1000.0, 0.0, 80.0))
    assert best_return_place(plane, HOME) == HOME
    plane.motion.north = 600.0
    assert best_return_place(plane, HOME) != HOME


def test_disallowed_rally_point_is_ignored() -> None:
    plane, _ = ready_plane()
    rally_points(plane, (100.0, 0.0, 80.0), (-200.0, 0.0, 70.0))
    place = best_return_place(plane, HOME, is_allowed=lambda point: point[0] < 0.0)
    assert place == pytest.approx((-200.0, 0.0, -70.0), abs=0.1)


def test_plane_circles_above_rally_point() -> None:
    plane, client = flying_plane()
    rally_points(plane, (300.0, 300.0, 80.0))
    assert set_mode(client, PlaneMode.RTL) == MavResult.ACCEPTED
    client.run(40.0)
    away = math.hypot(plane.motion.north - 300.0, plane.motion.east - 300.0)
    assert away < 1.5 * plane.parameters["WP_LOITER_RAD"]
    assert plane.altitude_m == pytest.approx(80.0, abs=2.0)


def test_copter_lands_at_rally_point_inside_fence() -> None:
    parameters = {"RTL_LOIT_TIME": 0.0, "RTL_ALT": 1200.0, "FENCE_RADIUS": 50.0, "RALLY_INCL_HOME": 0.0}
    copter, client = flying_copter(parameters=parameters)
    rally_points(copter, (25.0, 10.0, 15.0), (-5.0, 0.0, 200.0))
    copter.parameters["FENCE_ENABLE"] = 1.0
    client.run(0.2)
    assert set_mode(client, CopterMode.RTL) == MavResult.ACCEPTED
    highest = 0.0

    def look() -> bool:
        nonlocal highest
        highest = max(highest, copter.altitude_m)
        return not copter.is_armed

    client.run_until(look)
    assert highest == pytest.approx(15.0, abs=0.6), "the rally point is above RTL_ALT"
    assert (copter.motion.north, copter.motion.east) == pytest.approx((25.0, 10.0), abs=1.0)


def test_rover_drives_to_rally_point_nearer_than_home() -> None:
    rover, client = driving_rover(30.0)
    rally_points(rover, (25.0, 10.0, 0.0))
    client.run_until(lambda: rover.motion.north > 20.0)
    assert set_mode(client, RoverMode.RTL) == MavResult.ACCEPTED
    client.run_until(lambda: "Reached destination" in client.texts)
    assert (rover.motion.north, rover.motion.east) == pytest.approx((25.0, 10.0), abs=1.5)
