"""Missions, fences and rally points of a simulated vehicle: conversions, ``@MISSION`` files, fence zones.

`sim.ardupilot.mission_server` and `sim.px4.mission_server` extend the server of `protocols.servers.missions` with the
behaviour of the autopilots. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink.enums import MavCmd, MavMissionResult, MavMissionType
from aerokit.mavlink.messages import MissionItemInt
from aerokit.missions import MissionItem
from aerokit.missions.wire import HEADER, NO_CLEAR, pack_items, read_header, unpack_items
from aerokit.protocols.servers.files import EINVAL, ENFILE, ENOENT, FileFault, FileHandle, Mount, UploadedFile
from aerokit.sim.motion import LocalFrame, Ned

INVALID_INDEX = 0xFFFF
"""The value of an unset index."""


class MissionStore(Protocol):
    """The missions of a vehicle, as its file server uses them.

    ``mission_type`` is a MAV_MISSION_TYPE: 0 mission, 1 fence, 2 rally points.
    """

    @property
    def transfer_is_open(self) -> bool: ...

    def items(self, mission_type: int) -> list[MissionItem]:
        """Return the items that a download sends, including ArduPilot's home (item 0)."""
        ...

    def replace(self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True) -> int:
        """Store all ``items`` at once, as the upload of a file does. ``start`` is the index of the first one.

        ``clear`` deletes the old items first. Return the MAV_MISSION_RESULT.
        """
        ...


