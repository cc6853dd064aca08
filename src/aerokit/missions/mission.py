"""``Mission``: what a vehicle is to fly, item by item, as a value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, overload

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.missions.check import check_items
from aerokit.missions.compare import Storage, items_differences
from aerokit.missions.fence import Fence, RallyPoints
from aerokit.missions.item import MissionItem
from aerokit.missions.wire import with_home, without_home
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self


class Mission(Snapshot):
    """``Mission([take_off(20), waypoint(47.3, 8.5, altitude_relative_m=20), land()])``.

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


class Plan(Snapshot):
    """A mission with its fence and its rally points, as QGroundControl keeps them in one ``.plan`` file.

    ``mission.home`` is the planned home position. ``firmware_type`` is a MAV_AUTOPILOT and ``vehicle_type`` a
    MAV_TYPE, for which it was planned; ``cruise_speed_m_s`` (planes) and ``hover_speed_m_s`` (copters) are what the
    planner reckons with. ``source`` is the text of the file it was read from: writing changes in it only what has
    become different, so that surveys and whatever else stands there stay. It is not compared.
    """

    mission: Mission = Mission()
    fence: Fence = Fence()
    rally: RallyPoints = RallyPoints()
    firmware_type: int = 0
    vehicle_type: int = 2
    cruise_speed_m_s: float = 15.0
    hover_speed_m_s: float = 5.0
    source: str = ""

    def _key(self) -> tuple[Any, ...]:
        return tuple(self.to_dict().values())[:-1]

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Plan) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={value!r}" for name, value in self.to_dict().items() if name != "source")
        return f"Plan({fields})"
