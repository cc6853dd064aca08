"""ArduPilot's lists of mission items: commands, fence and rally points.

An upload changes commands and rally points in place, item by item, so an aborted upload leaves a mixture of the old
and the new list. A fence is collected first, and validated and stored at the end of the upload.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.protocols.servers.missions import ItemRefused
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.mission_items import altitude_frame, as_stored, check_place
from aerokit.sim.commands import to_int
from aerokit.sim.missions import CIRCLES, POLYGON_CORNERS, float32

_MIN_RALLY_M, _MAX_RALLY_M = -32768, 32767
_HOME_SEQ = 0


class ItemList:
    """Base of the lists of mission, fence and rally items. `put` and `finish` raise ItemRefused."""

    name: ClassVar[str]
    """Name of the list in status texts."""
    capacity: ClassVar[int]
    """Maximum number of items."""

    def __init__(self) -> None:
        self._items: list[MissionItem] = []

    @property
    def count(self) -> int:
        return len(self._items)

    def items(self) -> list[MissionItem]:
        items = map(self.item, range(len(self._items)))
        return [item for item in items if item is not None]

    def item(self, seq: int) -> MissionItem | None:
        return self._items[seq] if seq < len(self._items) else None

    def begin(self, count: int) -> None:
        del self._items[count:]

    def begin_update(self) -> None:
        """Start a partial upload."""

    def put(self, seq: int, item: MissionItem, last: int) -> None:
        """Store an uploaded item. ``last`` is the upload's last sequence number."""
        raise NotImplementedError

    def finish(self, warn: Callable[[str], None]) -> None:
        """Complete an upload. ``warn`` sends a status text."""

    def abandon(self) -> None: ...

    def clear(self) -> bool:
        """Delete all items. Return False if this is not allowed at present."""
        self._items.clear()
        return True


class CommandList(ItemList):
    """The list of mission commands. Item 0 is home, which the function ``home`` returns at each download."""

    name = "Mission"
    capacity: ClassVar[int] = 650

    def __init__(self, home: Callable[[], MissionItem], is_running: Callable[[], bool], kind: Kind) -> None:
        super().__init__()  # The item at index 0 is a placeholder for home.
        self._kind: Kind = kind
        self._home = home
        self._is_running = is_running
        self.version: int = 0  # Every change of an item increments the version.

    def item(self, seq: int) -> MissionItem | None:
        return self._home() if seq == 0 else self.command(seq)  # Home can be read even if there is no mission.

    def command(self, index: int) -> MissionItem | None:
        return self._items[index] if 0 < index < len(self._items) else None

    def add_home(self) -> None:
        """Add home as item 0 of an empty mission."""
        if not self._items:
            self._items.append(self._home())

    def begin(self, count: int) -> None:
        super().begin(count)
        self.version += 1

    def put(self, seq: int, item: MissionItem, last: int) -> None:
        stored_item = as_stored(item, self._kind)
        target = stored_item.param1
        leads_nowhere = target == 0 or target > max(last, self.count - 1)
        if stored_item.command == Cmd.DO_JUMP and leads_nowhere:
            raise ItemRefused(MavMissionResult.ERROR)
        self._write(seq, stored_item)

    def _write(self, seq: int, stored_item: MissionItem) -> None:
        if seq > len(self._items) or seq >= self.capacity:
            raise ItemRefused(MavMissionResult.ERROR)
        if seq == len(self._items):
            # If the list is empty, the firmware adds home first, so this item becomes item 1 (AP_Mission.cpp, add_cmd).
            self.add_home()
            self._items.append(stored_item)
        elif seq != _HOME_SEQ:  # Item 0 is home, which is not stored.
            self._items[seq] = stored_item
        self.version += 1

    def clear(self) -> bool:
        if self._is_running():
            return False
        self.begin(0)
        return True

    def write_file(self, items: Sequence[MissionItem], start: int) -> None:
        """Store the items of an uploaded file, up to the first refused item."""
        for seq, item in enumerate(items, start):
            stored_item = as_stored(item, self._kind)
            # The firmware checks the jump target against the length of the file, even if `start` is not 0
            # (AP_Filesystem_Mission.cpp, finish_upload_mission).
            if stored_item.command == Cmd.DO_JUMP and not 0 < stored_item.param1 < len(items):
                raise ItemRefused(MavMissionResult.ERROR)
            self._write(seq, stored_item)


