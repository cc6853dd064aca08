"""Conversions of items: to messages, to ArduPilot's plan files, to the item numbers of the vehicle; and back."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.check import MAX_ITEMS
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
    """Convert an item to MISSION_ITEM_INT. Its ``x`` and ``y`` must be integers."""
    common = _common_fields(item, seq, target_system, target_component, mission_type, current)
    return messages.MissionItemInt(x=item.x, y=item.y, **common)  # type: ignore[arg-type]


def to_wire_float(
    item: MissionItem,
    seq: int,
    *,
    target_system: int,
    target_component: int,
    mission_type: int = 0,
    current: int = 0,
    place: tuple[float, float] | None = None,
) -> messages.MissionItem:
    """Convert an item to MISSION_ITEM, for vehicles without MISSION_ITEM_INT.

    Places are rounded to about a metre. If ``place`` is given, it is sent in ``x`` and ``y`` instead of the item's own
    values.
    """
    x, y = unscaled_xy(item) if place is None else place
    common = _common_fields(item, seq, target_system, target_component, mission_type, current)
    return messages.MissionItem(x=x, y=y, **common)


def _common_fields(
    item: MissionItem, seq: int, target_system: int, target_component: int, mission_type: int, current: int
) -> dict[str, Any]:
    return {
        "target_system": target_system,
        "target_component": target_component,
        "seq": seq,
        "frame": int(item.frame),
        "command": int(item.command),
        "current": int(current),
        "autocontinue": int(item.autocontinue),
        "param1": item.param1,
        "param2": item.param2,
        "param3": item.param3,
        "param4": item.param4,
        "z": item.z,
        "mission_type": mission_type,
    }


def from_wire(message: messages.MissionItemInt | messages.MissionItem) -> MissionItem:
    """Convert a message to an item, without checks."""
    x: int | float = message.x
    y: int | float = message.y
    if isinstance(message, messages.MissionItem):
        x, y = (scaled_coordinate(value, message.command, message.frame) for value in (x, y))
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


def unscaled_xy(item: MissionItem) -> tuple[float, float]:
    """Return x and y as in MISSION_ITEM and files: degrees, metres or parameters; NaN for "not given"."""
    scale = xy_scale(item.command, item.frame)
    x, y = (math.nan if value == DEFAULT_XY else value / scale for value in (item.x, item.y))
    return x, y


def scaled_coordinate(value: float, command: int, frame: int) -> int | float:
    """Convert degrees (in a global frame), metres (in a local frame) or a parameter to the ``x`` or ``y`` of an item.

    Infinity and a parameter with a fraction are returned unchanged. This is the inverse of :func:`unscaled_xy`.
    """
    if math.isnan(value):
        return DEFAULT_XY
    scale = xy_scale(command, frame)
    if math.isinf(value * scale) or (scale == 1 and value != int(value)):
        return value
    return round(value * scale)


def with_home(items: Sequence[MissionItem], home: Position | None = None) -> tuple[MissionItem, ...]:
    """Add home as item 0, and adjust jump targets. An unknown home is 0°, 0°."""
    # ArduPilot counts home as item 0. It ignores this item and uses its own home.
    return (home_item(home), *shift_jumps(items, 1))


def without_home(items: Sequence[MissionItem]) -> tuple[tuple[MissionItem, ...], Position | None]:
    """Return the items after item 0, with adjusted jump targets, and the place of item 0."""
    home = items[0].position if items else None
    return shift_jumps(items[1:], -1), home


def home_item(home: Position | None) -> MissionItem:
    """Create the item for home. An unknown home is 0°, 0°."""
    if home is None:
        return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
    x, y = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
    return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL, x=x, y=y, z=home.altitude_amsl_m or 0.0)


def shift_jumps(items: Iterable[MissionItem], offset: int) -> tuple[MissionItem, ...]:
    """Add ``offset`` to the targets of DO_JUMP."""

    # No other command refers to items by number.
    def shifted(item: MissionItem) -> MissionItem:
        return item.replace(param1=item.param1 + offset) if item.command == MavCmd.DO_JUMP else item

    return tuple(map(shifted, items))


def convert_from_ardupilot(items: Iterable[MissionItem], here: tuple[float, float] | None) -> Iterator[MissionItem]:
    """Convert the items of a mission that was made for ArduPilot, so that another autopilot accepts them.

    A first destination at 0°, 0° is replaced by ``here``, the current position (latitude and longitude in degrees). If
    ``here`` is None, 0°, 0° is kept, and `check_items` refuses the mission.
    """
    current_xy: tuple[int, int] | None = None
    if here is not None:
        latitude_deg, longitude_deg = here
        current_xy = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    for item in items:
        # If a command has no position, PX4 accepts it only with MAV_FRAME_MISSION, ArduPilot with any frame.
        if item.frame in GLOBAL_FRAMES and not has_place(item.command):
            item = item.replace(frame=int(MavFrame.MISSION))
        if item.command in DESTINATIONS and item.frame in GLOBAL_FRAMES:
            # ArduPilot takes 0°, 0° for the current position, which during the mission is the previous destination.
            if current_xy is not None and item.x == item.y == 0:
                x, y = current_xy
                item = item.replace(x=x, y=y)
            elif DEFAULT_XY not in (item.x, item.y):
                current_xy = round(item.x), round(item.y)
        yield item


# ---------------------------------------------------------------------------- ArduPilot's plan files

# ArduPilot's ``@MISSION/mission.dat``, ``fence.dat`` and ``rally.dat``: a header of ten bytes (magic number,
# MAV_MISSION_TYPE, options, first index, number of items; 16 bits each, little endian), then 38 bytes for each item: a
# MISSION_ITEM_INT, not truncated. Missions have home as item 0.
MAGIC = 0x763D
HEADER = struct.Struct("<5H")
NO_CLEAR = 1  # option of a plan file that replaces only its own items, and keeps all others
PACKED_PATHS = {0: "@MISSION/mission.dat", 1: "@MISSION/fence.dat", 2: "@MISSION/rally.dat"}

_ITEM_LENGTH = messages.MissionItemInt.LENGTH


class PlanHeader(NamedTuple):
    """Header of one of ArduPilot's plan files."""

    mission_type: int
    options: int
    first_index: int
    item_count: int

    @property
    def length(self) -> int:
        return HEADER.size + self.item_count * _ITEM_LENGTH


