"""ArduPilot's three lists of mission items, as its transfer protocol changes them.

Commands and rally points are changed in place, item by item, while they come: an upload that breaks off leaves a list
that is neither the old nor the new one. A fence is put together aside and checked as a whole at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.mission_items import altitude_frame, is_place, stored
from aerokit.sim.missions import float32

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.parameter_tables import Kind

__all__ = ["CommandList", "ItemList", "RallyList"]

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
        """With home."""
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
        """Cut what is longer."""
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
        """Not while it is being flown."""
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
        """How many there are."""
        return len(self._points)

    def item(self, seq: int) -> MissionItem | int:
        """A point at 0, 0 counts as none."""
        if seq >= len(self._points):
            return MavMissionResult.INVALID_SEQUENCE
        point = self._points[seq]
        return MavMissionResult.INVALID_SEQUENCE if (point.x, point.y) == (0, 0) else point

    def begin(self, count: int) -> None:
        """Cut what is longer."""
        del self._points[count:]

    def put(self, seq: int, item: MissionItem, last: int) -> int:
        """Replace or append."""
        kept = _kept_rally_point(item)
        if isinstance(kept, int):
            return kept
        if seq > len(self._points) or seq >= self.capacity:
            return MavMissionResult.ERROR
        self._points[seq : seq + 1] = [kept]
        return MavMissionResult.ACCEPTED

    def clear(self) -> bool:
        """Always."""
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
