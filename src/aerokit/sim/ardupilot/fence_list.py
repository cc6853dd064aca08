"""The fence of a simulated ArduPilot: polygons, circles and a return point, checked as a whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.mission_items import altitude_frame, is_place, whole
from aerokit.sim.ardupilot.mission_lists import ItemList
from aerokit.sim.missions import float32

__all__ = ["FenceList"]

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
        """What is stored."""
        return list(self._stored)

    def item(self, seq: int) -> MissionItem | int:
        """Out of what is stored."""
        return self._stored[seq] if seq < len(self._stored) else MavMissionResult.INVALID_SEQUENCE

    def begin(self, count: int) -> None:
        """Make room beside the stored fence."""
        coming: list[MissionItem | None] = [None for _ in range(count)]
        self._coming = coming

    def begin_update(self) -> None:
        """What is not sent stays as it is."""
        self._coming = list(self._stored)

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        """Keep it for later."""
        assert self._coming is not None
        if seq >= len(self._coming):
            return MavMissionResult.INVALID_SEQUENCE
        kept = _kept(item)
        if isinstance(kept, int):
            return kept
        self._coming[seq] = kept
        return MavMissionResult.ACCEPTED

    def finish(self, say: Say) -> int:
        """Check the whole fence and put it into force."""
        assert self._coming is not None
        return self.store([item for item in self._coming if item is not None], say)

    def abandon(self) -> None:
        """The stored fence stays."""
        self._coming = None

    def clear(self) -> bool:
        """Always."""
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
        """All at once, as a file does."""
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
