"""QGroundControl's .plan files: reading, round trips and refused files."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import plan_samples as samples
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.missions import (
    Fence,
    FenceCircle,
    FencePolygon,
    Mission,
    MissionItem,
    Plan,
    RallyPoints,
    format_plan,
    jump,
    parse_plan,
    rally_point,
    read_plan_file,
    return_to_launch,
    set_servo,
    take_off,
    waypoint,
    write_plan_file,
)
from aerokit.position import Position

NAN = math.nan


def read(document: object) -> Plan:
    return parse_plan(json.dumps(document), "test.plan")


def written(plan: Plan) -> Any:
    return json.loads(format_plan(plan))


# ------------------------------------------------------------------------------------------ reading


def test_plan_file_is_read_completely() -> None:
    plan = read(samples.full_document())
    assert [item.command for item in plan.mission] == [
        22,
        16,
        206,
        16,
        206,
        16,
        177,
        189,
        206,
        2001,
        2501,
        31,
        21,
    ]
    assert plan.mission[0] == MissionItem(22, 3, 0, 0, 0, NAN, 473977507, 85456075, 50.0)
    assert plan.mission[1].x == 473977123
    assert plan.mission[6] == jump(5, repeat=3)
    assert plan.mission[11] == MissionItem(31, 3, 1, -75, 0, 1, 473990000, 85490000, 40.0)
    assert plan.mission[12] == MissionItem(21, 3, 0, 0, 0, 0, 473977000, 85456000, 0.0)
    assert plan.mission.home == Position(47.39774191234, 8.545594, 487.989)
    assert (plan.firmware_type, plan.vehicle_type, plan.cruise_speed_m_s, plan.hover_speed_m_s) == (
        12,
        2,
        15,
        5.5,
    )
    assert plan.fence == Fence(
        [
            FencePolygon(
                [
                    Position(47.3980777, 8.5438346),
                    Position(47.3983519, 8.55002464),
                    Position(47.3964101, 8.5449928),
                ],
                inclusion=False,
            )
        ],
        [FenceCircle(Position(47.39756763610029, 8.544649762407738), 319.85)],
        Position(47.3975, 8.5452, altitude_relative_m=42.5),
    )
    assert plan.rally.positions == (
        Position(47.397604, 8.5509154, altitude_relative_m=50),
        Position(47.3990202, 8.5426327, altitude_relative_m=49.5),
    )
    plan.mission.check()
    plan.fence.check()
    plan.rally.check()


def test_plan_file_landing_patterns() -> None:
    pattern = samples.landing() | {
        "complexItemType": "vtolLandingPattern",
        "useLoiterToAlt": False,
        "altitudesAreRelative": False,
        "stopTakingPhotos": False,
        "useDoChangeSpeed": True,
        "finalApproachSpeed": 12,
    }
    items = read(samples.document(pattern)).mission.items
    assert [(item.command, item.frame) for item in items] == [(189, 2), (178, 2), (2501, 2), (16, 0), (85, 0)]
    assert (items[1].param1, items[1].param2) == (0, 12)


@pytest.mark.parametrize(
    ("changes", "frame", "z"),
    [
        ({"AltitudeMode": 1, "Altitude": 40}, 3, 40),
        ({"AltitudeMode": 2, "Altitude": 540}, 0, 540),
        ({"AltitudeMode": 3, "Altitude": 40, "AMSLAltAboveTerrain": 530}, 0, 530),
        ({"AltitudeMode": 4, "Altitude": 40}, 10, 40),
        ({"AltitudeMode": 0, "Altitude": 40}, 3, 40),
        ({"AltitudeMode": 3, "AMSLAltAboveTerrain": None}, 0, NAN),
    ],
)
def test_plan_file_altitude_mode_without_altitude(changes: dict[str, Any], frame: int, z: float) -> None:
    entry = samples.place(16, 1, 47, 8, 50) | changes
    entry["params"][6] = None
    item = read(samples.document(entry)).mission[0]
    assert item == MissionItem(16, frame, 0, 0, 0, NAN, 470000000, 80000000, z)
    if z != z:
        with pytest.raises(InvalidArgument, match="z = nan"):
            Mission([item]).check()


def test_plan_file_frame_takes_precedence() -> None:
    entry = samples.place(16, 1, 47, 8, 530) | {
        "frame": 0,
        "AltitudeMode": 3,
        "Altitude": 40,
        "AMSLAltAboveTerrain": 530,
    }
    assert read(samples.document(entry)).mission[0].position == Position(47, 8, altitude_amsl_m=530)


def test_plan_file_jumps_refer_to_ids() -> None:
    jumping = samples.simple(177, 8, 2, 20, 1)
    plan = read(samples.document(samples.place(16, 10, 47, 8, 5), jumping, samples.place(16, 20, 47, 8, 6)))
    assert plan.mission[1] == jump(2, repeat=1)
    del jumping["doJumpId"]
    first, second = samples.place(16, 0, 47, 8, 5), samples.place(16, 0, 47, 8, 6)
    del first["doJumpId"], second["doJumpId"]
    jumping["params"][0] = 3
    assert read(samples.document(first, jumping, second)).mission[1].param1 == 2


def test_plan_file_with_fence_only() -> None:
    document = samples.document()
    del document["mission"], document["rallyPoints"]
    plan = read(document)
    assert plan.mission == Mission()
    assert plan.fence.circles
    assert written(plan) == document
    document["rallyPoints"] = {"points": [], "version": 1}
    assert read(document).rally == RallyPoints()
    document["rallyPoints"]["points"] = [[1, 2, 3]]
    with pytest.raises(FileFormatError, match=r"rallyPoints.version = 1: expected 2"):
        read(document)


def test_return_point_in_fence_of_version_1_is_refused() -> None:
    document = samples.document()
    document["geoFence"] = {"version": 1}
    assert read(document).fence == Fence()
    document["geoFence"] = {"version": 1, "breachReturn": [47.0, 8.0]}
    with pytest.raises(FileFormatError, match=r"geoFence.version = 1: expected 2"):
        read(document)


# ------------------------------------------------------------------------------------------ writing


def test_unchanged_plan_file_is_written_unchanged() -> None:
    document = samples.full_document()
    plan = read(document)
    assert written(plan) == document
    assert parse_plan(format_plan(plan)) == plan


def test_plan_file_keeps_unchanged_parts() -> None:
    document = samples.full_document()
    plan = read(document)
    speed = plan.replace(cruise_speed_m_s=20.5, vehicle_type=1)
    assert written(speed) == {
        **document,
        "mission": {**document["mission"], "cruiseSpeed": 20.5, "vehicleType": 1},
    }
    rally = plan.replace(rally=RallyPoints([rally_point(47, 8, altitude_relative_m=12.5)]))
    assert written(rally) == {**document, "rallyPoints": {"points": [[47, 8, 12.5]], "version": 2}}
    fence = plan.replace(fence=plan.fence.replace(return_point=None))
    expected = copy.deepcopy(document)
    del expected["geoFence"]["breachReturn"]
    assert written(fence) == expected
    home = plan.replace(mission=plan.mission.replace(home=Position(47.5, 8.5, 400.0)))
    assert written(home)["mission"]["plannedHomePosition"] == [47.5, 8.5, 400]
    assert written(home)["mission"]["items"] == document["mission"]["items"]


def test_plan_file_keeps_unchanged_survey() -> None:
    document = samples.full_document()
    plan = read(document)
    extra = waypoint(47.4, 8.5, altitude_amsl_m=600)
    items = (*plan.mission[:5], extra, *plan.mission[5:])
    changed = plan.replace(mission=plan.mission.replace(items=[*items[:7], jump(6, repeat=3), *items[8:]]))
    entries = written(changed)["mission"]["items"]
    assert entries[1] == document["mission"]["items"][1]
    assert entries[2] == {
        "AMSLAltAboveTerrain": None,
        "Altitude": 600,
        "AltitudeMode": 2,
        "autoContinue": True,
        "command": 16,
        "doJumpId": 6,
        "frame": 0,
        "params": [0, 0, 0, None, 47.4, 8.5, 600],
        "type": "SimpleItem",
    }
    assert entries[3] == {**document["mission"]["items"][2], "doJumpId": 7}
    assert entries[4]["params"][0] == 7
    assert entries[-1] == document["mission"]["items"][-1]
    assert parse_plan(format_plan(changed)) == changed


def test_changed_survey_becomes_simple_items() -> None:
    plan = read(samples.full_document())
    items = list(plan.mission)
    items[3] = items[3].replace(z=60.0)
    changed = plan.replace(mission=plan.mission.replace(items=items))
    entries = written(changed)["mission"]["items"]
    assert [entry["type"] for entry in entries] == ["SimpleItem"] * 7 + ["ComplexItem"]
    assert parse_plan(format_plan(changed)) == changed


def test_jump_into_landing_pattern_makes_it_simple_items() -> None:
    plan = read(samples.full_document())
    first_of_landing = 7
    items = [*plan.mission, jump(first_of_landing, repeat=1)]
    changed = plan.replace(mission=plan.mission.replace(items=items))
    entries = written(changed)["mission"]["items"]
    assert entries[-1]["params"][0] == entries[-7]["doJumpId"]
    assert parse_plan(format_plan(changed)) == changed


def test_new_plan_file(tmp_path: Path) -> None:
    mission = Mission(
        [take_off(47, 8, altitude_relative_m=10), set_servo(9, 1500), jump(0, repeat=2), return_to_launch()],
        Position(47.1, 8.1, 500.0),
    )
    plan = Plan(mission, firmware_type=3, vehicle_type=13)
    path = tmp_path / "new.plan"
    write_plan_file(path, plan)
    assert read_plan_file(path) == plan
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["fileType"] == "Plan"
    assert document["mission"]["plannedHomePosition"] == [47.1, 8.1, 500]
    assert document["mission"]["items"][2] == samples.simple(177, 3, 2, 1, 2)
    assert [entry["doJumpId"] for entry in document["mission"]["items"]] == [1, 2, 3, 4]


def test_plan_comparison_ignores_source() -> None:
    plan = read(samples.full_document())
    assert plan == plan.replace(source="")
    assert hash(plan) == hash(plan.replace(source=""))
    assert "source" not in repr(plan)
    assert plan != plan.replace(hover_speed_m_s=1.0)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (
            Plan(rally=RallyPoints([rally_point(47, 8, altitude_amsl_m=5)])),
            r"rally\[0\]: frame = .* only altitudes above home",
        ),
        (Plan(fence=Fence(return_point=Position(47, 8, 500.0))), "return_point.altitude_amsl_m = 500.0"),
        (Plan(Mission([MissionItem(16, 3, math.inf)])), "not finite"),
        (Plan(source="{"), "the plan cannot be written: .*the text is not valid JSON"),
    ],
)
def test_plan_file_rejects_values_it_cannot_store(plan: Plan, message: str) -> None:
    with pytest.raises(InvalidArgument, match=message):
        format_plan(plan)


latitudes = st.floats(-90, 90)
longitudes = st.floats(-180, 180)
heights = st.floats(-1e6, 1e6)
places = st.builds(Position, latitudes, longitudes)
numbers = st.floats(allow_infinity=False) | st.just(NAN)
raw_items = st.builds(
    MissionItem,
    st.sampled_from([16, 17, 20, 22, 93, 177, 178, 183, 189, 195, 203, 2000, 31010, 40000]),
    st.sampled_from([0, 2, 3, 6, 10]),
    numbers,
    numbers,
    numbers,
    numbers,
    st.integers(-900000000, 900000000),
    st.integers(-1800000000, 1800000000),
    st.floats(allow_infinity=False, allow_nan=False),
    st.booleans(),
)


def with_real_jumps(items: list[MissionItem]) -> list[MissionItem]:
    last = len(items) - 1
    return [item.replace(param1=float(i % (last + 1))) if item.command == 177 else item for i, item in enumerate(items)]


missions = st.builds(
    Mission,
    st.lists(raw_items, max_size=6).map(with_real_jumps),
    st.none() | st.builds(Position, latitudes, longitudes, st.none() | heights),
)
fences = st.builds(
    Fence,
    st.lists(st.builds(FencePolygon, st.lists(places, min_size=3, max_size=5), st.booleans()), max_size=3),
    st.lists(st.builds(FenceCircle, places, st.floats(0.1, 1e6), st.booleans()), max_size=3),
    st.none() | st.builds(Position, latitudes, longitudes, st.none(), st.none() | heights),
)
points = st.builds(
    lambda lat, lon, z: rally_point(lat, lon, altitude_relative_m=z),
    latitudes,
    longitudes,
    st.floats(-1e4, 1e4),
)
plans = st.builds(
    Plan,
    missions,
    fences,
    st.builds(RallyPoints, st.lists(points, max_size=3)),
    st.integers(0, 255),
    st.integers(0, 255),
    st.floats(0, 100),
    st.floats(0, 100),
)


@given(plans)
def test_plan_file_round_trip(plan: Plan) -> None:
    text = format_plan(plan)
    assert parse_plan(text) == plan
    assert format_plan(parse_plan(text)) == text


@given(plans, missions)
def test_changed_plan_file_round_trip(plan: Plan, mission: Mission) -> None:
    read_plan = read(samples.full_document())
    for changed in (read_plan.replace(mission=mission), plan.replace(source=read_plan.source)):
        assert parse_plan(format_plan(changed)) == changed


# ----------------------------------------------------------------------------------------- damaged


def at(document: Any, *path: str | int) -> Any:
    for key in path:
        document = document[key]
    return document


DAMAGES: list[tuple[tuple[str | int, ...], object, str]] = [
    (("fileType",), "Mission", 'fileType = "Mission": expected "Plan"'),
    (("version",), 2, "version = 2: expected 1"),
    (("mission",), [], "mission = .*: expected an object"),
    (("mission", "version"), 1, "mission.version = 1: expected 2"),
    (("mission", "items"), {}, "mission.items = {}: expected an array"),
    (("mission", "items", 0), 5, r"mission.items\[0\] = 5: expected an object"),
    (
        ("mission", "items", 0, "type"),
        "Item",
        r'items\[0\].type = "Item": expected "SimpleItem" or "ComplexItem"',
    ),
    (
        ("mission", "items", 0, "command"),
        70000,
        r"items\[0\].command = 70000: expected a whole number from 0 to 65535",
    ),
    (("mission", "items", 0, "command"), True, r"items\[0\].command = true"),
    (("mission", "items", 0, "frame"), 1.5, r"items\[0\].frame = 1.5"),
    (("mission", "items", 0, "autoContinue"), 1, r"items\[0\].autoContinue = 1: expected true or false"),
    (("mission", "items", 0, "params"), [1], r"items\[0\].params = .* 7 values; it has 1"),
    (("mission", "items", 0, "params", 1), "x", r'items\[0\].params\[1\] = "x": expected a number, or null'),
    (
        ("mission", "items", 0, "params", 4),
        91,
        r"params\[4\] = 91: expected a number from -90 to 90, or null",
    ),
    (("mission", "items", 0, "params", 5), -181, r"params\[5\] = -181: expected a number from -180 to 180"),
    (("mission", "items", 0, "params", 6), 10**400, r"params\[6\] = 1000.*: expected a number"),
    (
        ("mission", "items", 3, "params", 0),
        99,
        r"items\[3\].params\[0\] = 99: expected the doJumpId of an item",
    ),
    (
        ("mission", "items", 1, "TransectStyleComplexItem", "Items"),
        [],
        r"items\[1\] = .*: expected a complex item with TransectStyleComplexItem.Items; this is a 'survey'",
    ),
    (
        ("mission", "items", 1),
        {"type": "ComplexItem", "complexItemType": "StructureScan"},
        r"items\[1\] = .*: expected a complex item with .* this is a 'StructureScan'",
    ),
    (
        ("mission", "items", 1, "TransectStyleComplexItem", "Items", 2, "params", 4),
        91,
        r"mission.items\[1\].TransectStyleComplexItem.Items\[2\].params\[4\] = 91",
    ),
    (("mission", "items", 4, "landCoordinate"), [1, 2], r"items\[4\].landCoordinate = .* 3 values"),
    (("mission", "items", 4, "loiterRadius"), -1, r"loiterRadius = -1: expected a number from 0 on"),
    (("mission", "plannedHomePosition"), [91, 0, 0], r"plannedHomePosition\[0\] = 91"),
    (("mission", "firmwareType"), "px4", 'firmwareType = "px4"'),
    (("geoFence", "version"), 3, "geoFence.version = 3: expected 2"),
    (
        ("geoFence", "polygons", 0, "polygon"),
        [[1, 2], [3, 4]],
        r"polygons\[0\].polygon = .* at least 3 positions",
    ),
    (("geoFence", "polygons", 0, "polygon", 2), [1], r"polygons\[0\].polygon\[2\] = .* array of 2 values"),
    (
        ("geoFence", "polygons", 0, "inclusion"),
        None,
        r"polygons\[0\].inclusion = null: expected true or false",
    ),
    (
        ("geoFence", "circles", 0, "circle", "radius"),
        0,
        r"circle.radius = 0: expected a number of metres above 0",
    ),
    (("geoFence", "circles", 0, "circle", "radius"), None, r"circle.radius = null: expected a number"),
    (("geoFence", "circles", 0, "circle", "center", 0), -90.5, r"circle.center\[0\] = -90.5"),
    (("geoFence", "breachReturn"), 5, "geoFence.breachReturn = 5: expected an array"),
    (("rallyPoints", "points", 1), [1, 2], r"rallyPoints.points\[1\] = .* array of 3 values"),
    (("rallyPoints", "points", 1, 2), None, r"rallyPoints.points\[1\]\[2\] = null: expected a number"),
]


@pytest.mark.parametrize(("path", "value", "message"), DAMAGES)
def test_plan_file_error_names_invalid_value(path: tuple[str | int, ...], value: object, message: str) -> None:
    document = samples.full_document()
    at(document, *path[:-1])[path[-1]] = value
    with pytest.raises(FileFormatError, match=r"^test\.plan: .*" + message):
        read(document)


@pytest.mark.parametrize(
    "path",
    [
        ("fileType",),
        ("version",),
        ("mission", "items"),
        ("mission", "items", 0, "params"),
        ("mission", "items", 1, "complexItemType"),
        ("mission", "items", 4, "altitudesAreRelative"),
        ("geoFence", "version"),
        ("geoFence", "circles", 0, "circle", "radius"),
        ("rallyPoints", "points"),
    ],
)
def test_plan_file_error_names_missing_value(path: tuple[str | int, ...]) -> None:
    document = samples.full_document()
    del at(document, *path[:-1])[path[-1]]
    with pytest.raises(FileFormatError, match=f"^test.plan: .* has no '{path[-1]}'"):
        read(document)


def test_plan_file_error_names_all_missing_values() -> None:
    document = samples.full_document()
    for path in (("version",), ("mission", "items", 0, "command"), ("mission", "items", 0, "params")):
        del at(document, *path[:-1])[path[-1]]
    del document["geoFence"]["circles"][0]["circle"]["center"]
    with pytest.raises(FileFormatError) as caught:
        read(document)
    assert str(caught.value) == (
        "test.plan: required fields are missing: the document has no 'version'; mission.items[0] has no 'command' and"
        " 'params'; geoFence.circles[0].circle has no 'center'"
    )


def test_plan_file_error_counts_further_incomplete_items() -> None:
    document = samples.full_document()
    document["mission"]["items"] = [{"type": "SimpleItem"}] * 9
    with pytest.raises(
        FileFormatError, match=r"items\[4\] has no 'command'.*'autoContinue'; 4 more objects are incomplete"
    ):
        read(document)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "x.plan: line 1, column 1: the text is not valid JSON"),
        ('{\n "fileType": \n}', "x.plan: line 3, column 1: the text is not valid JSON"),
        ('{"version": NaN}', "x.plan: the text is not valid JSON: NaN is not allowed"),
        ("[" * 100_000, "x.plan: the text is not valid JSON"),
        ("[]", "x.plan: the document = .*: expected an object"),
        ('{"fileType": "Plan", "version": 1}', "the document has no 'mission'"),
    ],
)
def test_other_files_are_rejected_as_plan(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.plan"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=message):
        read_plan_file(path)


def test_plan_file_with_invalid_utf8_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "x.plan"
    path.write_bytes(b'{"a": "\xff"}')
    with pytest.raises(FileFormatError, match=r"x.plan: byte 7 is not valid UTF-8"):
        read_plan_file(path)
    path.write_bytes(b"\xef\xbb\xbf" + samples.text(samples.full_document()).encode())
    assert len(read_plan_file(path).mission) == 13


def damaged(value: Any, rng: random.Random, junk: Callable[[], Any]) -> Any:
    """Return the document with one value replaced or removed."""
    document = copy.deepcopy(value)
    node = document
    while isinstance(node, (dict, list)) and node:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = rng.choice(keys)
        if not isinstance(node[key], (dict, list)) or not node[key] or rng.random() < 0.2:
            if rng.random() < 0.3:
                del node[key]
            else:
                node[key] = junk()
            break
        node = node[key]
    return document


@given(
    st.integers(0, 2**32),
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
    | st.just([]),
)
def test_damaged_plan_file_raises_only_our_errors(seed: int, junk: object) -> None:
    document = damaged(samples.full_document(), random.Random(seed), lambda: junk)
    try:
        plan = read(document)
    except FileFormatError:
        return
    assert written(plan) == document


def test_plan_file_of_other_version_is_not_called_incomplete() -> None:
    with pytest.raises(FileFormatError, match=r"version.*9") as caught:
        read({"fileType": "Plan", "version": 9})
    assert "required" not in str(caught.value)


def test_mission_is_written_as_plan_without_other_parts(tmp_path: Path) -> None:
    mission = Mission([take_off(15), return_to_launch()])
    write_plan_file(tmp_path / "two.plan", mission)
    assert read_plan_file(tmp_path / "two.plan") == Plan(mission)


def test_plan_file_of_other_type_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "two.plan"
    items: Any = [take_off(15)]
    with pytest.raises(InvalidArgument, match=r"^plan = .* is neither a Plan nor a Mission: pass Mission\(\[…\]\), or"):
        write_plan_file(path, items)
    assert not path.exists()
