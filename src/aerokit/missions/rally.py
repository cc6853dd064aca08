"""``RallyPoints``: where a vehicle may return to instead of home (PX4 calls them safe points).

https://mavlink.io/en/services/mission.html#mission-types
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, overload

from aerokit.errors import InvalidArgument
from aerokit.missions.check import check_items
from aerokit.missions.compare import items_differences
from aerokit.missions.item import MissionItem
from aerokit.missions.storage import Storage
from aerokit.position import Position
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self

__all__ = ["RallyPoints"]


class RallyPoints(Snapshot):
    """``RallyPoints([rally_point(47.3, 8.5, altitude_relative_m=30)])``; ``items`` becomes a tuple.

    ArduPilot keeps their altitudes in whole metres, -32,768 to 32,767.
    """

    MISSION_TYPE: ClassVar[int] = 2

    items: Sequence[MissionItem] = ()

    @property
    def positions(self) -> tuple[Position, ...]:
        """The places; what is no place on earth is left out."""
        return tuple(item.position for item in self.items if item.position is not None)

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Raise :class:`InvalidArgument`, which names item, field and what is allowed, unless it can be sent."""
        check_items(self.items, self.MISSION_TYPE)

    def differences(self, found: RallyPoints, storage: Storage = Storage.ANY) -> tuple[str, ...]:
        """What the other points have otherwise, one text each; see Mission.differences."""
        return items_differences(self.items, found.items, storage)

    def matches(self, found: RallyPoints, storage: Storage = Storage.ANY) -> bool:
        """Whether there are no differences."""
        return not self.differences(found, storage)

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """The items as they are: home is never among them."""
        return tuple(self.items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """The inverse of :meth:`to_items`."""
        return cls(items)

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
