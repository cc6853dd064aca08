"""Missions in simulated time; texts are compared with real ArduCopter 4.7 and PX4 1.17."""

from __future__ import annotations

import math

import pytest
from mission_client import (
    EAST,
    HOME,
    LAND,
    NORTH,
    RETURN,
    TAKE_OFF,
    WAYPOINT,
    item,
    upload,
)
from simulated_client import PX4_HOME, Client, flying_copter, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult, MissionState
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter, SimulatedPx4

ARM, START = MavCmd.COMPONENT_ARM_DISARM, MavCmd.MISSION_START
METRE = 1 / 0.011131884502145034
PX4_NORTH, PX4_EAST = 473_977_432, 85_455_939
MISSION_MODE, HOLD_MODE, RTL_MODE = (4, 4), (4, 3), (4, 5)


def north(metres: float) -> int:
    return NORTH + round(metres * METRE)


def fly_to(metres: float, altitude: float = 10.0, hold: float = 0.0) -> MissionItem:
    return item(WAYPOINT, 3, hold, x=north(metres), y=EAST, z=altitude)


CLIMB = item(TAKE_OFF, 3, z=10.0)


def start(*items: MissionItem, **parameters: float) -> tuple[SimulatedCopter, Client]:
    """Arm in GUIDED, then start AUTO by MISSION_START."""
    copter, client = ready_copter(parameters=parameters)
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.MissionCurrent.ID, 200_000)
    assert upload(client, [HOME, *items]) == MavResult.ACCEPTED
    set_mode(client, CopterMode.GUIDED)
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    client.clear()
    assert client.command(START) == MavResult.ACCEPTED
    return copter, client


def mission_texts(client: Client) -> list[str]:
    return [text for text in client.texts if text.startswith(("Mission:", "Reached", "Delaying", "Skipping"))]


def reached(client: Client) -> list[int]:
    return [message.seq for message in client.all(m.MissionItemReached)]


def states(client: Client) -> list[int]:
    return list(dict.fromkeys(message.mission_state for message in client.all(m.MissionCurrent)))


# ------------------------------------------------------------------------------------------ ArduCopter


def test_copter_mission_matches_the_recording() -> None:
    east = EAST + round(20 * METRE / math.cos(math.radians(35.36)))
    copter, client = start(
        CLIMB,
        fly_to(20),
        item(MavCmd.DO_CHANGE_SPEED, 2, 1.0, 4.0),
        item(MavCmd.CONDITION_YAW, 2, 90.0, 0.0, 1.0),
        item(MavCmd.DO_SET_SERVO, 2, 5.0, 1500.0),
        fly_to(40, 12.0, hold=2.0),
        item(MavCmd.NAV_DELAY, 2, 3.0),
        item(MavCmd.NAV_LOITER_TURNS, 3, 1.0, 0.0, 8.0, x=north(40), y=east, z=12.0),
        item(MavCmd.NAV_LOITER_TIME, 3, 2.0, x=north(40), y=east, z=12.0),
        item(MavCmd.DO_JUMP, 2, 9.0, 1.0),
        item(MavCmd.CONDITION_DELAY, 2, 2.0),
        item(MavCmd.DO_SET_ROI, 0, x=north(10), y=EAST, z=580.0),
        item(MavCmd.NAV_SPLINE_WAYPOINT, 3, x=north(10), y=EAST, z=10.0),
        item(RETURN, 2),
    )
    client.run_until(lambda: not copter.is_armed, 300.0)
    client.run(1.0)
    assert mission_texts(client) == [
        "Mission: 1 Takeoff",
        "Mission: 1 Takeoff",
        "Mission: 2 WP",
        "Reached command #2",
        "Mission: 3 ChangeSpeed",
        "Mission: 6 WP",
        "Mission: 4 CondYaw",
        "Mission: 5 SetServo",
        "Reached command #6",
        "Mission: 7 Delay",
        "Delaying 3 sec",
        "Mission: 8 LoitTurns",
        "Mission: starting circle 1/1",
        "Mission: starting circle 2/1",
        "Mission: 9 LoitTime",
        "Reached command #9",
        "Mission: 10 Jump 1/1",
        "Mission: 9 LoitTime",
        "Reached command #9",
        "Mission: 11 CondDelay",
        "Mission: 13 SplineWP",
        "Mission: 12 SetROI",
        "Reached command #13",
        "Mission: 14 RTL",
    ]
    assert reached(client) == [1, 3, 4, 6, 7, 8, 9, 9, 11, 12, 13, 14]
    assert states(client) == [MissionState.ACTIVE, MissionState.COMPLETE]
    assert client.last(m.MissionCurrent).seq == 0
    assert math.hypot(copter.motion.north, copter.motion.east) < 1.0


