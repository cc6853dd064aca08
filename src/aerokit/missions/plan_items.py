"""Items of a ``.plan`` file: simple items, and complex ones (surveys, landings) that consist of several.

https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html

Altitudes: ``frame`` and the last of ``params`` are flown. ``AltitudeMode``, ``Altitude`` and ``AMSLAltAboveTerrain``
are for display, and only count if the last of ``params`` is null. Jump targets are the ``doJumpId`` of an item, which
QGroundControl counts from 1.

A landing pattern in the file has settings instead of items. This module generates the items that QGroundControl sends:
DO_LAND_START, then commands that reset speed, photos and video, the approach, and the landing.
"""

from __future__ import annotations

import copy
import json
import math
from itertools import islice
from typing import TYPE_CHECKING, Any

from aerokit.errors import FileFormatError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import MissionItem, canonical_frame, has_place, xy_scale
from aerokit.missions.wire import from_degrees, in_degrees

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

LANDING_PATTERNS = {"fwLandingPattern": MavCmd.NAV_LAND, "vtolLandingPattern": MavCmd.NAV_VTOL_LAND}


def landing_items(pattern: JsonValue) -> tuple[MissionItem, ...]:
    """Generate the items of a ComplexItem of a type in :data:`LANDING_PATTERNS`."""
    command = LANDING_PATTERNS[pattern["complexItemType"].value]
    relative = pattern["altitudesAreRelative"].boolean()
    frame = MavFrame.GLOBAL_RELATIVE_ALT if relative else MavFrame.GLOBAL
    approach = pattern.child("landingApproachCoordinate") or pattern["loiterCoordinate"]
    heading = 0.0 if command == MavCmd.NAV_LAND else math.nan
    return (
        MissionItem(MavCmd.DO_LAND_START, MavFrame.MISSION),
        *_reset_items(pattern),
        _approach(pattern, frame, approach),
        MissionItem(command, frame, 0.0, 0.0, 0.0, heading, *_place(pattern["landCoordinate"])),
    )


def _reset_items(pattern: JsonValue) -> list[MissionItem]:
    items = []
    if _flag(pattern, "useDoChangeSpeed"):
        speed = pattern["finalApproachSpeed"].number(0)
        items.append(MissionItem(MavCmd.DO_CHANGE_SPEED, MavFrame.MISSION, 0.0, speed, -1.0))
    if _flag(pattern, "stopTakingPhotos"):
        items.append(MissionItem(MavCmd.DO_SET_CAM_TRIGG_DIST, MavFrame.MISSION))
        items.append(MissionItem(MavCmd.IMAGE_STOP_CAPTURE, MavFrame.MISSION))
    if _flag(pattern, "stopVideoPhotos"):
        items.append(MissionItem(MavCmd.VIDEO_STOP_CAPTURE, MavFrame.MISSION))
    return items


def _approach(pattern: JsonValue, frame: MavFrame, place: JsonValue) -> MissionItem:
    # Descend in a circle and leave it tangentially, or fly to a waypoint. Older files have circles only.
    if not _flag(pattern, "useLoiterToAlt", default=True):
        return MissionItem(MavCmd.NAV_WAYPOINT, frame, 0.0, 0.0, 0.0, math.nan, *_place(place))
    radius = pattern["loiterRadius"].number(0)
    turn = radius if pattern["loiterClockwise"].boolean() else -radius
    return MissionItem(MavCmd.NAV_LOITER_TO_ALT, frame, 1.0, turn, 0.0, 1.0, *_place(place))


def _flag(pattern: JsonValue, key: str, *, default: bool = False) -> bool:
    value = pattern.child(key)
    return default if value is None else value.boolean()


def _place(value: JsonValue) -> tuple[int, int, float]:
    latitude, longitude, altitude = value.elements(3)
    x, y = round(latitude.number(-90, 90) * 1e7), round(longitude.number(-180, 180) * 1e7)
    return x, y, altitude.number()


_FRAME_OF_MODE = {
    1: MavFrame.GLOBAL_RELATIVE_ALT,
    2: MavFrame.GLOBAL,
    3: MavFrame.GLOBAL,
    4: MavFrame.GLOBAL_TERRAIN_ALT,
}

_MODE_OF_FRAME: dict[int, int] = {
    MavFrame.GLOBAL: 2,
    MavFrame.GLOBAL_RELATIVE_ALT: 1,
    MavFrame.GLOBAL_TERRAIN_ALT: 4,
}


def read_entries(entries: Sequence[JsonValue]) -> list[tuple[MissionItem, ...]]:
    """Return the items of each entry of ``mission.items``. Jump targets are counted from 0 over all entries."""
    values = [_simple_values(entry) for entry in entries]
    generated = [landing_items(entry) if group is None else () for entry, group in zip(entries, values)]  # noqa: B905
    sizes = [len(items) if group is None else len(group) for items, group in zip(generated, values)]  # noqa: B905
    ids = _jump_ids(entries, values, sizes)
    return [
        items if group is None else tuple(_read_item(value, ids) for value in group)
        for items, group in zip(generated, values)  # noqa: B905 - same length
    ]


