"""Parser of MAVLink XML, for the generator and for dialects that are loaded at run time.

Format: https://mavlink.io/en/guide/xml_schema.html. Field order and CRC_EXTRA:
https://mavlink.io/en/guide/serialization.html.
"""

from __future__ import annotations

import keyword
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.files import read_bounded
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.frame import x25
from aerokit.mavlink.message import BYTES_IN_CHARS, SIZES

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_MIN_VALUE, _MAX_VALUE = -(1 << 63), (1 << 64) - 1

# Names that message classes or their generated code already use. A field with one of these names gets a trailing
# underscore. Only private dialects have such fields.
_RESERVED = frozenset(
    (
        "ID", "NAME", "CRC_EXTRA", "FIELDS", "LENGTH", "BASE_LENGTH", "received_frame",
        "decode", "decode_body", "encode", "to_dict", "self", "cls", "tuple",
    )
)  # fmt: skip
_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
_FIELD_TYPE = re.compile(r"(\w+?)(?:_mavlink_version)?(?:\[([0-9]{1,3})\])?\Z")


@dataclass(frozen=True)
class FieldDefinition:
    """One field of a message."""

    name: str
    type: str  # without the array brackets
    array_length: int = 0  # 0 if the field is not an array
    units: str = ""
    enum: str = ""
    invalid: str = ""  # the value that means "unknown"
    description: str = ""
    extension: bool = False
    default: int | None = None  # only for mavlink_version
    carries_bytes: bool = False  # True for a char array that holds bytes instead of a text; see BYTES_IN_CHARS

    @property
    def attribute(self) -> str:
        """Name in Python, with a trailing underscore if the standard's name is reserved."""
        reserved = keyword.iskeyword(self.name) or self.name in _RESERVED
        return self.name + "_" if reserved else self.name

    @property
    def length(self) -> int:
        return SIZES[self.type] * (self.array_length or 1)

    @property
    def is_text(self) -> bool:
        return self.type == "char" and not self.carries_bytes

    @property
    def is_bytes(self) -> bool:
        return self.carries_bytes or (self.type == "uint8_t" and bool(self.array_length))


@dataclass(frozen=True)
class MessageDefinition:
    """One message. ``fields`` are in the order of the XML, extensions last."""

    id: int
    name: str
    fields: tuple[FieldDefinition, ...]
    description: str = ""
    origin: str = ""  # name of the XML file without its suffix
    remarks: tuple[str, ...] = ()  # sentences which say that the message is deprecated, superseded or work in progress

    @property
    def class_name(self) -> str:
        return cap_words(self.name)

    @property
    def wire_fields(self) -> tuple[FieldDefinition, ...]:
        """The fields in wire order: sorted by size of type, largest first, then extensions in their order."""
        base = sorted((field for field in self.fields if not field.extension), key=lambda field: -SIZES[field.type])
        return (*base, *(field for field in self.fields if field.extension))

    @property
    def base_length(self) -> int:
        """Payload length without extensions, as in MAVLink 1."""
        return sum(field.length for field in self.fields if not field.extension)

    @property
    def length(self) -> int:
        """Payload length with extensions."""
        return sum(field.length for field in self.fields)

    @property
    def crc_extra(self) -> int:
        # https://mavlink.io/en/guide/serialization.html#crc_extra
        text = self.name + " "
        for field in self.wire_fields:
            if not field.extension:
                text += f"{field.type} {field.name} " + (chr(field.array_length) if field.array_length else "")
        crc = x25(text.encode("latin-1"))
        return (crc & 0xFF) ^ (crc >> 8)


