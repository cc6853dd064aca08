"""Conversion from and to pymavlink messages."""

from __future__ import annotations

import math
import operator
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.frame import HEADER_LENGTH, SIGNATURE_LENGTH, SIGNED, x25
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from types import ModuleType

    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Field

__all__ = ["from_pymavlink", "to_pymavlink"]

REAL_TYPES = ("float", "double")


def from_pymavlink(message: Any, target_system: int | None = None) -> Message:
    """Convert a message to one of aerokit, for ``vehicle.send``. The result is a validated copy.

    Args:
        message: a pymavlink message of any dialect, for MAVLink 1 or 2, or a message of aerokit. Any other object must
            have ``get_type()`` and, as attributes, the fields of a standard message. Numbers in integer fields are
            rounded. Strings may be ``str`` (sent as UTF-8) or bytes. Missing extension fields are 0.
        target_system: new value of the field ``target_system``, if the message has this field. It is also assigned to
            ``message`` itself, unless that is a message of aerokit. None and 0 leave the field unchanged.
            ``target_component`` is never changed.

    Raises:
        InvalidArgument: a value does not fit its field, or the object is not a message.
    """
    if isinstance(message, Message):
        message_class: type[Message] = type(message)
    else:
        message_class = _class_of(message)
        if target_system and hasattr(message, "target_system"):
            message.target_system = target_system
    values = _values(message_class, message)
    if target_system and "target_system" in values:
        values["target_system"] = target_system
    try:
        copy = message_class(**values)
    except TypeError as error:
        raise InvalidArgument(f"{message_class.NAME} cannot be sent: {error}") from None
    copy.encode()
    return copy


def _class_of(message: Any) -> type[Message]:
    message_type: Any = type(message)
    # Classes of pymavlink have these attributes. Other objects are looked up by their message name.
    if hasattr(message_type, "ordered_fieldnames") and hasattr(message_type, "crc_extra"):
        return _counterpart(int(message_type.id), int(message_type.crc_extra), message_type)
    try:
        return STANDARD.by_name(message.get_type())
    except AttributeError:
        raise InvalidArgument(f"{message!r} is not a MAVLink message") from None


@cache
def _counterpart(message_id: int, crc_extra: int, pymavlink_class: Any) -> type[Message]:
    """Return the standard's class if it has the same wire format, else a class created from pymavlink's class."""
    if message_id < 0 or not pymavlink_class.ordered_fieldnames:
        raise InvalidArgument(f"{pymavlink_class.__name__} is not a message that can be sent")
    standard = STANDARD.get(message_id)
    if standard is not None and crc_extra == standard.CRC_EXTRA:
        return standard
    from aerokit.mavlink.runtime_dialect import class_from_pymavlink

    return class_from_pymavlink(pymavlink_class, STANDARD)


# ----------------------------------------------------------------------------------------- values
def _values(message_class: type[Message], message: Any) -> dict[str, Any]:
    values = {}
    for field in message_class.FIELDS:
        name = field.name.rstrip("_")
        if field.extension and not _has(message, name):
            continue
        try:
            value = _original_text(message, name) if field.type == "char" else getattr(message, name)
        except AttributeError:
            raise InvalidArgument(f"{message_class.NAME} cannot be sent: its field {name} has no value") from None
        values[field.name] = _converted(message_class, field, value)
    return values


def _has(message: Any, name: str) -> bool:
    # All classes of pymavlink have an attribute ``id``, the message id. It must not be mistaken for a field ``id``.
    if name in getattr(message, "__dict__", ()):
        return True
    return hasattr(message, name) and not hasattr(type(message), "ordered_fieldnames")


def _converted(message_class: type[Message], field: Field, value: Any) -> Any:
    if field.is_text:
        return _text(value)
    if field.type == "char" and isinstance(value, str):  # an array of `char` that carries bytes
        return value.encode()
    is_real = field.type in REAL_TYPES
    if not field.array_length:
        return _real(value) if is_real else _integer(value)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value)
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise _error(message_class, field, value, f"must be a sequence of at most {field.array_length} numbers")
    items = [_real(item) if is_real else _integer(item) for item in value]
    return items if field.type != "uint8_t" else _packed(message_class, field, items)


def _packed(message_class: type[Message], field: Field, items: list[Any]) -> bytes:
    try:
        return bytes(items)
    except (TypeError, ValueError):
        position = next((index for index, item in enumerate(items) if not _is_byte(item)), 0)
        raise _error(message_class, field, items, f"element {position} must be in 0..255") from None