def float32(value: float) -> float:
    """Round to single precision. Values beyond its range become infinite."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


_FILES = {"mission.dat": MavMissionType.MISSION, "fence.dat": MavMissionType.FENCE, "rally.dat": MavMissionType.RALLY}
# Parts of an upload that were not received are zero bytes, which decode as this item.
_EMPTY = MissionItem(0, 0, autocontinue=False)
_PLACEHOLDER_SIZE = 1 << 20


class MissionMount(Mount):
    """The virtual files of ``@MISSION``. They accept one upload at a time. Opening always reports a size of 1 MiB."""

    def __init__(self, store: MissionStore) -> None:
        self._store = store
        self._writer: _Writer | None = None  # the upload that is open; None without one

    def size(self, path: str) -> int:
        _type_of(path)
        return _PLACEHOLDER_SIZE

    def open(self, path: str, *, writing: bool) -> FileHandle:
        type_ = _type_of(path)
        if not writing:
            return _Reader(self._store, type_)
        if self._writer is not None and not self._writer.is_closed:
            raise FileFault(ENFILE)
        self._writer = _Writer(self._store, type_)
        return self._writer


class _Reader(FileHandle):
    """Like ArduPilot, it reads the header when it is opened, and each item when it is requested."""

    def __init__(self, store: MissionStore, type_: int) -> None:
        self._store = store
        self._type = type_
        self._items = list(store.items(type_))
        self._content = _packed(self._items, type_)
        self._header = self._content[: HEADER.size]

    def read(self, offset: int, size: int) -> bytes:
        items = self._store.items(self._type)
        if items != self._items:
            self._items = list(items)
            self._content = self._header + _packed(self._items, self._type)[HEADER.size :]
        return self._content[offset : offset + size]


class _Writer(UploadedFile):
    """Upload of a list of items. An incomplete upload has no effect. No status text reports a failed upload."""

    def __init__(self, store: MissionStore, type_: int) -> None:
        super().__init__()
        self.is_closed = False
        self._store = store
        self._type = type_

    def announced_size(self, data: bytes) -> int:
        with suppress(RemoteProtocolError):
            header = read_header(data)
            return header.length if header.item_count < INVALID_INDEX else 0
        return 0

    def close(self) -> None:
        self.is_closed = True
        try:
            header = read_header(bytes(self.content))
            items = unpack_items(bytes(self.content[: header.length]))
        except (RemoteProtocolError, InvalidArgument):
            raise FileFault(EINVAL) from None
        # ArduPilot rejects items that the header does not announce, and items whose bytes are all 0
        # (AP_Filesystem_Mission.cpp, finish_upload).
        has_extra_item = len(self.content) >= header.length + MissionItemInt.LENGTH
        if has_extra_item or _EMPTY in items:
            raise FileFault(EINVAL)
        clear = not header.options & NO_CLEAR
        result = self._store.replace(self._type, items, start=header.first_index, clear=clear)
        if result != MavMissionResult.ACCEPTED:
            raise FileFault(EINVAL)


def _packed(items: list[MissionItem], type_: int) -> bytes:
    return pack_items([item.replace(x=int(item.x), y=int(item.y)) for item in items], type_)


def _type_of(path: str) -> int:
    if path not in _FILES:
        raise FileFault(ENOENT)
    return _FILES[path]


_POLYGON_INCLUSION, _CIRCLE_INCLUSION = MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, MavCmd.NAV_FENCE_CIRCLE_INCLUSION
POLYGON_CORNERS = (_POLYGON_INCLUSION, MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION)
CIRCLES = (_CIRCLE_INCLUSION, MavCmd.NAV_FENCE_CIRCLE_EXCLUSION)
Point = tuple[float, float]


class FenceZones:
    """Inclusion and exclusion zones of an uploaded fence. A `Point` is (north, east) in the world frame, in metres."""

    def __init__(self, items: Sequence[MissionItem], frame: LocalFrame) -> None:
        self._inclusions: list[PolygonZone | CircleZone] = []
        self._exclusions: list[PolygonZone | CircleZone] = []
        places = [frame.to_local(round(item.x), round(item.y)) for item in items]
        index = 0
        while index < len(items):
            item = items[index]
            is_inclusion = item.command in (_POLYGON_INCLUSION, _CIRCLE_INCLUSION)
            zones = self._inclusions if is_inclusion else self._exclusions
            count = 1  # number of items of this zone
            if item.command in CIRCLES:
                zones.append(CircleZone(places[index], item.param1))
            elif item.command in POLYGON_CORNERS:
                count = max(1, int(item.param1))  # Param 1 of each corner is the number of corners.
                zones.append(PolygonZone(places[index : index + count]))
            index += count

    def __bool__(self) -> bool:
        # A return point is not a zone.
        return bool(self._inclusions or self._exclusions)

    @property
    def smallest_inclusion_m(self) -> float:
        """Radius of the smallest inclusion circle."""
        return min((zone.radius for zone in self._inclusions if isinstance(zone, CircleZone)), default=math.inf)

    def breach_m(self, place: Point, *, union: bool = False) -> float:
        """Return the distance beyond the border in metres, which is negative inside the allowed area.

        With ``union``, the allowed area is the union of the inclusion zones. Otherwise it is their intersection.
        """
        out_of_inclusions = [zone.outside_m(place) for zone in self._inclusions]
        into_exclusions = [-zone.outside_m(place) for zone in self._exclusions]
        if union and out_of_inclusions:  # A place inside one of the inclusion zones is allowed.
            out_of_inclusions = [min(out_of_inclusions)]
        return max(out_of_inclusions + into_exclusions, default=-math.inf)


class CircleZone:
    """Circle with a radius in metres."""

    def __init__(self, center: Point, radius: float) -> None:
        self.radius = radius
        self._center = center

    def outside_m(self, place: Point) -> float:
        """Return the distance from the border in metres, which is negative inside."""
        return math.dist(place, self._center) - self.radius


class PolygonZone:
    """Polygon given by its corners in order."""

    def __init__(self, corners: Sequence[Point]) -> None:
        self._sides = list(zip(corners, [*corners[1:], corners[0]], strict=True))

    def outside_m(self, place: Point) -> float:
        """Return the distance from the border in metres, which is negative inside."""
        distance = min(distance_to_segment((*place, 0.0), (*start, 0.0), (*end, 0.0)) for start, end in self._sides)
        crossings = sum(_crosses(place, start, end) for start, end in self._sides)
        is_inside = crossings % 2 == 1  # A ray from a point inside crosses the border an odd number of times.
        return -distance if is_inside else distance


def vector_between(start: Ned, end: Ned) -> Ned:
    start_north, start_east, start_down = start
    north, east, down = end
    return (north - start_north, east - start_east, down - start_down)


def dot_product(first: Ned, second: Ned) -> float:
    first_north, first_east, first_down = first
    north, east, down = second
    return first_north * north + first_east * east + first_down * down


def point_along(start: Ned, line: Ned, share: float) -> Ned:
    start_north, start_east, start_down = start
    north, east, down = line
    return (start_north + share * north, start_east + share * east, start_down + share * down)


def distance_to_segment(point: Ned, start: Ned, end: Ned) -> float:
    """Return the distance of a point from the line between two places, in metres."""
    line = vector_between(start, end)
    squared_length = dot_product(line, line)
    share = 0.0  # Place on the line that is nearest to the point: 0 is the start, 1 the end.
    if squared_length != 0.0:
        share = max(0.0, min(1.0, dot_product(vector_between(start, point), line) / squared_length))
    return math.dist(point, point_along(start, line, share))


def _crosses(place: Point, start: Point, end: Point) -> bool:
    """Return True if a ray from ``place`` to the north crosses the line from ``start`` to ``end``."""
    place_north, place_east = place
    start_north, start_east = start
    end_north, end_east = end
    if (start_east > place_east) == (end_east > place_east):
        return False
    share = (place_east - start_east) / (end_east - start_east)
    return place_north < start_north + share * (end_north - start_north)
