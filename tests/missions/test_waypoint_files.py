"""QGC WPL files: reading of real files, writing as Mission Planner does, and pymavlink's reading."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavwp

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import (
    Mission,
    MissionItem,
    Plan,
    format_waypoints,
    jump,
    land,
    loiter_turns,
    parse_waypoints,
    read_waypoint_file,
    return_to_launch,
    take_off,
    trigger_camera,
    waypoint,
    write_waypoint_file,
)
from aerokit.missions.item import has_place
from aerokit.position import Position

MISSION_PLANNER = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t-35.363262\t149.165237\t584.090000\t1
1\t0\t3\t22\t15.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t20.000000\t1
2\t0\t3\t16\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t-35.36180530\t149.16507460\t100.500000\t1
3\t0\t3\t203\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t1.00000000\t0.00000000\t0.000000\t1
4\t0\t3\t177\t2.00000000\t3.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.000000\t1
5\t0\t3\t20\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.000000\t0
"""


def test_mission_planner_file_round_trip_is_exact() -> None:
    mission = parse_waypoints(MISSION_PLANNER)
    assert mission.home == Position(-35.363262, 149.165237, 584.09)
    assert [item.command for item in mission] == [22, 16, 203, 177, 20]
    assert mission[0] == MissionItem(22, 3, 15.0, z=20.0)
    assert mission[1] == MissionItem(16, 3, x=-353618053, y=1491650746, z=100.5)
    assert mission[2].x == 1
    assert mission[3].param1 == 1  # without home
    assert not mission[4].autocontinue
    mission.check()
    assert format_waypoints(mission) == MISSION_PLANNER


@pytest.mark.parametrize(
    "text",
    [
        MISSION_PLANNER.replace("\t", "   "),
        MISSION_PLANNER.replace("\n", "\r\n"),
        "\ufeff" + MISSION_PLANNER.replace("\n", "\n\n# a remark\n"),
        MISSION_PLANNER.replace("QGC WPL 110", "QGC WPL  110 ").rstrip("\n"),
        MISSION_PLANNER.replace("0\t1\t0\t16", "0\t1\t0\t0"),  # older Mission Planner versions
    ],
)
def test_equivalent_waypoint_files_read_the_same(text: str, tmp_path: Path) -> None:
    path = tmp_path / "mission.waypoints"
    path.write_text(text, encoding="utf-8", newline="")
    assert read_waypoint_file(path) == parse_waypoints(MISSION_PLANNER)


def test_waypoint_file_without_home() -> None:
    lines = MISSION_PLANNER.splitlines()
    rows = [f"{index}\t{line.split(chr(9), 1)[1]}" for index, line in enumerate(lines[2:])]
    text = "\n".join(["QGC WPL 120", *rows]).replace("177\t2.0", "177\t1.0")
    expected = parse_waypoints(MISSION_PLANNER).replace(home=None)
    assert parse_waypoints(text) == expected
    assert parse_waypoints(text.replace("120", "110")) == expected  # a take-off is not taken as home
    assert format_waypoints(expected, version=120).splitlines() == text.splitlines()
    assert parse_waypoints(format_waypoints(expected)) == expected
    assert format_waypoints(expected).splitlines()[1].startswith("0\t1\t0\t16\t0\t0\t0\t0\t0.000000")


def test_waypoint_file_with_empty_mission() -> None:
    assert parse_waypoints("QGC WPL 110\n") == Mission()
    assert parse_waypoints(format_waypoints(Mission())) == Mission()
    home = Mission(home=Position(47, 8, 400.0))
    assert parse_waypoints(format_waypoints(home)) == home


def test_waypoint_file_writes_enough_digits() -> None:
    mission = Mission(
        [
            MissionItem(183, 2, 0.1 + 0.2, 1e-12, 1e20, z=1 / 3),
            MissionItem(187, 2, x=0.123456789012),
        ],
        Position(47.39774191234, 8.0, 1 / 3),
    )
    assert parse_waypoints(format_waypoints(mission)) == mission


@pytest.mark.parametrize(
    "item",
    [MissionItem(16, 3, x=1, y=2), MissionItem(22, 3), MissionItem(16, 1, x=10_000)],
    ids=["place", "take-off", "local place"],
)
def test_place_without_altitude_is_not_written(item: MissionItem) -> None:
    with pytest.raises(InvalidArgument, match="a place without an altitude"):
        format_waypoints(Mission([item.replace(z=math.nan)]))


NUMBERS = ("param1", "param2", "param3", "param4", "z")
numbers = st.floats(allow_infinity=False) | st.just(math.nan)
items = st.builds(
    MissionItem,
    st.sampled_from([16, 17, 20, 22, 93, 177, 178, 183, 189, 195, 203, 2000, 31010, 40000]),
    st.sampled_from([0, 1, 2, 3, 6, 10]),
    numbers,
    numbers,
    numbers,
    numbers,
    st.integers(-900000000, 900000000),
    st.integers(-1800000000, 1800000000),
    numbers,
    st.booleans(),
).map(lambda item: item.replace(param1=float(round(item.x / 1e6))) if item.command == 177 else item)
items = items.map(
    lambda item: item.replace(z=0.0) if math.isnan(item.z) and (has_place(item.command) or item.position) else item
)
homes = st.none() | st.builds(Position, st.floats(1, 90), st.floats(-180, 180), st.floats(-1e6, 1e6))
missions = st.builds(Mission, st.lists(items, max_size=6), homes)


