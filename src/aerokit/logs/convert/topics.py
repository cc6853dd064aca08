"""The topics of a vehicle: their names, their JSON schemas and their messages, for a live viewer and for files alike.

Those whose schema is ``foxglove.…`` are the ones that its panels know
(https://docs.foxglove.dev/docs/sdk/schemas); the others hold our values, field by field. Everything is JSON.
"""

from __future__ import annotations

import inspect
import json
import math
from typing import TYPE_CHECKING, Any

from aerokit._internal import geo
from aerokit._internal.plain import plain
from aerokit._internal.values import Snapshot
from aerokit.mavlink.message import SECRET_FIELDS, Message, field_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from aerokit.position import Position
    from aerokit.vehicle.state.condition import StatusText
    from aerokit.vehicle.state.movement import Attitude, Velocity

MAP_FRAME = "map"
"""The frame of all vehicles: x east, y north, z up, metres; its origin is where the first of them was first heard."""

_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False)
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_KINDS = {"float": "number", "int": "number", "str": "string", "bool": "boolean"}
_FATAL, _ERROR, _WARNING, _INFO, _DEBUG = 5, 4, 3, 2, 1
_LEVELS = (_FATAL, _FATAL, _FATAL, _ERROR, _WARNING, _INFO, _INFO, _DEBUG)
"""MAV_SEVERITY → foxglove.LogLevel."""