def _is_byte(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value <= 255


def _integer(value: Any) -> Any:
    # A value that is not a number is returned unchanged, because `Message.encode` rejects it.
    try:
        return operator.index(value)
    except TypeError:
        number = _real(value)
    return round(number) if isinstance(number, float) and math.isfinite(number) else value


def _real(value: Any) -> Any:
    # Numbers of numpy and decimal have __float__, too. Values that are not numbers are returned unchanged;
    # `Message.encode` rejects them.
    if isinstance(value, (int, float)) or not hasattr(value, "__float__"):
        return value
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return value


def _error(message_class: type[Message], field: Field, value: Any, problem: str) -> InvalidArgument:
    return InvalidArgument(f"{message_class.NAME}.{field.name} = {value!r} cannot be sent: {problem}")


# ------------------------------------------------------------------------------------------ texts
def _original_text(message: Any, name: str) -> Any:
    """Return the value of a text field, as bytes if possible."""
    # In the text of a received message, pymavlink replaces non-ASCII characters. It also stores the original bytes.
    text = getattr(message, name)
    raw = getattr(message, f"_{name}_raw", None)
    if isinstance(raw, bytes) and text == raw.partition(b"\0")[0].decode("ascii", "replace"):
        return raw
    return text


def _text(value: Any) -> Any:
    """Convert a text to str without trailing NULs."""
    if isinstance(value, str):
        return value.rstrip("\0")
    if not isinstance(value, (bytes, bytearray, memoryview)):
        return value
    data = bytes(value).rstrip(b"\0")
    try:
        return data.decode()
    except UnicodeDecodeError:
        return _RawText(data)


class _RawText(str):
    """A text that was received as bytes that are not UTF-8. `encode` returns these bytes, to send them unchanged."""

    _data: bytes

    def __new__(cls, data: bytes) -> _RawText:
        self = super().__new__(cls, data.decode(errors="replace"))
        self._data = data
        return self

    def encode(self, encoding: str = "utf-8", errors: str = "strict") -> bytes:
        return self._data


# pymavlink dialects to search for a message that the program's dialect does not have. Together, they have all messages
# of STANDARD.
DIALECTS = ("ardupilotmega", "development")

CHECKSUM_LENGTH = 2

# Attributes that are created on first access, because few programs use them.
LAZY_ATTRIBUTES = ("_header", "_msgbuf", "_payload", "_crc")

Decoder = Callable[["Frame", float], Any]


def to_pymavlink(frame: Frame, *, dialect: ModuleType | None = None, timestamp: float = 0.0) -> Any:
    """Decode a frame to a pymavlink message, with header, buffers and ``str()`` as in pymavlink. Never raises.

    Args:
        frame: a received frame: ``message.received_frame``, or the argument of a frame observer.
        dialect: pymavlink module for MAVLink 2 that decodes the message. If it lacks the message, or has another
            CRC_EXTRA than the standard, pymavlink's modules ardupilotmega and development are tried.
        timestamp: ``_timestamp`` of the message: in pymavlink, seconds since 1970.

    Returns:
        The message. If no module has it, or its checksum is wrong: a ``MAVLink_unknown`` of type ``UNKNOWN_<id>``.
    """
    return _decoder(frame.message_id, dialect)(frame, timestamp)


@cache
def _decoder(message_id: int, preferred: ModuleType | None) -> Decoder:
    """Return the decoder of the first pymavlink dialect that has the message."""
    row = STANDARD.rows.get(message_id)
    for module in _dialects(preferred):
        message_class = module.mavlink_map.get(message_id)
        if message_class is None:
            continue
        if row is None:
            return _with_checksum_check(message_class, _decoder_for(message_class))
        crc_extra, *_ = row
        # A dialect with another CRC_EXTRA contradicts the standard.
        if message_class.crc_extra == crc_extra:
            return _decoder_for(message_class)
    return _unknown


def _dialects(preferred: ModuleType | None) -> Any:
    if getattr(preferred, "WIRE_PROTOCOL_VERSION", None) == "2.0":
        yield preferred
    for name in DIALECTS:
        yield import_module(f"pymavlink.dialects.v20.{name}")


def _decoder_for(message_class: Any) -> Decoder:
    received_class = _received_class(message_class)
    unpack = message_class.unpacker.unpack_from
    length = HEADER_LENGTH + message_class.unpacker.size
    layout = _Layout(message_class)
    names, arrays, texts = layout.names, layout.arrays, layout.texts
    new = object.__new__

    def decode(frame: Frame, timestamp: float) -> Any:
        body = frame.body
        values = unpack(body if len(body) >= length else body.ljust(length, b"\0"), HEADER_LENGTH)
        message = new(received_class)
        fields = message.__dict__
        fields["_frame"] = frame
        fields["_timestamp"] = timestamp
        if arrays:
            values = [values[start] if width == 1 else list(values[start : start + width]) for start, width in arrays]
        fields.update(zip(names, values))  # noqa: B905 - same length
        for name, raw_name in texts:
            raw = fields[raw_name] = fields[raw_name].rstrip(b"\0")
            text_bytes = raw.partition(b"\0")[0] if b"\0" in raw else raw  # A text ends at the first NUL.
            fields[name] = text_bytes.decode("ascii", "replace")
        return message

    return decode


class _Layout:
    """Describes which of the unpacked values belong to which attributes of a pymavlink message."""

    def __init__(self, message_class: Any) -> None:
        zeros = message_class.unpacker.unpack(bytes(message_class.unpacker.size))
        # The names of the attributes, in wire order. A text field is listed by the attribute with its raw bytes.
        self.names: list[str] = []
        # For each field, the index of its first unpacked value, and the number of its values. Empty without arrays.
        self.arrays: list[tuple[int, int]] = []
        self.texts: list[tuple[str, str]] = []  # for each text field, its name and the name of its raw bytes
        position = 0
        for name, width in zip(message_class.ordered_fieldnames, message_class.lengths):  # noqa: B905
            is_text = isinstance(zeros[position], bytes)
            if is_text:
                self.texts.append((name, f"_{name}_raw"))
            self.names.append(f"_{name}_raw" if is_text else name)
            self.arrays.append((position, width))
            position += width
        if position == len(self.names):
            self.arrays = []


# -------------------------------------------------------------------------------- lazy attributes
class _Received:
    """Mixin that creates header and buffers on first access, because they cost more than decoding the fields."""

    _frame: Frame
    _header_class: Any
    _decoded_class: Any
    _signed = False  # Signatures are not verified here.
    _link_id = None
    _instances = None

    def __getattr__(self, name: str) -> Any:
        if name not in LAZY_ATTRIBUTES:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        value = self.__dict__[name] = getattr(self, f"create{name}")()  # E.g. `create_header` creates `_header`.
        return value

    def __reduce_ex__(self, protocol: Any) -> Any:
        names = (*LAZY_ATTRIBUTES, "_type", "_fieldnames", "_instance_field", "_instance_offset")
        state = {name: getattr(self, name) for name in (*names, "_signed", "_link_id", "_instances")}
        state.update((name, value) for name, value in self.__dict__.items() if name != "_frame")
        # Messages are pickled and copied as objects of pymavlink's own class.
        return _restored, (self._decoded_class, state)

    def create_header(self) -> Any:
        frame = self._frame
        flags = frame.incompat_flags, frame.compat_flags
        payload_length = frame.body[0]
        source = frame.system_id, frame.component_id
        return self._header_class(frame.message_id, *flags, payload_length, frame.sequence, *source)

    def create_msgbuf(self) -> bytearray:
        return bytearray(self._frame.raw)

    def create_payload(self) -> bytearray:
        # In pymavlink, `_payload` begins at offset 6 of the frame, even in MAVLink 2, where the header has ten bytes.
        return bytearray(self._frame.raw)[6 : -_length_after_payload(self._frame)]

    def create_crc(self) -> int:
        return self._frame.checksum


def _length_after_payload(frame: Frame) -> int:
    return CHECKSUM_LENGTH + (SIGNATURE_LENGTH if frame.incompat_flags & SIGNED else 0)


def _received_class(message_class: Any) -> Any:
    return type(
        message_class.__name__,
        (_Received, message_class),
        {
            "__module__": message_class.__module__,
            "__doc__": message_class.__doc__,
            "_decoded_class": message_class,
            "_header_class": sys.modules[message_class.__module__].MAVLink_header,
            "_type": message_class.msgname,
            "_fieldnames": message_class.fieldnames,
            "_instance_field": message_class.instance_field,
            "_instance_offset": message_class.instance_offset,
        },
    )


def _restored(message_class: Any, state: dict[str, Any]) -> Any:
    message = object.__new__(message_class)
    message.__dict__.update(state)
    return message


# -------------------------------------------------------------------------------- unknown messages
def _with_checksum_check(message_class: Any, decode: Decoder) -> Decoder:
    # The framer cannot verify the checksum of a message that the standard does not have. The program's dialect has the
    # message, so the checksum is verified here.

    def decode_if_valid(frame: Frame, timestamp: float) -> Any:
        raw = frame.raw
        is_valid = x25(raw[1 : -_length_after_payload(frame)] + bytes((message_class.crc_extra,))) == frame.checksum
        return decode(frame, timestamp) if is_valid else _unknown(frame, timestamp)

    return decode_if_valid


def _unknown(frame: Frame, timestamp: float) -> Any:
    """Return pymavlink's message for a frame that cannot be decoded."""
    module: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
    message = module.MAVLink_unknown(frame.message_id, bytearray(frame.raw))
    header = message.get_header()
    header.seq, header.srcSystem, header.srcComponent = frame.sequence, frame.system_id, frame.component_id
    vars(message)["_timestamp"] = timestamp
    return message
