"""Items of a ``.plan`` file: simple items, and complex items (surveys, landings) that consist of several simple items.

https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html

The altitude that is flown is the last of ``params``, relative to ``frame``. ``AltitudeMode``, ``Altitude`` and
``AMSLAltAboveTerrain`` are for display, and are used only if the last of ``params`` is null. Jump targets are the
``doJumpId`` of an item, which QGroundControl counts from 1.

A landing pattern in the file has settings instead of items. This module generates the items that QGroundControl sends:
DO_LAND_START, then commands that reset speed, photos and video, the approach, and the landing.
"""

from __future__ import annotations

import copy
import json
import math
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.errors import FileFormatError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import DEGREE_SCALE, MissionItem, canonical_frame, has_place, xy_scale
from aerokit.missions.wire import scaled_coordinate, unscaled_xy

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

LANDING_PATTERNS = {"fwLandingPattern": MavCmd.NAV_LAND, "vtolLandingPattern": MavCmd.NAV_VTOL_LAND}


def landing_items(pattern: JsonValue) -> tuple[MissionItem, ...]:
    command = LANDING_PATTERNS[pattern["complexItemType"].value]
    is_relative = pattern["altitudesAreRelative"].boolean()
    frame = MavFrame.GLOBAL_RELATIVE_ALT if is_relative else MavFrame.GLOBAL
    # Older files have a loiterCoordinate instead of the landingApproachCoordinate.
    approach = pattern.child("landingApproachCoordinate") or pattern["loiterCoordinate"]
    heading = 0.0 if command == MavCmd.NAV_LAND else math.nan  # QGroundControl sends these values.
    x, y, z = read_xyz(pattern["landCoordinate"])
    return (
        MissionItem(MavCmd.DO_LAND_START, MavFrame.MISSION),
        *_reset_items(pattern),
        _approach(pattern, frame, approach),
        MissionItem(command, frame, param4=heading, x=x, y=y, z=z),
    )


def _reset_items(pattern: JsonValue) -> list[MissionItem]:
    """Return the items before the approach, which set the speed and stop photos and video."""
    items = []
    if _flag(pattern, "useDoChangeSpeed"):
        speed = pattern["finalApproachSpeed"].number(0)
        airspeed, unchanged_throttle = 0.0, -1.0
        items.append(MissionItem(MavCmd.DO_CHANGE_SPEED, MavFrame.MISSION, airspeed, speed, unchanged_throttle))
    if _flag(pattern, "stopTakingPhotos"):
        items.append(MissionItem(MavCmd.DO_SET_CAM_TRIGG_DIST, MavFrame.MISSION))
        items.append(MissionItem(MavCmd.IMAGE_STOP_CAPTURE, MavFrame.MISSION))
    if _flag(pattern, "stopVideoPhotos"):
        items.append(MissionItem(MavCmd.VIDEO_STOP_CAPTURE, MavFrame.MISSION))
    return items


def _approach(pattern: JsonValue, frame: MavFrame, place: JsonValue) -> MissionItem:
    x, y, z = read_xyz(place)
    if not _flag(pattern, "useLoiterToAlt", default=True):  # Older files lack this flag and have only circles.
        return MissionItem(MavCmd.NAV_WAYPOINT, frame, param4=math.nan, x=x, y=y, z=z)
    radius = pattern["loiterRadius"].number(0)
    signed_radius = radius if pattern["loiterClockwise"].boolean() else -radius
    # The vehicle leaves the circle tangentially (param4), as soon as it heads for the next item (param1).
    return MissionItem(MavCmd.NAV_LOITER_TO_ALT, frame, param1=1.0, param2=signed_radius, param4=1.0, x=x, y=y, z=z)


def _flag(pattern: JsonValue, key: str, *, default: bool = False) -> bool:
    value = pattern.child(key)
    return default if value is None else value.boolean()


def read_xyz(value: JsonValue) -> tuple[int, int, float]:
    latitude, longitude, altitude = value.elements(3)
    x, y = round(latitude.number(-90, 90) * 1e7), round(longitude.number(-180, 180) * 1e7)
    return x, y, altitude.number()


