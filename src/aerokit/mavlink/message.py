"""`Message`, the base class of all message classes, and `Field`, the description of a field."""

from __future__ import annotations

import enum
import struct
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from aerokit._internal.wire import wire
from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import HEADER_LENGTH

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from typing_extensions import Self, dataclass_transform

    from aerokit.mavlink.frame import Frame
else:  # At run time, typing_extensions is not imported, because that would take longer than importing aerokit.

    def dataclass_transform(**_: object) -> Any:
        return lambda cls: cls


# Errors that packing a wrong value may raise. Generated classes convert them to InvalidArgument.
PACK_ERRORS = (struct.error, OverflowError, TypeError, ValueError, AttributeError)

MessageT = TypeVar("MessageT", bound="Message")

_ANY_HEADER = bytes(HEADER_LENGTH)
# (message, field) of ``char`` arrays that carry a number or a text, depending on another field. They are decoded as
# bytes, because a text would end at the first zero byte of a number.
BYTES_IN_CHARS = frozenset((name, "param_value") for name in ("PARAM_EXT_VALUE", "PARAM_EXT_SET", "PARAM_EXT_ACK"))
# Fields whose values are secret, and therefore never appear in texts.
SECRET_FIELDS = frozenset(("secret_key", "passkey", "password"))
# Size in bytes of each type of the standard.
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
# Format character of each number type in Python's ``struct``.
STRUCT_CODES: dict[str, str] = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
}
# Minimum and maximum of each integer type.
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


class Field:
    """Description of one field of a message in the standard."""

    __slots__ = ("array_length", "description", "enum", "extension", "invalid", "is_text", "name", "type", "units")

    def __init__(
        self,
        name: str,
        type: str,  # noqa: A002 - the name in the standard
        array_length: int,
        units: str,
        enum: str,
        invalid: str,
        description: str,
        extension: bool,
        carries_bytes: bool = False,
    ) -> None:
        self.name: str = name
        """Name of the attribute: the name in the standard. A Python keyword gets a trailing underscore."""
        self.type: str = type
        """Type without brackets: ``"uint16_t"``, ``"float"``, ``"char"`` …"""
        self.array_length: int = array_length
        """Number of elements; 0 if the field is not an array."""
        self.units: str = units
        """Unit, for example ``"cm/s"``, or empty."""
        self.enum: str = enum
        """Name of the enum of the values, or empty."""
        self.invalid: str = invalid
        """Value that means "unknown", as in the XML: for example ``"UINT16_MAX"``, or empty."""
        self.description: str = description
        """Description in the standard."""
        self.extension: bool = extension
        """True if MAVLink 1 does not have the field."""
        self.is_text: bool = type == "char" and not carries_bytes
        """True if the value is a ``str``. A few ``char`` arrays are ``bytes``, because they carry numbers."""

    def __repr__(self) -> str:
        brackets = f"[{self.array_length}]" if self.array_length else ""
        unit = f" [{self.units}]" if self.units else ""
        return f"<Field {self.type}{brackets} {self.name}{unit}>"

    def problem(self, value: Any) -> str | None:
        """Explain why ``value`` is invalid for this field, or return None."""
        if self.is_text:
            return _text_problem(value, self.array_length or 1)
        if not self.array_length:
            return _number_problem(value, self.type)
        if self.type in ("uint8_t", "char") and not isinstance(value, (bytes, bytearray)):
            return f"must be bytes, at most {self.array_length}"
        try:
            size = len(value)
        except TypeError:
            return f"must be a sequence of at most {self.array_length} numbers"
        if size > self.array_length:
            return f"has {size} elements, at most {self.array_length} fit"
        problems = (_number_problem(item, self.type) for item in value)
        return next((problem for problem in problems if problem), None)


class _Fields:
    """Descriptor that creates ``Message.FIELDS`` on first access, because most programs do not need them."""

    def __get__(self, instance: object, owner: type[Message]) -> tuple[Field, ...]:
        fields = tuple(Field(*row) for row in owner._FIELDS)
        setattr(owner, "FIELDS", fields)  # noqa: B010 - a plain assignment looks wrong to the type checker
        return fields


