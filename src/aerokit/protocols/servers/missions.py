"""Missions, fences and rally points: messages of items, and a server (https://mavlink.io/en/services/mission.html)."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.missions import MissionItem
from aerokit.missions.wire import to_wire

AnyItem = m.MissionItemInt | m.MissionItem
AnyRequest = m.MissionRequestInt | m.MissionRequest


def item_from(message: AnyItem) -> MissionItem:
    """Convert a MISSION_ITEM_INT or MISSION_ITEM to an item; does not scale ``x`` and ``y``."""
    numbers = (
        message.param1,
        message.param2,
        message.param3,
        message.param4,
        message.x,
        message.y,
        message.z,
    )
    return MissionItem(message.command, message.frame, *numbers, autocontinue=bool(message.autocontinue))


def item_message_int(
    item: MissionItem, seq: int, to: tuple[int, int], mission_type: int, *, current: bool
) -> m.MissionItemInt:
    system, component = to
    return to_wire(
        item,
        seq,
        target_system=system,
        target_component=component,
        mission_type=mission_type,
        current=current,
    )


def item_message_float(
    item: MissionItem,
    place: tuple[float, float],
    seq: int,
    to: tuple[int, int],
    mission_type: int,
    current: int = 0,
) -> m.MissionItem:
    """Create a MISSION_ITEM; ``place`` becomes ``x`` and ``y``."""
    head = (*to, seq, item.frame, item.command, current, int(item.autocontinue))
    numbers = (item.param1, item.param2, item.param3, item.param4)
    return m.MissionItem(*head, *numbers, *place, item.z, mission_type)
