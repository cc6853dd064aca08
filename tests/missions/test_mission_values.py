"""Mission objects: their values, refused items, and home and jumps in the vehicle's numbering."""

from __future__ import annotations

import math
import pickle

import pytest

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions import Fence, FenceCircle, FencePolygon, Mission, MissionItem, RallyPoints
from aerokit.position import Position

WAYPOINT = MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL_RELATIVE_ALT, x=473977419, y=85455940, z=30.0)
RTL = MissionItem(MavCmd.NAV_RETURN_TO_LAUNCH, MavFrame.MISSION)
HOME = Position(47.3977419, 8.545594, altitude_amsl_m=488.0)


def jump(to: float, times: float = 3) -> MissionItem:
    return MissionItem(MavCmd.DO_JUMP, MavFrame.MISSION, float(to), float(times))


def test_mission_behaves_like_tuple_of_items() -> None:
    mission = Mission([WAYPOINT, RTL])
    assert mission.items == (WAYPOINT, RTL)
    assert len(mission) == 2
    assert mission[1] == RTL
    assert mission[:1] == (WAYPOINT,)
    assert list(mission) == [WAYPOINT, RTL]
    assert mission == Mission((WAYPOINT, RTL))
    assert hash(mission) == hash(Mission((WAYPOINT, RTL)))
    assert mission != Mission([WAYPOINT])
    mission.check()


def test_items_with_nan_are_equal() -> None:
    one, other = WAYPOINT.replace(param4=math.nan), WAYPOINT.replace(param4=float("nan"))
    assert one == other
    assert hash(one) == hash(other)
    assert one != WAYPOINT
    assert pickle.loads(pickle.dumps(Mission([one]))) == Mission([other])


def test_item_position() -> None:
    assert WAYPOINT.position == Position(47.3977419, 8.545594, altitude_relative_m=30.0)
    assert WAYPOINT.replace(frame=MavFrame.GLOBAL_INT).position == Position(47.3977419, 8.545594, 30.0)
    assert WAYPOINT.replace(frame=11).position == Position(47.3977419, 8.545594)
    assert WAYPOINT.replace(x=0, y=0).position is None
    assert WAYPOINT.replace(x=910000000).position is None
    assert WAYPOINT.replace(frame=MavFrame.LOCAL_NED).position is None
    assert RTL.position is None
    assert WAYPOINT.name == "NAV_WAYPOINT"
    assert WAYPOINT.replace(command=64000).name == "command 64000"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"x": 910000000},
            r"item 1 \(NAV_WAYPOINT\): x = 910000000 .* latitude of -90 to 90 .* this is 91",
        ),
        ({"y": -1800000001}, r"y = .* longitude"),
        ({"x": 47.4}, "x = 47.4 .* an integer"),
        ({"frame": MavFrame.MISSION}, "frame = .* a global frame"),
        ({"frame": MavFrame.BODY_NED}, "frame"),
        ({"frame": 99}, "frame = 99 .* MAV_FRAME"),
        ({"frame": -1}, "frame = -1"),
        ({"command": 70000}, "item 1: command = 70000 .* 0 to 65535"),
        ({"command": True}, "command = True"),
        ({"command": MavCmd.NAV_RALLY_POINT}, "command = 5100 .* in a mission"),
        ({"command": MavCmd.NAV_FENCE_CIRCLE_INCLUSION}, "command = 5003"),
        ({"param1": math.nan}, "param1 = nan .* finite"),
        ({"param4": math.inf}, "param4 = inf .* or NaN"),
        ({"param2": 1e39}, "param2 = 1e.39 .* 32 bits"),
        ({"param3": "1"}, "param3 = '1' .* a number"),
        ({"z": math.nan}, "z = nan"),
        ({"autocontinue": 1}, "autocontinue = 1"),
    ],
)
def test_check_rejects_invalid_items(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidArgument, match=message):
        Mission([RTL, WAYPOINT.replace(**changes)]).check()


def test_check_accepts_standard_values() -> None:
    for changes in (
        {"param4": math.nan},
        {"x": 0x7FFFFFFF, "y": 0x7FFFFFFF},
        {"frame": MavFrame.LOCAL_NED, "x": -(10**9)},
    ):
        Mission([WAYPOINT.replace(**changes)]).check()
    Mission([RTL.replace(param1=math.nan, z=math.nan), RTL.replace(frame=0)]).check()


def test_check_rejects_other_objects() -> None:
    with pytest.raises(InvalidArgument, match="item 1 = 'land' is not a MissionItem"):
        Mission([WAYPOINT, "land"])  # type: ignore[list-item]
    with pytest.raises(InvalidArgument, match="item 0 = None"):
        RallyPoints([None])  # type: ignore[list-item]


@pytest.mark.exhaustive
def test_check_rejects_too_many_items() -> None:
    Mission([RTL] * 65_535).check()
    with pytest.raises(InvalidArgument, match="65536 items are too many: at most 65535"):
        Mission([RTL] * 65_536).check()
    with pytest.raises(InvalidArgument, match="65535 items are too many: at most 65534"):
        Mission([RTL] * 65_535).check(home_is_item_0=True)