def pack_items(
    items: Sequence[MissionItem],
    mission_type: int = 0,
    *,
    first: int = 0,
    options: int = 0,
    target_system: int = 0,
    target_component: int = 0,
) -> bytes:
    """Encode items as one of ArduPilot's plan files. Indices are those of the vehicle, so item 0 of a mission is home.

    By default, the plan replaces all items. When the written file is closed, ArduPilot deletes the old items and stores
    the new items, up to the first item that it refuses.

    With the option :data:`NO_CLEAR`, which is for missions only, the plan replaces items from index ``first`` on, or
    appends items at the end of the mission. ArduPilot keeps all other items. Jump targets must be below the number of
    items in the file (ArduPilot 4.7).
    """
    if len(items) + first > MAX_ITEMS:
        raise InvalidArgument(f"{len(items) + first} items are too many: at most {MAX_ITEMS} are possible")
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
    """Decode the header of a plan file. Raises RemoteProtocolError for other data."""
    if len(data) < HEADER.size:
        raise RemoteProtocolError(f"plan file: expected a header of {HEADER.size} bytes, received {len(data)} bytes")
    magic, *numbers = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise RemoteProtocolError(f"plan file: expected the magic number 0x{MAGIC:04X}, found 0x{magic:04X}")
    return PlanHeader(*numbers)


def unpack_items(data: bytes, mission_type: int | None = None) -> tuple[MissionItem, ...]:
    """Decode all items of one of ArduPilot's plan files. Item 0 of a mission is home.

    The header says which item is the first (``first_index``). Raises RemoteProtocolError if the data is not a complete
    plan file of this type.
    """
    header = read_header(data)
    if mission_type is not None and header.mission_type != mission_type:
        raise RemoteProtocolError(f"plan file: expected MAV_MISSION_TYPE {mission_type}, found {header.mission_type}")
    if len(data) != header.length:
        raise RemoteProtocolError(
            f"plan file: expected {header.length} bytes for {header.item_count} items, received {len(data)} bytes"
        )
    starts = range(HEADER.size, header.length, _ITEM_LENGTH)
    return tuple(from_wire(messages.MissionItemInt.decode(data[start : start + _ITEM_LENGTH])) for start in starts)