class RallyList(ItemList):
    """The list of rally points. Their position, altitude (in whole metres) and altitude frame are stored."""

    name = "Rally"
    capacity: ClassVar[int] = 46

    def item(self, seq: int) -> MissionItem | None:
        point = super().item(seq)
        # A rally point at latitude 0 and longitude 0 counts as missing.
        return None if point is None or (point.x, point.y) == (0, 0) else point

    def put(self, seq: int, item: MissionItem, last: int) -> None:
        stored_item = _stored_rally_point(item)
        if seq > len(self._items) or seq >= self.capacity:
            raise ItemRefused(MavMissionResult.ERROR)
        self._items[seq : seq + 1] = [stored_item]  # replaces the point, or appends it at the end


def _stored_rally_point(item: MissionItem) -> MissionItem:
    if item.command != Cmd.NAV_RALLY_POINT:
        raise ItemRefused(MavMissionResult.UNSUPPORTED)
    check_place(item.x, item.y)
    if not _MIN_RALLY_M <= item.z <= _MAX_RALLY_M:  # The altitude is stored in whole metres, as an int16.
        raise ItemRefused(MavMissionResult.INVALID_PARAM7)
    frame = _global_frame(item)
    height = float32(int(item.z))
    return MissionItem(item.command, frame, x=int(item.x), y=int(item.y), z=height, autocontinue=False)


def _global_frame(item: MissionItem) -> int:
    """Return the frame with which an item is downloaded. Without a global frame, the item is refused."""
    if item.frame == MavFrame.MISSION:
        raise ItemRefused(MavMissionResult.UNSUPPORTED_FRAME)
    return altitude_frame(item.frame)


_TYPE_NUMBERS: dict[int, int] = {
    Cmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: 98,
    Cmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: 97,
    Cmd.NAV_FENCE_RETURN_POINT: 95,
    Cmd.NAV_FENCE_CIRCLE_EXCLUSION: 93,
    Cmd.NAV_FENCE_CIRCLE_INCLUSION: 92,
}
_STORAGE_BYTES = 560
_BYTES_PER_POINT = 8
_MAX_VERTICES = 255

Warn = Callable[[str], None]


class FenceList(ItemList):
    """The list of fence items. During an upload, `item` still reads the old fence."""

    name = "Fence"
    capacity: ClassVar[int] = _STORAGE_BYTES // _BYTES_PER_POINT

    def __init__(self, on_total: Callable[[int], None]) -> None:
        super().__init__()
        self._on_total = on_total  # called with the new FENCE_TOTAL after each change of the stored fence
        # Items of the running upload, with None for each missing item. None if no upload is running.
        self._uploaded: list[MissionItem | None] | None = None

    @property
    def count(self) -> int:
        return len(self._items if self._uploaded is None else self._uploaded)

    def begin(self, count: int) -> None:
        self._uploaded = [None for _ in range(count)]

    def begin_update(self) -> None:
        self._uploaded = list(self._items)

    def put(self, seq: int, item: MissionItem, last: int) -> None:
        assert self._uploaded is not None  # `begin` has created the list with the announced number of items.
        if seq >= len(self._uploaded):
            raise ItemRefused(MavMissionResult.INVALID_SEQUENCE)
        self._uploaded[seq] = _stored_fence_item(item)

    def finish(self, warn: Warn) -> None:
        assert self._uploaded is not None
        self._check_and_store([item for item in self._uploaded if item is not None], warn)

    def abandon(self) -> None:
        self._uploaded = None

    def clear(self) -> bool:
        self._store([])
        return True

    def _store(self, items: Sequence[MissionItem]) -> None:
        self._items = list(items)
        # FENCE_TOTAL is 0 if the fence has fewer than three items other than return points (AC_PolyFence_loader.cpp).
        zone_points = sum(item.command != Cmd.NAV_FENCE_RETURN_POINT for item in items)
        self._on_total(zone_points + 2 if zone_points >= 3 else 0)

    def _check_and_store(self, items: Sequence[MissionItem], warn: Warn) -> None:
        """Store a fence, or ``warn`` if it is invalid or too large."""
        problem = _fence_problem(items)
        if problem is not None:
            warn(problem)
            warn("Fence validation failed")
            raise ItemRefused(MavMissionResult.ERROR)
        if _storage_needed(items) > _STORAGE_BYTES:
            warn("Fence exceeds storage size")
            raise ItemRefused(MavMissionResult.ERROR)
        self._store(items)

    def replace(self, items: Sequence[MissionItem], warn: Warn) -> None:
        self._check_and_store([_stored_fence_item(item) for item in items], warn)


