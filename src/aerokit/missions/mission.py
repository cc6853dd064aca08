"""``Mission``, ``Fence``, ``RallyPoints`` and ``Plan``: immutable values that describe what a vehicle flies.

See https://mavlink.io/en/services/mission.html#mission-types.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, overload

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.check import check_items
from aerokit.missions.compare import ItemStorage, plan_differences
from aerokit.missions.item import MissionItem, canonical_frame
from aerokit.missions.wire import with_home, without_home
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self


class _ItemSequence(Snapshot):
    """Base class of plans that are sequences of items."""

    MISSION_TYPE: ClassVar[int]

    items: Sequence[MissionItem] = ()

    def differences(self, found: Self, storage: ItemStorage = ItemStorage.ANY) -> tuple[str, ...]:
        """Return one text for each difference between this plan and ``found``, which was read from a vehicle.

        Home is not compared. Changes that the protocol or the autopilot's ``storage`` makes to items are ignored.
        """
        return plan_differences(self.items, found.items, storage)

    def matches(self, found: Self, storage: ItemStorage = ItemStorage.ANY) -> bool:
        """Return True if there are no differences."""
        return not self.differences(found, storage)

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Check that all items can be sent.

        NaN is accepted where the standard defines it as "not given": headings and reserved parameters.

        Args:
            home_is_item_0: True for missions of ArduPilot: at most 65,534 items are allowed, because home is sent as an
                item, too. False for other autopilots: destinations at 0°, 0° are refused, because only ArduPilot takes
                them for the current position. None skips both checks.

        Raises:
            InvalidArgument: an item cannot be sent; the text names item, field, value and the allowed values.
        """
        check_items(self.items, self.MISSION_TYPE, home_is_item_0=home_is_item_0)

    def _check(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        for index, item in enumerate(self.items):
            if not isinstance(item, MissionItem):
                raise InvalidArgument(f"item {index} = {item!r} is not a MissionItem")

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


class Mission(_ItemSequence):
    """A mission: ``Mission([take_off(20), waypoint(47.3, 8.5, altitude_relative_m=20), land()])``.

    For any autopilot, ``items`` are counted from 0 and never include home. Jumps, progress and errors use the same
    indices. ``home`` is the planned home position and only used in files, because a vehicle uses its own home. A
    mission can be indexed, sliced and iterated like a tuple of its items; ``items`` is converted to a tuple.
    """

    MISSION_TYPE: ClassVar[int] = 0

    home: Position | None = None

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """Return the items as the vehicle counts them. For ArduPilot, home is added and jump targets are adjusted."""
        return with_home(self.items, self.home) if home_is_item_0 else tuple(self.items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """Create a mission from the items of a vehicle; the inverse of :meth:`to_items`."""
        return cls(*without_home(items)) if home_is_item_0 else cls(items)


# Maps the argument `inclusion` to the command of a polygon.
_POLYGON = {True: MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, False: MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION}

_CIRCLE = {True: MavCmd.NAV_FENCE_CIRCLE_INCLUSION, False: MavCmd.NAV_FENCE_CIRCLE_EXCLUSION}


class FencePolygon(Snapshot):
    """A polygon of at least three vertices. The vehicle must stay inside or, if ``inclusion`` is False, outside.

    ``vertices`` is converted to a tuple; altitudes are ignored. ArduPilot stores at most 255 vertices.
    """

    vertices: Sequence[Position]
    inclusion: bool = True

    def _check(self) -> None:
        object.__setattr__(self, "vertices", tuple(self.vertices))
        for index, vertex in enumerate(self.vertices):
            if not isinstance(vertex, Position):
                raise InvalidArgument(f"vertices[{index}] = {vertex!r} is not a Position")
        if len(self.vertices) < 3:
            raise InvalidArgument(f"vertices has {len(self.vertices)} places; a polygon needs at least 3")


class FenceCircle(Snapshot):
    """A circle. The vehicle must stay inside or, if ``inclusion`` is False, outside."""

    center: Position
    radius_m: float
    inclusion: bool = True

    def _check(self) -> None:
        if not isinstance(self.center, Position):
            raise InvalidArgument(f"center = {self.center!r} is not a Position")
        if not isinstance(self.radius_m, (float, int, Real)) or not 0 < self.radius_m < 3e7:
            raise InvalidArgument(f"radius_m = {self.radius_m!r} is not allowed: it must be above 0 and below 3e7")


class Fence(Snapshot):
    """A geofence: ``Fence(polygons=[FencePolygon([...])], circles=[FenceCircle(home, 300.0)])``.

    ``Fence()`` is an empty fence. ``return_point`` is the destination after a breach (Plane, and PX4 if configured).
    Both sequences are converted to tuples.
    """

    MISSION_TYPE: ClassVar[int] = 1

    polygons: Sequence[FencePolygon] = ()
    circles: Sequence[FenceCircle] = ()
    return_point: Position | None = None

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Raise :class:`InvalidArgument` if the fence cannot be sent. ``home_is_item_0`` has no effect on a fence."""
        check_items(self.to_items(), self.MISSION_TYPE)

    def differences(self, found: Fence, storage: ItemStorage = ItemStorage.ANY) -> tuple[str, ...]:
        """Describe how ``found`` differs from this fence, item by item; see `Mission.differences`."""
        return plan_differences(self.to_items(), found.to_items(), storage)

    def matches(self, found: Fence, storage: ItemStorage = ItemStorage.ANY) -> bool:
        """Return True if there are no differences."""
        return not self.differences(found, storage)

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """Return the items: vertices, each with the size of its polygon, then circles, then the return point."""
        items = [
            _fence_item(_POLYGON[polygon.inclusion], place, float(len(polygon.vertices)))
            for polygon in self.polygons
            for place in polygon.vertices
        ]
        items += [_fence_item(_CIRCLE[circle.inclusion], circle.center, circle.radius_m) for circle in self.circles]
        if self.return_point is not None:
            items.append(_return_item(self.return_point))
        return tuple(items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """Create a fence from the items of a vehicle; the inverse of :meth:`to_items`.

        The order does not matter, except that the vertices of a polygon must follow each other. If there are several
        return points, the last one counts.

        Raises:
            RemoteProtocolError: the items do not form a fence; the text names the item.
        """
        polygons: list[FencePolygon] = []
        circles: list[FenceCircle] = []
        return_point: Position | None = None
        index = 0
        while index < len(items):
            item, item_count = items[index], 1
            if item.command in _POLYGON.values():
                polygon = _read_polygon(items, index)
                polygons.append(polygon)
                item_count = len(polygon.vertices)
            elif item.command in _CIRCLE.values():
                circles.append(_read_circle(item, index))
            elif item.command == MavCmd.NAV_FENCE_RETURN_POINT:
                return_point = _place(item, index)
            else:
                raise RemoteProtocolError(f"item {index} ({item.name}) does not belong to a fence")
            index += item_count
        return cls(polygons, circles, return_point)

    def _check(self) -> None:
        for name, kind in (("polygons", FencePolygon), ("circles", FenceCircle)):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            for index, value in enumerate(values):
                if not isinstance(value, kind):
                    raise InvalidArgument(f"{name}[{index}] = {value!r} is not a {kind.__name__}")


def _fence_item(command: MavCmd, place: Position, param1: float) -> MissionItem:
    x, y = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    return MissionItem(command, MavFrame.GLOBAL, param1, x=x, y=y)


def _return_item(place: Position) -> MissionItem:
    item = _fence_item(MavCmd.NAV_FENCE_RETURN_POINT, place, 0.0)
    if place.altitude_relative_m is not None:
        return item.replace(frame=MavFrame.GLOBAL_RELATIVE_ALT, z=place.altitude_relative_m)
    return item.replace(z=place.altitude_amsl_m or 0.0)


def _read_polygon(items: Sequence[MissionItem], first_index: int) -> FencePolygon:
    """Return the polygon whose vertices begin at item ``first_index``.

    Raises RemoteProtocolError if vertices are missing.
    """
    item = items[first_index]
    # On PX4 and ArduPilot, every vertex contains the number of vertices of its polygon.
    count = int(item.param1) if 3 <= item.param1 <= 0xFFFF else 0  # A polygon has at least 3 vertices.
    vertices = items[first_index : first_index + count]
    if not count:
        raise RemoteProtocolError(
            f"item {first_index} ({item.name}) begins a polygon of {item.param1:g} vertices,"
            " but 3 to 65535 are possible"
        )
    if len(vertices) < count or any(vertex.command != item.command for vertex in vertices):
        raise RemoteProtocolError(
            f"item {first_index} ({item.name}) begins a polygon of {item.param1:g} vertices,"
            " but some of them are missing"
        )
    places = [_place(vertex, index) for index, vertex in enumerate(vertices, first_index)]
    is_inclusion = item.command == MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION
    return FencePolygon(places, is_inclusion)


def _read_circle(item: MissionItem, index: int) -> FenceCircle:
    center = _place(item, index)
    is_inclusion = item.command == MavCmd.NAV_FENCE_CIRCLE_INCLUSION
    try:
        return FenceCircle(center, item.param1, is_inclusion)
    except InvalidArgument as error:
        raise RemoteProtocolError(f"item {index} ({item.name}): {error}") from error


def _place(item: MissionItem, index: int) -> Position:
    try:
        place = Position(item.x / 1e7, item.y / 1e7)
    except InvalidArgument as error:
        raise RemoteProtocolError(f"item {index} ({item.name}): {error}") from error
    # Of all fence items, only a return point has an altitude. In the frame GLOBAL, 0 means "unknown" (`_return_item`).
    has_altitude = item.command == MavCmd.NAV_FENCE_RETURN_POINT and (
        item.z != 0 or canonical_frame(item.frame) != MavFrame.GLOBAL
    )
    position_with_altitude = item.position if has_altitude else None
    return position_with_altitude or place


class RallyPoints(_ItemSequence):
    """Rally points: ``RallyPoints([rally_point(47.3, 8.5, altitude_relative_m=30)])``. ``items`` becomes a tuple.

    ArduPilot stores altitudes in whole metres, -32,768 to 32,767.
    """

    MISSION_TYPE: ClassVar[int] = 2

    @property
    def positions(self) -> tuple[Position, ...]:
        """The positions of all items that have a position."""
        return tuple(item.position for item in self.items if item.position is not None)

    def check(self, *, home_is_item_0: bool | None = None) -> None:
        """Check that all rally points can be sent. ``home_is_item_0`` has no effect.

        Raises:
            InvalidArgument: a point cannot be sent; the text names item, field, value and the allowed values.
        """
        super().check()

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """Return the items unchanged, because home is never among them."""
        return tuple(self.items)

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool = False) -> Self:
        """Create rally points from the items of a vehicle."""
        return cls(items)


class Plan(Snapshot):
    """A mission with its fence and rally points, as in one QGroundControl ``.plan`` file.

    ``mission.home`` is the planned home position. ``firmware_type`` (MAV_AUTOPILOT) and ``vehicle_type`` (MAV_TYPE)
    describe the vehicle that the plan was made for; ``cruise_speed_m_s`` (planes) and ``hover_speed_m_s`` (copters) are
    assumptions of the planner. ``source`` is the text of the file from which the plan was read. When the plan is
    written, only the parts of this text that differ from the plan are changed, so that surveys and unknown fields are
    kept. Comparisons of plans ignore ``source``.
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
        return tuple(self.to_dict().values())[:-1]  # Leave out the last field, `source`.

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Plan) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={value!r}" for name, value in self.to_dict().items() if name != "source")
        return f"Plan({fields})"
