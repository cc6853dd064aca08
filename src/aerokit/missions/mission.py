"""``Mission``: what a vehicle is to fly, item by item, as a value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, overload

from aerokit.errors import InvalidArgument
from aerokit.missions.check import check_items
from aerokit.missions.compare import items_differences
from aerokit.missions.item import MissionItem
from aerokit.missions.storage import Storage
from aerokit.missions.wire import with_home, without_home
from aerokit.position import Position
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self

__all__ = ["Mission"]


class Mission(Snapshot):
    """``Mission([take_off(altitude_relative_m=20), waypoint(47.3, 8.5, altitude_relative_m=20), land()])``.

    ``items`` are counted from 0 and never contain home, whatever the autopilot: jumps, progress and errors count the
    same way. ``home`` is where the planner thought it to be, for files; a vehicle uses its own. Like a tuple of its
    items it can be indexed, sliced and iterated; ``items`` becomes a tuple, whatever it is made of.
    """

    MISSION_TYPE: ClassVar[int] = 0

    items: Sequence[MissionItem] = ()
    home: Position | None = None

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Raise :class:`InvalidArgument`, which names item, field, value and what is allowed, unless it can be sent.

        NaN passes where the standard gives it a meaning ("not given"): headings, reserved parameters. With
        ``home_is_item_0``, which says whether it is for an ArduPilot, more can be said: one item fewer fits there,
        and elsewhere 0°, 0° is not "where the vehicle is".
        """
        check_items(self.items, self.MISSION_TYPE, home_is_item_0=home_is_item_0)

    def differences(self, found: Mission, storage: Storage = Storage.ANY) -> tuple[str, ...]:
        """What ``found``, from a vehicle, has otherwise than this mission, one text each; empty when it is the same.

        What the wire and the memory of the autopilot in ``storage`` change is no difference, nor is home.
        """
        return items_differences(self.items, found.items, storage)

    def matches(self, found: Mission, storage: Storage = Storage.ANY) -> bool:
        """Whether there are no differences."""
        return not self.differences(found, storage)

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """The items as the vehicle counts them: for ArduPilot with home in front, and jumps counted accordingly."""
        return with_home(self.items, self.home) if home_is_item_0 else tuple(self.items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """The inverse of :meth:`to_items`."""
        return cls(*without_home(items)) if home_is_item_0 else cls(items)

    def _check(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        for index, item in enumerate(self.items):
            if not isinstance(item, MissionItem):
                raise InvalidArgument(f"item {index} = {item!r} is no MissionItem")

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[MissionItem]:
        return iter(self.items)

    @overload
    def __getitem__(self, index: int) -> MissionItem: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[MissionItem, ...]: ...
    def __getitem__(self, index: int | slice) -> MissionItem | tuple[MissionItem, ...]:
        return self.items[index]  # type: ignore[return-value]