@dataclass(frozen=True)
class EntryDefinition:
    """One entry of an enum. In MAV_CMD, ``params`` has (index, label, units, description) of each parameter."""

    name: str
    value: int
    description: str = ""
    params: tuple[tuple[int, str, str, str], ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class EnumDefinition:
    """One enum. Has the entries of one XML file or, from `merged_enums`, of all files."""

    name: str
    entries: tuple[EntryDefinition, ...]
    bitmask: bool = False
    description: str = ""
    origin: str = ""
    remarks: tuple[str, ...] = ()
    own_prefix: str = ""  # the value of `prefix`; if empty, the prefix is derived from the entries

    @property
    def class_name(self) -> str:
        return cap_words(self.name)

    @property
    def prefix(self) -> str:
        """Prefix that is removed from the names of entries."""
        return self.own_prefix or _common_prefix(self.name, [entry.name for entry in self.entries])

    def members(self) -> list[tuple[str, EntryDefinition]]:
        """Return the entries with their names in Python."""
        prefix = self.prefix
        return [(_member_name(self.name, prefix, entry.name), entry) for entry in self.entries]


@dataclass(frozen=True)
class DialectDefinition:
    """The definitions of one XML file. ``includes`` are the files that it includes."""

    name: str
    messages: tuple[MessageDefinition, ...] = ()
    enums: tuple[EnumDefinition, ...] = ()
    includes: tuple[str, ...] = ()


def cap_words(name: str) -> str:
    """Convert ``GLOBAL_POSITION_INT`` to ``GlobalPositionInt``."""
    words = "".join(part.capitalize() for part in name.split("_"))
    return words + "_" if keyword.iskeyword(words) else words  # "None", "True" and "False" are keywords


def read_dialect(path: Path, search: Sequence[Path] = ()) -> list[DialectDefinition]:
    """Read a file and its includes; included files come first.

    Includes are searched beside the file, then in the folders of ``search``.

    Raises:
        InvalidArgument: a file is missing or is not MAVLink XML.
        FileFormatError: a file is larger than 16 MB.
    """
    dialects: dict[str, DialectDefinition] = {}
    visited: set[str] = set()  # Files may include each other, so a file is added before its includes are read.

    def visit(file: Path) -> None:
        if file.name in visited:
            return
        visited.add(file.name)
        dialect = read_xml(file)
        for include in dialect.includes:
            visit(_find_include(include, file, search))
        dialects[file.name] = dialect

    visit(path)
    return list(dialects.values())


def read_xml(path: Path) -> DialectDefinition:
    """Read one file without its includes. Raises the errors of :func:`read_dialect`."""
    # The XML parsers are imported here, because definitions from pymavlink do not need them.
    from xml.etree.ElementTree import ParseError

    from defusedxml import ElementTree as DefusedXml

    try:
        root = DefusedXml.fromstring(read_bounded(path), forbid_dtd=True)
        return DialectDefinition(
            name=path.stem,
            messages=tuple(_parse_message(node, path.stem) for node in root.findall("messages/message")),
            enums=tuple(_parse_enum(node, path.stem) for node in root.findall("enums/enum")),
            includes=tuple((node.text or "").strip() for node in root.findall("include")),
        )
    except FileNotFoundError:
        raise InvalidArgument(f"there is no dialect file {path}") from None
    except (InvalidArgument, FileFormatError):
        raise
    except (ParseError, LookupError, ValueError) as error:
        raise InvalidArgument(f"{path} is not a MAVLink dialect: {error!r}") from error


def merged_enums(dialects: Iterable[DialectDefinition]) -> list[EnumDefinition]:
    """Return all enums. An enum that several files define has the entries of all of them."""
    merged: dict[str, EnumDefinition] = {}
    for dialect in dialects:
        for enum in dialect.enums:
            earlier = merged.get(enum.name)
            if earlier is None:
                merged[enum.name] = enum
                continue
            # Only entries are merged: all else is from the first file's enum. For each name, the last entry is used.
            entries = {entry.name: entry for entry in (*earlier.entries, *enum.entries)}
            ordered = sorted(entries.values(), key=lambda entry: entry.value)
            merged[enum.name] = replace(earlier, entries=tuple(ordered))
    return list(merged.values())


# ------------------------------------------------------------------------------------------ XML


def _find_include(include: str, file: Path, search: Sequence[Path]) -> Path:
    folders = [file.parent, *search]
    for folder in folders:
        if os.path.isfile(folder / include):  # For a name that is too long, Path.is_file would raise.
            return folder / include
    searched = ", ".join(str(folder) for folder in folders)
    raise InvalidArgument(f"{file.name} includes {include}, which is in none of these folders: {searched}")


def _parse_message(node: Element, origin: str) -> MessageDefinition:
    fields: list[FieldDefinition] = []
    extension = False
    for child in node:
        if child.tag == "extensions":
            extension = True
        elif child.tag == "field":
            fields.append(_parse_field(child, extension, node.attrib["name"]))
    message = MessageDefinition(
        id=int(node.attrib["id"], 0),
        name=_identifier(node.attrib["name"]),
        fields=tuple(fields),
        description=_text(node.find("description")),
        origin=origin,
        remarks=_remarks(node),
    )
    if not 0 <= message.id < 1 << 24:
        raise ValueError(f"{message.name}: message id {message.id} is not in 0..16777215")
    names = Counter(field.attribute for field in fields)
    duplicates = [name for name, count in names.items() if count > 1]
    if duplicates:
        raise ValueError(f"{message.name}: the field {duplicates[0]} is defined twice")
    if message.length > 255:
        raise ValueError(f"{message.name}: the payload has {message.length} bytes, but at most 255 fit in a frame")
    return message


def _parse_field(node: Element, extension: bool, message: str) -> FieldDefinition:
    # The field mavlink_version of HEARTBEAT has its own type "uint8_t_mavlink_version", and its value is always 3.
    match = _FIELD_TYPE.match(node.attrib["type"])
    if match is None or match[1] not in SIZES or match[2] == "0":
        raise ValueError(f"{message}: unknown field type {node.attrib['type']!r}")
    type_, array_length = match[1], int(match[2] or 0)
    return FieldDefinition(
        name=_identifier(node.attrib["name"]),
        type=type_,
        array_length=array_length,
        units=node.get("units", ""),
        enum=node.get("enum", ""),
        invalid=node.get("invalid", ""),
        description=_text(node),
        extension=extension,
        default=3 if node.attrib["type"] == "uint8_t_mavlink_version" else None,
        carries_bytes=carries_bytes(message, node.attrib["name"], type_),
    )


def carries_bytes(message: str, field_name: str, kind: str) -> bool:
    return kind == "char" and (message, field_name) in BYTES_IN_CHARS


def _parse_enum(node: Element, origin: str) -> EnumDefinition:
    entries: list[EntryDefinition] = []
    highest = 0
    for child in node.findall("entry"):
        # An entry without a value gets the highest value so far plus 1, as in pymavlink's mavparse.py.
        value = _integer(child.attrib["value"]) if "value" in child.attrib else highest + 1
        highest = max(highest, value)
        entries.append(
            EntryDefinition(
                name=_identifier(child.attrib["name"]),
                value=value,
                description=_text(child.find("description")),
                params=tuple(_parse_param(param) for param in child.findall("param")),
                remarks=_remarks(child),
            )
        )
    return EnumDefinition(
        name=_identifier(node.attrib["name"]),
        entries=tuple(entries),
        bitmask=node.get("bitmask") == "true",
        description=_text(node.find("description")),
        origin=origin,
        remarks=_remarks(node),
    )


def _parse_param(node: Element) -> tuple[int, str, str, str]:
    return int(node.attrib["index"]), node.get("label", ""), node.get("units", ""), _text(node)


def _integer(text: str) -> int:
    """Parse ``16``, ``0x10``, ``0b10000``, ``1<<4`` or ``2**4``."""
    for operator in ("<<", "**"):
        if operator in text:
            left, right = (int(part.strip(), 0) for part in text.split(operator))
            if not (0 <= left <= _MAX_VALUE and 0 <= right <= 64):  # A hostile file must not create a huge number.
                raise ValueError(f"{text!r} is not a valid enum value")
            return _in_range(left << right if operator == "<<" else int(left**right))
    return _in_range(int(text.strip(), 0))


def _in_range(value: int) -> int:
    if not _MIN_VALUE <= value <= _MAX_VALUE:
        raise ValueError(f"an enum value exceeds 64 bits: {value:#x}")
    return value


def _identifier(name: str) -> str:
    if not _IDENTIFIER.match(name):
        raise ValueError(f"{name!r} is not a name of letters, digits and '_'")
    return name


def _text(node: Element | None) -> str:
    return "" if node is None else " ".join("".join(node.itertext()).split())


def _remarks(node: Element) -> tuple[str, ...]:
    remarks: list[str] = []
    for child in node:
        if child.tag in ("deprecated", "superseded"):
            since, replacement = child.get("since", ""), child.get("replaced_by", "")
            remark = child.tag.capitalize()
            if since:
                remark += f" since {since}"
            if replacement:
                remark += f", replaced by {replacement}"
            remarks.append(f"{remark}. {_text(child)}".strip())
        elif child.tag == "wip":
            remarks.append("Work in progress: may change.")
    return tuple(remarks)


# --------------------------------------------------------------------------------------- member names


def _common_prefix(enum: str, names: list[str]) -> str:
    """Return the enum's name if most entries begin with it, otherwise the words that all entries begin with."""
    if not names:
        return ""
    enum_prefix = enum + "_"
    if sum(name.startswith(enum_prefix) for name in names) * 2 > len(names):
        return enum_prefix
    # The last word of an entry's name is never part of the prefix. A single name is compared with the enum's name.
    split_names = [name.split("_")[:-1] for name in names]
    if len(names) == 1:
        split_names.append(enum.split("_"))
    common: list[str] = []
    for words in zip(*split_names):  # noqa: B905 - the shortest ends it
        if len(set(words)) > 1:
            break
        common.append(words[0])
    return "".join(word + "_" for word in common)


def _member_name(enum: str, prefix: str, name: str) -> str:
    if not name.startswith(prefix):  # Some entries begin only with the last words of the enum's name.
        words = enum.split("_")
        shorter_prefixes = ("_".join(words[i:]) + "_" for i in range(1, len(words)))
        prefix = next((shorter for shorter in shorter_prefixes if name.startswith(shorter)), "")
    member = name[len(prefix) :]
    # A Python name cannot begin with a digit, so the last word of the prefix is kept.
    if member[:1].isdigit():
        member = prefix.rstrip("_").rpartition("_")[2] + "_" + member
    # Python reserves keywords, and enum classes cannot have a member called "mro".
    return member + "_" if keyword.iskeyword(member) or member == "mro" else member
