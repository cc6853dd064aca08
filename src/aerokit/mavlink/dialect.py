"""`Dialect`: which message an id stands for.

`STANDARD` knows all generated messages: MAVLink's own minimal, standard, common and development, and ardupilotmega
(with what it includes). Others are read at run time from an XML file or a pymavlink dialect module; their messages
which are the standard's are the same classes, so that ``isinstance(message, messages.Heartbeat)`` goes on working.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from enum import IntFlag
from functools import partial
from importlib import import_module
from pathlib import Path
from struct import Struct
from types import ModuleType
from typing import TYPE_CHECKING, Any

from aerokit.errors import InvalidArgument
from aerokit.mavlink import enums, messages
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
from aerokit.mavlink.enumeration import make_enum
from aerokit.mavlink.generator import xml_folder
from aerokit.mavlink.message import Message
from aerokit.mavlink.rendering import render_message

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame

__all__ = [
    "STANDARD",
    "Dialect",
    "class_from_pymavlink",
    "compile_message",
    "dialect_from_pymavlink",
    "dialect_from_xml",
]

Row = tuple[int, int, int]


class Dialect:
    """Message ids and their classes. Dialects do not change once they are made."""

    def __init__(
        self, name: str, classes: Iterable[type[Message]], enum_types: Mapping[str, type[Any]] | None = None
    ) -> None:
        """Make a dialect of classes; ``enum_types`` maps the standard's spelling, ``"MAV_CMD"``, to enums."""
        self.name = name
        """Its name, the XML file's for example."""
        self._classes = {cls.ID: cls for cls in classes}
        self._enums = dict(enum_types or {})
        self._take(
            {cls.ID: (cls.CRC_EXTRA, cls.BASE_LENGTH, cls.LENGTH) for cls in self._classes.values()},
        )

    def _take(self, rows: dict[int, Row]) -> None:
        self.rows = rows
        """Message id → (CRC_EXTRA, length of the payload without extensions, and with them)."""
        self.extras: dict[int, bytes] = {message_id: bytes((row[0],)) for message_id, row in rows.items()}
        """Message id → CRC_EXTRA as the byte that goes behind the payload into the checksum."""
        self._decoders: dict[int, Callable[[bytes, Frame | None], Message]] = {
            message_id: partial(self._decode_first, message_id) for message_id in rows
        }

    @classmethod
    def from_xml(cls, path: str | Path) -> Dialect:
        """Read an XML file and all it includes, beside it or in pymavlink's package.

        Raises InvalidArgument when a file is missing or wrong, or an id is defined twice.
        """
        return dialect_from_xml(path)

    @classmethod
    def from_pymavlink(cls, module: str | ModuleType) -> Dialect:
        """Take over a pymavlink dialect: the module, its dotted name, or the last part of it (``"storm32"``).

        Raises InvalidArgument when there is no such module or it is no dialect.
        """
        return dialect_from_pymavlink(module)

    def __getitem__(self, message_id: int) -> type[Message]:
        """The class of a message id; KeyError when the dialect has none."""
        return self._classes[message_id]

    def get(self, message_id: int) -> type[Message] | None:
        """The class of a message id, or None."""
        return self[message_id] if message_id in self.rows else None

    def by_name(self, name: str) -> type[Message]:
        """The class of the standard's name, ``"GLOBAL_POSITION_INT"``; InvalidArgument when there is none."""
        for message_class in self:
            if name == message_class.NAME:
                return message_class
        raise InvalidArgument(f"dialect {self.name!r} has no message {name!r}")

    def enum(self, name: str) -> type[Any]:
        """The enum of the standard's name, ``"MAV_CMD"``; InvalidArgument when there is none."""
        if name in self._enums:
            return self._enums[name]
        raise InvalidArgument(f"dialect {self.name!r} has no enum {name!r}")

    def __contains__(self, message_id: object) -> bool:
        return message_id in self.rows

    def __iter__(self) -> Iterator[type[Message]]:
        return (self[message_id] for message_id in sorted(self.rows))

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return f"<Dialect {self.name!r}: {len(self)} messages>"

    def decode(self, frame: Frame) -> Message:
        """The message of a frame, its ``received_frame`` set; KeyError when the dialect does not know the id."""
        return self._decoders[frame.message_id](frame.body, frame)

    def _decode_first(self, message_id: int, body: bytes, frame: Frame | None) -> Message:
        """Stands in for a class that is not loaded yet, so that `decode` need not ask each time."""
        decoder = self._decoders[message_id] = self[message_id].decode_body
        return decoder(body, frame)

    def extended_by(self, other: Dialect) -> Dialect:
        """Both together. InvalidArgument when an id means one message here and another there."""
        for message_id in self.rows.keys() & other.rows.keys():
            if self.rows[message_id] != other.rows[message_id]:
                raise InvalidArgument(
                    f"message id {message_id} is {self[message_id].NAME} (CRC_EXTRA {self.rows[message_id][0]}) in"
                    f" {self.name!r}, but {other[message_id].NAME} (CRC_EXTRA {other.rows[message_id][0]}) in"
                    f" {other.name!r}"
                )
        return _Extended(self, other)


