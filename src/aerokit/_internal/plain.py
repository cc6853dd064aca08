"""``plain``: any value of this library as what JSON knows: objects, lists, texts, numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from datetime import date, datetime, timedelta
from enum import Enum, Flag
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:  # importing typing_extensions would cost more than everything else here

    def dataclass_transform(**_: object) -> Any:
        """Only the type checker cares."""
        return lambda cls: cls


def plain(value: object) -> Any:
    """``value`` made of dictionaries, lists, texts, numbers, booleans and None.

    - an object with ``to_dict()`` (positions, states, events): its fields, by their names, which hold the units;
    - a MAVLink message: its fields with the name of the message before them, ``{"message": "HEARTBEAT", …}``;
    - an enumeration's member: its name, in the standard's spelling; several flags: a list of their names;
    - times: ISO 8601, durations: seconds; bytes: hexadecimal digits; infinity and NaN: None;
    - an exception: its text; anything else: its text, too.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Enum):
        return _names(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value).hex()
    if isinstance(value, (datetime, date)):
        return value.isoformat()
    if isinstance(value, timedelta):
        return value.total_seconds()
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(each) for key, each in value.items()}
    if isinstance(value, PurePath):
        return str(value)
    fields = _fields(value)
    if fields is not None:
        return {name: plain(each) for name, each in fields.items()}
    if isinstance(value, Iterable):
        return [plain(each) for each in value]
    return str(value)


def printable(text: str) -> str:
    """What a vehicle says, without characters that a terminal obeys."""
    return "".join(
        each if each.isprintable() or each == "\n" else "\N{REPLACEMENT CHARACTER}" for each in text
    )


def _names(member: Enum) -> Any:
    if isinstance(member, Flag) and member not in tuple(type(member)):
        return [each.name for each in type(member) if each in member]
    return member.name


def _fields(value: object) -> Mapping[str, object] | None:
    to_dict = getattr(value, "to_dict", None)
    if to_dict is None or isinstance(value, type):
        return None
    fields: Mapping[str, object] = to_dict()
    is_message = isinstance(getattr(value, "NAME", None), str) and isinstance(getattr(value, "ID", None), int)
    return {"message": getattr(value, "NAME"), **fields} if is_message else fields  # noqa: B009
