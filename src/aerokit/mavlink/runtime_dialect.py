"""Dialects that are loaded at run time from XML or a pymavlink module, and compiled to classes.

Imported on first use, because it needs the XML parser and the code renderer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from struct import Struct
from types import ModuleType
from typing import Any, Protocol

from aerokit.errors import InvalidArgument
from aerokit.mavlink import message as message_module
from aerokit.mavlink.definitions import (
    EntryDefinition,
    EnumDefinition,
    FieldDefinition,
    MessageDefinition,
    carries_bytes,
    merged_enums,
    read_dialect,
)
from aerokit.mavlink.generator import xml_folder
from aerokit.mavlink.message import Message, make_enum
from aerokit.mavlink.rendering import render_message

# (name of the dialect, message classes, enums). The enums are keyed by their MAVLink names (``MAV_CMD``).
LoadedDialect = tuple[str, list[type[Message]], dict[str, type[Any]]]


class Standard(Protocol):
    """Dialect of the generated message classes. Loaded dialects use these classes for messages with the same format."""

    rows: dict[int, tuple[int, int, int]]

    def __getitem__(self, message_id: int, /) -> type[Message]: ...


def read_xml_dialect(path: str | Path, standard: Standard) -> LoadedDialect:
    path = Path(path)
    dialects = read_dialect(path, [xml_folder()])
    definitions = [message for dialect in dialects for message in dialect.messages]
    return _load(path.stem, definitions, merged_enums(dialects), standard)


def read_pymavlink_dialect(module: str | ModuleType, standard: Standard) -> LoadedDialect:
    if isinstance(module, str):
        module = _import(module)
    classes: dict[int, Any] | None = getattr(module, "mavlink_map", None)
    if classes is None:
        raise InvalidArgument(f"{module.__name__} is not a pymavlink dialect: it has no mavlink_map")
    # Negative ids are those of pseudo messages such as BAD_DATA.
    definitions = [_message_definition(cls) for _, cls in sorted(classes.items()) if cls.id >= 0]
    enums = [_enum_definition(name, entries) for name, entries in getattr(module, "enums", {}).items()]
    name = module.__name__.rpartition(".")[2]
    return _load(name, definitions, [enum for enum in enums if enum.entries], standard)


def class_from_pymavlink(message_class: Any, standard: Standard) -> type[Message]:
    """Return the aerokit class with the format of a pymavlink message class. If there is none, create it.

    Raises:
        InvalidArgument: the fields of pymavlink's class do not match its CRC_EXTRA.
    """
    definition = _message_definition(message_class)
    return _standard_class(definition, standard) or compile_message(definition)


def compile_message(definition: MessageDefinition) -> type[Message]:
    """Create a class like the generated ones. Its messages cannot be pickled, because no module contains the class."""
    source = "from __future__ import annotations\n" + render_message(definition, docs=False)
    namespace: dict[str, Any] = {
        "__name__": f"{__name__}.{definition.origin}",
        "Struct": Struct,
        "Message": Message,
        "PACK_ERRORS": message_module.PACK_ERRORS,
        "pack_bytes": message_module.pack_bytes,
        "pack_items": message_module.pack_items,
        "pack_text": message_module.pack_text,
        "_new": object.__new__,
    }
    exec(compile(source, f"<{definition.origin} {definition.name}>", "exec"), namespace)
    message_class: type[Message] = namespace[definition.class_name]
    message_class.__doc__ = f"{definition.name} ({definition.id}): {definition.description}"
    return message_class


def _load(
    name: str, definitions: Iterable[MessageDefinition], enums: Iterable[EnumDefinition], standard: Standard
) -> LoadedDialect:
    by_id: dict[int, MessageDefinition] = {}
    for definition in definitions:
        # Several files of a dialect may contain the same definition. Different definitions with one id are an error.
        earlier = by_id.setdefault(definition.id, definition)
        if earlier != definition and (earlier.name, earlier.crc_extra) != (definition.name, definition.crc_extra):
            raise InvalidArgument(
                f"message id {definition.id} is defined twice in {name}: {earlier.name} in {earlier.origin},"
                f" {definition.name} in {definition.origin}"
            )
    classes = [_standard_class(definition, standard) or compile_message(definition) for definition in by_id.values()]
    return name, classes, {enum.name: _enum_type(name, enum) for enum in enums}


def _enum_type(dialect: str, enum: EnumDefinition) -> type[Any]:
    members = [(member, entry.value) for member, entry in enum.members()]
    try:
        return make_enum(
            f"{__name__}.{dialect}", enum.class_name, enum.bitmask, enum.description, members, is_external=True
        )
    except (TypeError, ValueError) as error:  # The name of an entry occurs twice, or is reserved.
        raise InvalidArgument(f"enum {enum.name} of {enum.origin or dialect}: {error}") from error


def _standard_class(definition: MessageDefinition, standard: Standard) -> type[Message] | None:
    """Return the generated class if the wire formats are the same, otherwise None."""
    row = standard.rows.get(definition.id)
    # A row has CRC_EXTRA, the base length and the length.
    if row is None or row[:2] != (definition.crc_extra, definition.base_length):
        return None
    generated = standard[definition.id]
    fields = [(field.attribute, field.type, field.array_length) for field in definition.fields]
    # The generated class may have more extensions than the definition.
    generated_fields = [(field.name, field.type, field.array_length) for field in generated.FIELDS[: len(fields)]]
    return generated if definition.name == generated.NAME and generated_fields == fields else None


# -------------------------------------------------------------------------------- pymavlink modules
def _import(name: str) -> ModuleType:
    """Import a dialect of pymavlink by its short name or its module's name."""
    candidates = [name] if "." in name else [f"pymavlink.dialects.v20.{name}", name]
    for candidate in candidates:
        try:
            return import_module(candidate)
        except ModuleNotFoundError as error:
            # The error may be about another module, which the candidate itself imports.
            is_candidate_missing = error.name is not None and f"{candidate}.".startswith(f"{error.name}.")
            if not is_candidate_missing:
                raise
    raise InvalidArgument(f"there is no pymavlink dialect {name!r}: tried {', '.join(candidates)}")


