"""What PX4 calls a mission, a fence or rally points: the checksum of their items as they came in."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.missions.item import MissionItem

__all__ = ["mission_checksum"]

ITEM = struct.Struct("<BHB4fiif")
INVERT = 0xFFFFFFFF


def mission_checksum(items: Iterable[MissionItem]) -> int:
    """CRC-32, begun with 0 and not inverted, over frame, command, autocontinue and the seven numbers of each item.

    PX4 (since 1.15) tells it as ``opaque_id`` in MISSION_ACK and MISSION_COUNT, and as ``mission_id``, ``fence_id``,
    ``rally_points_id`` in MISSION_CURRENT (https://mavlink.io/en/messages/common.html#MISSION_CURRENT).
    """
    checksum = INVERT
    for item in items:
        numbers = (item.param1, item.param2, item.param3, item.param4, int(item.x), int(item.y), item.z)
        checksum = zlib.crc32(ITEM.pack(item.frame, item.command, item.autocontinue, *numbers), checksum)
    return checksum ^ INVERT
