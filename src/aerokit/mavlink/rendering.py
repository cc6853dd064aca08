"""Renders definitions as Python source of message classes and enums.

`generator` writes this source to modules, and `runtime_dialect` compiles it. Both kinds of classes are therefore the
same.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable

from aerokit.mavlink.definitions import EntryDefinition, EnumDefinition, FieldDefinition, MessageDefinition
from aerokit.mavlink.frame import HEADER_LENGTH
from aerokit.mavlink.message import STRUCT_CODES

_WIDTH = 110
# Generated code unpacks arrays up to this length into separate variables. It slices longer arrays.
_MAX_UNPACKED_LENGTH = 4


def render_message(message: MessageDefinition, *, docs: bool = True) -> str:
    """Render the class of one message with its Struct. ``docs=False`` keeps only the first docstring line."""
    struct_format = "<" + "".join(_struct_code(field) for field in message.wire_fields)
    lines = [
        f"_S{message.id} = Struct({struct_format!r})",
        "",
        "",
        f"class {message.class_name}(Message):",
    ]
    lines += _docstring(_message_doc(message) if docs else [f"{message.name} ({message.id})."], "    ")
    names = [field.attribute for field in message.fields]
    lines += ["", *_render_tuple("__slots__", names), *_render_tuple("__match_args__", names)]
    lines += [
        f"    ID: ClassVar[int] = {message.id}",
        f"    NAME: ClassVar[str] = {_quoted(message.name)}",
        f"    CRC_EXTRA: ClassVar[int] = {message.crc_extra}",
        f"    LENGTH: ClassVar[int] = {message.length}",
        f"    BASE_LENGTH: ClassVar[int] = {message.base_length}",
        "    _FIELDS = (",
        *(f"        {_field_row(field)}," for field in message.fields),
        "    )",
    ]
    for field in message.fields:
        lines += ["", f"    {field.attribute}: {_annotation(field)}"]
        if docs:
            lines += _docstring([_field_doc(field)], "    ")
    lines += ["", *_render_init(message), "", *_render_decode(message), "", *_render_encode(message)]
    return "\n".join(lines) + "\n"


def render_enum_row(enum: EnumDefinition) -> str:
    """Render an entry of an enum module's table: name → (bitmask, docstring, members)."""
    members = "".join(f"            ({_quoted(name)}, {entry.value}),\n" for name, entry in enum.members())
    doc = "\n\n".join(_enum_doc(enum))
    head = f"    {_quoted(enum.class_name)}: (\n        {enum.bitmask},\n        {doc!r},\n"
    return f"{head}        (\n{members}        ),\n    ),\n"


def render_enum_stub(enum: EnumDefinition) -> str:
    """Render the class of one enum for type checkers and editors."""
    lines = [f"class {enum.class_name}({'IntFlag' if enum.bitmask else 'IntEnum'}):"]
    lines += _docstring(_enum_doc(enum), "    ")
    for name, entry in enum.members():
        lines.append(f"    {name} = {entry.value}")
        doc = _entry_doc(entry)
        if doc:
            lines += _docstring(doc, "    ")
    return "\n".join(lines) + "\n"


# ------------------------------------------------------------------------------------------ texts


def _page_url(origin: str, name: str) -> str:
    return f"https://mavlink.io/en/messages/{origin}.html#{name}"


def _message_doc(message: MessageDefinition) -> list[str]:
    first = f"{message.name} ({message.id}): {message.description or 'no description in the standard.'}"
    return [first, *message.remarks, _page_url(message.origin, message.name)]


def _enum_doc(enum: EnumDefinition) -> list[str]:
    first = f"{enum.name}: {enum.description or 'no description in the standard.'}"
    return [first, *enum.remarks, _page_url(enum.origin, enum.name)]