def _object(title: str, /, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _of_foxglove(name: str, /, **properties: Any) -> dict[str, Any]:
    return {**_object(f"foxglove.{name}", **properties), "required": list(properties)}


_TIME = _object("time", sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR = _of_foxglove("Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _of_foxglove("Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)

LOCATION_FIX: dict[str, Any] = {
    **_of_foxglove(
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
FRAME_TRANSFORM = _of_foxglove(
    "FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
POSE_IN_FRAME = _of_foxglove(
    "PoseInFrame",
    timestamp=_TIME,
    frame_id=_TEXT,
    pose=_of_foxglove("Pose", position=_VECTOR, orientation=_QUATERNION),
)
LOG = _of_foxglove(
    "Log",
    timestamp=_TIME,
    level={"type": "integer"},
    message=_TEXT,
    name=_TEXT,
    file=_TEXT,
    line={"type": "integer"},
)


class Topic(Snapshot):
    """One topic: its name, and the JSON schema of its messages, whose ``title`` is the schema's name."""

    name: str
    schema: Mapping[str, Any]

    @property
    def schema_name(self) -> str:
        """The schema's name, ``"foxglove.LocationFix"``."""
        return str(self.schema["title"])


class MapFrame:
    """Places as metres east, north and up of an origin."""

    def __init__(self) -> None:
        self._origin: tuple[float, float, float] | None = None

    def east_north_up_m(self, place: Position) -> tuple[float, float, float]:
        """Where a place is; the first that is asked for is made the origin, at the height of home where it is known."""
        altitude, relative = place.altitude_amsl_m, place.altitude_relative_m
        if self._origin is None:
            self._origin = (place.latitude_deg, place.longitude_deg, (altitude or 0.0) - (relative or 0.0))
        latitude, longitude, height = self._origin
        north, east = geo.north_east_m(latitude, longitude, place.latitude_deg, place.longitude_deg)
        return east, north, height_above(height, altitude, relative)


def height_above(origin_m: float, altitude_amsl_m: float | None, relative_m: float | None) -> float:
    """Metres above the origin: by the altitude above the sea, else by the one above home."""
    return (relative_m or 0.0) if altitude_amsl_m is None else altitude_amsl_m - origin_m


# ------------------------------------------------------------------------------------ names


def vehicle_topic(system_id: int, what: str) -> str:
    """``/vehicle/1/location`` and the like."""
    return f"/vehicle/{system_id}/{what}"


def frame_of(system_id: int) -> str:
    """The name of the frame that moves with a vehicle: x forward, y left, z up."""
    return f"vehicle_{system_id}"


def state_topic(system_id: int, name: str, value: object) -> Topic:
    """The topic of a state, ``/vehicle/1/attitude``; its schema is that of its first value."""
    schema = _schema_of(value)
    if schema.get("type") != "object":
        schema = {"type": "object", "properties": {"value": schema}}
    return Topic(vehicle_topic(system_id, name), {**schema, "title": f"aerokit.{name}"})


def raw_topic(system_id: int, component_id: int, message: type[Message]) -> Topic:
    """The topic of a MAVLink message as it came, ``/mavlink/1/1/GPS_RAW_INT``; the units are in the schema."""
    properties: dict[str, Any] = {}
    for field in message.FIELDS:
        if field.name in SECRET_FIELDS:
            continue
        number: dict[str, Any] = {"type": "string" if field.is_text or _are_bytes(field) else "number"}
        schema = {"type": "array", "items": number} if field.array_length and number == _NUMBER else number
        unit = f" [{field.units}]" if field.units else ""
        properties[field.name] = {**schema, "description": f"{field.description}{unit}"}
    name = raw_topic_name(system_id, component_id, message)
    return Topic(name, _object(f"mavlink.{message.NAME}", **properties))


def raw_topic_name(system_id: int, component_id: int, message: type[Message]) -> str:
    """``/mavlink/1/1/GPS_RAW_INT``."""
    return f"/mavlink/{system_id}/{component_id}/{message.NAME}"


def _are_bytes(field: Any) -> bool:
    return field.type in ("uint8_t", "char") and bool(field.array_length)


# --------------------------------------------------------------------------------- messages


def nanoseconds(unix_s: float) -> int:
    """Nanoseconds since 1970, to the microsecond."""
    return round(unix_s * 1e6) * 1000


def encoded(fields: Mapping[str, Any]) -> bytes:
    """A message as it goes to the viewer or the file."""
    return _JSON.encode(fields).encode()


def state_fields(value: object) -> dict[str, Any]:
    """The message of a state: its fields, or ``{"value": …}`` when it is a number, a text or a list."""
    if isinstance(value, Snapshot):
        return {name: _plain(getattr(value, name)) for name in value.__match_args__}
    told = plain(value)
    return told if isinstance(told, dict) else {"value": told}


def raw_fields(message: Message) -> dict[str, Any]:
    """The message of a MAVLink message: the standard's fields in its raw units; keys and passwords are left out."""
    return {
        name: _plain(getattr(message, name)) for name in field_names(message) if name not in SECRET_FIELDS
    }


def _plain(value: object) -> Any:
    """Like `aerokit._internal.plain.plain`, and three times as fast for the common field types: a log has millions."""
    kind = type(value)
    if kind is int or kind is str or value is None:
        return value
    if kind is float:
        return value if math.isfinite(value) else None  # type: ignore[arg-type]
    return plain(value)


def location_fix(
    unix_s: float,
    system_id: int,
    place: Position,
    heading_deg: float | None = None,
    velocity: Velocity | None = None,
) -> dict[str, Any]:
    """``foxglove.LocationFix``, for the map; the altitude is above mean sea level, 0 when it is not known."""
    fix: dict[str, Any] = {
        "timestamp": _time(unix_s),
        "frame_id": frame_of(system_id),
        "latitude": place.latitude_deg,
        "longitude": place.longitude_deg,
        "altitude": place.altitude_amsl_m or 0.0,
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,
    }
    if heading_deg is not None:
        fix["heading"] = math.radians(heading_deg)
    if velocity is not None:
        fix["velocity"] = _vector(velocity.east_m_s, velocity.north_m_s, -velocity.down_m_s)
    return fix


def frame_transform(
    unix_s: float, system_id: int, east_north_up_m: Sequence[float], attitude: Attitude | None
) -> dict[str, Any]:
    """``foxglove.FrameTransform`` from the map to the vehicle's body, for the 3D panel."""
    return {
        "timestamp": _time(unix_s),
        "parent_frame_id": MAP_FRAME,
        "child_frame_id": frame_of(system_id),
        "translation": _vector(*east_north_up_m),
        "rotation": _rotation(attitude),
    }


def pose_in_frame(
    unix_s: float, east_north_up_m: Sequence[float], attitude: Attitude | None
) -> dict[str, Any]:
    """``foxglove.PoseInFrame`` in the map, for the 3D panel."""
    return {
        "timestamp": _time(unix_s),
        "frame_id": MAP_FRAME,
        "pose": {"position": _vector(*east_north_up_m), "orientation": _rotation(attitude)},
    }


def log_entry(unix_s: float, system_id: int, text: StatusText) -> dict[str, Any]:
    """``foxglove.Log`` of what the vehicle said; its level is 0, unknown, where a log does not keep it."""
    severity: int | None = text.severity
    return {
        "timestamp": _time(unix_s),
        "level": 0 if severity is None or not 0 <= severity < len(_LEVELS) else _LEVELS[severity],
        "message": text.text,
        "name": frame_of(system_id),
        "file": "",
        "line": 0,
    }


def _time(unix_s: float) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds(unix_s), 1_000_000_000)
    return {"sec": seconds, "nsec": rest}


def _vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _rotation(attitude: Attitude | None) -> dict[str, float]:
    """From (forward, right, down) in (north, east, down) to (forward, left, up) in (east, north, up)."""
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    if attitude is not None and all(
        map(math.isfinite, (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg))
    ):
        w, x, y, z = attitude.quaternion
    half = math.sqrt(0.5)
    return {"x": half * (x + y), "y": half * (x - y), "z": half * (w - z), "w": half * (w + z)}


# ---------------------------------------------------------------------------------- schemas


def _schema_of(value: object) -> dict[str, Any]:
    """The JSON schema of what `plain` makes of a value; a field that is None tells its type."""
    if isinstance(value, Snapshot):
        kinds = _annotations(type(value))
        fields = value.to_dict()
        return {
            "type": "object",
            "properties": {
                name: _declared(kinds.get(name, "")) if field is None else _schema_of(field)
                for name, field in fields.items()
            },
        }
    told = plain(value)
    if isinstance(told, dict):
        return {"type": "object", "properties": {name: _schema_of(each) for name, each in told.items()}}
    if isinstance(told, list):
        members = value if isinstance(value, (list, tuple)) else told
        return {"type": "array", "items": _schema_of(members[0]) if members else {}}
    return {} if told is None else {"type": _KINDS[type(told).__name__]}


def _annotations(kind: type) -> dict[str, str]:
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found.update(inspect.get_annotations(base))
    return found


def _declared(annotation: str) -> dict[str, Any]:
    """The schema of ``"float | None"``."""
    kind = _KINDS.get(annotation.partition(" | ")[0])
    return {} if kind is None else {"type": kind}
