"""ArduPilot's three lists of mission items, as its transfer protocol changes them.

Commands and rally points are changed in place, item by item, while they come: an upload that breaks off leaves a list
that is neither the old nor the new one. A fence is put together aside and checked as a whole at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.mission_items import altitude_frame, is_place, stored, whole
from aerokit.sim.missions import float32

_LOWEST_RALLY_M, _HIGHEST_RALLY_M = -32768, 32767


class ItemList:
    """What the protocol needs of a list. Results are MAV_MISSION_RESULTs."""

    name: ClassVar[str]
    """How texts call an upload."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        """How many items fit."""

    @property
    def count(self) -> int:
        """How many items there are, as the protocol tells it now."""
        raise NotImplementedError

    def items(self) -> list[MissionItem]:
        """All of them, as they are given back."""
        return [item for seq in range(self.count) if not isinstance(item := self.item(seq), int)]

    def item(self, seq: int) -> MissionItem | int:
        """One of them, or the result that says why not."""
        raise NotImplementedError

    def begin(self, count: int) -> None:
        """A new list of this length is going to be sent."""
        raise NotImplementedError

    def begin_update(self) -> None:
        """Some of the items are going to be sent."""

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        """Store what was sent; ``last`` is the number of the last item of this transfer."""
        raise NotImplementedError

    def finish(self, say: Callable[[str], None]) -> int:
        """Everything was sent; ``say`` takes warnings."""
        return MavMissionResult.ACCEPTED

    def abandon(self) -> None:
        """Nothing more will be sent."""

    def clear(self) -> bool:
        """Forget all items; False when it may not be done now."""
        raise NotImplementedError


class CommandList(ItemList):
    """The mission. Item 0 is home, which is never stored: it is where home is when somebody asks."""

    version: int

    name = "Mission"

    def __init__(
        self,
        capacity: int,
        home: Callable[[], MissionItem],
        is_running: Callable[[], bool],
        kind: Kind = "copter",
    ) -> None:
        super().__init__(capacity)
        self._kind: Kind = kind
        self._home, self._is_running = home, is_running
        self._commands: list[MissionItem] = []  # [0] only holds home's place
        self.version = 0
        """Changes whenever an item changes."""

    @property
    def count(self) -> int:
        return len(self._commands)

    def item(self, seq: int) -> MissionItem | int:
        """Home can be read even when there is no mission."""
        if seq == 0:
            return self._home()
        return self._commands[seq] if seq < len(self._commands) else MavMissionResult.INVALID_SEQUENCE

    def command(self, index: int) -> MissionItem | None:
        """What the execution reads; None beyond the end."""
        return self._commands[index] if 0 < index < len(self._commands) else None

    def add_home(self) -> None:
        """Home became known: from now on it is item 0 of an empty mission."""
        if not self._commands:
            self._commands.append(self._home())

    def begin(self, count: int) -> None:
        del self._commands[count:]
        self.version += 1

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        """Replace or append; item 0 is checked and then ignored, but an empty list gets its home first."""
        kept = stored(item, self._kind)
        if isinstance(kept, int):
            return kept
        if kept.command == MavCmd.DO_JUMP and not self._is_target(kept.param1, last):
            return MavMissionResult.ERROR
        return self._write(seq, kept)

    def _is_target(self, target: float, last: int) -> bool:
        return target != 0 and (target < self.count or target <= last)

    def _write(self, seq: int, kept: MissionItem) -> int:
        count = len(self._commands)
        if seq > count or max(seq, 1) >= self.capacity:
            return MavMissionResult.ERROR
        if seq == count:
            self.add_home()
            self._commands.append(kept)
        elif seq > 0:
            self._commands[seq] = kept
        self.version += 1
        return MavMissionResult.ACCEPTED

    def clear(self) -> bool:
        if self._is_running():
            return False
        self.begin(0)
        return True

    def write_file(self, items: list[MissionItem], start: int) -> int:
        """Put items one after the other until one cannot be stored."""
        for seq, item in enumerate(items):
            kept = stored(item, self._kind)
            if isinstance(kept, int):
                return kept
            if kept.command == MavCmd.DO_JUMP and not 0 < kept.param1 < len(items):
                return MavMissionResult.ERROR
            result = self._write(seq + start, kept)
            if result != MavMissionResult.ACCEPTED:
                return result
        return MavMissionResult.ACCEPTED


class RallyList(ItemList):
    """Rally points: latitude, longitude, whole metres and the frame of the altitude are kept."""

    name = "Rally"

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity)
        self._points: list[MissionItem] = []

    @property
    def count(self) -> int:
        return len(self._points)

    def item(self, seq: int) -> MissionItem | int:
        """A point at 0, 0 counts as none."""
        if seq >= len(self._points):
            return MavMissionResult.INVALID_SEQUENCE
        point = self._points[seq]
        return MavMissionResult.INVALID_SEQUENCE if (point.x, point.y) == (0, 0) else point

    def begin(self, count: int) -> None:
        del self._points[count:]

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        kept = _kept_rally_point(item)
        if isinstance(kept, int):
            return kept
        if seq > len(self._points) or seq >= self.capacity:
            return MavMissionResult.ERROR
        self._points[seq : seq + 1] = [kept]
        return MavMissionResult.ACCEPTED

    def clear(self) -> bool:
        self._points.clear()
        return True


def _kept_rally_point(item: MissionItem) -> MissionItem | int:
    if item.command != MavCmd.NAV_RALLY_POINT:
        return MavMissionResult.UNSUPPORTED
    result = is_place(item.x, item.y)
    if result != MavMissionResult.ACCEPTED:
        return result
    if not _LOWEST_RALLY_M <= item.z <= _HIGHEST_RALLY_M:
        return MavMissionResult.INVALID_PARAM7
    frame = altitude_frame(item.frame)
    if frame is None or item.frame == MavFrame.MISSION:
        return MavMissionResult.UNSUPPORTED_FRAME
    place, height = (int(item.x), int(item.y)), float32(int(item.z))
    return MissionItem(item.command, frame, 0.0, 0.0, 0.0, 0.0, *place, height, autocontinue=False)


_C = MavCmd
_POLYGONS = (_C.NAV_FENCE_POLYGON_VERTEX_INCLUSION, _C.NAV_FENCE_POLYGON_VERTEX_EXCLUSION)
_CIRCLES = (_C.NAV_FENCE_CIRCLE_INCLUSION, _C.NAV_FENCE_CIRCLE_EXCLUSION)
_TYPE_NUMBERS: dict[int, int] = {
    _C.NAV_FENCE_POLYGON_VERTEX_INCLUSION: 98,
    _C.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: 97,
    _C.NAV_FENCE_RETURN_POINT: 95,
    _C.NAV_FENCE_CIRCLE_EXCLUSION: 93,
    _C.NAV_FENCE_CIRCLE_INCLUSION: 92,
}
_STORAGE_BYTES = 560
_BYTES_PER_POINT = 8
_MOST_VERTICES = 255

Say = Callable[[str], None]


class FenceList(ItemList):
    """While an upload goes on, its items count and the stored ones are what is read."""

    name = "Fence"

    def __init__(self, capacity: int = _STORAGE_BYTES // _BYTES_PER_POINT) -> None:
        super().__init__(capacity)
        self._stored: list[MissionItem] = []
        self._coming: list[MissionItem | None] | None = None

    @property
    def count(self) -> int:
        """How many are stored; of an upload, how many are to come."""
        return len(self._stored if self._coming is None else self._coming)

    def items(self) -> list[MissionItem]:
        return list(self._stored)

    def item(self, seq: int) -> MissionItem | int:
        return self._stored[seq] if seq < len(self._stored) else MavMissionResult.INVALID_SEQUENCE

    def begin(self, count: int) -> None:
        """Make room beside the stored fence."""
        coming: list[MissionItem | None] = [None for _ in range(count)]
        self._coming = coming

    def begin_update(self) -> None:
        self._coming = list(self._stored)

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        assert self._coming is not None
        if seq >= len(self._coming):
            return MavMissionResult.INVALID_SEQUENCE
        kept = _kept(item)
        if isinstance(kept, int):
            return kept
        self._coming[seq] = kept
        return MavMissionResult.ACCEPTED

    def finish(self, say: Say) -> int:
        assert self._coming is not None
        return self.store([item for item in self._coming if item is not None], say)

    def abandon(self) -> None:
        self._coming = None

    def clear(self) -> bool:
        self._stored = []
        return True

    def store(self, items: Sequence[MissionItem], say: Say) -> int:
        """Put a fence into force if it is one; the result."""
        problem = _problem(items)
        if problem is not None:
            say(problem)
            say("Fence validation failed")
            return MavMissionResult.ERROR
        if _storage_needed(items) > _STORAGE_BYTES:
            say("Fence exceeds storage size")
            return MavMissionResult.ERROR
        self._stored = list(items)
        return MavMissionResult.ACCEPTED

    def replace(self, items: Sequence[MissionItem], say: Say) -> int:
        kept = [_kept(item) for item in items]
        for item in kept:
            if isinstance(item, int):
                return item
        return self.store([item for item in kept if not isinstance(item, int)], say)


def _kept(item: MissionItem) -> MissionItem | int:
    if item.frame == MavFrame.MISSION or altitude_frame(item.frame) is None:
        return MavMissionResult.UNSUPPORTED_FRAME
    size = 0.0
    if item.command in _POLYGONS:
        if item.param1 > _MOST_VERTICES:
            return MavMissionResult.INVALID_PARAM1
        size = float(whole(item.param1) & 0xFF)
    elif item.command in _CIRCLES:
        size = float32(item.param1)
    elif item.command != _C.NAV_FENCE_RETURN_POINT:
        return MavMissionResult.UNSUPPORTED
    return MissionItem(
        item.command, MavFrame.GLOBAL, size, x=int(item.x), y=int(item.y), z=0.0, autocontinue=False
    )


def _problem(items: Sequence[MissionItem]) -> str | None:
    """What is wrong with a fence, as the firmware words it."""
    wanted, vertices, missing, has_return_point = 0, 0.0, 0, False
    for item in items:
        if item.command in _POLYGONS:
            if item.param1 < 3:
                return f"Invalid vertex count ({item.param1:.0f})"
            if missing == 0:
                wanted, vertices, missing = item.command, item.param1, int(item.param1)
            elif item.command != wanted:
                return f"Received incorrect vertex type (want={_number(wanted)} got={_number(item.command)})"
            elif item.param1 != vertices:
                return f"Unexpected vertex count want={vertices:.0f} got={item.param1:.0f}"
            missing -= 1
        elif missing:
            return f"Received incorrect type (want={_number(wanted)} got={_number(item.command)})"
        elif item.command in _CIRCLES and not item.param1 > 0:
            return "Non-positive circle radius"
        elif item.command == _C.NAV_FENCE_RETURN_POINT:
            if has_return_point:
                return "Multiple return points"
            has_return_point = True
        if is_place(item.x, item.y) != MavMissionResult.ACCEPTED:
            return "Bad lat or lon"
    return "Incorrect item count" if missing else None


def _number(command: int) -> int:
    return _TYPE_NUMBERS.get(command, 0)


def _storage_needed(items: Sequence[MissionItem]) -> int:
    size, left = 4, 0
    for item in items:
        size += _BYTES_PER_POINT
        if left:
            left -= 1
            continue
        size += 1
        if item.command in _POLYGONS:
            size, left = size + 1, int(item.param1) - 1
        elif item.command in _CIRCLES:
            size += 4
    return size
