"""Where a simulated PX4 returns to: home, or the nearest rally point, as RTL_TYPE says.

https://docs.px4.io/main/en/flight_modes/return.html. Simulated: 0 and 3 (the nearest of home and the rally points),
1 (the nearest rally point, home without any); all others go home. Not simulated: returning by way of a mission.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavFrame, MavMissionType

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["return_destination"]

Ned = tuple[float, float, float]
_NEAREST, _RALLY_FIRST = (0, 3), 1
_RELATIVE = (MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.GLOBAL_RELATIVE_ALT_INT)


def return_destination(px4: SimulatedPx4) -> Ned:
    """North, east, and the level that heights above the destination are counted from."""
    kind = round(px4.parameters["RTL_TYPE"])
    points = [_place(px4, item) for item in px4.missions.items(MavMissionType.RALLY)]
    if kind not in (*_NEAREST, _RALLY_FIRST) or not points:
        return px4.home
    candidates = points if kind == _RALLY_FIRST else [px4.home, *points]
    here = (px4.motion.north, px4.motion.east)
    return min(candidates, key=lambda place: math.dist(here, place[:2]))


def _place(px4: SimulatedPx4, item: MissionItem) -> Ned:
    north, east = px4.frame.to_local(round(item.x), round(item.y))
    level = px4.home[2] if item.frame in _RELATIVE else px4.frame.origin.altitude_m
    return (north, east, level - item.z)
