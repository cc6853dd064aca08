"""Landing patterns in ``.plan`` files: where to descend and where to land, of which QGroundControl makes items.

The file does not keep these items; this makes the ones that QGroundControl sends: the mark where the landing begins,
then what is switched off (speed, photos, video), the approach, the landing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import MissionItem

if TYPE_CHECKING:
    from aerokit.missions.json_values import JsonValue

__all__ = ["LANDING_PATTERNS", "landing_items"]

LANDING_PATTERNS = {"fwLandingPattern": MavCmd.NAV_LAND, "vtolLandingPattern": MavCmd.NAV_VTOL_LAND}


def landing_items(pattern: JsonValue) -> tuple[MissionItem, ...]:
    """The items of a ComplexItem that is one of :data:`LANDING_PATTERNS`."""
    command = LANDING_PATTERNS[pattern["complexItemType"].value]
    relative = pattern["altitudesAreRelative"].boolean()
    frame = MavFrame.GLOBAL_RELATIVE_ALT if relative else MavFrame.GLOBAL
    approach = pattern.child("landingApproachCoordinate") or pattern["loiterCoordinate"]
    heading = 0.0 if command == MavCmd.NAV_LAND else math.nan
    return (
        MissionItem(MavCmd.DO_LAND_START, MavFrame.MISSION),
        *_switched_off(pattern),
        _approach(pattern, frame, approach),
        MissionItem(command, frame, 0.0, 0.0, 0.0, heading, *_place(pattern["landCoordinate"])),
    )


def _switched_off(pattern: JsonValue) -> list[MissionItem]:
    items = []
    if _flag(pattern, "useDoChangeSpeed"):
        speed = pattern["finalApproachSpeed"].number(0)
        items.append(MissionItem(MavCmd.DO_CHANGE_SPEED, MavFrame.MISSION, 0.0, speed, -1.0))
    if _flag(pattern, "stopTakingPhotos"):
        items.append(MissionItem(MavCmd.DO_SET_CAM_TRIGG_DIST, MavFrame.MISSION))
        items.append(MissionItem(MavCmd.IMAGE_STOP_CAPTURE, MavFrame.MISSION))
    if _flag(pattern, "stopVideoPhotos"):
        items.append(MissionItem(MavCmd.VIDEO_STOP_CAPTURE, MavFrame.MISSION))
    return items


def _approach(pattern: JsonValue, frame: MavFrame, place: JsonValue) -> MissionItem:
    """Circling down, and then on from the circle's edge; or a mere waypoint. Older files have circles only."""
    if not _flag(pattern, "useLoiterToAlt", default=True):
        return MissionItem(MavCmd.NAV_WAYPOINT, frame, 0.0, 0.0, 0.0, math.nan, *_place(place))
    radius = pattern["loiterRadius"].number(0)
    turn = radius if pattern["loiterClockwise"].boolean() else -radius
    return MissionItem(MavCmd.NAV_LOITER_TO_ALT, frame, 1.0, turn, 0.0, 1.0, *_place(place))


def _flag(pattern: JsonValue, key: str, *, default: bool = False) -> bool:
    value = pattern.child(key)
    return default if value is None else value.boolean()


def _place(value: JsonValue) -> tuple[int, int, float]:
    latitude, longitude, altitude = value.elements(3)
    x, y = round(latitude.number(-90, 90) * 1e7), round(longitude.number(-180, 180) * 1e7)
    return x, y, altitude.number()
