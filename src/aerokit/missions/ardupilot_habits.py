"""What ArduPilot makes of items by itself, written out for autopilots that do not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavFrame
from aerokit.missions.commands import DEFAULT_XY, DESTINATIONS, GLOBAL_FRAMES, has_place

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.missions.item import MissionItem

__all__ = ["written_out"]


def written_out(items: Iterable[MissionItem], here: tuple[float, float] | None) -> Iterator[MissionItem]:
    """The items of a mission made for ArduPilot, for another autopilot.

    Commands without a place, which ArduPilot takes in any frame, come in MAV_FRAME_MISSION, the only one that PX4 takes
    them in. 0°, 0° is "where the vehicle is" for ArduPilot: it becomes where the item before leads, at first ``here``:
    latitude and longitude in degrees, None: not known.
    """
    place = None if here is None else (round(here[0] * 1e7), round(here[1] * 1e7))
    for item in items:
        if item.frame in GLOBAL_FRAMES and not has_place(item.command):
            item = item.replace(frame=int(MavFrame.MISSION))
        if item.command in DESTINATIONS and item.frame in GLOBAL_FRAMES:
            if place is not None and item.x == item.y == 0:
                item = item.replace(x=place[0], y=place[1])
            elif DEFAULT_XY not in (item.x, item.y):
                place = round(item.x), round(item.y)
        yield item