def _field_doc(field: FieldDefinition) -> str:
    parts = [_sentence(field.description)] if field.description else []
    if field.array_length:
        parts.append(f"Type: {field.type}[{field.array_length}].")
    else:
        parts.append(f"Type: {field.type}.")
    if field.units:
        parts.append(f"Unit: {field.units}.")
    if field.enum:
        parts.append(f"Values: {field.enum}.")
    if field.invalid:
        parts.append(f"Unknown: {field.invalid}.")
    if field.extension:
        parts.append("Extension, absent in MAVLink 1.")
    return " ".join(parts)


def _entry_doc(entry: EntryDefinition) -> list[str]:
    paragraphs = [_sentence(entry.description)] if entry.description else []
    paragraphs += entry.remarks
    for index, label, units, text in entry.params:
        unit = f" [{units}]" if units else ""
        title = f"param{index}{' ' + label if label else ''}{unit}: {text}".rstrip(": ")
        paragraphs.append(title)
    return paragraphs


def _sentence(text: str) -> str:
    return text if text[-1:] in ".!?:)" else text + "."


def _docstring(paragraphs: Iterable[str], indent: str) -> list[str]:
    texts = [text.replace("\\", "\\\\").replace('"""', "'''") for text in paragraphs if text]
    width = _WIDTH - len(indent) - 6  # The opening and the closing quotes have six characters.
    wrapped: list[str] = []
    for number, text in enumerate(texts):
        if number:  # An empty line separates paragraphs.
            wrapped.append("")
        wrapped += textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
    if len(wrapped) == 1:
        # Without a space, a quotation mark would join the closing quotes.
        space = " " if wrapped[0].endswith('"') else ""
        return [f'{indent}"""{wrapped[0]}{space}"""']
    body = [f"{indent}{line}" if line else "" for line in wrapped[1:]]
    return [f'{indent}"""{wrapped[0]}', *body, f'{indent}"""']


# ------------------------------------------------------------------------------------------- code


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # JSON strings are valid Python strings


def _render_tuple(name: str, items: list[str]) -> list[str]:
    return _filled(f"    {name} = (", [_quoted(item) for item in items], ")", "    ")


def _filled(head: str, items: list[str], tail: str, indent: str) -> list[str]:
    """Format items in brackets on one line, or on several if they do not fit."""
    single = f"{head}{', '.join(items)}{',' if len(items) == 1 else ''}{tail}"
    if len(single) <= _WIDTH:
        return [single]
    lines = [""]
    for item in items:
        width = len(indent) + 4 + len(lines[-1]) + len(item) + 2  # with 4 spaces of indentation, a space and a comma
        if lines[-1] and width > _WIDTH:
            lines.append("")
        lines[-1] += f" {item}," if lines[-1] else f"{item},"
    return [head, *(f"{indent}    {line}" for line in lines), f"{indent}{tail}"]


def _field_row(field: FieldDefinition) -> str:
    texts = ", ".join(_quoted(text) for text in (field.units, field.enum, field.invalid, field.description))
    carries_bytes = ", True" if field.carries_bytes else ""
    return (
        f'({_quoted(field.attribute)}, "{field.type}", {field.array_length}, {texts}, {field.extension}{carries_bytes})'
    )


def _struct_code(field: FieldDefinition) -> str:
    if field.type == "char" or (field.type == "uint8_t" and field.array_length):
        return f"{field.array_length or 1}s"
    return f"{field.array_length or ''}{STRUCT_CODES[field.type]}"


def _is_tuple(field: FieldDefinition) -> bool:
    return bool(field.array_length) and field.type not in ("char", "uint8_t")


def _annotation(field: FieldDefinition, *, argument: bool = False) -> str:
    """Return the type of a field's attribute or, with ``argument``, of the constructor's argument."""
    if field.is_text:
        return "str"
    if field.is_bytes:
        return "bytes"
    number = "float" if field.type in ("float", "double") else "int"
    if not field.array_length:
        return number
    return f"Sequence[{number}]" if argument else f"tuple[{number}, ...]"


