"""Generates the JSON schema of published states from their types: ``python -m aerokit.apps.network.schema``."""

from __future__ import annotations

import inspect
import json
import sys
import types
import typing
from datetime import date, datetime
from enum import Enum, Flag
from typing import Any

from aerokit._internal.values import Snapshot
from aerokit.apps.network.publishing import VERSION
from aerokit.events import LinkState
from aerokit.mavlink import enums
from aerokit.vehicle.state.states import States
from aerokit.vehicle.state.table import documentation

_ABOUT = (
    "States of a vehicle that aerokit publishes (docs/network.md). Units are in the names of fields. null: unknown."
    " Readers must accept unknown fields and states, because they are added without a new version."
)
_PLAIN_SCHEMAS: dict[Any, dict[str, Any]] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": ["number", "null"]},
    str: {"type": "string"},
    bytes: {"type": "string", "description": "hexadecimal digits", "pattern": "^([0-9a-f]{2})*$"},
    datetime: {"type": "string", "format": "date-time"},
    date: {"type": "string", "format": "date"},
    type(None): {"type": "null"},
}
ENUMS: dict[str, type[Enum]] = {
    "system_status": enums.MavState,
    "vtol_state": enums.MavVtolState,
    "landed_state": enums.MavLandedState,
    "capabilities": enums.MavProtocolCapability,
    "GpsReceiver.fix_type": enums.GpsFixType,
    "Battery.charge_state": enums.MavBatteryChargeState,
    "MissionProgress.state": enums.MissionState,
    "Power.flags": enums.MavPowerStatus,
    "Odometry.frame": enums.MavFrame,
    "Odometry.child_frame": enums.MavFrame,
    "Aircraft.emitter": enums.AdsbEmitterType,
}
"""Maps states and fields to MAVLink enums. Their integers are published as names of the enum where it has one."""


def document() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of the messages."""
    definitions: dict[str, dict[str, Any]] = {"Message": _MESSAGE}
    cell_types = typing.get_type_hints(States)
    states = {}
    for name, (_, text) in documentation().items():
        (value_type,) = typing.get_args(cell_types[name])
        states[name] = _message_schema(name, text, _enum_schema(name) or _schema_of(value_type, definitions))
    states["link"] = _message_schema("link", "State and statistics of the link to the vehicle.", _LINK)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "aerokit state",
        "description": _ABOUT,
        "oneOf": list(states.values()),
        "$defs": dict(sorted(definitions.items())),
    }


_COUNT = {"type": "integer", "minimum": 0}
_LINK: dict[str, Any] = {
    "type": "object",
    "properties": {
        "state": {"type": ["string", "null"], "enum": [*(state.value for state in LinkState), None]},
        "heartbeat_age_s": {"type": ["number", "null"]},
        "frames_received": _COUNT,
        "frames_lost": _COUNT,
    },
    "required": ["state", "heartbeat_age_s", "frames_received", "frames_lost"],
}


_MESSAGE: dict[str, Any] = {
    "description": "fields of all messages",
    "type": "object",
    "properties": {
        "version": {"const": VERSION},
        "system_id": {"type": "integer", "minimum": 1, "maximum": 255},
        "state": {"type": "string"},
        "age_s": {"type": "number", "minimum": 0, "description": "seconds since the value was received"},
        "unix_s": {"type": "number", "description": "time of publication, by the publisher's clock"},
    },
    "required": ["version", "system_id", "state", "value", "age_s", "unix_s"],
}


def _message_schema(name: str, text: str, value: dict[str, Any]) -> dict[str, Any]:
    return {
        "title": name,
        "description": " ".join(text.replace("`", "").split()),
        "$ref": "#/$defs/Message",
        "properties": {"state": {"const": name}, "value": value},
    }


def _schema_of(value_type: Any, definitions: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the schema of a value of this type, and add the types that it names to ``definitions``."""
    origin = typing.get_origin(value_type)
    arguments = typing.get_args(value_type)
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [_schema_of(argument, definitions) for argument in arguments]}
    if origin is tuple:
        first_type, *other_types = arguments
        if other_types == [Ellipsis]:  # any number of values of one type: tuple[float, ...]
            return {"type": "array", "items": _schema_of(first_type, definitions)}
        items = [_schema_of(argument, definitions) for argument in arguments]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if isinstance(value_type, type) and issubclass(value_type, Snapshot):
        name = value_type.__name__
        if name not in definitions:
            definitions[name] = {}  # prevents endless recursion if the type refers to itself
            definitions[name] = _snapshot_schema(value_type, definitions)
        return {"$ref": f"#/$defs/{name}"}
    return dict(_PLAIN_SCHEMAS[value_type])


def _enum_schema(name: str) -> dict[str, Any] | None:
    """Return the JSON schema of a state, or of a field by ``Class.field``, that is an enum; None if it is no enum."""
    enum = ENUMS.get(name)
    if enum is None:
        return None
    names = {"enum": [member.name for member in enum]}
    name_lists = [{"type": "array", "items": names}] if issubclass(enum, Flag) else []
    # An enum value without a name is an integer.
    return {"description": f"of {enum.__name__}", "anyOf": [names, *name_lists, {"type": "integer"}]}


def _snapshot_schema(value_type: type[Snapshot], definitions: dict[str, dict[str, Any]]) -> dict[str, Any]:
    annotations: dict[str, Any] = {}
    for base in reversed(value_type.__mro__):
        if issubclass(base, Snapshot) and base is not Snapshot:
            annotations.update(inspect.get_annotations(base, eval_str=True))
    names = list(value_type.__match_args__)
    return {
        "type": "object",
        "description": " ".join((inspect.getdoc(value_type) or "").replace("`", "").split()),
        "properties": {
            name: _enum_schema(f"{value_type.__name__}.{name}") or _schema_of(annotations[name], definitions)
            for name in names
        },
        "required": names,
    }


def rendered() -> str:
    """Return the content of docs/state.schema.json."""
    schema = document()
    lines = [f" {json.dumps(key)}: {_json(value)}," for key, value in schema.items() if key not in ("oneOf", "$defs")]
    states = ",\n".join(f"  {_json(state)}" for state in schema["oneOf"])
    types_ = ",\n".join(f"  {_json(name)}: {_json(definition)}" for name, definition in schema["$defs"].items())
    return "\n".join(["{", *lines, f' "oneOf": [\n{states}\n ],', f' "$defs": {{\n{types_}\n }}', "}", ""])


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


if __name__ == "__main__":
    sys.stdout.write(rendered())
