"""Mission comparison: rounding by a firmware is no difference, anything else is."""

from __future__ import annotations

import itertools
import math
import struct

import pytest
from for_each import for_each
from hypothesis import given
from hypothesis import strategies as st

from aerokit.missions import (
    Fence,
    FenceCircle,
    FencePolygon,
    ItemStorage,
    Mission,
    MissionItem,
    RallyPoints,
    change_speed,
    delay,
    jump,
    land,
    loiter_time,
    loiter_turns,
    loiter_unlimited,
    point_gimbal,
    rally_point,
    region_of_interest,
    return_to_launch,
    set_servo,
    spline_waypoint,
    take_off,
    take_photos,
    trigger_camera,
    waypoint,
)
from aerokit.missions.compare import changed_items, item_differences
from aerokit.position import Position

PLACE = (47.3977419, 8.545594)
NAN = math.nan


def f32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def returned(item: MissionItem, **changes: object) -> MissionItem:
    """Return the item rounded to 32-bit floats, with the given fields changed."""
    numbers = {name: f32(getattr(item, name)) for name in ("param1", "param2", "param3", "param4", "z")}
    return item.replace(**numbers).replace(**changes)


ARDUPILOT = [  # (sent item, item returned by ArduPilot 4.7)
    (waypoint(*PLACE, altitude_relative_m=30.29, hold_s=2.5), {"param1": 2, "param4": 0, "z": f32(30.28)}),
    (waypoint(*PLACE, altitude_relative_m=30, acceptance_radius_m=7), {"param2": 0, "param4": 0}),  # Copter
    (
        waypoint(*PLACE, altitude_relative_m=30, acceptance_radius_m=300),
        {"param2": 255, "param4": 0},
    ),  # Plane
    (waypoint(*PLACE, altitude_terrain_m=30), {"frame": 10, "param4": 0}),
    (spline_waypoint(*PLACE, altitude_amsl_m=500.5, hold_s=3), {}),
    (take_off(altitude_relative_m=20, pitch_deg=12.5), {"param1": 12, "param4": 0}),
    (land(), {"param4": 1}),
    (land(yaw_deg=-20), {"param4": -1}),
    (loiter_unlimited(*PLACE, altitude_relative_m=9, radius_m=-60.7), {"param3": -60, "param4": 0}),
    (loiter_turns(0.3, *PLACE, altitude_relative_m=9, radius_m=-777), {"param1": 76 / 256, "param3": -770}),
    (loiter_turns(3.5, *PLACE, altitude_relative_m=9, radius_m=80.5), {"param1": 3, "param3": 80}),
    (loiter_time(9.5, *PLACE, altitude_relative_m=9, radius_m=80.5), {"param1": 9, "param3": 1}),
    (region_of_interest(*PLACE, altitude_amsl_m=9), {}),
    (return_to_launch(), {"frame": 0}),
    (
        return_to_launch().replace(frame=3, x=473977419, y=85455940, z=20.0),
        {"frame": 0, "x": 0, "y": 0, "z": 0.0},
    ),
    (change_speed(7.3), {"frame": 0}),
    (delay(2.25), {"frame": 0}),
    (jump(0, repeat=-1), {"frame": 0}),
    (set_servo(9, 1500), {"frame": 0}),
    (trigger_camera(), {"frame": 0}),
    (take_photos(3, interval_s=1.5).replace(param1=1.0), {"frame": 0}),
    (point_gimbal(pitch_deg=-45), {"frame": 0}),
]


@for_each("sent, changes", ARDUPILOT)
def test_comparison_ignores_ardupilot_conversions(sent: MissionItem, changes: dict[str, object]) -> None:
    received = returned(sent, **changes)
    assert item_differences(sent, received, ItemStorage.ARDUPILOT) == ()
    assert item_differences(sent, received) == ()
    assert item_differences(sent, received.replace(autocontinue=True)) == ()


PX4 = [
    (waypoint(*PLACE, altitude_relative_m=30.29, hold_s=2.5, pass_by_m=4), {"frame": 6, "param3": 0}),
    (waypoint(*PLACE, altitude_amsl_m=500, yaw_deg=-90), {"frame": 5, "param4": f32(270.00001)}),
    (waypoint(*PLACE, altitude_amsl_m=500, yaw_deg=-0.0001), {"frame": 5, "param4": 0.0}),
    (take_off(*PLACE, altitude_relative_m=20, pitch_deg=12), {"frame": 6, "param1": 0}),
    (land(*PLACE, precision=1, abort_altitude_m=20), {"frame": 6, "param1": 0}),
    (loiter_unlimited(*PLACE, altitude_relative_m=9, radius_m=-60.7), {"frame": 6}),
    (loiter_time(9.5, *PLACE, altitude_relative_m=9, leave_tangentially=True), {"frame": 6}),
    (region_of_interest(*PLACE, altitude_relative_m=9), {"frame": 6}),
    (return_to_launch(), {}),
    (change_speed(7.3), {}),
    (jump(0, repeat=-1), {"param2": 65535}),
    (trigger_camera(), {}),
]


@for_each("sent, changes", PX4)
def test_comparison_ignores_px4_conversions(sent: MissionItem, changes: dict[str, object]) -> None:
    received = returned(sent, **changes)
    assert item_differences(sent, received, ItemStorage.PX4) == ()
    assert item_differences(sent, received) == ()


WAYPOINT = waypoint(*PLACE, altitude_relative_m=30, hold_s=5)


