"""The Foxglove topics of a vehicle: their names, JSON schemas and messages, for the live bridge and for files.

Foxglove's panels know the schemas named ``foxglove.…`` (https://docs.foxglove.dev/docs/sdk/schemas). Other schemas
contain the fields of aerokit's values. All messages are JSON.
"""

from __future__ import annotations

import inspect
import json
import math
from typing import TYPE_CHECKING, Any

from aerokit._internal import geo
from aerokit._internal.formatting import to_jsonable
from aerokit._internal.values import Snapshot
from aerokit.mavlink.message import SECRET_FIELDS, Message, field_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from aerokit.position import Position
    from aerokit.vehicle.state.condition import StatusText
    from aerokit.vehicle.state.movement import Attitude, Velocity

MAP_FRAME = "map"
"""Common frame of all vehicles: x is east, y north, z up, in metres. `MapFrame` chooses the origin."""
_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False)
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_JSON_TYPES = {"float": "number", "int": "number", "str": "string", "bool": "boolean"}
_FATAL, _ERROR, _WARNING, _INFO, _DEBUG = 5, 4, 3, 2, 1
# Maps MAV_SEVERITY (the index) to foxglove.LogLevel.
_FOXGLOVE_LEVELS = (_FATAL, _FATAL, _FATAL, _ERROR, _WARNING, _INFO, _INFO, _DEBUG)