# Maps the ``AltitudeMode`` of an item to its frame.
_FRAME_OF_MODE = {
    1: MavFrame.GLOBAL_RELATIVE_ALT,
    2: MavFrame.GLOBAL,
    3: MavFrame.GLOBAL,  # See `_planned_altitude`.
    4: MavFrame.GLOBAL_TERRAIN_ALT,
}

_MODE_OF_FRAME: dict[int, int] = {
    MavFrame.GLOBAL: 2,
    MavFrame.GLOBAL_RELATIVE_ALT: 1,
    MavFrame.GLOBAL_TERRAIN_ALT: 4,
}


class _Entry(NamedTuple):
    """An entry of ``mission.items``: simple items in the file, or the items generated for a landing pattern."""

    value: JsonValue
    simple_items: Sequence[JsonValue] = ()
    landing_items: tuple[MissionItem, ...] = ()

    @property
    def size(self) -> int:
        return len(self.simple_items) + len(self.landing_items)


def read_entries(values: Sequence[JsonValue]) -> list[tuple[MissionItem, ...]]:
    """Return the items of each entry of ``mission.items``. Jumps have the index of their target among all items."""
    entries = list(map(_read_entry, values))
    ids = _jump_ids(entries)
    return [entry.landing_items or tuple(_read_item(item, ids) for item in entry.simple_items) for entry in entries]


def merged_entries(
    entries: Sequence[Any], groups: Sequence[tuple[MissionItem, ...]], items: Sequence[MissionItem]
) -> list[Any]:
    """Return new entries for ``mission.items`` of a .plan file, which together contain ``items``.

    ``entries`` are the old entries, and ``groups`` the items of each old entry. Old entries at the beginning and at the
    end are kept if their items are unchanged.
    """
    targets = {item.param1 for item in items if item.command == MavCmd.DO_JUMP}

    def may_keep(number: int, start: int) -> bool:
        end = start + len(groups[number])
        # The items of a landing pattern have no doJumpId, so the file cannot store a jump to them.
        is_jump_target = not _items_with_id(entries[number]) and any(start <= target < end for target in targets)
        return not is_jump_target and _matches(groups[number], items[start:end])

    # The file's entries before `head_end` are kept. They contain the plan's items before `first_new`.
    head_end, first_new = 0, 0
    while head_end < len(groups) and may_keep(head_end, first_new):
        first_new += len(groups[head_end])
        head_end += 1
    # The file's entries from `tail_start` on are kept. They contain the plan's items from `end_new` on.
    tail_start, end_new = len(groups), len(items)
    while tail_start > head_end:
        start = end_new - len(groups[tail_start - 1])
        if start < first_new or not may_keep(tail_start - 1, start):
            break
        tail_start -= 1
        end_new = start
    new_entries = [simple_entry(item) for item in items[first_new:end_new]]
    head = copy.deepcopy(list(entries[:head_end]))
    tail = copy.deepcopy(list(entries[tail_start:]))
    merged = [*head, *new_entries, *tail]
    sizes = [*map(len, groups[:head_end]), *(1 for _ in new_entries), *map(len, groups[tail_start:])]
    _set_jump_ids(merged, sizes, items)
    return merged


def simple_entry(item: MissionItem) -> dict[str, Any]:
    """Create a SimpleItem. The caller sets its doJumpId and the target of a jump."""
    x, y = unscaled_xy(item)
    numbers = (item.param1, item.param2, item.param3, item.param4, x, y, item.z)
    entry: dict[str, Any] = {}
    mode = _MODE_OF_FRAME.get(canonical_frame(item.frame))
    if has_place(item.command) and mode is not None:
        entry |= {"AMSLAltAboveTerrain": None, "Altitude": json_number(item.z), "AltitudeMode": mode}
    entry |= {"autoContinue": item.autocontinue, "command": int(item.command), "doJumpId": 0}
    return entry | {"frame": int(item.frame), "params": [*map(json_number, numbers)], "type": "SimpleItem"}


