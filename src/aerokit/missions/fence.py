"""``Fence``: where a vehicle may and may not be, as polygons and circles.

https://mavlink.io/en/services/mission.html#mission-types

https://mavlink.io/en/services/mission.html#mission-types
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, ClassVar, overload

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.check import check_items
from aerokit.missions.compare import Storage, items_differences
from aerokit.missions.item import MissionItem
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self

_POLYGON = {True: MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, False: MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION}

_CIRCLE = {True: MavCmd.NAV_FENCE_CIRCLE_INCLUSION, False: MavCmd.NAV_FENCE_CIRCLE_EXCLUSION}


class FencePolygon(Snapshot):
    """A polygon of at least three places, inside which the vehicle must stay, or which it must not enter.

    ``vertices`` becomes a tuple; the altitudes of its places do not count. At most 255 fit into an ArduPilot.
    """

    vertices: Sequence[Position]
    inclusion: bool = True

    def _check(self) -> None:
        object.__setattr__(self, "vertices", tuple(self.vertices))
        for index, vertex in enumerate(self.vertices):
            if not isinstance(vertex, Position):
                raise InvalidArgument(f"vertices[{index}] = {vertex!r} is no Position")
        if len(self.vertices) < 3:
            raise InvalidArgument(f"vertices has {len(self.vertices)} places, a polygon needs at least 3")


class FenceCircle(Snapshot):
    """A circle of ``radius_m`` metres around a place, to stay inside of or to keep out of."""

    center: Position
    radius_m: float
    inclusion: bool = True

    def _check(self) -> None:
        if not isinstance(self.center, Position):
            raise InvalidArgument(f"center = {self.center!r} is no Position")
        if not isinstance(self.radius_m, (float, int, Real)) or not 0 < self.radius_m < 3e7:
            raise InvalidArgument(
                f"radius_m = {self.radius_m!r} is not allowed: above 0 m, and on this planet"
            )


class Fence(Snapshot):
    """``Fence(polygons=[FencePolygon([...])], circles=[FenceCircle(home, 300.0)])``; empty: no fence.

    ``return_point`` is where a vehicle goes that has left it (Plane, and PX4 where it is set up so). Both sequences
    become tuples.
    """

    MISSION_TYPE: ClassVar[int] = 1

    polygons: Sequence[FencePolygon] = ()
    circles: Sequence[FenceCircle] = ()
    return_point: Position | None = None

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Raise :class:`InvalidArgument` unless it can be sent; a fence never has home in it."""
        check_items(self.to_items(), self.MISSION_TYPE)

    def differences(self, found: Fence, storage: Storage = Storage.ANY) -> tuple[str, ...]:
        """What the other fence has otherwise, in the items that are sent, one text each; see Mission.differences."""
        return items_differences(self.to_items(), found.to_items(), storage)

    def matches(self, found: Fence, storage: Storage = Storage.ANY) -> bool:
        """Whether there are no differences."""
        return not self.differences(found, storage)

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """The items: vertices, each with the number of them in its polygon, then circles, then the return point."""
        items = [
            _item(_POLYGON[polygon.inclusion], place, float(len(polygon.vertices)))
            for polygon in self.polygons
            for place in polygon.vertices
        ]
        items += [_item(_CIRCLE[circle.inclusion], circle.center, circle.radius_m) for circle in self.circles]
        if self.return_point is not None:
            items.append(_return_item(self.return_point))
        return tuple(items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """The inverse of :meth:`to_items`, in whatever order a vehicle has them.

        Raises :class:`RemoteProtocolError`, which names the item, when they make no fence.
        """
        polygons: list[FencePolygon] = []
        circles: list[FenceCircle] = []
        return_point: Position | None = None
        index = 0
        while index < len(items):
            item, taken = items[index], 1
            if item.command in _POLYGON.values():
                polygon = _read_polygon(items, index)
                polygons.append(polygon)
                taken = len(polygon.vertices)
            elif item.command in _CIRCLE.values():
                circles.append(_read_circle(item, index))
            elif item.command == MavCmd.NAV_FENCE_RETURN_POINT:
                return_point = _place(item, index)
            else:
                raise RemoteProtocolError(f"item {index} ({item.name}) does not belong into a fence")
            index += taken
        return cls(polygons, circles, return_point)

    def _check(self) -> None:
        for name, kind in (("polygons", FencePolygon), ("circles", FenceCircle)):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            for index, value in enumerate(values):
                if not isinstance(value, kind):
                    raise InvalidArgument(f"{name}[{index}] = {value!r} is no {kind.__name__}")


def _item(command: MavCmd, place: Position, param1: float) -> MissionItem:
    x, y = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    return MissionItem(command, MavFrame.GLOBAL, param1, x=x, y=y)


def _return_item(place: Position) -> MissionItem:
    item = _item(MavCmd.NAV_FENCE_RETURN_POINT, place, 0.0)
    if place.altitude_relative_m is not None:
        return item.replace(frame=MavFrame.GLOBAL_RELATIVE_ALT, z=place.altitude_relative_m)
    return item.replace(z=place.altitude_amsl_m or 0.0)


def _read_polygon(items: Sequence[MissionItem], first: int) -> FencePolygon:
    """The vertices from there on; PX4 and ArduPilot repeat their number in each."""
    item = items[first]
    count = int(item.param1) if 3 <= item.param1 <= 0xFFFF else 0
    vertices = items[first : first + count]
    if not count or len(vertices) < count or any(one.command != item.command for one in vertices):
        raise RemoteProtocolError(
            f"item {first} ({item.name}) begins a polygon of {item.param1:g} vertices, and they are not all there"
        )
    places = [_place(vertex, first + number) for number, vertex in enumerate(vertices)]
    return FencePolygon(places, item.command == _POLYGON[True])


def _read_circle(item: MissionItem, index: int) -> FenceCircle:
    center = _place(item, index)
    try:
        return FenceCircle(center, item.param1, item.command == _CIRCLE[True])
    except InvalidArgument as error:
        raise RemoteProtocolError(f"item {index} ({item.name}): {error}") from error


def _place(item: MissionItem, index: int) -> Position:
    """Its latitude and longitude; of the return point also the altitude."""
    try:
        place = Position(item.x / 1e7, item.y / 1e7)
    except InvalidArgument as error:
        raise RemoteProtocolError(f"item {index} ({item.name}): {error}") from error
    if item.command != MavCmd.NAV_FENCE_RETURN_POINT or (item.z == 0 and item.frame == MavFrame.GLOBAL):
        return place
    return item.position or place


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
