"""What every MAVLink message class has: `Message`, and `Field`, which says what the standard says of one field."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, ClassVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import HEADER_LENGTH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self, dataclass_transform

    from aerokit.mavlink.frame import Frame
else:  # importing typing_extensions would cost more than everything else here

    def dataclass_transform(**_: object) -> Any:
        """Only the type checker cares."""
        return lambda cls: cls


PACK_ERRORS = (struct.error, OverflowError, TypeError, ValueError, AttributeError)
"""What packing a wrong value can raise; the generated classes turn it into InvalidArgument."""

_ANY_HEADER = bytes(HEADER_LENGTH)
BYTES_IN_CHARS = frozenset(
    (name, "param_value") for name in ("PARAM_EXT_VALUE", "PARAM_EXT_SET", "PARAM_EXT_ACK")
)
"""Message and field of those ``char`` arrays that carry bytes: a number as C keeps it in memory, or a text, as another
field says. As texts, which end at the first NUL, the numbers would be lost."""
SECRET_FIELDS = frozenset(("secret_key", "passkey", "password"))
"""Fields that are shown to nobody."""
SIZES = {
    "char": 1,
    "int8_t": 1,
    "uint8_t": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
    "int64_t": 8,
    "uint64_t": 8,
    "float": 4,
    "double": 8,
}
"""Bytes on the wire of each type the standard knows."""
INTEGER_RANGES = {
    "int8_t": (-(1 << 7), (1 << 7) - 1),
    "uint8_t": (0, (1 << 8) - 1),
    "int16_t": (-(1 << 15), (1 << 15) - 1),
    "uint16_t": (0, (1 << 16) - 1),
    "int32_t": (-(1 << 31), (1 << 31) - 1),
    "uint32_t": (0, (1 << 32) - 1),
    "int64_t": (-(1 << 63), (1 << 63) - 1),
    "uint64_t": (0, (1 << 64) - 1),
}
"""Lowest and highest number of each integer type."""


class Field:
    """One field of a message, as the standard describes it."""

    __slots__ = (
        *("array_length", "description", "enum", "extension", "invalid", "is_text", "name", "type", "units"),
    )

    def __init__(
        self,
        name: str,
        type: str,  # noqa: A002 - the standard's word
        array_length: int,
        units: str,
        enum: str,
        invalid: str,
        description: str,
        extension: bool,
        carries_bytes: bool = False,
    ) -> None:
        self.name = name
        """The attribute's name, and the standard's, but for an underscore behind a Python keyword."""
        self.type = type
        """The standard's type without brackets: ``"uint16_t"``, ``"float"``, ``"char"`` …"""
        self.array_length = array_length
        """Number of elements, 0 when it is no array."""
        self.units = units
        """The standard's unit, ``"cm/s"`` for example, or empty."""
        self.enum = enum
        """The standard's name of the enum its values come from, or empty."""
        self.invalid = invalid
        """The standard's text for the value that means "not known", ``"UINT16_MAX"`` for example, or empty."""
        self.description = description
        """The standard's description."""
        self.extension = extension
        """Whether it is absent in MAVLink 1."""
        self.is_text: bool = type == "char" and not carries_bytes
        """Whether its value is a ``str``; a few ``char`` arrays are ``bytes``, because they carry numbers."""

    def __repr__(self) -> str:
        brackets = f"[{self.array_length}]" if self.array_length else ""
        unit = f" [{self.units}]" if self.units else ""
        return f"<Field {self.type}{brackets} {self.name}{unit}>"

    def complaint(self, value: Any) -> str | None:
        """What is wrong with ``value`` for this field, or None."""
        if self.is_text:
            return _text_complaint(value, self.array_length or 1)
        if not self.array_length:
            return _number_complaint(value, self.type)
        if self.type in ("uint8_t", "char") and not isinstance(value, (bytes, bytearray)):
            return f"must be bytes, at most {self.array_length}"
        try:
            size = len(value)
        except TypeError:
            return f"must be a sequence of at most {self.array_length} numbers"
        if size > self.array_length:
            return f"has {size} elements, at most {self.array_length} fit"
        return next((c for c in (_number_complaint(item, self.type) for item in value) if c), None)


class _Fields:
    """``Message.FIELDS``: made when first asked for, because most programs never ask."""

    def __get__(self, instance: object, owner: type[Message]) -> tuple[Field, ...]:
        fields = tuple(Field(*row) for row in owner._FIELDS)
        setattr(owner, "FIELDS", fields)  # noqa: B010 - a plain assignment looks wrong to the type checker
        return fields


def offset_of(message_type: type[Message], field: str) -> int:
    """Where in the payload this field begins: large types first, extensions behind them in their order.

    https://mavlink.io/en/guide/serialization.html#field_reordering
    """
    fields = [each for each in message_type.FIELDS if not each.extension]
    fields.sort(key=lambda each: -SIZES[each.type])
    offset = 0
    for each in (*fields, *(each for each in message_type.FIELDS if each.extension)):
        if each.name == field:
            return offset
        offset += SIZES[each.type] * (each.array_length or 1)
    raise InvalidArgument(f"{message_type.NAME} has no field {field!r}")