def offset_of(message_type: type[Message], field: str) -> int:
    # https://mavlink.io/en/guide/serialization.html#field_reordering
    offset = 0
    for wire_field in _wire_fields(message_type):
        if wire_field.name == field:
            return offset
        offset += SIZES[wire_field.type] * (wire_field.array_length or 1)
    raise InvalidArgument(f"{message_type.NAME} has no field {field!r}")


def _wire_fields(message_type: type[Message]) -> list[Field]:
    """Return the fields in the order in which they are sent."""
    fields = [Field(*row) for row in message_type._FIELDS]
    base = sorted((field for field in fields if not field.extension), key=lambda field: -SIZES[field.type])
    return [*base, *(field for field in fields if field.extension)]


def layout_of(message_type: type[Message]) -> Any:
    """Return the description of the fields for compiled code; None if compiled code cannot be used for this class."""
    own_attributes = message_type.__dict__  # A layout inherited from a base class would be wrong.
    if "_LAYOUT" not in own_attributes:
        is_generated = {"_FIELDS", "decode_body", "encode"} <= own_attributes.keys()
        message_type._LAYOUT = _new_layout(message_type) if wire is not None and is_generated else None
    return message_type._LAYOUT


def _new_layout(message_type: type[Message]) -> Any:
    rows = tuple((field.name, _wire_code(field), field.array_length) for field in _wire_fields(message_type))
    numbers = message_type.ID, message_type.CRC_EXTRA, message_type.LENGTH, message_type.BASE_LENGTH
    return wire.layout(message_type, *numbers, rows)


def _wire_code(field: Field) -> str:
    """Return the code of a field in ``_wire.c``."""
    if field.is_text:
        return "s"
    is_bytes = field.type == "char" or (field.type == "uint8_t" and field.array_length > 0)
    return "p" if is_bytes else STRUCT_CODES[field.type]


def decoder_of(message_type: type[MessageT]) -> Callable[[Frame], MessageT]:
    """Return a function that decodes frames of this class, compiled if possible."""
    layout = layout_of(message_type)
    if layout is None:
        return lambda frame: message_type.decode_body(frame.body, frame)
    decode: Callable[[Frame], MessageT] = layout.decode
    return decode


def field_names(message: Message) -> tuple[str, ...]:
    """Return the names of the fields, in the order of the XML."""
    return message.__match_args__  # type: ignore[attr-defined,no-any-return]