def test_waypoints_are_passed_in_order() -> None:
    copter, client = start(CLIMB, fly_to(30), fly_to(60, 15.0), item(LAND, 3))
    places = []
    for seq in (2, 3):
        client.run_until(lambda seq=seq: seq in reached(client), 120.0)  # type: ignore[misc]
        places.append((copter.motion.north, copter.altitude_m))
    assert places[0] == pytest.approx((30.0, 10.0), abs=2.5)
    assert places[1] == pytest.approx((60.0, 15.0), abs=0.5)


def test_relative_turn_over_180_degrees_keeps_direction_in_mission() -> None:
    copter, client = start(CLIMB, item(MavCmd.CONDITION_YAW, 2, 270.0, 20.0, 0.0, 1.0), fly_to(10, hold=60.0))
    client.run_until(lambda: "Mission: 2 CondYaw" in client.texts)
    client.run(2.0)
    assert copter.motion.yaw_rate > 0.3


def test_landing_ends_the_mission() -> None:
    copter, client = start(CLIMB, fly_to(20), item(LAND, 3, x=north(20), y=EAST))
    client.run_until(lambda: not copter.is_armed, 120.0)
    client.run(1.0)
    assert mission_texts(client)[-2:] == ["Mission: 3 Land", "Mission: 1 Takeoff"]
    assert reached(client) == [1, 2]
    assert client.last(m.MissionCurrent).mission_state == MissionState.ACTIVE
    assert copter.is_landed
    client.run(5.0)
    assert copter.is_landed


def test_mission_continues_after_landing_if_allowed() -> None:
    copter, client = start(CLIMB, item(LAND, 3), CLIMB, fly_to(10), MIS_OPTIONS=4)
    client.run_until(lambda: 4 in reached(client), 200.0)
    assert copter.is_armed
    assert reached(client) == [1, 2, 3, 4]


def test_after_the_last_item_it_stays_in_auto() -> None:
    copter, client = start(CLIMB, fly_to(20), item(MavCmd.DO_SET_REVERSE, 2))
    client.run(30.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE
    assert (copter.mode.number, copter.is_landed) == (CopterMode.AUTO, False)
    client.send(m.MissionSetCurrent(1, 1, 2))
    assert client.last(m.MissionCurrent).mission_state == MissionState.NOT_STARTED
    client.send(m.MissionClearAll(1, 1, 0))
    assert client.last(m.MissionAck).type == 0
    client.run(1.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.NO_MISSION
    set_mode(client, CopterMode.GUIDED)
    assert set_mode(client, CopterMode.AUTO) == MavResult.FAILED
    client.run(0.1)
    assert client.texts[-1] == "Mode change to AUTO failed: init failed"


def test_flown_mission_can_be_changed_not_cleared() -> None:
    copter, client = start(CLIMB, fly_to(50), item(RETURN, 2))
    client.run_until(lambda: copter.mission.nav_index == 2, 60.0)
    client.send(m.MissionClearAll(1, 1, 0))
    assert client.last(m.MissionAck).type == 1
    upload(client, [HOME, CLIMB, fly_to(-30), item(RETURN, 2)])
    client.run(1.0)
    assert "Auto mission changed, restarted command" in client.texts
    client.run_until(lambda: 2 in reached(client), 60.0)
    assert copter.motion.north == pytest.approx(-30.0, abs=1.0)


def test_arming_in_auto_needs_auto_options() -> None:
    _, client = ready_copter()
    assert set_mode(client, CopterMode.AUTO) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.FAILED
    client.run(0.1)
    assert client.texts[-1] == "Arm: Mode requires mission"
    upload(client, [HOME, CLIMB])
    assert client.command(ARM, 1) == MavResult.FAILED
    client.run(0.1)
    assert client.texts[-1] == "Arm: AUTO mode not armable"
    copter, client = ready_copter(parameters={"AUTO_OPTIONS": 3})
    upload(client, [HOME, CLIMB])
    set_mode(client, CopterMode.AUTO)
    client.run(0.1)
    assert client.texts[-1] == "Mission: 1 Takeoff"
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    client.run_until(lambda: copter.altitude_m > 9.5, 40.0)


def test_mission_on_ground_needs_take_off_and_pilot() -> None:
    copter, client = ready_copter()
    upload(client, [HOME, fly_to(20)])
    set_mode(client, CopterMode.GUIDED)
    client.command(ARM, 1)
    assert set_mode(client, CopterMode.AUTO) == MavResult.FAILED
    client.run(0.1)
    assert "Auto: Missing Takeoff Cmd" in client.texts
    upload(client, [HOME, CLIMB])
    assert set_mode(client, CopterMode.AUTO) == MavResult.ACCEPTED
    client.run(8.0)
    assert copter.is_landed
    copter.rc[2] = 1500
    client.run(8.0)
    assert not copter.is_landed


def test_pause_stops_between_waypoints() -> None:
    copter, client = start(CLIMB, fly_to(60), item(MavCmd.NAV_LOITER_UNLIM, 3, x=north(60), y=EAST, z=10.0))
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 0) == MavResult.FAILED
    client.run_until(lambda: copter.motion.north > 20, 60.0)
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 0) == MavResult.ACCEPTED
    client.run(6.0)
    place = copter.motion.north
    assert client.last(m.MissionCurrent).mission_state == MissionState.PAUSED
    client.run(3.0)
    assert copter.motion.north == pytest.approx(place, abs=0.5)
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 1) == MavResult.ACCEPTED
    client.run(20.0)
    assert copter.motion.north == pytest.approx(60.0, abs=1.0)
    client.run(20.0)
    assert reached(client) == [1, 2]