def json_number(value: float) -> int | float | None:
    """Convert a number to QGroundControl's form: null for NaN, whole numbers without a decimal point."""
    if math.isnan(value):
        return None
    is_whole = math.isfinite(value) and value == int(value)
    return int(value) if is_whole and abs(value) < 2**53 else value  # Beyond 2**53, not every integer is a float.


def _read_entry(entry: JsonValue) -> _Entry:
    kind = entry["type"]
    kind.one_of("SimpleItem", "ComplexItem")
    if kind.value == "SimpleItem":
        return _Entry(entry, [entry])
    complex_type = entry["complexItemType"].value
    if isinstance(complex_type, str) and complex_type in LANDING_PATTERNS:
        return _Entry(entry, landing_items=landing_items(entry))
    body = entry.child("TransectStyleComplexItem")
    items = body.child("Items") if body is not None else None
    if items is None or not items.elements():
        raise entry.expected(
            f"a complex item with TransectStyleComplexItem.Items; this is a {complex_type!r}, for which the file has"
            " only settings and no items"
        )
    return _Entry(entry, items.elements())


def _jump_ids(entries: Sequence[_Entry]) -> dict[int, int]:
    """Map each doJumpId in a .plan file to the index of the mission item that has this id."""
    ids_of_entries: dict[int, int] = {}
    ids_in_surveys: dict[int, int] = {}
    first_index = 0
    for entry in entries:
        for index, value in enumerate(entry.simple_items, first_index):
            member = value.child("doJumpId")
            jump_id = index + 1 if member is None else member.integer(-1, 2**31)
            has_own_entry = value is entry.value
            if has_own_entry:
                ids_of_entries.setdefault(jump_id, index)
            else:
                ids_in_surveys.setdefault(jump_id, index)
        first_index += entry.size
    # If an item inside a survey and an item with an entry of its own have the same id, the item with the entry is used.
    return ids_in_surveys | ids_of_entries


def _read_item(value: JsonValue, ids: dict[int, int]) -> MissionItem:
    """Read one simple item. ``ids`` maps the file's jump ids to indices of items."""
    command, frame = value["command"].integer(0, 0xFFFF), value["frame"].integer(0, 0xFF)
    params = value["params"].elements(7)
    param1, param2, param3, param4, latitude, longitude, z = (param.number(null=True) for param in params)
    first_param, _, _, _, latitude_param, longitude_param, _ = params
    if xy_scale(command, frame) == DEGREE_SCALE:  # number() checks the range.
        latitude_param.number(-90, 90, null=True)
        longitude_param.number(-180, 180, null=True)
    if command == MavCmd.DO_JUMP:
        param1 = _jump_target(first_param, ids)
    if math.isnan(z) and has_place(command):  # The file has null instead of the altitude in `params`.
        frame, z = _planned_altitude(value, frame)
    x, y = (scaled_coordinate(number, command, frame) for number in (latitude, longitude))
    return MissionItem(command, frame, param1, param2, param3, param4, x, y, z, value["autoContinue"].boolean())


def _jump_target(param: JsonValue, ids: dict[int, int]) -> float:
    number = param.number()
    if number not in ids:
        raise param.expected("the doJumpId of an item")
    return float(ids[int(number)])


def _planned_altitude(value: JsonValue, frame: int) -> tuple[int, float]:
    """Return the frame and the altitude that the planner has saved."""
    mode_member = value.child("AltitudeMode")
    mode = 0 if mode_member is None else mode_member.integer(0, 0xFF)
    # Mode 3 is an altitude above the terrain, which the planner has converted to one above mean sea level.
    altitude_member = value.child("AMSLAltAboveTerrain" if mode == 3 else "Altitude")
    altitude = math.nan if altitude_member is None else altitude_member.number(null=True)
    return _FRAME_OF_MODE.get(mode, frame), altitude


def _matches(group: Sequence[MissionItem], items: Sequence[MissionItem]) -> bool:
    if len(group) == len(items) == 1:
        old, new = group[0], items[0]
        if old.command == new.command == MavCmd.DO_JUMP:  # The target of a jump is always rewritten.
            return old.replace(param1=0.0) == new.replace(param1=0.0)
    return tuple(group) == tuple(items)