def _default(field: FieldDefinition) -> str:
    """Return `` = value`` for a field that a program may omit, otherwise an empty text."""
    if field.default is not None:
        return f" = {field.default}"
    if not field.extension:
        return ""
    if field.is_text:
        return ' = ""'
    if field.array_length:
        return f" = bytes({field.array_length})" if field.is_bytes else f" = (0,) * {field.array_length}"
    return " = 0"


def _render_init(message: MessageDefinition) -> list[str]:
    # In Python, a parameter without a default cannot follow one with a default, unless a "*" makes it keyword-only.
    arguments: list[str] = []
    follows_default = False
    for field in message.fields:
        default = _default(field)
        if follows_default and not default and "*" not in arguments:
            arguments.append("*")
        follows_default = follows_default or bool(default)
        arguments.append(f"{field.attribute}: {_annotation(field, argument=True)}{default}")
    lines = _filled("    def __init__(", ["self", *arguments], ") -> None:", "    ")
    for field in message.fields:
        value = f"tuple({field.attribute})" if _is_tuple(field) else field.attribute
        lines.append(f"        self.{field.attribute} = {value}")
    return [*lines, "        self.received_frame: Frame | None = None"]


def _render_decode(message: MessageDefinition) -> list[str]:
    unpacked = f"_S{message.id}.unpack_from(body, {HEADER_LENGTH})"
    lines = [
        "    @classmethod",
        f"    def decode_body(cls, body: bytes, frame: Frame | None = None) -> {message.class_name}:",
        f'        body = body.ljust({HEADER_LENGTH + message.length}, b"\\0")',
    ]
    lines += ["        self = _new(cls)", "        self.received_frame = frame"]
    if not message.fields:
        return [*lines, "        return self"]
    fields = message.wire_fields
    if any(_is_tuple(field) and field.array_length > _MAX_UNPACKED_LENGTH for field in fields):
        return [*lines, *_render_decode_by_index(fields, unpacked), "        return self"]
    targets: list[str] = []
    conversions: list[str] = []
    for number, field in enumerate(fields):
        if _is_tuple(field):
            parts = [f"v{number}_{i}" for i in range(field.array_length)]
            targets += parts
            comma = "," if len(parts) == 1 else ""
            conversions.append(f"        self.{field.attribute} = ({', '.join(parts)}{comma})")
        elif field.is_text:
            targets.append(f"v{number}")
            conversions.append(f"        self.{field.attribute} = {_text_expression(f'v{number}')}")
        else:
            targets.append(f"self.{field.attribute}")
    lines += _filled("        (", targets, f") = {unpacked}", "        ")
    return [*lines, *conversions, "        return self"]


def _render_decode_by_index(fields: Iterable[FieldDefinition], unpacked: str) -> list[str]:
    """Render the statements that decode a message with long arrays."""
    lines = [f"        values = {unpacked}"]
    index = 0
    for field in fields:
        if _is_tuple(field):
            value, count = f"values[{index}:{index + field.array_length}]", field.array_length
        else:
            value, count = f"values[{index}]", 1
        lines.append(f"        self.{field.attribute} = {_text_expression(value) if field.is_text else value}")
        index += count
    return lines


def _text_expression(value: str) -> str:
    return f'{value}.partition(b"\\0")[0].decode("utf-8", "replace")'


def _render_encode(message: MessageDefinition) -> list[str]:
    arguments: list[str] = []
    for field in message.wire_fields:
        value = f"self.{field.attribute}"
        if field.is_text:
            value = f"pack_text({value}, {field.array_length or 1})"
        elif field.is_bytes:
            value = f"pack_bytes({value}, {field.array_length})"
        elif field.array_length:
            value = f"*pack_items({value}, {field.array_length})"
        arguments.append(value)
    return [
        "    def encode(self) -> bytes:",
        "        try:",
        *_filled(f"            return _S{message.id}.pack(", arguments, ")", "            "),
        "        except PACK_ERRORS:",
        "            raise self._encode_error() from None",
    ]
