"""ArduPilot's ``@MISSION/mission.dat``, ``fence.dat`` and ``rally.dat``: all items of a plan in one file.

Ten bytes of header (magic 0x763D, MAV_MISSION_TYPE, options, first index, number of items; 16 bits each, little
endian), then 38 bytes for each item: a MISSION_ITEM_INT as on the wire, untrimmed. Missions have home as item 0.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink.messages import MissionItemInt
from aerokit.missions.check import MOST_ITEMS
from aerokit.missions.wire import from_wire, to_wire

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions.item import MissionItem

MAGIC = 0x763D
HEADER = struct.Struct("<5H")
NO_CLEAR = 1  # in options: the items that are there stay, those that come replace some of them
PACKED_NAMES = {0: "@MISSION/mission.dat", 1: "@MISSION/fence.dat", 2: "@MISSION/rally.dat"}

_ITEM_LENGTH = MissionItemInt.LENGTH


class PlanHeader(NamedTuple):
    """What a packed plan says of itself."""

    mission_type: int
    options: int
    first: int
    items: int

    @property
    def length(self) -> int:
        """Bytes of the whole file."""
        return HEADER.size + self.items * _ITEM_LENGTH


def pack_items(
    items: Sequence[MissionItem],
    mission_type: int = 0,
    *,
    first: int = 0,
    options: int = 0,
    target_system: int = 0,
    target_component: int = 0,
) -> bytes:
    """The file of these items, counted as the vehicle counts them; ``first`` is the index of the first one.

    A whole plan is written with ``first`` 0 and no options. ArduPilot takes ``options`` :data:`NO_CLEAR` for missions
    only: items from ``first`` on are replaced or appended, the others stay (jumps must then lead to an index below
    the number of items in the file, 4.7). It reads the file when it is closed, and empties the old mission first: a
    file it refuses half way leaves half a mission.
    """
    if len(items) + first > MOST_ITEMS:
        raise InvalidArgument(f"{len(items) + first} items are too many: at most {MOST_ITEMS} fit")
    header = HEADER.pack(MAGIC, mission_type, options, first, len(items))
    return header + b"".join(
        to_wire(
            item,
            index,
            target_system=target_system,
            target_component=target_component,
            mission_type=mission_type,
        ).encode()
        for index, item in enumerate(items, first)
    )


def read_header(data: bytes) -> PlanHeader:
    """The first ten bytes; :class:`RemoteProtocolError` when they are not those of a packed plan."""
    if len(data) < HEADER.size:
        raise RemoteProtocolError(
            f"a packed plan begins with {HEADER.size} bytes of header, these are {len(data)}"
        )
    magic, *numbers = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise RemoteProtocolError(f"a packed plan begins with 0x{MAGIC:04X}, this with 0x{magic:04X}")
    return PlanHeader(*numbers)


def unpack_items(data: bytes, mission_type: int | None = None) -> tuple[MissionItem, ...]:
    """The items of a file, counted as the vehicle counts them.

    Raises :class:`RemoteProtocolError` when it is none, is cut off, or is about another ``mission_type``.
    """
    header = read_header(data)
    if mission_type is not None and header.mission_type != mission_type:
        raise RemoteProtocolError(
            f"a packed plan of MAV_MISSION_TYPE {mission_type} was expected, this is of {header.mission_type}"
        )
    if len(data) != header.length:
        raise RemoteProtocolError(
            f"a packed plan of {header.items} items has {header.length} bytes, this has {len(data)}"
        )
    starts = range(HEADER.size, header.length, _ITEM_LENGTH)
    return tuple(from_wire(MissionItemInt.decode(data[at : at + _ITEM_LENGTH])) for at in starts)