class _Standard(Dialect):
    """The generated messages; their modules are imported when one of them is first needed."""

    def __init__(self) -> None:
        super().__init__("standard", ())
        self._take({message_id: row[2:] for message_id, row in messages.INDEX.items()})

    def __getitem__(self, message_id: int) -> type[Message]:
        message_class: type[Message] = getattr(messages, messages.INDEX[message_id][0])
        return message_class

    def by_name(self, name: str) -> type[Message]:
        message_class = getattr(messages, _cap_words(name), None)
        return super().by_name(name) if message_class is None else message_class

    def enum(self, name: str) -> type[Any]:
        found = getattr(enums, _cap_words(name), None)
        return super().enum(name) if found is None else found


class _Extended(Dialect):
    def __init__(self, first: Dialect, second: Dialect) -> None:
        super().__init__(f"{first.name}+{second.name}", ())
        self._parts = (first, second)
        self._take({**second.rows, **first.rows})

    def __getitem__(self, message_id: int) -> type[Message]:
        first, second = self._parts
        return first[message_id] if message_id in first else second[message_id]

    def enum(self, name: str) -> type[Any]:
        found: list[type[Any]] = []
        for part in self._parts:
            try:
                found.append(part.enum(name))
            except InvalidArgument:
                continue
        if len(found) < 2 or found[1].__members__.keys() <= found[0].__members__.keys():
            return found[0] if found else super().enum(name)
        if name not in self._enums:
            self._enums[name] = _united(*found)
        return self._enums[name]


def _united(first: type[Any], second: type[Any]) -> type[Any]:
    """An enum with the entries of both: private dialects add to enums of the standard, which has more than theirs."""
    members = {**second.__members__, **first.__members__}
    bitmask = issubclass(first, IntFlag)
    return make_enum(first.__module__, first.__name__, bitmask, first.__doc__ or "", members.items())


