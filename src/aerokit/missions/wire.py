"""Items as messages and back, and items as the vehicle counts them: ArduPilot's item 0 is home."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import DEFAULT_XY, DESTINATIONS, GLOBAL_FRAMES, MissionItem, has_place, xy_scale
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


def to_wire(
    item: MissionItem,
    seq: int,
    *,
    target_system: int,
    target_component: int,
    mission_type: int = 0,
    current: bool = False,
) -> messages.MissionItemInt:
    """The item as MISSION_ITEM_INT; check it first, a fraction in x or y cannot be sent.

    https://mavlink.io/en/messages/common.html#MISSION_ITEM_INT
    """
    return messages.MissionItemInt(
        target_system,
        target_component,
        seq,
        int(item.frame),
        int(item.command),
        int(current),
        int(item.autocontinue),
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        item.x,  # type: ignore[arg-type]
        item.y,  # type: ignore[arg-type]
        item.z,
        mission_type,
    )


def to_wire_float(
    item: MissionItem,
    seq: int,
    *,
    target_system: int,
    target_component: int,
    mission_type: int = 0,
    current: bool = False,
) -> messages.MissionItem:
    """The item as MISSION_ITEM, for a vehicle that cannot do better: places are rounded to about a metre.

    https://mavlink.io/en/messages/common.html#MISSION_ITEM
    """
    x, y = in_degrees(item)
    return messages.MissionItem(
        target_system,
        target_component,
        seq,
        int(item.frame),
        int(item.command),
        int(current),
        int(item.autocontinue),
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        x,
        y,
        item.z,
        mission_type,
    )


def from_wire(message: messages.MissionItemInt | messages.MissionItem) -> MissionItem:
    """The item of a message of either form; any numbers off the air are taken as they are."""
    x: int | float = message.x
    y: int | float = message.y
    if isinstance(message, messages.MissionItem):
        x, y = (from_degrees(value, message.command, message.frame) for value in (x, y))
    return MissionItem(
        message.command,
        message.frame,
        message.param1,
        message.param2,
        message.param3,
        message.param4,
        x,
        y,
        message.z,
        bool(message.autocontinue),
    )


def in_degrees(item: MissionItem) -> tuple[float, float]:
    """Return x and y as the float form and files have them: degrees or metres for places, NaN for "not given"."""
    scale = xy_scale(item.command, item.frame)
    x, y = (math.nan if value == DEFAULT_XY else value / scale for value in (item.x, item.y))
    return x, y


def from_degrees(value: float, command: int, frame: int) -> int | float:
    """The inverse of :func:`in_degrees` for one number: an integer unless it has a fraction and is no place."""
    if math.isnan(value):
        return DEFAULT_XY
    scale = xy_scale(command, frame)
    if math.isinf(value) or (scale == 1 and value != int(value)):
        return value
    return round(value * scale)


def with_home(items: Sequence[MissionItem], home: Position | None = None) -> tuple[MissionItem, ...]:
    """Items as ArduPilot counts them: home in front (0°, 0° when it is not known), jumps one further.

    ArduPilot puts its own home there, whatever is sent.
    """
    return (home_item(home), *shift_jumps(items, 1))


def without_home(items: Sequence[MissionItem]) -> tuple[tuple[MissionItem, ...], Position | None]:
    """The inverse: the items without the one in front, and home, None when that is no place."""
    home = items[0].position if items else None
    return shift_jumps(items[1:], -1), home


def home_item(home: Position | None) -> MissionItem:
    """Home as a waypoint with its altitude above the sea."""
    if home is None:
        return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
    x, y = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
    return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL, x=x, y=y, z=home.altitude_amsl_m or 0.0)


def shift_jumps(items: Iterable[MissionItem], by: int) -> tuple[MissionItem, ...]:
    """The items with that much added to the targets of DO_JUMP, the only number of an item that counts items."""
    return tuple(
        item.replace(param1=item.param1 + by) if item.command == MavCmd.DO_JUMP else item for item in items
    )


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
