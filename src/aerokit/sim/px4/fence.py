"""The geofence of a simulated PX4: distances from home and the polygons and circles that were sent."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavMissionType, MavSeverity
from aerokit.sim.px4.texts import OUTSIDE, TOO_FAR, TOO_HIGH

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Fence"]


_C = MavCmd
_POLYGONS = {_C.NAV_FENCE_POLYGON_VERTEX_INCLUSION: True, _C.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False}
_CIRCLES = {_C.NAV_FENCE_CIRCLE_INCLUSION: True, _C.NAV_FENCE_CIRCLE_EXCLUSION: False}
_NO_ACTION, _WARNING = 0, 1

Ned = tuple[float, float, float]


class Fence:
    """What PX4 checks of a place while GF_ACTION is not 0. One inclusion is enough to be inside."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self._is_valid = True

    def uploaded(self) -> None:
        """Another list of areas: one that home is not in is told, and not looked at."""
        home = self._px4.home
        self._is_valid = self._areas_allow(home[0], home[1])
        if not self._is_valid:
            self._px4.send_text(MavSeverity.CRITICAL, "Geofence invalid, doesn't contain Home position")

    @property
    def breaches(self) -> list[str]:
        """What is violated now, as the texts that tell it; nothing while GF_ACTION is 0."""
        motion = self._px4.motion
        if round(self._px4.parameters["GF_ACTION"]) == _NO_ACTION:
            return []
        return self.breaches_at((motion.north, motion.east, motion.down))

    def allows(self, place: Ned) -> bool:
        """Whether the vehicle may be sent there: with no action, or a warning only, anywhere."""
        action = round(self._px4.parameters["GF_ACTION"])
        return action in (_NO_ACTION, _WARNING) or not self.breaches_at(place)

    def breaches_at(self, place: Ned) -> list[str]:
        """What would be violated at a place (metres north, east, down)."""
        px4, (north, east, down) = self._px4, place
        farthest, highest = px4.parameters["GF_MAX_HOR_DIST"], px4.parameters["GF_MAX_VER_DIST"]
        found = []
        if 0 < farthest < math.hypot(north - px4.home[0], east - px4.home[1]):
            found.append(TOO_FAR)
        if 0 < highest < px4.home[2] - down:
            found.append(TOO_HIGH)
        if not self._is_inside(north, east):
            found.append(OUTSIDE)
        return found

    def _is_inside(self, north: float, east: float) -> bool:
        if not self._is_valid or not self._px4.missions.count(MavMissionType.FENCE):
            return True
        return self._areas_allow(north, east)

    def _areas_allow(self, north: float, east: float) -> bool:
        areas = list(self._areas(north, east))
        if any(inside for is_inclusion, inside in areas if not is_inclusion):
            return False
        inclusions = [inside for is_inclusion, inside in areas if is_inclusion]
        return not inclusions or any(inclusions)

    def _areas(self, north: float, east: float) -> Iterator[tuple[bool, bool]]:
        """Of each area whether it includes, and whether the place is in it."""
        items, index = self._items(), 0
        while index < len(items):
            item = items[index]
            if item.command in _POLYGONS:
                count = max(1, int(item.param1))
                corners = [self._place(each) for each in items[index : index + count]]
                yield _POLYGONS[MavCmd(item.command)], _is_in_polygon(corners, north, east)
                index += count
                continue
            if item.command in _CIRCLES:
                centre = self._place(item)
                inside = math.dist(centre, (north, east)) <= item.param1
                yield _CIRCLES[MavCmd(item.command)], inside
            index += 1

    def _items(self) -> Sequence[MissionItem]:
        return self._px4.missions.items(MavMissionType.FENCE)

    def _place(self, item: MissionItem) -> tuple[float, float]:
        return self._px4.frame.to_local(round(item.x), round(item.y))


def _is_in_polygon(corners: Sequence[tuple[float, float]], north: float, east: float) -> bool:
    inside, previous = False, corners[-1]
    for corner in corners:
        if (corner[1] > east) != (previous[1] > east):
            share = (east - corner[1]) / (previous[1] - corner[1])
            inside ^= north < corner[0] + share * (previous[0] - corner[0])
        previous = corner
    return inside