def _stored_fence_item(item: MissionItem) -> MissionItem:
    _global_frame(item)
    size = 0.0
    if item.command in POLYGON_CORNERS:
        if item.param1 > _MAX_VERTICES:
            raise ItemRefused(MavMissionResult.INVALID_PARAM1)
        size = float(to_int(item.param1) & 0xFF)  # The number of vertices is stored in one byte.
    elif item.command in CIRCLES:
        size = float32(item.param1)
    elif item.command != Cmd.NAV_FENCE_RETURN_POINT:
        raise ItemRefused(MavMissionResult.UNSUPPORTED)
    return MissionItem(item.command, MavFrame.GLOBAL, size, x=int(item.x), y=int(item.y), z=0.0, autocontinue=False)


def _fence_problem(items: Sequence[MissionItem]) -> str | None:
    """Return the firmware's text about an invalid fence."""
    polygon_type = 0  # command of the vertices of the current polygon
    vertices = 0.0  # number of vertices of the current polygon
    missing = 0  # number of vertices that must still follow
    has_return_point = False
    for item in items:
        number = _TYPE_NUMBERS[item.command]
        if item.command in POLYGON_CORNERS:
            if item.param1 < 3:
                return f"Invalid vertex count ({item.param1:.0f})"
            if missing == 0:
                polygon_type = item.command
                vertices = item.param1
                missing = int(item.param1)
            elif item.command != polygon_type:
                return f"Received incorrect vertex type (want={_TYPE_NUMBERS[polygon_type]} got={number})"
            elif item.param1 != vertices:
                return f"Unexpected vertex count want={vertices:.0f} got={item.param1:.0f}"
            missing -= 1
        elif missing:
            return f"Received incorrect type (want={_TYPE_NUMBERS[polygon_type]} got={number})"
        elif item.command in CIRCLES and not item.param1 > 0:
            return "Non-positive circle radius"
        elif item.command == Cmd.NAV_FENCE_RETURN_POINT:
            if has_return_point:
                return "Multiple return points"
            has_return_point = True
        try:
            check_place(item.x, item.y)
        except ItemRefused:
            return "Bad lat or lon"
    return "Incorrect item count" if missing else None


def _storage_needed(items: Sequence[MissionItem]) -> int:
    size, vertices_left = 4, 0  # The header has four bytes.
    for item in items:
        size += _BYTES_PER_POINT
        if vertices_left:
            vertices_left -= 1
            continue
        size += 1  # One byte for the type of a polygon, circle or return point.
        if item.command in POLYGON_CORNERS:
            size += 1  # One byte for the number of vertices.
            vertices_left = int(item.param1) - 1
        elif item.command in CIRCLES:
            size += 4  # Four bytes for the radius.
    return size