@pytest.mark.parametrize("target", [-1, 2, 0.5, 70000])
def test_check_rejects_jump_outside_mission(target: float) -> None:
    with pytest.raises(InvalidArgument, match=r"item 1 \(DO_JUMP\): param1 = .* 0 to 1"):
        Mission([WAYPOINT, jump(target)]).check()


def test_check_rejects_unknown_jump_tag() -> None:
    tag = MissionItem(MavCmd.JUMP_TAG, MavFrame.MISSION, 7.0)
    leap = MissionItem(MavCmd.DO_JUMP_TAG, MavFrame.MISSION, 7.0, 1.0)
    Mission([tag, WAYPOINT, leap]).check()
    with pytest.raises(InvalidArgument, match=r"DO_JUMP_TAG.*param1 = 8"):
        Mission([tag, leap.replace(param1=8.0)]).check()


def test_home_is_removed_and_jumps_adjusted() -> None:
    mission = Mission([WAYPOINT, jump(0), RTL], HOME)
    items = mission.to_items(home_is_item_0=True)
    assert len(items) == 4
    assert items[0] == MissionItem(MavCmd.NAV_WAYPOINT, 0, x=473977419, y=85455940, z=488.0)
    assert items[2].param1 == 1
    assert Mission.from_items(items, home_is_item_0=True) == mission
    assert mission.to_items() == mission.items
    assert Mission.from_items(mission.items) == mission.replace(home=None)


def test_unknown_home_and_empty_mission_convert() -> None:
    assert Mission().to_items(home_is_item_0=True) == (MissionItem(MavCmd.NAV_WAYPOINT, 0),)
    assert Mission.from_items([], home_is_item_0=True) == Mission()
    assert Mission.from_items(Mission().to_items(home_is_item_0=True), home_is_item_0=True) == Mission()


SQUARE = [Position(47.0, 8.0), Position(47.0, 8.1), Position(47.1, 8.1), Position(47.1, 8.0)]


def test_fence_items_round_trip() -> None:
    fence = Fence(
        polygons=[FencePolygon(SQUARE), FencePolygon(SQUARE[:3], inclusion=False)],
        circles=[
            FenceCircle(HOME.replace(altitude_amsl_m=None), 300.5),
            FenceCircle(SQUARE[0], 5, inclusion=False),
        ],
        return_point=Position(47.05, 8.05, altitude_relative_m=40.0),
    )
    items = fence.to_items()
    assert [item.command for item in items] == [5001] * 4 + [5002] * 3 + [5003, 5004, 5000]
    assert [item.param1 for item in items] == [4] * 4 + [3] * 3 + [300.5, 5, 0]
    assert Fence.from_items(items) == fence
    fence.check()
    assert Fence.from_items(()) == Fence()


@pytest.mark.parametrize("frame", [MavFrame.GLOBAL, MavFrame.GLOBAL_INT])
def test_return_point_without_altitude_has_none(frame: int) -> None:
    fence = Fence(return_point=SQUARE[0])
    [item] = fence.to_items()
    assert Fence.from_items([item.replace(frame=frame)]) == fence


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FencePolygon(SQUARE[:2]), "2 places; a polygon needs at least 3"),
        (
            lambda: FencePolygon([1, 2, 3]),  # type: ignore[list-item]
            r"vertices\[0\] = 1 is not a Position",
        ),
        (lambda: FenceCircle(SQUARE[0], 0), "radius_m = 0 is not allowed"),
        (lambda: FenceCircle(SQUARE[0], math.nan), "radius_m = nan"),
        (
            lambda: FenceCircle(SQUARE[0], "5"),  # type: ignore[arg-type]
            "radius_m = '5' is not allowed",
        ),
        (
            lambda: FenceCircle((1, 2), 3),  # type: ignore[arg-type]
            r"center = \(1, 2\)",
        ),
        (
            lambda: Fence([FenceCircle(SQUARE[0], 1)]),  # type: ignore[list-item]
            r"polygons\[0\] .* not a FencePolygon",
        ),
    ],
)
def test_invalid_fence_is_rejected(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InvalidArgument, match=message):
        make()


def test_rally_points_round_trip() -> None:
    item = MissionItem(MavCmd.NAV_RALLY_POINT, MavFrame.GLOBAL_RELATIVE_ALT, x=473977419, y=85455940, z=40.0)
    points = RallyPoints([item])
    points.check()
    assert points.positions == (Position(47.3977419, 8.545594, altitude_relative_m=40.0),)
    assert RallyPoints.from_items(points.to_items()) == points
    assert (len(points), points[0], list(points)) == (1, item, [item])
    with pytest.raises(InvalidArgument, match="among rally points"):
        RallyPoints([WAYPOINT]).check()
    with pytest.raises(InvalidArgument, match=r"frame = .* a global frame"):
        RallyPoints([item.replace(frame=2)]).check()
