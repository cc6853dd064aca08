"""Texts of events for the terminal monitor and ``aerokit events``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit._internal.formatting import format_value
from aerokit.mavlink.enums import MavAutopilot, MavType

if TYPE_CHECKING:
    from aerokit.events import Event

_NOTES = {"DuplicateSender": "a second sender has the same ids, and is ignored"}
_UNLABELLED_FIELDS = frozenset(("name", "message", "link", "peer", "text", "error"))
_ENUM_FIELDS: dict[str, type[MavType] | type[MavAutopilot]] = {
    "vehicle_type": MavType,
    "type": MavType,
    "autopilot": MavAutopilot,
}
_UNITS = {"_percent": " %", "_hz": " Hz", "_s": " s"}


def event_details(event: Event) -> str:
    """Describe the fields of an event: ``"STABILIZE → LOITER"``, ``"silent for 3.2 s"``."""
    fields = event.to_dict()
    parts = []
    for name, value in fields.items():
        if name in ("at", "system_id") or (name == "before" and "after" in fields):
            continue  # `before` is shown together with `after`
        if name == "after":
            before = fields.get("before")
            parts.append(format_value(value) if before is None else f"{format_value(before)} → {format_value(value)}")
        elif isinstance(value, bool):
            label = name.removeprefix("is_").replace("_", " ")
            parts.append(label if value else f"not {label}")
        elif name in _ENUM_FIELDS and value in _ENUM_FIELDS[name].__members__.values():
            parts.append(_ENUM_FIELDS[name](value).name)
        elif name in _UNLABELLED_FIELDS:
            parts.append(format_value(value))
        else:
            suffix = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
            label = name.removesuffix(suffix).removesuffix("_id").replace("_", " ")
            parts.append(f"{label} {format_value(value)}{_UNITS.get(suffix, '')}")
    note = _NOTES.get(type(event).__name__)
    if note is not None:
        parts.append(note)
    return ", ".join(parts)
