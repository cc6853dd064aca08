"""Missions made for ArduPilot, converted for other autopilots."""

from __future__ import annotations

from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import DEFAULT_XY, MissionItem
from aerokit.missions.wire import convert_from_ardupilot

RELATIVE, MISSION = MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.MISSION


def item(command: int, x: int = 0, y: int = 0, frame: int = RELATIVE) -> MissionItem:
    return MissionItem(command, frame, x=x, y=y, z=10.0)


def test_item_without_place_gets_mission_frame() -> None:
    speed, local = item(MavCmd.DO_CHANGE_SPEED), item(MavCmd.DO_CHANGE_SPEED, frame=MavFrame.LOCAL_NED)
    roi, unknown = item(MavCmd.DO_SET_ROI), item(60_000)
    assert [item.frame for item in convert_from_ardupilot([speed, local, roi, unknown], None)] == [
        MISSION,
        MavFrame.LOCAL_NED,
        RELATIVE,
        RELATIVE,
    ]


def test_zero_place_becomes_previous_destination() -> None:
    items = [
        item(MavCmd.NAV_TAKEOFF),
        item(MavCmd.NAV_WAYPOINT, 470_000_000, 80_000_000),
        item(MavCmd.NAV_LOITER_UNLIM, DEFAULT_XY, DEFAULT_XY),
        item(MavCmd.DO_SET_ROI),
        item(MavCmd.NAV_LAND),
        item(MavCmd.NAV_WAYPOINT, 0, 5),
        item(MavCmd.NAV_LAND, frame=MavFrame.LOCAL_NED),
    ]
    places = [(item.x, item.y) for item in convert_from_ardupilot(items, (46.5, 8.25))]
    assert places[0] == (465_000_000, 82_500_000)
    assert places[1:4] == [(470_000_000, 80_000_000), (DEFAULT_XY, DEFAULT_XY), (0, 0)]
    assert places[4:] == [(470_000_000, 80_000_000), (0, 5), (0, 0)]
    assert next(iter(convert_from_ardupilot(items, None))) == items[0]
