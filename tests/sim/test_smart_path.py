"""Recording, simplification and use of the path of SMART_RTL."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client, flying_copter, ready_copter, set_mode
from vehicles import driving_rover, ready_rover

from aerokit.mavlink.enums import CopterMode, MavResult, RoverMode
from aerokit.sim import SimulatedRover
from aerokit.sim.ardupilot.navigation import SmartPath, prune, simplify

Ned = tuple[float, float, float]


def line(*places: tuple[float, float]) -> list[Ned]:
    return [(north, east, 0.0) for north, east in places]


# ---------------------------------------------------------------------------------- pure functions


def test_simplify_removes_points_on_line_and_keeps_corners() -> None:
    path = line((0, 0), (5, 0.4), (10, 0), (10, 5), (10, 10))
    assert simplify(path, 1.0) == line((0, 0), (10, 0), (10, 10))
    assert simplify(path, 0.1) == line((0, 0), (5, 0.4), (10, 0), (10, 10))
    assert simplify(path[:2], 1.0) == path[:2]


def test_prune_removes_loop() -> None:
    path = line((0, 0), (10, 0), (10, 10), (5, 10), (5, -10), (0, -10))
    assert prune(path, 1.0) == line((0, 0), (5, 0), (5, -10), (0, -10))
    assert prune(line((0, 0), (10, 0), (10, 10), (0, 10)), 1.0) == line((0, 0), (10, 0), (10, 10), (0, 10))


def test_prune_keeps_loop_at_another_height() -> None:
    path = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (10.0, 10.0, -9.0), (5.0, 10.0, -9.0), (5.0, -10.0, -9.0)]
    assert prune(path, 1.98) == path


def test_prune_joins_parts_that_nearly_touch() -> None:
    path = line((0, 0), (10, 0), (10, 10), (5, 10), (5, 1))
    assert prune(path, 1.5) == line((0, 0), (5, 0.5), (5, 1))
    assert prune(path, 0.5) == path


# --------------------------------------------------------------------------------------- recording


def drive(rover: SimulatedRover, client: Client, *places: tuple[float, float]) -> None:
    for north, east in places:
        rover.guided.go_to((north, east, 0.0))
        client.run_until(lambda: rover.has_arrived((north, east, 0.0)))  # noqa: B023


def test_path_starts_at_arming_with_points_two_metres_apart() -> None:
    rover, client = driving_rover(10.0)
    client.run_until(lambda: rover.motion.north > 9.0)
    assert 4 <= len(rover.path) <= 6
    way = rover.path.take_way_back()
    assert way[-1] == pytest.approx((0.0, 0.0, 0.0), abs=0.1)
    assert way[0][0] == pytest.approx(rover.motion.north, abs=3.0)
    assert len(way) == 2, "a straight line has two points"


def test_path_without_position_is_deactivated() -> None:
    rover, client = driving_rover()
    rover.faults.gps_lost = True
    client.run(21.0)
    assert rover.path.is_active, "7 s of dead reckoning and 15 s of grace"
    client.run(3.0)
    assert "SmartRTL deactivated: bad position" in client.texts
    rover.faults.gps_lost = False
    client.run(3.0)
    client.clear()
    assert set_mode(client, RoverMode.SMART_RTL) == MavResult.FAILED
    assert client.texts == ["Flight mode change failed"]


def test_path_without_space_is_deactivated() -> None:
    rover, client = ready_rover(SRTL_POINTS=14.0)
    path = SmartPath(rover)
    path.reset()
    for index in range(60):
        rover.motion.north, rover.motion.east = 5.0 * index, 5.0 * (index % 2)
        path.update()
        client.run(0.5)
        if not path.is_active:
            break
    assert client.texts[0] == "SmartRTL Low on space!"
    assert client.texts[-1] == "SmartRTL deactivated: buffer full"


def test_path_can_be_disabled_by_parameters() -> None:
    copter, client = flying_copter(parameters={"SRTL_POINTS": 0.0})
    assert set_mode(client, CopterMode.SMART_RTL) == MavResult.FAILED
    assert client.texts == ["Mode change to SMARTRTL failed: init failed"]
    assert copter.mode.number == CopterMode.GUIDED


def test_disarmed_copter_records_no_path() -> None:
    copter, client = ready_copter()
    copter.motion.north = 20.0
    client.run(2.0)
    assert len(copter.path) == 1


# -------------------------------------------------------------------------------------- going back


def test_rover_smart_rtl_returns_without_loop() -> None:
    rover, client = driving_rover(15.0)
    drive(rover, client, (15, 0), (15, 15), (5, 15), (5, 5), (10, 5))
    assert set_mode(client, RoverMode.SMART_RTL) == MavResult.ACCEPTED
    farthest = 0.0
    corners = {(15.0, 0.0): 99.0, (15.0, 15.0): 99.0}

    def has_returned() -> bool:
        nonlocal farthest
        here = (rover.motion.north, rover.motion.east)
        farthest = max(farthest, here[1])
        for corner in corners:
            corners[corner] = min(corners[corner], math.dist(here, corner))
        return "Reached destination" in client.texts

    client.run_until(has_returned)
    assert all(away < 4.0 for away in corners.values()), "returns around the same corners"
    assert math.hypot(rover.motion.north, rover.motion.east) < 1.0
    assert rover.is_armed


def test_interrupted_smart_rtl_keeps_remaining_path() -> None:
    rover, client = driving_rover(15.0)
    drive(rover, client, (15, 0), (15, 15))
    assert set_mode(client, RoverMode.SMART_RTL) == MavResult.ACCEPTED
    client.run(3.0)
    assert len(rover.path) == 0
    assert set_mode(client, RoverMode.HOLD) == MavResult.ACCEPTED
    assert len(rover.path) >= 2
    assert rover.path.take_way_back()[-1] == pytest.approx((0.0, 0.0, 0.0), abs=0.1)


def test_copter_smart_rtl_lands_at_start() -> None:
    copter, client = flying_copter()
    copter.guided.go_to((20.0, 0.0, -10.0))
    client.run(12.0)
    copter.guided.go_to((20.0, 20.0, -10.0))
    client.run(12.0)
    assert set_mode(client, CopterMode.SMART_RTL) == MavResult.ACCEPTED
    nearest = 99.0

    def has_returned() -> bool:
        nonlocal nearest
        nearest = min(nearest, math.dist((copter.motion.north, copter.motion.east), (20.0, 0.0)))
        return not copter.is_armed

    client.run_until(has_returned)
    assert nearest < 3.0, "not straight home"
    assert math.hypot(copter.motion.north, copter.motion.east) < 1.0
