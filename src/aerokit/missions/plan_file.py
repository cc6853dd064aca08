"""QGroundControl ``.plan`` files.

https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit._internal.files import read_text, write_atomically
from aerokit._internal.formatting import short_repr
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import MissionItem, canonical_frame
from aerokit.missions.mission import Fence, FenceCircle, FencePolygon, Mission, Plan, RallyPoints
from aerokit.missions.plan_items import JsonValue, json_number, load_json, merged_entries, read_entries, read_xyz
from aerokit.missions.wire import unscaled_xy
from aerokit.position import Position

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator

_MAX_LISTED = 5
"""Number of objects with missing fields that an error lists."""

_NUMBER_KEYS = {
    "firmware_type": "firmwareType",
    "vehicle_type": "vehicleType",
    "cruise_speed_m_s": "cruiseSpeed",
    "hover_speed_m_s": "hoverSpeed",
}


def read_plan_file(path: str | os.PathLike[str]) -> Plan:
    """Read a plan from a .plan file.

    Surveys, corridor scans and landing patterns are converted to simple items. Other complex items are refused, because
    the file has only their settings and not their items. Ranges of parameters are not checked here, but by ``check``.

    Raises:
        FileFormatError: the file is invalid; the error text names the file, the position in it and what was expected
            there.
        OSError: the file cannot be read.
    """
    return parse_plan(read_text(path), Path(path).name)


def write_plan_file(path: str | os.PathLike[str], plan: Plan | Mission) -> None:
    """Write a plan, or a mission as a plan without fence and rally points, to a .plan file; see :func:`format_plan`.

    Raises:
        InvalidArgument: the plan cannot be written. No file was changed.
        OSError: the file cannot be written.
    """
    write_atomically(path, format_plan(plan))


def parse_plan(text: str, name: str = "plan") -> Plan:
    """Parse the text of a .plan file. Error texts begin with ``name``."""
    document = load_json(text, name)
    # Check the kind of file before the missing fields, because a file of another kind lacks most of these fields.
    for key, allowed in (("fileType", "Plan"), ("version", 1)):
        member = document.child(key)
        if member is not None:
            member.one_of(allowed)
    _check_required(document)
    mission = document.child("mission")
    fence, rally = document.child("geoFence"), document.child("rallyPoints")
    return Plan(
        Mission() if mission is None else _read_mission(mission),
        Fence() if fence is None else _read_fence(fence),
        RallyPoints() if rally is None else _read_rally(rally),
        **_read_numbers(mission),
        source=text,
    )


def format_plan(plan: Plan | Mission) -> str:
    """Format a plan or a mission as the text of a .plan file.

    If the plan was read from a .plan file, the unchanged values of that file are kept, including unknown fields.

    Raises:
        InvalidArgument: ``plan`` is neither a plan nor a mission, or it has a value that a .plan file cannot store: an
            infinite number, or a rally point or fence return point whose altitude is not relative to home.
    """
    if isinstance(plan, Mission):
        plan = Plan(plan)
    elif not isinstance(plan, Plan):
        raise InvalidArgument(
            f"plan = {short_repr(plan)} is neither a Plan nor a Mission: pass Mission([…]), or Plan(mission, fence,"
            " rally)"
        )
    try:
        return json.dumps(_document(plan), indent=4, allow_nan=False) + "\n"
    except RecursionError:
        raise InvalidArgument("the plan cannot be written: it was read from a file that is nested too deeply") from None
    except InvalidArgument:
        raise
    except FileFormatError as error:  # `plan.source`, the text of the original file, is invalid.
        raise InvalidArgument(f"the plan cannot be written: {error}") from error
    except ValueError as error:
        raise InvalidArgument("a number of the plan is not finite, and a .plan file cannot store it") from error


def _document(plan: Plan) -> dict[str, Any]:
    """Return the JSON object of a .plan file. Unchanged parts of ``plan.source`` are kept."""
    document: dict[str, Any]
    if plan.source:
        old = parse_plan(plan.source)  # This call is first, because it raises FileFormatError if the text is no plan.
        document = json.loads(plan.source)
    else:
        document, old = _new_document(), None
    if old is None or (plan.mission, _numbers(plan)) != (old.mission, _numbers(old)):
        _update_mission(document, plan, old)
    if old is None or plan.fence != old.fence:
        document.setdefault("geoFence", {}).update(_fence_members(plan.fence))
        if plan.fence.return_point is None:
            document["geoFence"].pop("breachReturn", None)
    if old is None or plan.rally != old.rally:
        points = [_rally_point(item, index) for index, item in enumerate(plan.rally)]
        document.setdefault("rallyPoints", {}).update({"points": points, "version": 2})
    return document


# ------------------------------------------------------------------------------------------- reading


def _check_required(document: JsonValue) -> None:
    """Raise one error for all required fields that are missing."""
    incomplete = [(path, keys) for path, keys in _missing_fields(document.value) if keys]
    if not incomplete:
        return
    texts = [f"{path} has no {' and '.join(map(repr, keys))}" for path, keys in incomplete[:_MAX_LISTED]]
    unlisted = len(incomplete) - len(texts)
    if unlisted:
        texts.append(f"{unlisted} more objects are incomplete")
    raise FileFormatError(f"{document.name}: required fields are missing: {'; '.join(texts)}")


def _missing_fields(plan: Any) -> Iterator[tuple[str, list[str]]]:
    """Yield each object of a plan with the names of the required fields that it lacks."""
    mission, fence, rally = (_member(plan, key) for key in ("mission", "geoFence", "rallyPoints"))
    document_keys = ["fileType", "version"]
    if mission is None and fence is None and rally is None:  # A plan needs one of the three, usually the mission.
        document_keys.append("mission")
    yield _missing_in("the document", plan, *document_keys)
    yield _missing_in("mission", mission, "version", "items")
    for path, item in _entries("mission.items", _member(mission, "items")):
        if _member(item, "type") == "SimpleItem":
            yield _missing_in(path, item, "type", "command", "frame", "params", "autoContinue")
        else:
            yield _missing_in(path, item, "type")
    yield _missing_in("geoFence", fence, "version")
    for path, polygon in _entries("geoFence.polygons", _member(fence, "polygons")):
        yield _missing_in(path, polygon, "polygon", "inclusion")
    for path, circle in _entries("geoFence.circles", _member(fence, "circles")):
        yield _missing_in(path, circle, "circle", "inclusion")
        yield _missing_in(f"{path}.circle", _member(circle, "circle"), "center", "radius")
    yield _missing_in("rallyPoints", rally, "version")


# The following three functions skip values of an unexpected type. The functions that read the plan raise the error.


def _member(value: Any, key: str) -> Any:
    return value.get(key) if isinstance(value, dict) else None


def _entries(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        for number, entry in enumerate(value):
            yield f"{path}[{number}]", entry


def _missing_in(path: str, value: Any, *keys: str) -> tuple[str, list[str]]:
    missing = [key for key in keys if key not in value] if isinstance(value, dict) else []
    return path, missing


def _read_mission(value: JsonValue) -> Mission:
    value["version"].one_of(2)
    groups = read_entries(value["items"].elements())
    home = value.child("plannedHomePosition")
    items = [item for group in groups for item in group]
    return Mission(items, None if home is None else _read_place(home, altitude="amsl"))


def _read_numbers(mission: JsonValue | None) -> dict[str, Any]:
    """Return the fields of `Plan` for the numbers that the mission in the file has."""
    numbers: dict[str, Any] = {}
    for field, key in _NUMBER_KEYS.items():
        value = None if mission is None else mission.child(key)
        if value is not None:
            is_type = field in ("firmware_type", "vehicle_type")
            numbers[field] = value.integer(0, 0xFF) if is_type else value.number()
    return numbers


def _read_fence(value: JsonValue) -> Fence:
    version = _check_version(value, "polygon", "polygons", "circles", "breachReturn")
    if version == 1:  # Version 1 is allowed only for empty fences.
        return Fence()
    polygons, circles = (value.child(key) for key in ("polygons", "circles"))
    point = value.child("breachReturn")
    return Fence(
        [_read_polygon(polygon) for polygon in (polygons.elements() if polygons else ())],
        [_read_circle(circle) for circle in (circles.elements() if circles else ())],
        None if point is None else _read_place(point, altitude="relative"),
    )


def _check_version(value: JsonValue, *content_keys: str) -> int:
    """Return the version. Raises FileFormatError if it is not supported."""
    is_empty = not any(value.members().get(key) for key in content_keys)
    # QGroundControl has written version 1 for empty fences and empty rally points.
    allowed = (1, 2) if is_empty else (2,)
    value["version"].one_of(*allowed)
    return int(value["version"].value)


def _read_polygon(value: JsonValue) -> FencePolygon:
    corners = value["polygon"]
    places = [_required_place(corner) for corner in corners.elements()]
    if len(places) < 3:
        raise corners.expected(f"an array of at least 3 positions; it has {len(places)}")
    return FencePolygon(places, value["inclusion"].boolean())


def _read_circle(value: JsonValue) -> FenceCircle:
    circle = value["circle"]
    radius = circle["radius"]
    center = _required_place(circle["center"])
    try:
        return FenceCircle(center, radius.number(), value["inclusion"].boolean())
    except InvalidArgument as error:
        raise radius.expected("a number of metres above 0") from error


def _read_rally(value: JsonValue) -> RallyPoints:
    if _check_version(value, "points") == 1:  # Version 1 is allowed only without rally points.
        return RallyPoints()
    return RallyPoints([_read_rally_point(point) for point in value["points"].elements()])


def _read_rally_point(value: JsonValue) -> MissionItem:
    x, y, z = read_xyz(value)
    return MissionItem(MavCmd.NAV_RALLY_POINT, MavFrame.GLOBAL_RELATIVE_ALT, x=x, y=y, z=z)


def _required_place(value: JsonValue) -> Position:
    latitude, longitude = value.elements(2)
    return Position(latitude.number(-90, 90), longitude.number(-180, 180))


def _read_place(value: JsonValue, *, altitude: str) -> Position | None:
    """Read a place; return None if a coordinate is null. ``altitude`` is "amsl" or "relative"."""
    latitude_value, longitude_value, *altitude_values = value.elements(2, 3)
    latitude = latitude_value.number(-90, 90, null=True)
    longitude = longitude_value.number(-180, 180, null=True)
    if math.isnan(latitude) or math.isnan(longitude):
        return None
    height = altitude_values[0].number(null=True) if altitude_values else math.nan
    place = Position(latitude, longitude)
    if math.isnan(height):
        return place
    altitude_field = f"altitude_{altitude}_m"
    return place.replace(**{altitude_field: height})


# ------------------------------------------------------------------------------------------- writing


def _new_document() -> dict[str, Any]:
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {},
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def _numbers(plan: Plan) -> tuple[int, int, float, float]:
    return plan.firmware_type, plan.vehicle_type, plan.cruise_speed_m_s, plan.hover_speed_m_s


def _update_mission(document: dict[str, Any], plan: Plan, old: Plan | None) -> None:
    """Write the mission into a document. Members that are unchanged since ``old`` are kept."""
    mission = document.setdefault("mission", {})
    if not mission:
        # The altitude mode 1 means altitudes above home.
        mission.update({"globalPlanAltitudeMode": 1, "items": [], "version": 2})
        old = None  # The document has no mission whose members could be kept.
    if old is None or plan.mission.items != old.mission.items:
        groups = read_entries(JsonValue(mission["items"], "plan", "mission.items").elements())
        mission["items"] = merged_entries(mission["items"], groups, plan.mission.items)
    for name, key in _NUMBER_KEYS.items():
        value = getattr(plan, name)
        if old is None or value != getattr(old, name):
            mission[key] = json_number(value)
    if old is None or plan.mission.home != old.mission.home:
        home = plan.mission.home
        mission["plannedHomePosition"] = _place_members(home, None if home is None else home.altitude_amsl_m)


def _fence_members(fence: Fence) -> dict[str, Any]:
    members: dict[str, Any] = {
        "version": 2,
        "circles": [
            {
                "circle": {"center": _place(circle.center), "radius": json_number(circle.radius_m)},
                "inclusion": circle.inclusion,
                "version": 1,
            }
            for circle in fence.circles
        ],
        "polygons": [
            {
                "inclusion": polygon.inclusion,
                "polygon": [_place(vertex) for vertex in polygon.vertices],
                "version": 1,
            }
            for polygon in fence.polygons
        ],
    }
    point = fence.return_point
    if point is not None:
        if point.altitude_amsl_m is not None:
            altitude = f"return_point.altitude_amsl_m = {point.altitude_amsl_m!r}"
            raise InvalidArgument(f"{altitude}: a .plan file stores only altitudes above home")
        members["breachReturn"] = _place_members(point, point.altitude_relative_m)
    return members


def _rally_point(item: MissionItem, index: int) -> list[int | float | None]:
    if canonical_frame(item.frame) != MavFrame.GLOBAL_RELATIVE_ALT:
        raise InvalidArgument(f"rally[{index}]: frame = {item.frame!r}: a .plan file stores only altitudes above home")
    return [json_number(number) for number in (*unscaled_xy(item), item.z)]


def _place(position: Position) -> list[int | float | None]:
    return [json_number(position.latitude_deg), json_number(position.longitude_deg)]


def _place_members(position: Position | None, altitude: float | None) -> list[int | float | None]:
    place: list[int | float | None] = [None, None] if position is None else _place(position)
    return [*place, None if altitude is None else json_number(altitude)]