@dataclass_transform(frozen_default=True)
class Message:
    """Base class of all messages. Treat messages as immutable; type checkers enforce it.

    Messages are equal if their classes and fields are; NaN equals NaN.
    """

    if not TYPE_CHECKING:  # Type checkers would mistake the slot for a class attribute of this name.
        __slots__ = ("received_frame",)
        __match_args__ = ()  # The field names, for `match`. Each message class overrides this; type checkers infer it.
    __hash__: ClassVar[None]  # type: ignore[assignment]

    ID: ClassVar[int]
    """Message id."""
    NAME: ClassVar[str] = ""
    """Name in the standard, ``"GLOBAL_POSITION_INT"``."""
    CRC_EXTRA: ClassVar[int]
    """Byte added to the checksum, so that frames of a different definition are invalid."""
    LENGTH: ClassVar[int]
    """Payload length."""
    BASE_LENGTH: ClassVar[int]
    """Payload length without extensions, as in MAVLink 1."""
    if TYPE_CHECKING:
        FIELDS: ClassVar[tuple[Field, ...]]
        """The fields in the order of the XML, extensions last."""
    else:
        FIELDS = _Fields()
    _FIELDS: ClassVar[tuple[tuple[Any, ...], ...]] = ()
    _LAYOUT: ClassVar[Any] = None

    received_frame: Frame | None
    """The frame this message was decoded from; None if the program created the message."""

    @classmethod
    def decode(cls, payload: bytes, frame: Frame | None = None) -> Self:
        """Decode a payload. Truncated zeros are restored, unknown extensions ignored."""
        return cls.decode_body(_ANY_HEADER + payload, frame)

    if TYPE_CHECKING:

        @classmethod
        def decode_body(cls, body: bytes, frame: Frame | None = None) -> Self:
            """Decode a `Frame.body`, which has a header before the payload."""
            raise NotImplementedError

        def encode(self) -> bytes:
            """Encode the whole payload. InvalidArgument names the field, the value and the allowed range."""
            raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as a dictionary, in the order of the XML."""
        return {name: getattr(self, name) for name in field_names(self)}

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_same(getattr(self, name), getattr(other, name)) for name in field_names(self))

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={_format_field(name, getattr(self, name))}" for name in field_names(self))
        return f"{type(self).__name__}({fields})"

    def _encode_error(self) -> InvalidArgument:
        for field in self.FIELDS:
            value = getattr(self, field.name, None)
            problem = field.problem(value)
            if problem:
                shown = _format_field(field.name, value)
                return InvalidArgument(f"{self.NAME}.{field.name} = {shown} cannot be sent: {problem}")
        return InvalidArgument(f"{self!r} cannot be sent")


def _format_field(name: str, value: object) -> str:
    # Secret keys must not appear in logs and error messages.
    return "<not shown>" if name in SECRET_FIELDS else repr(value)


# -------------------------------------------------------------------- used by the generated classes


def pack_text(value: str, size: int) -> bytes:
    """Encode a text as UTF-8. Raise ValueError if it has more than ``size`` bytes."""
    data = value.encode()
    if len(data) > size:
        raise ValueError(value)
    # The struct format appends missing zeros.
    return data


def pack_bytes(value: bytes, size: int) -> bytes:
    """Return the value. Raise ValueError if it has more than ``size`` bytes."""
    if len(value) > size:
        raise ValueError(value)
    # The struct format appends missing zeros.
    return value


def pack_items(value: Sequence[float], size: int) -> Sequence[float]:
    """Return the numbers, with zeros appended up to ``size``."""
    # If there are too many numbers, packing them raises.
    missing = size - len(value)
    return (*value, *(0,) * missing) if missing else value


# --------------------------------------------------------------------------------------- checks


def _same(left: Any, right: Any) -> bool:
    """Return True if two values are equal. NaN equals NaN, also inside tuples."""
    are_both_nan = left != left and right != right
    if left == right or are_both_nan:
        return True
    if isinstance(left, tuple) and isinstance(right, tuple) and len(left) == len(right):
        return all(map(_same, left, right))
    return False


def _number_problem(value: Any, kind: str) -> str | None:
    """Explain why a value does not fit into this type, or return None."""
    if kind in INTEGER_RANGES:
        low, high = INTEGER_RANGES[kind]
        try:  # Only values that are not integers are refused here, because the range is checked below.
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


def _text_problem(value: Any, size: int) -> str | None:
    """Explain why a value does not fit into a text of ``size`` bytes, or return None."""
    if not isinstance(value, str):
        return f"must be a str of at most {size} bytes"
    try:
        length = len(value.encode())
    except UnicodeEncodeError:
        return "has characters that cannot be encoded"
    return f"has {length} bytes, at most {size} fit" if length > size else None


# ------------------------------------------------------------------------------------------ enums

# The standard library uses this private decorator for its own long enums since Python 3.11, because it creates the same
# enum in half the time. Other versions of Python may lack the decorator.
_simple_enum: Any = getattr(enum, "_simple_enum", None)


class _Flags(enum.IntFlag):
    # Python caches every combination of flags that occurs. Received values must not fill that cache without limit.
    @classmethod
    def _missing_(cls, value: object) -> Any:
        combination = super()._missing_(value)
        cls._value2member_map_.pop(value, None)
        return combination


def make_enum(
    module: str, name: str, bitmask: bool, doc: str, members: Iterable[tuple[str, int]], *, is_external: bool = False
) -> type[Any]:
    """Create an ``IntFlag`` for a bitmask, else an ``IntEnum``. A second name for a value becomes an alias.

    ``is_external`` is True for a definition that aerokit has not generated. Only such names are checked.

    Raises:
        TypeError, ValueError: an external name is a duplicate or reserved.
    """
    base: Any = _Flags if bitmask else enum.IntEnum
    enum_type: type[Any]
    if _simple_enum is not None and not is_external:  # `_simple_enum` does not check names.
        body = {"__module__": module, "__qualname__": name, "__doc__": doc, **dict(members)}
        enum_type = _simple_enum(base)(type(name, (), body))
    else:
        enum_type = base(name, list(members), module=module, qualname=name)
        enum_type.__doc__ = doc
    return enum_type