@given(missions)
def test_waypoint_file_round_trip(mission: Mission) -> None:
    text = format_waypoints(mission)
    assert "nan" not in text
    given = [
        item.replace(**{name: 0.0 for name in NUMBERS if math.isnan(getattr(item, name))}) for item in mission.items
    ]
    assert parse_waypoints(text) == Mission(given, mission.home)
    assert format_waypoints(parse_waypoints(text)) == text


@given(st.text(max_size=60), st.integers(0, 400), st.integers(0, 400))
@settings(max_examples=100, deadline=None)
def test_damaged_waypoint_file_raises_only_our_errors(junk: str, start: int, length: int) -> None:
    for text in (
        junk,
        "QGC WPL 110\n" + junk,
        MISSION_PLANNER[:start] + junk + MISSION_PLANNER[start + length :],
    ):
        try:
            parse_waypoints(text)
        except FileFormatError:
            continue


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("QGC WPL 110", "QGC WPL 100", "line 1: expected 'QGC WPL 110' or 'QGC WPL 120', found 'QGC WPL 100'"),
        ("QGC WPL 110", "# survey\n\nQGC WPL 100", "line 3: expected .*, found 'QGC WPL 100'"),
        (MISSION_PLANNER, " ", "line 1: expected .*, found no text"),
        ("\n2\t0", "\n3\t0", "line 4: index = 3: expected 2; lines are missing"),
        ("\t0.000000\t0\n", "\t0\n", "line 7: expected 12 columns, found 11"),
        ("-35.36180530", "91.0", "line 4: latitude = '91.0': expected a number from -90 to 90"),
        ("149.16507460", "181", "line 4: longitude = '181'"),
        ("-35.363262", "-95", "line 2: latitude = '-95'"),
        ("-35.363262", "nan", "line 2: latitude = 'nan'"),
        ("100.500000", "100,5", "line 4: altitude = '100,5': expected a number"),
        ("15.00000000", "inf", "line 3: param1 = 'inf': expected a number"),
        ("15.00000000", "1_5", "line 3: param1 = '1_5'"),
        ("\t22\t", "\t22.0\t", "line 3: command = '22.0': expected a whole number from 0 to 65535"),
        ("\t3\t22\t", "\t300\t22\t", "line 3: frame = '300': expected a whole number from 0 to 255"),
        ("\t0\t3\t22", "\tx\t3\t22", "line 3: current = 'x'"),
        ("0.000000\t0\n", "0.000000\t-1\n", "line 7: autocontinue = '-1'"),
    ],
)
def test_waypoint_file_error_names_line(old: str, new: str, message: str) -> None:
    text = MISSION_PLANNER.replace(old, new, 1)
    assert text != MISSION_PLANNER
    with pytest.raises(FileFormatError, match=f"^a.txt: {message}"):
        parse_waypoints(text, "a.txt")


def test_waypoint_file_rejects_infinite_numbers() -> None:
    with pytest.raises(InvalidArgument, match="infinite"):
        format_waypoints(Mission([MissionItem(16, 3, math.inf)]))
    with pytest.raises(InvalidArgument, match="version = 100 is not allowed"):
        format_waypoints(Mission(), version=100)


MISSION = Mission(
    [
        take_off(altitude_relative_m=20, pitch_deg=15).replace(param4=0.0),
        waypoint(47.3977419, 8.545594, altitude_relative_m=30.5, hold_s=2).replace(param4=0.0),
        loiter_turns(2, 47.398, 8.546, altitude_amsl_m=520, radius_m=-30),
        trigger_camera(),
        jump(1, repeat=2),
        return_to_launch(),
        land(47.3977, 8.5456).replace(param4=1.0, autocontinue=False),
    ],
    Position(47.3977, 8.5456, 488.5),
)


def test_pymavlink_reads_our_waypoint_file(tmp_path: Path) -> None:
    path = tmp_path / "ours.waypoints"
    write_waypoint_file(path, MISSION)
    loader = mavwp.MAVWPLoader()
    assert loader.load(str(path)) == len(MISSION) + 1
    home = loader.wpoints[0]
    assert (home.x, home.y, home.z, home.current) == (47.3977, 8.5456, 488.5, 1)
    for item, theirs in zip(MISSION.to_items(home_is_item_0=True)[1:], loader.wpoints[1:], strict=True):
        assert (theirs.command, theirs.frame, theirs.z) == (item.command, item.frame, item.z)
        parameters = (theirs.param1, theirs.param2, theirs.param3, theirs.param4)
        assert parameters == (item.param1, item.param2, item.param3, item.param4)
        assert theirs.autocontinue == item.autocontinue
        scale = 1 if item.command == MavCmd.DO_DIGICAM_CONTROL else 1e7
        assert round(theirs.x * scale) == item.x
    assert loader.wpoints[5].param1 == 2


def test_waypoint_file_of_pymavlink_is_read(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours.txt", tmp_path / "theirs.txt"
    write_waypoint_file(ours, MISSION)
    loader = mavwp.MAVWPLoader()
    loader.load(str(ours))
    loader.save(str(theirs))
    mission = read_waypoint_file(theirs)
    assert mission.home == MISSION.home
    assert len(mission) == len(MISSION)
    for item, other in zip(MISSION, mission, strict=True):
        assert abs(item.x - other.x) <= 5  # six digits behind the point
        assert item.replace(x=0, y=0) == other.replace(x=0, y=0)


@pytest.mark.parametrize("plan", [Plan(), [take_off(15)]], ids=["plan", "items"])
def test_waypoint_file_of_other_type_is_refused(plan: Any) -> None:
    with pytest.raises(
        InvalidArgument, match=r"^mission = .* is not a Mission: pass Mission\(\[…\]\), or plan.mission"
    ):
        format_waypoints(plan)