def _message_definition(cls: Any) -> MessageDefinition:
    """Convert a message class of a pymavlink dialect to a definition."""
    order = list(cls.ordered_fieldnames)
    message_name = getattr(cls, "msgname", None) or cls.name
    fields = []
    for name, kind in zip(cls.fieldnames, cls.fieldtypes):  # noqa: B905 - same length
        array_length = int(cls.array_lengths[order.index(name)])
        units = getattr(cls, "fieldunits_by_name", {}).get(name, "")
        enum = getattr(cls, "fieldenums_by_name", {}).get(name, "")
        default = 3 if name == "mavlink_version" else None  # This field of HEARTBEAT is always 3.
        is_bytes = carries_bytes(message_name, name, kind)
        fields.append(FieldDefinition(name, kind, array_length, units, enum, default=default, carries_bytes=is_bytes))
    description = " ".join((cls.__doc__ or "").split())
    definition = MessageDefinition(
        int(cls.id), message_name, tuple(fields), description, cls.__module__.rpartition(".")[2]
    )
    return _with_extensions(definition, order, int(cls.crc_extra))


def _with_extensions(definition: MessageDefinition, order: list[str], crc_extra: int) -> MessageDefinition:
    """Return the definition with its extension fields marked."""
    fields = definition.fields
    # pymavlink's classes do not mark extensions. Try each possible number of base fields until CRC_EXTRA and the wire
    # order match.
    for base_count in range(len(fields), -1, -1):
        guess = MessageDefinition(
            definition.id,
            definition.name,
            tuple(replace(field, extension=i >= base_count) for i, field in enumerate(fields)),
            definition.description,
            definition.origin,
        )
        if guess.crc_extra == crc_extra and [field.name for field in guess.wire_fields] == order:
            return guess
    raise InvalidArgument(f"{definition.name}: the fields do not match CRC_EXTRA {crc_extra}")


def _enum_definition(name: str, entries: dict[int, Any]) -> EnumDefinition:
    end_marker = f"{name}_ENUM_END"  # pymavlink adds this entry to each enum.
    definitions = [
        EntryDefinition(entry.name, value, entry.description)
        for value, entry in entries.items()
        if entry.name != end_marker
    ]
    return EnumDefinition(name, tuple(definitions))