def _items_with_id(entry: dict[str, Any]) -> list[dict[str, Any]]:
    if entry["type"] == "SimpleItem":
        return [entry]
    items: list[dict[str, Any]] = entry.get("TransectStyleComplexItem", {}).get("Items", [])
    return items


def _set_jump_ids(entries: Sequence[Any], sizes: Sequence[int], items: Sequence[MissionItem]) -> None:
    """Number the items from 1 (doJumpId), and set jump targets to these numbers."""
    first_index = 0
    for entry, size in zip(entries, sizes):  # noqa: B905 - same length
        for index, simple_item in enumerate(_items_with_id(entry), first_index):
            simple_item["doJumpId"] = index + 1
            if simple_item["command"] == MavCmd.DO_JUMP:
                target_index = items[index].param1
                simple_item["params"][0] = json_number(target_index + 1)
        first_index += size


def load_json(text: str, name: str) -> JsonValue:
    """Parse a JSON document. Raises FileFormatError, which names the line of a syntax error."""
    try:
        return JsonValue(json.loads(text, parse_constant=_no_constant), name, "")
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise FileFormatError(f"{name}: {where}: the text is not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{name}: the text is not valid JSON: {error}") from error


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is not allowed")


class JsonValue:
    """A value in a JSON document. Its methods raise :class:`FileFormatError` if the value has another type."""

    __slots__ = ("name", "path", "value")

    def __init__(self, value: Any, name: str, path: str) -> None:
        self.value: Any = value
        self.name: str = name
        self.path: str = path

    def expected(self, expected: str) -> FileFormatError:
        """Create an error that says what was expected instead of this value."""
        # Encode only the beginning of the value, because a large value would take long and is shortened anyway.
        text = "".join(islice(json.JSONEncoder().iterencode(self.value), 41))
        if len(text) > 40:
            text = f"{text[:37]}..."
        return FileFormatError(f"{self.name}: {self.path or 'the document'} = {text}: expected {expected}")

    def child(self, key: str) -> JsonValue | None:
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
        if not isinstance(self.value, dict):
            raise self.expected("an object")
        return self.value

    def elements(self, *sizes: int) -> list[JsonValue]:
        """Return the elements of an array. If ``sizes`` are given, the array must have one of these lengths."""
        if not isinstance(self.value, list):
            raise self.expected("an array")
        if sizes and len(self.value) not in sizes:
            raise self.expected(f"an array of {' or '.join(map(str, sizes))} values; it has {len(self.value)}")
        return list(self._elements())

    def _elements(self) -> Iterator[JsonValue]:
        for index, value in enumerate(self.value):
            yield JsonValue(value, self.name, f"{self.path}[{index}]")

    def number(self, low: float = -math.inf, high: float = math.inf, *, null: bool = False) -> float:
        """Return a finite number in the range. With ``null``, null is allowed and becomes NaN."""
        if self.value is None and null:
            return math.nan
        value = self._as_float()
        if not math.isfinite(value) or not low <= value <= high:
            bounds = ""
            if math.isfinite(high):
                bounds = f" from {low:g} to {high:g}"
            elif low == 0:
                bounds = " from 0 on"
            or_null = ", or null" if null else ""
            raise self.expected(f"a number{bounds}{or_null}")
        return value

    def integer(self, low: int, high: int) -> int:
        """Return a whole number in the range. 3.0 counts as a whole number."""
        value = self.number()
        if not value.is_integer() or not low <= value <= high:
            raise self.expected(f"a whole number from {low} to {high}")
        return int(value)

    def boolean(self) -> bool:
        if not isinstance(self.value, bool):
            raise self.expected("true or false")
        return self.value

    def one_of(self, *choices: object) -> None:
        """Raise FileFormatError for any other value."""
        if self.value not in choices or isinstance(self.value, bool):
            raise self.expected(" or ".join(json.dumps(choice) for choice in choices))

    def _as_float(self) -> float:
        # A value that is not a number becomes infinity, which every caller rejects.
        if not isinstance(self.value, (int, float)) or isinstance(self.value, bool):
            return math.inf
        try:
            return float(self.value)
        except OverflowError:
            return math.inf
