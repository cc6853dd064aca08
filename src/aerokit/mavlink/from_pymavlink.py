"""`from_pymavlink`: any message object of a program, pymavlink's above all, as one that a connection can send."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING, Any

from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.message import Message
from aerokit.mavlink.runtime_dialect import class_from_pymavlink

if TYPE_CHECKING:
    from aerokit.mavlink.message import Field

__all__ = ["from_pymavlink"]

REAL_TYPES = ("float", "double")


def from_pymavlink(message: Any, target_system: int | None = None) -> Message:
    """A copy of a message, checked, for ``vehicle.send``; later changes to ``message`` do not change it.

    Args:
        message: of any pymavlink dialect, for MAVLink 1 or 2, a subclass of such a class, anything with ``get_type()``
            and the fields of a standard message as attributes, or a message of aerokit. Numbers for integer fields
            are rounded; texts may be ``str`` (sent in UTF-8) or bytes; missing extension fields are 0.
        target_system: written into ``message.target_system``, if it has that field (aerokit's own messages do not
            change: only the copy gets it). None and 0 leave what is there. ``target_component`` always stays.

    Raises:
        InvalidArgument: a ValueError; a value does not fit its field, or this is no message.
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
    given: Any = type(message)
    if hasattr(given, "ordered_fieldnames") and hasattr(given, "crc_extra"):
        return _counterpart(int(given.id), int(given.crc_extra), given)
    try:
        return STANDARD.by_name(message.get_type())
    except AttributeError:
        raise InvalidArgument(f"{message!r} is no MAVLink message") from None


@cache
def _counterpart(message_id: int, crc_extra: int, given: Any) -> type[Message]:
    """The standard's class when it is about the same bytes, else one like it made of pymavlink's."""
    if message_id < 0 or not given.ordered_fieldnames:
        raise InvalidArgument(f"{given.__name__} is nothing that can be sent")
    standard = STANDARD.get(message_id)
    if standard is not None and crc_extra == standard.CRC_EXTRA:
        return standard
    return class_from_pymavlink(given)


# ----------------------------------------------------------------------------------------- values


def _values(message_class: type[Message], message: Any) -> dict[str, Any]:
    """The arguments of ``message_class``; extension fields that ``message`` does not have are left out."""
    values = {}
    for field in message_class.FIELDS:
        name = field.name.rstrip("_")
        if field.extension and not _has(message, name):
            continue
        try:
            value = _text_given(message, name) if field.type == "char" else getattr(message, name)
        except AttributeError:
            raise InvalidArgument(f"{message_class.NAME}.{name} cannot be sent: it is missing") from None
        values[field.name] = _converted(message_class, field, value)
    return values


def _has(message: Any, name: str) -> bool:
    """Whether it is a field of it: every class of pymavlink has an ``id`` of its own."""
    if name in getattr(message, "__dict__", ()):
        return True
    return hasattr(message, name) and not hasattr(type(message), "ordered_fieldnames")


def _converted(message_class: type[Message], field: Field, value: Any) -> Any:
    if field.is_text:
        return _text(value)
    if field.type == "char" and isinstance(value, str):
        return value.encode()
    is_real = field.type in REAL_TYPES
    if not field.array_length:
        return _real(value) if is_real else _integer(value)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value)
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise _error(
            message_class, field, value, f"must be a sequence of at most {field.array_length} numbers"
        )
    items = [_real(item) if is_real else _integer(item) for item in value]
    return items if field.type != "uint8_t" else _packed(message_class, field, items)


def _packed(message_class: type[Message], field: Field, items: list[Any]) -> bytes:
    try:
        return bytes(items)
    except (TypeError, ValueError):
        wrong = next((at for at, item in enumerate(items) if not _is_byte(item)), 0)
        raise _error(message_class, field, items, f"element {wrong} must be in 0..255") from None


def _is_byte(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value <= 255


def _integer(value: Any) -> Any:
    """An int, if it is any number; what is none is left for `Message.encode` to complain of."""
    try:
        return operator.index(value)
    except TypeError:
        number = _real(value)
    return round(number) if isinstance(number, float) and math.isfinite(number) else value


def _real(value: Any) -> Any:
    """A number that ``struct`` packs: numpy's and decimals too; what is none stays as it is."""
    if isinstance(value, (int, float)) or not hasattr(value, "__float__"):
        return value
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return value


def _error(message_class: type[Message], field: Field, value: Any, complaint: str) -> InvalidArgument:
    return InvalidArgument(f"{message_class.NAME}.{field.name} = {value!r} cannot be sent: {complaint}")


# ------------------------------------------------------------------------------------------ texts


def _text_given(message: Any, name: str) -> Any:
    """What the program gave: pymavlink keeps the bytes beside a text that has lost what is not ASCII."""
    text, raw = getattr(message, name), getattr(message, f"_{name}_raw", None)
    if isinstance(raw, bytes) and text == raw.partition(b"\0")[0].decode("ascii", "replace"):
        return raw
    return text


def _text(value: Any) -> Any:
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
    """Bytes that are no UTF-8, in a message whose texts are str: they are sent as they are."""

    _data: bytes

    def __new__(cls, data: bytes) -> _RawText:
        self = super().__new__(cls, data.decode(errors="replace"))
        self._data = data
        return self

    def encode(self, encoding: str = "utf-8", errors: str = "strict") -> bytes:
        return self._data