def merged_entries(
    entries: Sequence[Any], groups: Sequence[tuple[MissionItem, ...]], items: Sequence[MissionItem]
) -> list[Any]:
    """Return entries for ``items``. Old entries at the beginning and the end that still match are kept.

    ``groups`` are the items of each old entry.
    """
    head, used = 0, 0
    while head < len(groups) and _matches(groups[head], items[used : used + len(groups[head])]):
        used += len(groups[head])
        head += 1
    tail, end = len(groups), len(items)
    while tail > head and end - len(groups[tail - 1]) >= used:
        begin = end - len(groups[tail - 1])
        if not _matches(groups[tail - 1], items[begin:end]):
            break
        tail, end = tail - 1, begin
    middle = [simple_entry(item) for item in items[used:end]]
    merged = [*copy.deepcopy(list(entries[:head])), *middle, *copy.deepcopy(list(entries[tail:]))]
    sizes = [*map(len, groups[:head]), *(1,) * len(middle), *map(len, groups[tail:])]
    _number(merged, sizes, items)
    return merged


def simple_entry(item: MissionItem) -> dict[str, Any]:
    """Create a SimpleItem. The caller sets its doJumpId and the target of a jump."""
    x, y = in_degrees(item)
    numbers = (item.param1, item.param2, item.param3, item.param4, x, y, item.z)
    entry: dict[str, Any] = {}
    mode = _MODE_OF_FRAME.get(canonical_frame(item.frame))
    if has_place(item.command) and mode is not None:
        entry |= {"AMSLAltAboveTerrain": None, "Altitude": json_number(item.z), "AltitudeMode": mode}
    entry |= {"autoContinue": item.autocontinue, "command": int(item.command), "doJumpId": 0}
    return entry | {"frame": int(item.frame), "params": [*map(json_number, numbers)], "type": "SimpleItem"}


def json_number(value: float) -> int | float | None:
    """Convert a number as QGroundControl does: null for NaN, whole numbers without a decimal point."""
    if math.isnan(value):
        return None
    return int(value) if math.isfinite(value) and value == int(value) and abs(value) < 2**53 else value


def _simple_values(entry: JsonValue) -> list[JsonValue] | None:
    """Return the simple items in an entry, or None for a landing pattern, whose items are generated."""
    kind = entry["type"]
    kind.one_of("SimpleItem", "ComplexItem")
    if kind.value == "SimpleItem":
        return [entry]
    complex_type = entry["complexItemType"].value
    if isinstance(complex_type, str) and complex_type in LANDING_PATTERNS:
        return None
    body = entry.child("TransectStyleComplexItem")
    items = body.child("Items") if body is not None else None
    if items is None or not items.elements():
        raise entry.error(
            f"a complex item with TransectStyleComplexItem.Items; this is a {complex_type!r}, for which the file has"
            " only settings and no items"
        )
    return items.elements()


def _jump_ids(
    entries: Sequence[JsonValue], values: Sequence[Sequence[JsonValue] | None], sizes: Sequence[int]
) -> dict[int, int]:
    """Map doJumpId to index. Simple items take precedence over those inside surveys."""
    found: dict[int, int] = {}
    inner: dict[int, int] = {}
    first = 0
    for entry, group, size in zip(entries, values, sizes):  # noqa: B905 - same length
        for index, value in enumerate(group or (), first):
            number = value.child("doJumpId")
            key = index + 1 if number is None else number.integer(-1, 2**31)
            (found if value is entry else inner).setdefault(key, index)
        first += size
    return inner | found


def _read_item(value: JsonValue, ids: dict[int, int]) -> MissionItem:
    command, frame = value["command"].integer(0, 0xFFFF), value["frame"].integer(0, 0xFF)
    params = value["params"].elements(7)
    numbers = [param.number(null=True) for param in params]
    if xy_scale(command, frame) == 10_000_000:
        params[4].number(-90, 90, null=True)
        params[5].number(-180, 180, null=True)
    if command == MavCmd.DO_JUMP:
        numbers[0] = _jump_target(params[0], ids)
    if math.isnan(numbers[6]) and has_place(command):
        frame, numbers[6] = _planned_altitude(value, frame)
    one, two, three, four, latitude, longitude, z = numbers
    x, y = (from_degrees(number, command, frame) for number in (latitude, longitude))
    return MissionItem(command, frame, one, two, three, four, x, y, z, value["autoContinue"].boolean())


def _jump_target(param: JsonValue, ids: dict[int, int]) -> float:
    number = param.number()
    if number not in ids:
        raise param.error("the doJumpId of an item")
    return float(ids[int(number)])


