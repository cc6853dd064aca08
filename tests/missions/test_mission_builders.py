"""Mission item builders: encoded values and refused arguments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from for_each import for_each

from aerokit import missions
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import MissionItem, RallyPoints
from aerokit.missions.check import check_item
from aerokit.position import Position

PLACE = (47.3977419, 8.545594)
XY = {"x": 473977419, "y": 85455940}
NAN = math.nan


def numbers(item: MissionItem) -> tuple[float, ...]:
    return (
        item.command,
        item.frame,
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        item.x,
        item.y,
        item.z,
    )


def at(command: int, *parameters: float, frame: int = 3, z: float = 30.0, here: bool = False) -> MissionItem:
    one, two, three, four = (*parameters, 0, 0, 0, 0)[:4]
    x, y = (0, 0) if here else XY.values()
    return MissionItem(command, frame, one, two, three, four, x, y, z)


def do(command: int, *parameters: float, x: int = 0, z: float = 0.0) -> MissionItem:
    one, two, three, four = (*parameters, 0, 0, 0, 0)[:4]
    return MissionItem(command, 2, one, two, three, four, x=x, z=z)


CASES: list[tuple[MissionItem, MissionItem]] = [
    (missions.waypoint(*PLACE, altitude_relative_m=30), at(16, 0, 0, 0, NAN)),
    (missions.waypoint(*PLACE, altitude_amsl_m=30), at(16, 0, 0, 0, NAN, frame=0)),
    (missions.waypoint(*PLACE, altitude_terrain_m=30), at(16, 0, 0, 0, NAN, frame=10)),
    (
        missions.waypoint(*PLACE, altitude_relative_m=30, hold_s=5, acceptance_radius_m=2, pass_by_m=-3, yaw_deg=90),
        at(16, 5, 2, -3, 90),
    ),
    (missions.spline_waypoint(*PLACE, altitude_relative_m=30, hold_s=2), at(82, 2)),
    (missions.take_off(altitude_relative_m=30), at(22, 0, 0, 0, NAN, here=True)),
    (missions.take_off(*PLACE, altitude_relative_m=30, pitch_deg=15, yaw_deg=-90), at(22, 15, 0, 0, -90)),
    (missions.vtol_take_off(*PLACE, altitude_relative_m=30), at(84, 0, 0, 0, NAN)),
    (missions.land(), at(21, 0, 0, 0, NAN, here=True, z=0)),
    (missions.land(*PLACE, abort_altitude_m=25, precision=2, yaw_deg=0), at(21, 25, 2, 0, 0, z=0)),
    (missions.vtol_land(*PLACE, altitude_amsl_m=488), at(85, 0, 0, 0, NAN, frame=0, z=488)),
    (missions.loiter_unlimited(*PLACE, altitude_relative_m=30, radius_m=-50), at(17, 0, 0, -50, NAN)),
    (missions.loiter_time(9, *PLACE, altitude_relative_m=30, leave_tangentially=True), at(19, 9, 0, 0, 1)),
    (missions.loiter_turns(3, *PLACE, altitude_relative_m=30, radius_m=80), at(18, 3, 0, 80)),
    (missions.loiter_to_altitude(*PLACE, altitude_relative_m=30, radius_m=80), at(31, 0, 80)),
    (missions.region_of_interest(*PLACE, altitude_relative_m=30), at(195)),
    (missions.rally_point(*PLACE, altitude_relative_m=30), at(5100)),
    (missions.return_to_launch(), do(20)),
    (missions.change_speed(7.5), do(178, 1, 7.5, -1)),
    (missions.change_speed(20, kind="air", throttle_percent=60), do(178, 0, 20, 60)),
    (missions.change_speed(-2), do(178, 1, -2, -1)),
    (missions.delay(2.5), do(93, 2.5, -1, -1, -1)),
    (missions.delay_until(13, 5), do(93, -1, 13, 5, 0)),
    (missions.condition_delay(3), do(112, 3)),
    (missions.condition_distance(20), do(114, 20)),
    (
        missions.condition_yaw(90, rate_deg_s=20, direction="counterclockwise", relative=True),
        do(115, 90, 20, -1, 1),
    ),
    (missions.set_servo(9, 1500), do(183, 9, 1500)),
    (missions.set_servo(9, 0), do(183, 9, 0)),
    (missions.set_relay(0, True), do(181, 0, 1)),
    (missions.jump(0, repeat=2), do(177, 0, 2)),
    (missions.jump_tag(7), do(600, 7)),
    (missions.jump_to_tag(7), do(601, 7, -1)),
    (missions.vtol_transition("fixed_wing"), do(3000, 4)),
    (missions.vtol_transition("multicopter"), do(3000, 3)),
    (missions.land_start(), do(189)),
    (missions.enable_fence(False), do(207, 0)),
    (missions.set_camera_trigger_distance(25, trigger_now=True), do(206, 25, 0, 1)),
    (missions.take_photo(), do(2000, 0, 0, 1)),
    (missions.take_photos(5, interval_s=2), do(2000, 0, 2, 5)),
    (missions.stop_photos(), do(2001)),
    (missions.start_video(), do(2500)),
    (missions.stop_video(), do(2501)),
    (missions.trigger_camera(), do(203, x=1)),
    (missions.region_of_interest_none(), do(197)),
    (missions.point_gimbal(pitch_deg=-45, yaw_deg=20), do(205, -45, 0, 20, z=2)),
]


@for_each("built, expected", CASES)
def test_builders_create_items(built: MissionItem, expected: MissionItem) -> None:
    assert built == expected
    check_item(built, "item", 2 if built.command == MavCmd.NAV_RALLY_POINT else 0)


def test_builder_position_reads_back() -> None:
    position = missions.waypoint(-33.8567844, 151.2152967, altitude_relative_m=30).position
    assert position is not None
    assert (position.latitude_deg, position.longitude_deg) == (-33.8567844, 151.2152967)


POSITION = Position(*PLACE, altitude_amsl_m=518, altitude_relative_m=30)
AT_POSITION: list[tuple[Any, tuple[float, ...]]] = [
    (missions.waypoint, ()),
    (missions.spline_waypoint, ()),
    (missions.take_off, ()),
    (missions.vtol_take_off, ()),
    (missions.loiter_unlimited, ()),
    (missions.loiter_time, (5,)),
    (missions.loiter_turns, (2,)),
    (missions.loiter_to_altitude, ()),
    (missions.rally_point, ()),
    (missions.region_of_interest, ()),
]


@pytest.mark.parametrize(("build", "first"), AT_POSITION)
def test_builders_accept_position_or_numbers(build: Any, first: tuple[float, ...]) -> None:
    assert build(*first, POSITION) == build(*first, *PLACE, altitude_relative_m=30)
    assert build(*first, Position(*PLACE, altitude_amsl_m=518)) == build(*first, *PLACE, altitude_amsl_m=518)
    assert build(*first, POSITION, altitude_terrain_m=7) == build(*first, *PLACE, altitude_terrain_m=7)


@pytest.mark.parametrize("build", [missions.land, missions.vtol_land])
def test_land_at_position_ignores_altitude(build: Any) -> None:
    assert build(POSITION) == build(*PLACE)
    assert build(POSITION, altitude_amsl_m=488) == build(*PLACE, altitude_amsl_m=488)


@pytest.mark.parametrize("build", [missions.take_off, missions.vtol_take_off, missions.loiter_to_altitude])
def test_single_number_is_altitude_above_home(build: Any) -> None:
    assert build(10) == build(altitude_relative_m=10)


WRONG: list[tuple[Callable[[], object], str]] = [
    (
        lambda: missions.waypoint(91, 8, altitude_relative_m=30),
        "latitude_deg = 91 is not allowed: it must be -90 to 90",
    ),
    (
        lambda: missions.waypoint(47, 181, altitude_relative_m=30),
        "longitude_deg = 181 is not allowed: it must be -180 to 180",
    ),
    (lambda: missions.waypoint(NAN, 8, altitude_relative_m=30), "latitude_deg = nan"),
    (lambda: missions.waypoint("47", 8, altitude_relative_m=30), "latitude_deg = '47'"),  # type: ignore[call-overload]
    (lambda: missions.waypoint(47, 8), "exactly one of altitude_relative_m .* not none"),
    (
        lambda: missions.waypoint(47, 8, altitude_relative_m=3, altitude_terrain_m=3),
        "not altitude_relative_m and altitude_terrain_m",
    ),
    (lambda: missions.waypoint(47, 8, altitude_amsl_m=NAN), "altitude_amsl_m = nan"),
    (
        lambda: missions.waypoint(47, 8, altitude_relative_m=90_000),
        "altitude_relative_m = 90000 .* -83000 to 83000",
    ),
    (lambda: missions.waypoint(47, 8, altitude_relative_m=3, hold_s=-1), "hold_s = -1"),
    (lambda: missions.waypoint(47, 8, altitude_relative_m=3, yaw_deg=400), "yaw_deg = 400"),
    (lambda: missions.take_off(47, altitude_relative_m=3), "latitude_deg and longitude_deg: give both"),
    (lambda: missions.waypoint(POSITION, altitude_amsl_m=3, altitude_relative_m=3), "exactly one of"),
    (lambda: missions.waypoint(Position(*PLACE)), "exactly one of .* not none"),
    (lambda: missions.waypoint(POSITION, 8.5), "longitude_deg = 8.5 .* together with a Position"),  # type: ignore[call-overload]
    (lambda: missions.take_off(12, POSITION), "the first argument, 12, was taken for the latitude"),  # type: ignore[call-overload]
    (lambda: missions.waypoint(47.0, altitude_amsl_m=3), "give both, or a Position"),  # type: ignore[call-overload]
    (lambda: missions.waypoint(None, altitude_amsl_m=3), "give both, or a Position"),  # type: ignore[call-overload]
    (lambda: missions.take_off(True), "altitude_relative_m = True"),
    (lambda: missions.take_off(10, altitude_amsl_m=3), "give both or none of them"),
    (lambda: missions.land(10), "give both or none of them"),
    (lambda: missions.take_off(altitude_relative_m=3, pitch_deg=91), "pitch_deg = 91"),
    (lambda: missions.land(precision=1.5), "precision = 1.5 .* whole"),  # type: ignore[call-overload]
    (lambda: missions.loiter_turns(256, altitude_relative_m=3), "turns = 256 .* 0 to 255"),
    (lambda: missions.loiter_time(math.inf, altitude_relative_m=3), "duration_s = inf"),
    (lambda: missions.rally_point(47, 8, altitude_relative_m=40_000), "altitude = 40000"),
    (lambda: missions.change_speed(-5), "speed_m_s = -5 is not allowed: it must be 0 to 1000, or -1, or -2"),
    (lambda: missions.change_speed(5, kind="warp"), "kind = 'warp' .* 'air', 'ground'"),  # type: ignore[arg-type]
    (lambda: missions.change_speed(5, throttle_percent=101), "throttle_percent = 101"),
    (lambda: missions.delay(0), "duration_s = 0"),
    (lambda: missions.delay(-1), "duration_s = -1"),
    (lambda: missions.delay_until(24), "hour = 24 .* 0 to 23"),
    (lambda: missions.condition_yaw(361), "heading_deg = 361"),
    (lambda: missions.condition_yaw(1, direction="left"), "direction = 'left'"),  # type: ignore[arg-type]
    (lambda: missions.set_servo(0, 1500), "servo = 0 .* 1 to 32"),
    (lambda: missions.set_servo(1, 3000), "pwm_us = 3000 is not allowed: it must be 500 to 2500, or 0"),
    (lambda: missions.set_relay(16, True), "relay = 16"),
    (lambda: missions.jump(-1), "to_item = -1"),
    (lambda: missions.jump(1.0), "to_item = 1.0 .* whole"),  # type: ignore[arg-type]
    (lambda: missions.jump(1, repeat=-2), "repeat = -2"),
    (lambda: missions.vtol_transition("x"), "to = 'x' .* 'multicopter', 'fixed_wing'"),  # type: ignore[arg-type]
    (lambda: missions.take_photos(-1), "count = -1"),
    (lambda: missions.point_gimbal(pitch_deg=200), "pitch_deg = 200"),
]


@pytest.mark.parametrize(("build", "message"), WRONG)
def test_builders_reject_invalid_arguments(build: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidArgument, match=message):
        build()


def test_zero_place_is_rejected_except_for_ardupilot() -> None:
    mission = missions.Mission([missions.take_off(altitude_relative_m=10), missions.land()])
    mission.check()
    mission.check(home_is_item_0=True)
    with pytest.raises(InvalidArgument, match=r"item 0 \(NAV_TAKEOFF\): x, y = 0, 0 .* only ArduPilot"):
        mission.check(home_is_item_0=False)
    RallyPoints([missions.rally_point(0, 0, altitude_relative_m=1)]).check(home_is_item_0=False)