def _object(title: str, /, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _foxglove_object(name: str, /, **properties: Any) -> dict[str, Any]:
    return {**_object(f"foxglove.{name}", **properties), "required": list(properties)}


_TIME = _object("time", sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR = _foxglove_object("Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _foxglove_object("Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)

LOCATION_FIX: dict[str, Any] = {
    **_foxglove_object(
        "LocationFix",
        timestamp=_TIME,
        frame_id=_TEXT,
        latitude=_NUMBER,
        longitude=_NUMBER,
        altitude=_NUMBER,
        position_covariance={"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
        position_covariance_type={"type": "integer"},
        heading=_NUMBER,
        velocity=_VECTOR,
    ),
    "required": ["timestamp", "frame_id", "latitude", "longitude", "altitude"],
}
FRAME_TRANSFORM = _foxglove_object(
    "FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
POSE_IN_FRAME = _foxglove_object(
    "PoseInFrame",
    timestamp=_TIME,
    frame_id=_TEXT,
    pose=_foxglove_object("Pose", position=_VECTOR, orientation=_QUATERNION),
)
LOG = _foxglove_object(
    "Log", timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT, file=_TEXT, line={"type": "integer"}
)


class Topic(Snapshot):
    """A topic: its name and the JSON schema of its messages."""

    name: str
    schema: Mapping[str, Any]

    @property
    def schema_name(self) -> str:
        return str(self.schema["title"])


class MapFrame:
    """Converts positions to metres east, north and up of an origin."""

    def __init__(self) -> None:
        self._origin: tuple[float, float] | None = None  # latitude and longitude
        self._origin_amsl_m: float | None = None

    def east_north_up_m(self, position: Position) -> tuple[float, float, float]:
        """Convert a position to metres east, north and up of the origin.

        The origin is the first position, at the altitude of home.
        """
        altitude, relative_m = position.altitude_amsl_m, position.altitude_relative_m or 0.0
        if self._origin is None:
            self._origin = position.latitude_deg, position.longitude_deg
        # The altitude of home is computed from the first position that has an altitude above sea level. An unknown
        # height above home counts as 0.
        if self._origin_amsl_m is None and altitude is not None:
            self._origin_amsl_m = altitude - relative_m
        up = relative_m if altitude is None or self._origin_amsl_m is None else altitude - self._origin_amsl_m
        north, east = geo.north_east_m(*self._origin, position.latitude_deg, position.longitude_deg)
        return east, north, up


def vehicle_topic(system_id: int, name: str) -> str:
    return f"/vehicle/{system_id}/{name}"


def frame_of(system_id: int) -> str:
    """Return the name of a vehicle's body frame: x forward, y left, z up."""
    return f"vehicle_{system_id}"


def state_topic(system_id: int, name: str, value: object) -> Topic:
    schema = _schema_of(value)
    if schema.get("type") != "object":
        schema = {"type": "object", "properties": {"value": schema}}
    return Topic(vehicle_topic(system_id, name), {**schema, "title": f"aerokit.{name}"})


def raw_topic(system_id: int, component_id: int, message: type[Message]) -> Topic:
    properties: dict[str, Any] = {}
    for field in message.FIELDS:
        if field.name in SECRET_FIELDS:
            continue
        schema: dict[str, Any] = _NUMBER
        if field.is_text or _is_byte_array(field):
            schema = _TEXT
        elif field.array_length:
            schema = {"type": "array", "items": _NUMBER}
        unit = f" [{field.units}]" if field.units else ""
        properties[field.name] = {**schema, "description": f"{field.description}{unit}"}
    name = raw_topic_name(system_id, component_id, message)
    return Topic(name, _object(f"mavlink.{message.NAME}", **properties))


def raw_topic_name(system_id: int, component_id: int, message: type[Message]) -> str:
    return f"/mavlink/{system_id}/{component_id}/{message.NAME}"


def _is_byte_array(field: Any) -> bool:
    return field.type in ("uint8_t", "char") and bool(field.array_length)


def nanoseconds(unix_s: float) -> int:
    """Convert seconds to nanoseconds, rounded to microseconds."""
    return round(unix_s * 1e6) * 1000


def encoded(fields: Mapping[str, Any]) -> bytes:
    return _JSON.encode(fields).encode()


def state_fields(value: object) -> dict[str, Any]:
    """Return the fields of a state. A number, text or list becomes ``{"value": …}``."""
    if isinstance(value, Snapshot):
        return {name: _plain(getattr(value, name)) for name in value.__match_args__}
    converted = to_jsonable(value)
    return converted if isinstance(converted, dict) else {"value": converted}


def raw_fields(message: Message) -> dict[str, Any]:
    """Return the fields of a message in raw units, without secrets such as passwords."""
    return {name: _plain(getattr(message, name)) for name in field_names(message) if name not in SECRET_FIELDS}


def _plain(value: object) -> Any:
    """Like `aerokit._internal.formatting.to_jsonable`, but three times as fast for common types."""
    # Logs have millions of values, so this function must be fast.
    kind = type(value)
    if kind is int or kind is str or value is None:
        return value
    if kind is float:
        return value if math.isfinite(value) else None  # type: ignore[arg-type]
    return to_jsonable(value)


def location_fix(
    unix_s: float,
    system_id: int,
    position: Position,
    heading_deg: float | None = None,
    velocity: Velocity | None = None,
) -> dict[str, Any]:
    """Return a ``foxglove.LocationFix``."""
    fix: dict[str, Any] = {
        "timestamp": _time(unix_s),
        "frame_id": frame_of(system_id),
        "latitude": position.latitude_deg,
        "longitude": position.longitude_deg,
        "altitude": position.altitude_amsl_m or 0.0,
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,  # unknown
    }
    if heading_deg is not None:
        fix["heading"] = math.radians(heading_deg)
    if velocity is not None and all(map(math.isfinite, (velocity.ground_speed_m_s, velocity.down_m_s))):
        fix["velocity"] = _vector(velocity.east_m_s, velocity.north_m_s, -velocity.down_m_s)
    return fix


def frame_transform(
    unix_s: float, system_id: int, east_north_up_m: Sequence[float], attitude: Attitude | None
) -> dict[str, Any]:
    return {
        "timestamp": _time(unix_s),
        "parent_frame_id": MAP_FRAME,
        "child_frame_id": frame_of(system_id),
        "translation": _vector(*east_north_up_m),
        "rotation": _rotation(attitude),
    }


def pose_in_frame(unix_s: float, east_north_up_m: Sequence[float], attitude: Attitude | None) -> dict[str, Any]:
    return {
        "timestamp": _time(unix_s),
        "frame_id": MAP_FRAME,
        "pose": {"position": _vector(*east_north_up_m), "orientation": _rotation(attitude)},
    }


def log_entry(unix_s: float, system_id: int, text: StatusText) -> dict[str, Any]:
    """Return a ``foxglove.Log``."""
    # Some logs have no severity. Level 0 means unknown.
    severity: int | None = text.severity
    level = 0
    if severity is not None and 0 <= severity < len(_FOXGLOVE_LEVELS):
        level = _FOXGLOVE_LEVELS[severity]
    return {
        "timestamp": _time(unix_s),
        "level": level,
        "message": text.text,
        "name": frame_of(system_id),
        "file": "",
        "line": 0,
    }


def _time(unix_s: float) -> dict[str, int]:
    seconds, remaining_ns = divmod(nanoseconds(unix_s), 1_000_000_000)
    return {"sec": seconds, "nsec": remaining_ns}


def _vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _rotation(attitude: Attitude | None) -> dict[str, float]:
    """Return the quaternion of a body frame (forward, left, up) in the map frame (east, north, up)."""
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    if attitude is not None and all(map(math.isfinite, (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg))):
        w, x, y, z = attitude.quaternion
    # MAVLink's quaternion rotates (forward, right, down) to (north, east, down), Foxglove's (forward, left, up) to
    # (east, north, up). Both changes are rotations by 180°, which result in these sums and differences.
    half = math.sqrt(0.5)
    return {"x": half * (x + y), "y": half * (x - y), "z": half * (w - z), "w": half * (w + z)}


def _schema_of(value: object) -> dict[str, Any]:
    if isinstance(value, Snapshot):
        annotations = _annotations(type(value))
        fields = value.to_dict()
        return {
            "type": "object",
            "properties": {
                name: _schema_of_annotation(annotations.get(name, "")) if field is None else _schema_of(field)
                for name, field in fields.items()
            },
        }
    converted = to_jsonable(value)
    if isinstance(converted, dict):
        return {"type": "object", "properties": {name: _schema_of(item) for name, item in converted.items()}}
    if isinstance(converted, list):
        # The items of `value` describe their types better than converted items, because their classes have annotations.
        items = value if isinstance(value, (list, tuple)) else converted
        return {"type": "array", "items": _schema_of(items[0]) if items else {}}
    return {} if converted is None else {"type": _JSON_TYPES[type(converted).__name__]}


def _annotations(value_class: type) -> dict[str, str]:
    annotations: dict[str, str] = {}
    for base in reversed(value_class.__mro__):
        annotations.update(inspect.get_annotations(base))
    return annotations


def _schema_of_annotation(annotation: str) -> dict[str, Any]:
    json_type = _JSON_TYPES.get(annotation.partition(" | ")[0])
    return {} if json_type is None else {"type": json_type}
