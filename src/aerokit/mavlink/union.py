"""What the standard has beyond pymavlink's XML, worked into the definitions that were read from there.

pymavlink carries ArduPilot's fork of the standard. The folder ``additions`` has the difference, in the same XML; where
both say something of units, enums, values and what is superseded, the standard's word counts. Texts are pymavlink's
where it has any. What ArduPilot alone has stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from aerokit.mavlink.definitions import (
    DialectDefinition,
    EntryDefinition,
    EnumDefinition,
    FieldDefinition,
    MessageDefinition,
    read_xml,
)

__all__ = ["read_additions", "with_added_enums", "with_added_messages"]

FOLDER = Path(__file__).parent / "additions"
FLOORS = ("minimal", "standard", "common")
"""The standard's files from below; what two of them name is at home in the lower one."""

DefinedT = TypeVar("DefinedT", EnumDefinition, MessageDefinition)


def read_additions() -> list[DialectDefinition]:
    """The definitions of the folder, each file by itself."""
    return [read_xml(FOLDER / f"{stem}.xml") for stem in ("minimal", "common", "development")]


def with_added_messages(
    messages: Sequence[MessageDefinition], additions: Sequence[DialectDefinition]
) -> list[MessageDefinition]:
    """Messages of pymavlink in their order, then those that are new."""
    merged = {message.id: message for message in messages}
    for added in (message for dialect in additions for message in dialect.messages):
        known = merged.get(added.id)
        if known is not None:
            added = _settled(replace(known, fields=_fields(known, added)), added)
        merged[added.id] = added
    return list(merged.values())


def with_added_enums(
    enums: Sequence[EnumDefinition], additions: Sequence[DialectDefinition]
) -> list[EnumDefinition]:
    """Enums of pymavlink in their order, then those that are new. Of two names for a value the standard's is first.

    New entries do not change the names that the others have in Python.
    """
    merged = {enum.name: enum for enum in enums}
    for added in (enum for dialect in additions for enum in dialect.enums):
        known = merged.get(added.name)
        if known is not None:
            entries = _entries(known, added)
            added = _settled(replace(known, entries=entries, own_prefix=known.prefix), added)
        merged[added.name] = added
    return list(merged.values())


def _settled(known: DefinedT, added: DefinedT) -> DefinedT:
    """With the remarks and the home of both."""
    home = min(
        known.origin, added.origin, key=lambda stem: FLOORS.index(stem) if stem in FLOORS else len(FLOORS)
    )
    return replace(known, origin=home, remarks=added.remarks or known.remarks)


def _fields(known: MessageDefinition, added: MessageDefinition) -> tuple[FieldDefinition, ...]:
    fields = {field.name: field for field in known.fields}
    for field in added.fields:
        before = fields.get(field.name)
        if before is not None:
            field = replace(before, units=field.units, enum=field.enum, invalid=field.invalid)
        fields[field.name] = field
    return tuple(fields.values())


def _entries(known: EnumDefinition, added: EnumDefinition) -> tuple[EntryDefinition, ...]:
    theirs = {entry.name: entry for entry in known.entries}
    ours = {entry.name: _entry(theirs.get(entry.name, entry), entry) for entry in added.entries}
    return tuple(sorted({**ours, **theirs, **ours}.values(), key=lambda entry: entry.value))


def _entry(known: EntryDefinition, added: EntryDefinition) -> EntryDefinition:
    params = {param[0]: param for param in (*known.params, *added.params)}
    return replace(
        known,
        value=added.value,
        params=tuple(params[index] for index in sorted(params)),
        remarks=added.remarks or known.remarks,
    )