def field_names(message: Message) -> tuple[str, ...]:
    """The names of its fields, in the order of the standard's definition."""
    return message.__match_args__  # type: ignore[attr-defined,no-any-return]


@dataclass_transform(frozen_default=True)
class Message:
    """Base of all message classes; immutable by agreement, which the type checker enforces.

    Messages are equal when they are of one class and their fields are equal (NaN counts as equal to NaN).
    """

    if not TYPE_CHECKING:  # a type checker would take the slot for a class attribute of the same name
        __slots__ = ("received_frame",)
        __match_args__ = ()  # each class has its own: what a checker infers there is its names, for `match`
    __hash__: ClassVar[None]  # type: ignore[assignment]

    ID: ClassVar[int]
    """The standard's number of the message."""
    NAME: ClassVar[str] = ""
    """The standard's name of the message, ``"GLOBAL_POSITION_INT"``."""
    CRC_EXTRA: ClassVar[int]
    """Goes into the checksum, so that frames of another definition are refused."""
    LENGTH: ClassVar[int]
    """Bytes of the whole payload."""
    BASE_LENGTH: ClassVar[int]
    """Bytes of the payload without extensions, as MAVLink 1 sends it."""
    if TYPE_CHECKING:
        FIELDS: ClassVar[tuple[Field, ...]]
        """The fields in the standard's order, extensions last."""
    else:
        FIELDS = _Fields()
    _FIELDS: ClassVar[tuple[tuple[Any, ...], ...]] = ()

    received_frame: Frame | None
    """The frame this was decoded from: who sent it and when it came. None when the program built it."""

    @classmethod
    def decode(cls, payload: bytes, frame: Frame | None = None) -> Self:
        """Make a message of a payload off the wire; trimmed zeros are restored, unknown extensions ignored."""
        return cls.decode_body(_ANY_HEADER + payload, frame)

    if TYPE_CHECKING:

        @classmethod
        def decode_body(cls, body: bytes, frame: Frame | None = None) -> Self:
            """The same of `Frame.body`, where a header is before the payload; a frame is decoded this way."""
            raise NotImplementedError

        def encode(self) -> bytes:
            """The whole payload; InvalidArgument names the field, the value and the allowed range."""
            raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Field names and values, in the standard's order."""
        return {name: getattr(self, name) for name in field_names(self)}

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_same(getattr(self, name), getattr(other, name)) for name in field_names(self))

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={_shown(name, getattr(self, name))}" for name in field_names(self))
        return f"{type(self).__name__}({fields})"

    def _encode_error(self) -> InvalidArgument:
        for field in self.FIELDS:
            value = getattr(self, field.name, None)
            complaint = field.complaint(value)
            if complaint:
                shown = _shown(field.name, value)
                return InvalidArgument(f"{self.NAME}.{field.name} = {shown} cannot be sent: {complaint}")
        return InvalidArgument(f"{self!r} cannot be sent")


def _shown(name: str, value: object) -> str:
    """A value as text; logs and error messages are no place for keys."""
    return "<not shown>" if name in SECRET_FIELDS else repr(value)


# -------------------------------------------------------------------- used by the generated classes


def pack_text(value: str, size: int) -> bytes:
    """UTF-8 of a text, ValueError when it is longer than ``size``; struct adds the zeros."""
    data = value.encode()
    if len(data) > size:
        raise ValueError(value)
    return data


def pack_bytes(value: bytes, size: int) -> bytes:
    """The bytes, ValueError when there are more than ``size``; struct adds the zeros."""
    if len(value) > size:
        raise ValueError(value)
    return value


def pack_items(value: Sequence[float], size: int) -> Sequence[float]:
    """The numbers, with zeros added; more than ``size`` are left for struct to refuse."""
    missing = size - len(value)
    return (*value, *(0,) * missing) if missing else value


# ------------------------------------------------------------------------------------- complaints


def _same(one: Any, other: Any) -> bool:
    if one == other or (one != one and other != other):
        return True
    if isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
        return all(_same(a, b) for a, b in zip(one, other))  # noqa: B905 - of one length
    return False


def _number_complaint(value: Any, kind: str) -> str | None:
    if kind in INTEGER_RANGES:
        low, high = INTEGER_RANGES[kind]
        try:
            struct.pack("<q" if low < 0 else "<Q", value)
        except (struct.error, OverflowError, TypeError):
            if not hasattr(value, "__index__"):
                return f"must be an integer in {low}..{high} ({kind})"
        return None if low <= value.__index__() <= high else f"must be in {low}..{high} ({kind})"
    try:
        struct.pack("<f" if kind == "float" else "<d", value)
    except OverflowError:
        return f"does not fit into a {kind}"
    except (struct.error, TypeError):
        return "must be a number"
    return None


def _text_complaint(value: Any, size: int) -> str | None:
    if not isinstance(value, str):
        return f"must be a str of at most {size} bytes"
    try:
        length = len(value.encode())
    except UnicodeEncodeError:
        return "has characters that cannot be encoded"
    return f"has {length} bytes, at most {size} fit" if length > size else None
