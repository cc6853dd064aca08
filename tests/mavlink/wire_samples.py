"""Random messages of every class, the same messages in pymavlink, and comparison of the two."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Any

from added_peer import added_module

from aerokit.mavlink import STANDARD, Field, Message

__all__ = [
    "PEERS",
    "added_peer",
    "dialect_module",
    "for_peer",
    "peer_class",
    "peer_fields",
    "peer_message",
    "random_message",
    "same",
    "samples",
]

PEERS = ("ardupilotmega", "development")
"""Pymavlink dialects that together have every message of `STANDARD` except our additions."""

_BITS = {"int8_t": 7, "uint8_t": 8, "int16_t": 15, "uint16_t": 16, "int32_t": 31, "uint32_t": 32} | {
    "int64_t": 63,
    "uint64_t": 64,
}
_ODD_FLOATS = (0.0, -0.0, 1.0, -1.5, math.inf, -math.inf, math.nan, 3.4028234e38, 1e-45, 0.1)
_LETTERS = "abcXYZ019 _-%µß→"


def samples(message_class: type[Message], count: int = 6) -> Iterator[Message]:
    """Return reproducible random messages; the first has only zeros, the second the extremes."""
    chance = random.Random(message_class.ID)
    for number in range(count):
        yield random_message(message_class, chance, ("zeros", "extremes")[number] if number < 2 else "random")


def random_message(message_class: type[Message], chance: random.Random, kind: str = "random") -> Message:
    """Return a message whose fields are zero, extreme or random."""
    return message_class(**{field.name: _value(field, chance, kind) for field in message_class.FIELDS})


def _value(field: Field, chance: random.Random, kind: str) -> Any:
    if field.is_text:
        return _text(field.array_length or 1, chance, kind)
    if not field.array_length:
        return _number(field.type, chance, kind)
    if field.type in ("uint8_t", "char"):
        return bytes(_number("uint8_t", chance, kind) for _ in range(field.array_length))
    return tuple(_number(field.type, chance, kind) for _ in range(field.array_length))


def _number(kind: str, chance: random.Random, how: str) -> Any:
    if how == "zeros":
        return 0
    if kind in ("float", "double"):
        value = chance.choice(_ODD_FLOATS) if how == "extremes" or chance.random() < 0.3 else chance.gauss(0, 1e3)
        return _rounded(value) if kind == "float" else value
    bits = _BITS[kind]
    low, high = (0 if kind.startswith("u") else -(1 << bits)), (1 << bits) - 1
    if how == "extremes":
        return chance.choice((low, high))
    return 0 if chance.random() < 0.2 else chance.randint(low, high)


def _rounded(value: float) -> float:
    """Round to the nearest 32-bit float, so that a round trip returns the same value."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _text(size: int, chance: random.Random, how: str) -> str:
    if how == "zeros":
        return ""
    text = "".join(chance.choice(_LETTERS) for _ in range(size if how == "extremes" else chance.randint(0, size)))
    return text.encode()[:size].decode(errors="ignore")


# -------------------------------------------------------------------------------------- pymavlink


def dialect_module(name: str, version: int) -> Any:
    """Return pymavlink's module of a dialect and protocol version."""
    return import_module(f"pymavlink.dialects.v{version}0.{name}")


def peer_class(message_class: type[Message], version: int) -> tuple[Any, Any]:
    """Return pymavlink's (module, class) for one of our classes; MAVLink 1 has no ids above 255."""
    modules = [dialect_module(name, version) for name in PEERS]
    if any((message_class.ID, field.name) not in _known() for field in message_class.FIELDS):
        modules = [added_peer(version)]
    for module in modules:
        if message_class.ID in module.mavlink_map:
            return module, module.mavlink_map[message_class.ID]
    raise LookupError(f"no dialect of pymavlink knows {message_class.NAME} in version {version}")


def added_peer(version: int = 2) -> Any:
    """Return the generated pymavlink module for messages or fields that pymavlink lacks."""
    return added_module(version, _known())


@cache
def _known() -> frozenset[tuple[int, str]]:
    """Return message id and name of every field in pymavlink's own modules."""
    classes = [cls for name in PEERS for cls in dialect_module(name, 2).mavlink_map.values()]
    return frozenset((cls.id, field) for cls in classes for field in cls.fieldnames)


def peer_message(message: Message, version: int) -> tuple[Any, Any]:
    """Return pymavlink's (module, message) with the same fields."""
    module, cls = peer_class(type(message), version)
    fields = [field for field in message.FIELDS if field.name in cls.fieldnames]
    return module, cls(**{field.name: for_peer(field, getattr(message, field.name)) for field in fields})


def for_peer(field: Field, value: Any) -> Any:
    """Convert a field's value to what pymavlink's constructors take."""
    if field.type == "char" and not field.is_text:
        return value
    if field.is_text:
        return value.encode() if field.array_length else value.encode().ljust(1, b"\0")
    return list(value) if field.array_length else value


def peer_fields(message: Any) -> dict[str, Any]:
    """Convert a decoded pymavlink message to our types; its texts continue after the first NUL, ours end there."""
    fields = {name: getattr(message, name) for name in message.fieldnames}
    for field in _fields_of_other_types(message.get_msgId()):
        if field.name in fields:
            fields[field.name] = _from_peer(field, message)
    return fields


@cache
def _fields_of_other_types(message_id: int) -> tuple[Field, ...]:
    return tuple(f for f in STANDARD[message_id].FIELDS if f.array_length or f.type == "char")


def _from_peer(field: Field, message: Any) -> Any:
    if field.type == "char":
        raw = getattr(message, f"_{field.name}_raw")
        if not field.is_text:
            return raw.ljust(field.array_length, b"\0")
        return raw.partition(b"\0")[0].decode(errors="replace")
    value = getattr(message, field.name)
    return bytes(value) if field.type == "uint8_t" else tuple(value)


def same(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Return whether all fields are equal; NaN equals NaN."""
    return ours == theirs or (ours.keys() == theirs.keys() and all(_equal(ours[name], theirs[name]) for name in ours))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
        return all(map(_equal, one, other))
    return bool(one == other or (one != one and other != other))
