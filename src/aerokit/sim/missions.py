"""Missions, fences and rally points of a simulated vehicle: what every kind of vehicle shares.

The protocol and what a vehicle makes of an item differ so much between autopilots that each has a server of its own
(`sim.ardupilot.mission_server`, `sim.px4.mission_server`). https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Protocol

from aerokit.mavlink import messages as m
from aerokit.missions import MissionItem

__all__ = [
    "INVALID_INDEX",
    "AnyItem",
    "AnyRequest",
    "MissionStore",
    "float32",
    "item_from",
    "item_message_float",
]

INVALID_INDEX = 0xFFFF
"""No item, where a message wants a number."""

AnyItem = m.MissionItemInt | m.MissionItem
AnyRequest = m.MissionRequestInt | m.MissionRequest


class MissionStore(Protocol):
    """What other servers of the vehicle (files) need of its missions.

    ``mission_type`` is a MAV_MISSION_TYPE: 0 mission, 1 fence, 2 rally points.
    """

    @property
    def transfer_is_open(self) -> bool:
        """Whether somebody's upload or download is going on."""
        ...

    def items(self, mission_type: int) -> list[MissionItem]:
        """What the vehicle has, as it gives it back: ArduPilot's home, item 0, included."""
        ...

    def replace(
        self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True
    ) -> int:
        """Store items at once, as a file does; the MAV_MISSION_RESULT."""
        ...


def float32(value: float) -> float:
    """As the wire and the vehicle's memory round it; infinity beyond the range."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def item_from(message: AnyItem) -> MissionItem:
    """The item in a MISSION_ITEM_INT, or in a MISSION_ITEM with ``x`` and ``y`` as they are there."""
    return MissionItem(
        message.command,
        message.frame,
        message.param1,
        message.param2,
        message.param3,
        message.param4,
        message.x,
        message.y,
        message.z,
        bool(message.autocontinue),
    )


def item_message_float(
    item: MissionItem,
    place: tuple[float, float],
    seq: int,
    to: tuple[int, int],
    mission_type: int,
    current: int = 0,
) -> m.MissionItem:
    """MISSION_ITEM for somebody; ``place`` is what goes into ``x`` and ``y``."""
    return m.MissionItem(
        *to,
        seq,
        item.frame,
        item.command,
        current,
        int(item.autocontinue),
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        *place,
        item.z,
        mission_type,
    )