def _planned_altitude(value: JsonValue, frame: int) -> tuple[int, float]:
    mode = value.child("AltitudeMode")
    number = 0 if mode is None else mode.integer(0, 0xFF)
    altitude = value.child("AMSLAltAboveTerrain" if number == 3 else "Altitude")
    return _FRAME_OF_MODE.get(number, frame), math.nan if altitude is None else altitude.number(null=True)


def _matches(group: Sequence[MissionItem], items: Sequence[MissionItem]) -> bool:
    """Return True if they are equal, ignoring the target of a jump, which is always rewritten."""
    if len(group) == len(items) == 1 and group[0].command == items[0].command == MavCmd.DO_JUMP:
        return group[0].replace(param1=0.0) == items[0].replace(param1=0.0)
    return tuple(group) == tuple(items)


def _number(entries: Sequence[Any], sizes: Sequence[int], items: Sequence[MissionItem]) -> None:
    """Number the items from 1, and set jump targets to these numbers."""
    first = 0
    for entry, size in zip(entries, sizes):  # noqa: B905 - same length
        body = entry.get("TransectStyleComplexItem", {})
        for index, simple in enumerate([entry] if entry["type"] == "SimpleItem" else body.get("Items", []), first):
            simple["doJumpId"] = index + 1
            if simple["command"] == MavCmd.DO_JUMP:
                simple["params"][0] = json_number(items[index].param1 + 1)
        first += size


def load_json(text: str, name: str) -> JsonValue:
    """Parse a JSON document, or raise :class:`FileFormatError`, which names the line."""
    try:
        return JsonValue(json.loads(text, parse_constant=_no_constant), name, "")
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise FileFormatError(f"{name}: {where}: not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{name}: not valid JSON: {error}") from error


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is not allowed")


class JsonValue:
    """A value in a JSON document. Its methods raise :class:`FileFormatError` if it has another type."""

    __slots__ = ("name", "path", "value")

    def __init__(self, value: Any, name: str, path: str) -> None:
        self.value: Any = value
        self.name: str = name
        self.path: str = path

    def error(self, expected: str) -> FileFormatError:
        """Create an error for a value that is not as expected."""
        # Encoded incrementally, so that a large value is not formatted only to be truncated.
        found = "".join(islice(json.JSONEncoder().iterencode(self.value), 41))
        found = found if len(found) <= 40 else f"{found[:37]}..."
        return FileFormatError(f"{self.name}: {self.path or 'the document'} = {found}: expected {expected}")

    def child(self, key: str) -> JsonValue | None:
        """Return the value of a key of an object, or None if there is no such key."""
        members = self.members()
        path = f"{self.path}.{key}" if self.path else key
        return JsonValue(members[key], self.name, path) if key in members else None

    def __getitem__(self, key: str) -> JsonValue:
        child = self.child(key)
        if child is None:
            where = self.path or "the document"
            raise FileFormatError(f"{self.name}: {where} has no {key!r}, which is required")
        return child

    def members(self) -> dict[str, Any]:
        """Return the value as an object."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        return self.value

    def elements(self, *sizes: int) -> list[JsonValue]:
        """Return the elements of an array, which must have one of these sizes, if any are given."""
        if not isinstance(self.value, list):
            raise self.error("an array")
        if sizes and len(self.value) not in sizes:
            raise self.error(f"an array of {' or '.join(map(str, sizes))} values; it has {len(self.value)}")
        return list(self._elements())

    def _elements(self) -> Iterator[JsonValue]:
        for index, value in enumerate(self.value):
            yield JsonValue(value, self.name, f"{self.path}[{index}]")

    def number(self, low: float = -math.inf, high: float = math.inf, *, null: bool = False) -> float:
        """Return a finite number in the range; with ``null``, NaN for null."""
        if self.value is None and null:
            return math.nan
        value = self._as_float()
        if not math.isfinite(value) or not low <= value <= high:
            bounds = f" from {low:g} to {high:g}" if math.isfinite(high) else f" from {low:g} on" if low == 0 else ""
            raise self.error(f"a number{bounds}" + ", or null" * null)
        return value

    def integer(self, low: int, high: int) -> int:
        """Return a whole number in the range. 3.0 counts as one."""
        value = self.number()
        if not value.is_integer() or not low <= value <= high:
            raise self.error(f"a whole number from {low} to {high}")
        return int(value)

    def boolean(self) -> bool:
        """Return true or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false")
        return self.value

    def one_of(self, *choices: object) -> None:
        """Raise unless the value is one of ``choices``."""
        if self.value not in choices or isinstance(self.value, bool):
            raise self.error(" or ".join(json.dumps(choice) for choice in choices))

    def _as_float(self) -> float:
        # Return infinity, which every caller rejects, for a value that is not a number.
        if not isinstance(self.value, (int, float)) or isinstance(self.value, bool):
            return math.inf
        try:
            return float(self.value)
        except OverflowError:
            return math.inf