@pytest.mark.parametrize("storage", list(ItemStorage))
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"command": 17}, "the command is NAV_LOITER_UNLIM instead of NAV_WAYPOINT"),
        ({"frame": 0}, "frame is 0 instead of"),
        ({"frame": 10}, "frame is 10"),
        ({"param1": 4.0}, "param1 is 4.0 instead of 5.0"),
        ({"param1": NAN}, "param1 is nan"),
        ({"param4": 10.0}, "param4 is 10.0 instead of nan"),
        ({"x": 473977421}, "x is 473977421 instead of 473977419"),
        ({"y": 85455938}, "y is 85455938"),
        ({"z": 30.1}, "z is 30.1 instead of 30.0"),
        ({"z": NAN}, "z is nan"),
    ],
)
def test_comparison_reports_real_differences(changes: dict[str, object], text: str, storage: ItemStorage) -> None:
    (difference,) = item_differences(WAYPOINT, WAYPOINT.replace(**changes), storage)
    assert text in difference


@for_each("sent, storage", list(itertools.product([item for item, _ in ARDUPILOT + PX4], list(ItemStorage))))
def test_comparison_of_item_with_itself_is_empty(sent: MissionItem, storage: ItemStorage) -> None:
    assert item_differences(sent, sent, storage) == ()
    assert item_differences(sent, returned(sent), storage) == ()
    near = sent.replace(x=sent.x + 1, y=sent.y - 1) if sent.position else sent
    assert item_differences(sent, near, storage) == ()


def test_wire_comparison_reports_other_changes() -> None:
    sent = waypoint(*PLACE, altitude_relative_m=30, hold_s=2.5)
    assert item_differences(sent, sent.replace(param1=2.0, frame=6), ItemStorage.WIRE)
    assert not item_differences(sent, sent.replace(frame=6), ItemStorage.WIRE)
    assert item_differences(sent.replace(autocontinue=False), sent, ItemStorage.WIRE) == (
        "autocontinue is True instead of False",
    )
    assert not item_differences(sent.replace(autocontinue=False), sent, ItemStorage.ARDUPILOT)
    assert item_differences(sent.replace(autocontinue=False), sent, ItemStorage.PX4)
    assert item_differences(return_to_launch(), return_to_launch().replace(frame=0), ItemStorage.PX4)


def test_mission_comparison() -> None:
    mission = Mission([take_off(altitude_relative_m=10), WAYPOINT, return_to_launch()])
    assert mission.matches(mission.replace(home=Position(1, 2)))
    other = Mission([mission[0], WAYPOINT.replace(z=20.0)])
    assert mission.differences(other) == (
        "there are 2 items instead of 3",
        "item 1 (NAV_WAYPOINT): z is 20.0 instead of 30.0",
    )
    assert not mission.matches(other)
    assert changed_items(mission.items, other.items) == (1, 2)
    assert changed_items(other.items, mission.items) == (1,)


def test_fence_comparison() -> None:
    corners = [Position(47.0, 8.0), Position(47.0, 8.1), Position(47.1, 8.1)]
    fence = Fence([FencePolygon(corners)], [FenceCircle(corners[0], 100.3)], Position(47, 8, altitude_relative_m=20))
    ardupilot = Fence.from_items([returned(item, frame=0, z=0.0, autocontinue=False) for item in fence.to_items()])
    px4 = Fence.from_items([returned(item, frame=5) for item in fence.to_items()])
    assert fence.matches(ardupilot, ItemStorage.ARDUPILOT)
    assert fence.matches(px4, ItemStorage.PX4)
    assert fence.matches(ardupilot)
    smaller = fence.replace(circles=[FenceCircle(corners[0], 90)])
    assert fence.differences(smaller) == ("item 3 (NAV_FENCE_CIRCLE_INCLUSION): param1 is 90 instead of 100.3",)
    assert not fence.matches(Fence())


def test_rally_point_comparison() -> None:
    points = RallyPoints([rally_point(*PLACE, altitude_relative_m=30.7)])
    assert points.matches(RallyPoints([returned(points[0], z=30.0, autocontinue=False)]), ItemStorage.ARDUPILOT)
    assert points.matches(RallyPoints([returned(points[0], frame=6)]), ItemStorage.PX4)
    assert not points.matches(RallyPoints([returned(points[0], z=29.0)]))


numbers = st.floats(width=32) | st.integers(-300, 300).map(float) | st.just(NAN)
items = st.builds(
    MissionItem,
    st.sampled_from([16, 17, 18, 19, 20, 21, 22, 82, 93, 112, 177, 178, 183, 203, 205, 1000, 2000, 5001, 5100, 42702]),
    st.sampled_from([0, 2, 3, 6, 10]),
    numbers,
    numbers,
    numbers,
    numbers,
    st.integers(-(2**31), 2**31 - 1),
    st.integers(-(2**31), 2**31 - 1),
    numbers,
)


@given(items, items, st.sampled_from(list(ItemStorage)))
def test_comparison_accepts_any_items(one: MissionItem, other: MissionItem, storage: ItemStorage) -> None:
    assert item_differences(one, one, storage) == ()
    texts = item_differences(one, other.replace(command=one.command), storage)
    assert all(" instead of " in text for text in texts)
    if storage is not ItemStorage.ANY:  # ANY accepts what a specific autopilot accepts
        assert len(item_differences(one, other, ItemStorage.ANY)) <= len(item_differences(one, other, storage))


def test_comparison_tolerates_32_bit_places() -> None:
    sent = waypoint(-34.3, 149.1662345, altitude_relative_m=30)
    came = returned(sent, x=round(f32(-34.3) * 1e7), y=round(f32(149.1662345) * 1e7))
    assert item_differences(sent, came)
    assert not item_differences(sent, came, single_precision=True)
    assert item_differences(sent, sent.replace(y=sent.y + 500), single_precision=True)
