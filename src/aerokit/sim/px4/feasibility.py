"""What PX4 says of a mission after it has taken it: a mission can arrive whole and be rejected all the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame, MavType

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["outside_fence", "rejection", "warning"]

_C = MavCmd
_TAKE_OFFS = (_C.NAV_TAKEOFF, _C.NAV_VTOL_TAKEOFF)
_LANDINGS = (_C.NAV_LAND, _C.NAV_VTOL_LAND)
_WITH_PLACE = (
    _C.NAV_WAYPOINT,
    _C.NAV_LOITER_UNLIM,
    _C.NAV_LOITER_TIME,
    _C.NAV_LOITER_TO_ALT,
    *_TAKE_OFFS,
    *_LANDINGS,
)
_STORED_ONLY = (_C.CONDITION_DELAY, _C.CONDITION_DISTANCE, _C.NAV_FENCE_RETURN_POINT)
"""Commands that can be sent to it and that no mission may have."""
_VTOL = (_C.NAV_VTOL_TAKEOFF, _C.NAV_VTOL_LAND)
_FAR_M = 10_000.0


def rejection(px4: SimulatedPx4, items: Sequence[MissionItem]) -> str | None:
    """Why such a mission cannot be flown; None when it can. Gliding is not checked."""
    if px4.VEHICLE_TYPE == MavType.QUADROTOR and any(item.command in _VTOL for item in items):
        return "Mission contains VTOL items but vehicle is not a VTOL"
    has_place = False
    for number, item in enumerate(items, start=1):
        if item.command in _STORED_ONLY:
            return f"item {number}: unsupported cmd: {item.command:d}"
        if item.command == _C.NAV_LAND and number == 1 and px4.is_landed:
            return "starts with landing"
        if item.command in _TAKE_OFFS:
            if _height(px4, item) <= 0.0:
                return "Takeoff altitude below home altitude!"
            if has_place:
                return "takeoff not first waypoint item"
        has_place = has_place or item.command in _WITH_PLACE
    return _missing_landing(px4, items) or _landing_problem(items)


def _missing_landing(px4: SimulatedPx4, items: Sequence[MissionItem]) -> str | None:
    """MIS_TKO_LAND_REQ: 1 demands a take-off, 2 a landing, 3 both, 4 both or none; an aeroplane has 2."""
    if "MIS_TKO_LAND_REQ" not in px4.parameters or not items:  # not in the multicopter's table
        return None
    takes_off, lands = (any(item.command in kind for item in items) for kind in (_TAKE_OFFS, _LANDINGS))
    required = round(px4.parameters["MIS_TKO_LAND_REQ"])
    if required == 1 and not takes_off:
        return "Takeoff waypoint required."
    if required == 2 and not lands:
        return "Landing waypoint/pattern required."
    if required == 3 and not (takes_off and lands):
        return "Takeoff or Landing item missing."
    if required == 4 and takes_off != lands:
        return f"Add {'Landing' if takes_off else 'Takeoff'} item or remove {'Takeoff' if takes_off else 'Landing'}."
    return None


def _height(px4: SimulatedPx4, item: MissionItem) -> float:
    above_sea = item.frame == MavFrame.GLOBAL
    return item.z - (px4.frame.origin.altitude_m - px4.home[2]) if above_sea else item.z


def _landing_problem(items: Sequence[MissionItem]) -> str | None:
    start = approach = -1
    for index, item in enumerate(items):
        if item.command == _C.DO_LAND_START:
            if start >= 0:
                return "more than one land start."
            start = index
        elif item.command in _LANDINGS:
            if index == 0:
                return "starts with land waypoint."
            approach = index - 1
        elif item.command == _C.NAV_RETURN_TO_LAUNCH and 0 <= start < index:
            return "land start item before RTL item not possible."
    return "invalid land start." if start > approach else None


def outside_fence(px4: SimulatedPx4, items: Sequence[MissionItem]) -> int | None:
    """The number, from 1 on, of the first item whose place the geofence forbids."""
    for number, item in enumerate(items, start=1):
        if item.command in _WITH_PLACE:
            north, east = px4.frame.to_local(round(item.x), round(item.y))
            if not px4.failsafes.fence.allows((north, east, px4.home[2] - _height(px4, item))):
                return number
    return None


def warning(px4: SimulatedPx4, items: Sequence[MissionItem]) -> str | None:
    """What it says of a mission that it flies nevertheless: the first place is far away, 0, 0 for example."""
    for item in items:
        if item.command in _WITH_PLACE:
            north, east = px4.frame.to_local(round(item.x), round(item.y))
            away = math.hypot(north - px4.home[0], east - px4.home[1])
            if away < _FAR_M:
                return None
            return f"First waypoint far away from home: {int(away)}m. Correct mission loaded?"
    return None