def test_the_current_item_can_be_chosen_in_flight_and_before() -> None:
    copter, client = start(CLIMB, fly_to(40), fly_to(-20), fly_to(-40))
    client.run_until(lambda: copter.mission.nav_index == 2, 60.0)
    assert client.command(MavCmd.DO_SET_MISSION_CURRENT, 4) == MavResult.ACCEPTED
    client.run(0.5)
    assert client.last(m.MissionCurrent).seq == 4
    assert client.command(MavCmd.DO_SET_MISSION_CURRENT, 9) == MavResult.DENIED
    set_mode(client, CopterMode.GUIDED)
    client.send(m.MissionSetCurrent(1, 1, 3))
    assert client.last(m.MissionCurrent).seq == 3
    set_mode(client, CopterMode.AUTO)
    client.run_until(lambda: copter.motion.north < -18, 60.0)
    assert copter.mission.nav_index >= 3


def test_reentering_auto_resumes_or_restarts() -> None:
    for restart, index in ((0, 3), (1, 1)):
        copter, client = start(CLIMB, fly_to(10), fly_to(60), MIS_RESTART=restart)
        client.run_until(lambda copter=copter: copter.mission.nav_index == 3, 60.0)  # type: ignore[misc]
        set_mode(client, CopterMode.LOITER)
        client.run(1.0)
        set_mode(client, CopterMode.AUTO)
        client.run(0.1)
        assert copter.mission.nav_index == index


def test_jumps_and_tags_repeat_as_specified() -> None:
    _, client = start(
        CLIMB,
        item(MavCmd.JUMP_TAG, 2, 7.0),
        fly_to(5),
        item(MavCmd.DO_JUMP_TAG, 2, 7.0, 2.0),
        item(MavCmd.CONDITION_DISTANCE, 2, 3.0),
        fly_to(15),
    )
    client.run(60.0)
    assert mission_texts(client)[2:] == [
        "Mission: 2 Tag 7",
        "Mission: 3 WP",
        "Reached command #3",
        "Mission: 4 Jump 1/2",
        "Mission: 2 Tag 7",
        "Mission: 3 WP",
        "Reached command #3",
        "Mission: 4 Jump 2/2",
        "Mission: 2 Tag 7",
        "Mission: 3 WP",
        "Reached command #3",
        "Mission: 5 CondDist",
        "Mission: 6 WP",
        "Reached command #6",
    ]
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE


def test_endless_jump_without_waypoints_does_not_hang() -> None:
    copter, client = start(CLIMB, item(MavCmd.DO_JUMP, 2, 2.0, -1.0))
    client.run(30.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE
    assert not copter.is_landed


def test_unlimited_jump_over_other_commands_does_not_hang() -> None:
    copter, client = start(CLIMB, item(MavCmd.DO_CHANGE_SPEED, 2, 1.0, 3.0), item(MavCmd.DO_JUMP, 3, 2.0, -1.0))
    client.run(30.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE
    assert not copter.is_landed


def test_auto_in_flight_starts_the_mission() -> None:
    copter, client = flying_copter()
    upload(client, [HOME, fly_to(20), item(MavCmd.NAV_LOITER_TO_ALT, 3, x=north(20), y=EAST, z=20.0)])
    assert set_mode(client, CopterMode.AUTO) == MavResult.ACCEPTED
    assert client.command(MavCmd.DO_CHANGE_SPEED, 1, 3.0) == MavResult.ACCEPTED
    client.run(3.0)
    assert copter.motion.ground_speed_m_s == pytest.approx(3.0, abs=0.3)
    client.run(30.0)
    assert copter.altitude_m == pytest.approx(20.0, abs=0.5)
    assert reached(client) == [1, 2]


# ------------------------------------------------------------------------------------------------- PX4


def px4_north(metres: float) -> int:
    return PX4_NORTH + round(metres * METRE)


def go(metres: float, altitude: float = 10.0, hold: float = 0.0, heading: float = math.nan) -> MissionItem:
    return item(WAYPOINT, 6, hold, param4=heading, x=px4_north(metres), y=PX4_EAST, z=altitude)


PX4_CLIMB = item(TAKE_OFF, 6, param4=math.nan, x=PX4_NORTH, y=PX4_EAST, z=10.0)


def start_px4(*items: MissionItem) -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(fast_rate_hz=1.0, boot_time_s=0.5, home=PX4_HOME)
    client = Client(px4)
    client.run(2.0)
    assert upload(client, items) == 0
    client.clear()
    assert client.command(START) == MavResult.ACCEPTED
    return px4, client


def test_px4_mission_matches_the_recording() -> None:
    px4, client = start_px4(
        PX4_CLIMB,
        go(20),
        item(MavCmd.DO_CHANGE_SPEED, 2, 1.0, 3.0, -1.0),
        go(40, 12.0, 2.0, 90.0),
        item(MavCmd.NAV_DELAY, 2, 2.0, -1.0, -1.0, -1.0),
        item(MavCmd.NAV_LOITER_TIME, 6, 3.0, x=px4_north(40), y=PX4_EAST + 1000, z=12.0),
        item(MavCmd.DO_JUMP, 2, 1.0, 1.0),
        item(RETURN, 2),
    )
    client.run_until(lambda: px4.mode == RTL_MODE, 150.0)
    client.run(3.0)
    assert list(dict.fromkeys(reached(client))) == [0, 2, 3, 4, 5, 7]  # Item 2 follows item 1 at once.
    assert reached(client).count(7) == 4
    assert states(client) == [MissionState.ACTIVE, MissionState.COMPLETE]
    assert [one.seq for one in client.all(m.MissionItemInt)] == [6]
    seqs = [one.seq for one in client.all(m.MissionCurrent)]
    assert seqs == sorted(seqs[: seqs.index(5)]) + seqs[seqs.index(5) :]
    texts = [text.rstrip() for text in client.texts]
    assert texts[1:4] == ["Executing Mission", "Climb to 10.0 meters above home", "Takeoff detected"]
    assert "Mission finished, loitering" in texts
    client.run_until(lambda: not px4.is_armed, 90.0)
    assert px4.mode == HOLD_MODE


def test_px4_holds_heading_and_position() -> None:
    px4, client = start_px4(PX4_CLIMB, go(20, hold=8.0, heading=90.0), go(30))
    client.run_until(lambda: px4.mission.current == 1 and px4.motion.north > 19.5, 60.0)
    client.run(4.0)
    assert px4.mission.current == 1
    assert math.degrees(px4.motion.yaw) == pytest.approx(90.0, abs=3.0)


def test_px4_loiters_at_end_and_restarts_on_request() -> None:
    px4, client = start_px4(PX4_CLIMB, go(15))
    client.run_until(lambda: px4.mode == HOLD_MODE, 60.0)
    client.run(1.5)
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE
    assert client.last(m.MissionCurrent).mission_mode == 2
    client.send(m.MissionSetCurrent(1, 1, 1))
    assert client.command(START) == MavResult.ACCEPTED
    client.run(1.5)
    assert client.last(m.MissionCurrent).mission_state == MissionState.ACTIVE


def test_px4_lands_at_end_and_keeps_the_mode() -> None:
    px4, client = start_px4(PX4_CLIMB, item(LAND, 6, x=px4_north(10), y=PX4_EAST))
    client.run_until(lambda: not px4.is_armed, 90.0)
    client.run(1.5)
    assert px4.mode == MISSION_MODE
    assert px4.motion.north == pytest.approx(10.0, abs=2.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.COMPLETE
    assert "Mission finished, landed\t" in client.texts


def test_px4_mission_start_refusals() -> None:
    px4 = SimulatedPx4(fast_rate_hz=1.0, boot_time_s=0.5, home=PX4_HOME)
    client = Client(px4)
    client.run(2.0)
    assert client.command(START) == MavResult.DENIED
    client.run(0.1)
    assert client.texts[-1] == "Mission start denied! No valid mission\t"
    upload(client, [PX4_CLIMB])
    assert client.command(START, 5) == MavResult.DENIED
    assert client.command(MavCmd.DO_SET_MISSION_CURRENT, 0) == MavResult.UNSUPPORTED
    px4.faults.prearm_failures.append("Compass")
    assert client.command(START) == MavResult.TEMPORARILY_REJECTED


def test_px4_pauses_in_hold_and_resumes() -> None:
    px4, client = start_px4(PX4_CLIMB, go(60))
    client.run_until(lambda: px4.motion.north > 20, 60.0)
    client.command(MavCmd.DO_SET_MODE, 1, 4, 3)
    client.run(3.0)
    assert client.last(m.MissionCurrent).mission_state == MissionState.PAUSED
    assert px4.motion.north < 40
    client.command(MavCmd.DO_SET_MODE, 1, 4, 4)
    client.run(20.0)
    assert px4.motion.north == pytest.approx(60.0, abs=2.0)


def test_px4_handles_new_and_cleared_mission_in_flight() -> None:
    px4, client = start_px4(PX4_CLIMB, go(60))
    client.run_until(lambda: px4.motion.north > 10, 60.0)
    upload(client, [go(-20), go(-60)])
    client.run_until(lambda: px4.motion.north < -15, 60.0)
    client.send(m.MissionClearAll(1, 1, 0))
    client.run(0.1)
    assert px4.mode == HOLD_MODE
    assert client.texts[-1] == "No valid mission available, loitering\t"
    client.run(1.0)
    assert client.last(m.MissionCurrent).total == 65535


def test_px4_climbs_first_without_take_off_item() -> None:
    px4, client = start_px4(go(20))
    client.run_until(lambda: px4.mode == HOLD_MODE, 60.0)
    assert "Climb to 2.5 meters above home\t" in client.texts
    assert px4.motion.north == pytest.approx(20.0, abs=2.0)
    assert px4.altitude_m == pytest.approx(10.0, abs=1.0)


@pytest.mark.parametrize(
    ("items", "reason"),
    [
        ([go(20), PX4_CLIMB], "takeoff not first waypoint item"),
        ([item(TAKE_OFF, 6, x=PX4_NORTH, y=PX4_EAST)], "Takeoff altitude below home altitude!"),
        ([item(LAND, 6, x=PX4_NORTH, y=PX4_EAST)], "starts with landing"),
        ([go(20), item(MavCmd.CONDITION_DELAY, 2, 3.0)], "item 2: unsupported cmd: 112"),
        ([go(20), *[item(MavCmd.DO_LAND_START, 2)] * 2], "more than one land start."),
        (
            [go(20), item(MavCmd.DO_LAND_START, 2), item(RETURN, 2)],
            "land start item before RTL item not possible.",
        ),
        ([go(20), item(MavCmd.DO_LAND_START, 2)], "invalid land start."),
    ],
)
def test_px4_stores_an_invalid_mission_and_rejects_it(items: list[MissionItem], reason: str) -> None:
    px4 = SimulatedPx4(fast_rate_hz=1.0, boot_time_s=0.5, home=PX4_HOME)
    client = Client(px4)
    client.run(2.0)
    assert upload(client, items) == 0
    client.run(1.1)
    assert f"Mission rejected: {reason}\t" in "".join(client.texts)
    assert client.last(m.MissionCurrent).mission_state == MissionState.NO_MISSION
    assert client.last(m.MissionCurrent).total == len(items)
    assert client.command(START) == MavResult.DENIED


def test_px4_flies_to_null_island() -> None:
    px4, client = start_px4(item(TAKE_OFF, 6, param4=math.nan, z=10.0), go(20))
    client.run_until(lambda: px4.altitude_m > 9.0, 40.0)
    client.run(15.0)
    assert px4.motion.north < -20.0
    assert px4.motion.east < -2.0