def _cap_words(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


STANDARD: Dialect = _Standard()
"""All messages that aerokit carries; made without importing one of them."""


def dialect_from_xml(path: str | Path) -> Dialect:
    """See `Dialect.from_xml`."""
    path = Path(path)
    dialects = read_dialect(path, [xml_folder()])
    definitions = [message for dialect in dialects for message in dialect.messages]
    return _dialect(path.stem, definitions, merged_enums(dialects))


def dialect_from_pymavlink(module: str | ModuleType) -> Dialect:
    """See `Dialect.from_pymavlink`."""
    if isinstance(module, str):
        module = _import(module)
    known: dict[int, Any] | None = getattr(module, "mavlink_map", None)
    if known is None:
        raise InvalidArgument(f"{module.__name__} is no pymavlink dialect: it has no mavlink_map")
    definitions = [_message(cls) for _, cls in sorted(known.items()) if cls.id >= 0]
    enums = [_enum(name, entries) for name, entries in getattr(module, "enums", {}).items()]
    return _dialect(module.__name__.rpartition(".")[2], definitions, [enum for enum in enums if enum.entries])


def class_from_pymavlink(message_class: Any) -> type[Message]:
    """The class for one of pymavlink's message classes: the committed one, if that says the same about the bytes.

    Raises InvalidArgument when pymavlink's class does not agree with its own CRC_EXTRA.
    """
    definition = _message(message_class)
    return _standard_class(definition) or compile_message(definition)


def compile_message(definition: MessageDefinition) -> type[Message]:
    """A class like the generated ones; it cannot be pickled, because no module holds it."""
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


def _dialect(name: str, definitions: Iterable[MessageDefinition], enums: Iterable[EnumDefinition]) -> Dialect:
    by_id: dict[int, MessageDefinition] = {}
    for definition in definitions:
        other = by_id.setdefault(definition.id, definition)
        if other != definition and (other.name, other.crc_extra) != (definition.name, definition.crc_extra):
            raise InvalidArgument(
                f"message id {definition.id} is defined twice in {name}: {other.name} in {other.origin},"
                f" {definition.name} in {definition.origin}"
            )
    classes = [_standard_class(definition) or compile_message(definition) for definition in by_id.values()]
    return Dialect(name, classes, {enum.name: _enum_type(name, enum) for enum in enums})


def _enum_type(dialect: str, enum: EnumDefinition) -> type[Any]:
    members = [(member, entry.value) for member, entry in enum.members()]
    try:
        return make_enum(
            f"{__name__}.{dialect}",
            enum.class_name,
            enum.bitmask,
            enum.description,
            members,
            is_from_outside=True,
        )
    except (TypeError, ValueError) as error:  # two of a name, names that Python keeps for itself
        raise InvalidArgument(f"enum {enum.name} of {enum.origin or dialect}: {error}") from error


def _standard_class(definition: MessageDefinition) -> type[Message] | None:
    """The committed class, when it says the same about the bytes, or knows more extension fields behind them."""
    row = STANDARD.rows.get(definition.id)
    if row is None or row[:2] != (definition.crc_extra, definition.base_length):
        return None
    standard = STANDARD[definition.id]
    fields = [(f.attribute, f.type, f.array_length) for f in definition.fields]
    known = [(f.name, f.type, f.array_length) for f in standard.FIELDS[: len(fields)]]
    return standard if definition.name == standard.NAME and known == fields else None


# -------------------------------------------------------------------------------- pymavlink modules
def _import(name: str) -> ModuleType:
    candidates = [name] if "." in name else [f"pymavlink.dialects.v20.{name}", name]
    for candidate in candidates:
        try:
            return import_module(candidate)
        except ModuleNotFoundError as error:
            if error.name is None or not candidate.startswith(error.name):
                raise
    raise InvalidArgument(f"no pymavlink dialect {name!r}: tried {', '.join(candidates)}")


def _message(cls: Any) -> MessageDefinition:
    order = list(cls.ordered_fieldnames)
    message_name = getattr(cls, "msgname", None) or cls.name
    fields = []
    for name, kind in zip(cls.fieldnames, cls.fieldtypes):  # noqa: B905 - of one length
        array_length = int(cls.array_lengths[order.index(name)])
        units = getattr(cls, "fieldunits_by_name", {}).get(name, "")
        enum = getattr(cls, "fieldenums_by_name", {}).get(name, "")
        default = 3 if name == "mavlink_version" else None
        is_bytes = carries_bytes(message_name, name, kind)
        fields.append(
            FieldDefinition(name, kind, array_length, units, enum, default=default, carries_bytes=is_bytes)
        )
    description = " ".join((cls.__doc__ or "").split())
    definition = MessageDefinition(
        int(cls.id), message_name, tuple(fields), description, cls.__module__.rpartition(".")[2]
    )
    return _with_extensions(definition, order, int(cls.crc_extra))


def _with_extensions(definition: MessageDefinition, order: list[str], crc_extra: int) -> MessageDefinition:
    """Pymavlink's classes do not say where the extensions begin; CRC_EXTRA and the order on the wire do."""
    fields = definition.fields
    for base in range(len(fields), -1, -1):
        guess = MessageDefinition(
            definition.id,
            definition.name,
            tuple(replace(f, extension=i >= base) for i, f in enumerate(fields)),
            definition.description,
            definition.origin,
        )
        if guess.crc_extra == crc_extra and [f.name for f in guess.wire_fields] == order:
            return guess
    raise InvalidArgument(f"{definition.name}: CRC_EXTRA {crc_extra} fits none of its field orders")


def _enum(name: str, entries: dict[int, Any]) -> EnumDefinition:
    end_marker = f"{name}_ENUM_END"
    kept = [
        EntryDefinition(e.name, value, e.description) for value, e in entries.items() if e.name != end_marker
    ]
    return EnumDefinition(name, tuple(kept))
