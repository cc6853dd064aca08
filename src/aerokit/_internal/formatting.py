"""Formatting of values: as JSON, as text for people, and in error messages."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import date, datetime, timedelta
from enum import Enum, Flag
from pathlib import PurePath
from typing import Any

_MAX_LENGTH = 100


def to_jsonable(value: object) -> Any:
    """Convert a value to dictionaries, lists, strings, numbers, booleans and None.

    The command line, `aerokit serve`, brokers and log conversion all use it, so a value has the same form everywhere.

    - an object with ``to_dict()`` (position, state, event): a dictionary of its fields, whose names include the units;
    - a MAVLink message: the same, with its name first: ``{"message": "HEARTBEAT", …}``;
    - a string, a boolean or None: unchanged;
    - an enum member: its name in the standard; a combination of flags: a list of names;
    - a time: ISO 8601; a duration: seconds; bytes: hexadecimal digits; infinity and NaN: None;
    - a mapping: a dictionary; any other iterable: a list;
    - an exception, or anything else: its text.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Enum):  # Enums come before int, because members of an IntEnum are integers, too.
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
        return {str(to_jsonable(key)): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, PurePath):
        return str(value)
    fields = _fields(value)
    if fields is not None:
        return {name: to_jsonable(field) for name, field in fields.items()}
    if isinstance(value, Iterable):
        return [to_jsonable(item) for item in value]
    return str(value)


def _names(member: Enum) -> Any:
    # `tuple(type(member))` has the single flags, so a value that is not among them is a combination of flags.
    if isinstance(member, Flag) and member not in tuple(type(member)):
        return [flag.name for flag in type(member) if flag in member]
    return member.name


def _fields(value: object) -> Mapping[str, object] | None:
    """Return the fields of an object with ``to_dict()``, or None. A message's name comes first."""
    to_dict = getattr(value, "to_dict", None)
    if to_dict is None or isinstance(value, type):
        return None
    fields: Mapping[str, object] = to_dict()
    is_message = isinstance(getattr(value, "NAME", None), str) and isinstance(getattr(value, "ID", None), int)
    return {"message": getattr(value, "NAME"), **fields} if is_message else fields  # noqa: B009


def printable(text: str) -> str:
    """Replace unprintable characters. Newlines are kept."""
    # A text from a vehicle may contain control characters, which a terminal would interpret.
    return "".join(char if char.isprintable() or char == "\n" else "\N{REPLACEMENT CHARACTER}" for char in text)


def format_value(value: object) -> str:
    """Format an event's field for people.

    Enum members are formatted as their names, floats with three significant digits, and floats from 1000 as integers.
    """
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 999.5 else f"{value:.3g}"  # 999.5 is rounded to 1000.
    name = getattr(value, "name", None)
    return name if isinstance(name, str) else str(value)


# Matches the user and the password in a URL.
_CREDENTIALS = re.compile(r"//([^/@:\s]*):[^\s]*@")


def short_repr(value: object) -> str:
    """Return at most 100 characters of ``repr(value)``, without passwords in URLs."""
    try:
        text = repr(value)
    except Exception:  # repr fails for an int of 5000 digits, and a __repr__ of the program may fail, too.
        text = f"<{type(value).__name__}>"
    text = _CREDENTIALS.sub(r"//\1:…@", text)
    return text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 3]}..."


def enum_name(enum: type[Enum], number: int, unknown: str) -> str:
    """Return the name of the member with this number, or ``unknown`` if there is none."""
    try:
        return enum(number).name
    except ValueError:
        return unknown


def with_article(noun: str) -> str:
    """Prepend the article: ``a Position``, ``an AttitudeSetpoint``."""
    return f"{'an' if noun[:1] in 'AEIO' else 'a'} {noun}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return ``" (did you mean 'GUIDED'?)"`` for the most similar known name; empty if none is similar."""
    if not isinstance(name, str) or len(name) > _MAX_LENGTH:
        return ""
    import difflib  # Imported here, because it is only needed for errors.

    by_upper_case = {candidate.upper(): candidate for candidate in known}
    close = difflib.get_close_matches(name.upper(), by_upper_case, n=1)
    return f" (did you mean {by_upper_case[close[0]]!r}?)" if close else ""
