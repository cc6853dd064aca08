"""Values of a JSON document with their path, so that a complaint says which one it is about."""

from __future__ import annotations

import json
import math
from itertools import islice
from typing import TYPE_CHECKING, Any

from aerokit.errors import FileFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["JsonValue", "load_json"]


def load_json(text: str, name: str) -> JsonValue:
    """The document in ``text``; :class:`FileFormatError` names the line when it is no JSON."""
    try:
        return JsonValue(json.loads(text, parse_constant=_no_constant), name, "")
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise FileFormatError(f"{name}: {where}: no JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{name}: no JSON: {error}") from error


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is none of its numbers")


class JsonValue:
    """One value of a document; every reading method raises :class:`FileFormatError` when it is of another kind."""

    __slots__ = ("name", "path", "value")

    def __init__(self, value: Any, name: str, path: str) -> None:
        self.value: Any = value
        self.name: str = name
        self.path: str = path

    def error(self, expected: str) -> FileFormatError:
        """The complaint that this value is not what was expected."""
        # Piece by piece, so that a large value is not written out to be cut off.
        found = "".join(islice(json.JSONEncoder().iterencode(self.value), 41))
        found = found if len(found) <= 40 else f"{found[:37]}..."
        return FileFormatError(f"{self.name}: {self.path or 'the document'} = {found}: expected {expected}")

    def child(self, key: str) -> JsonValue | None:
        """The value of a key of an object, None when there is no such key."""
        members = self.members()
        path = f"{self.path}.{key}" if self.path else key
        return JsonValue(members[key], self.name, path) if key in members else None

    def __getitem__(self, key: str) -> JsonValue:
        child = self.child(key)
        if child is None:
            where = self.path or "the document"
            raise FileFormatError(f"{self.name}: {where} has no {key!r}, which is required")
        return child

    def members(self) -> dict[str, Any]:
        """An object."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        return self.value

    def elements(self, *sizes: int) -> list[JsonValue]:
        """The elements of an array, which has one of these sizes."""
        if not isinstance(self.value, list):
            raise self.error("an array")
        if sizes and len(self.value) not in sizes:
            raise self.error(
                f"an array of {' or '.join(map(str, sizes))} values, and it has {len(self.value)}"
            )
        return list(self._elements())

    def _elements(self) -> Iterator[JsonValue]:
        for index, value in enumerate(self.value):
            yield JsonValue(value, self.name, f"{self.path}[{index}]")

    def number(self, low: float = -math.inf, high: float = math.inf, *, null: bool = False) -> float:
        """A finite number in that range, NaN for null where it is allowed."""
        if self.value is None and null:
            return math.nan
        value = self._as_float()
        if not math.isfinite(value) or not low <= value <= high:
            bounds = (
                f" from {low:g} to {high:g}"
                if math.isfinite(high)
                else f" from {low:g} on"
                if low == 0
                else ""
            )
            raise self.error(f"a number{bounds}" + ", or null" * null)
        return value

    def integer(self, low: int, high: int) -> int:
        """A whole number in that range; 3.0 counts as one."""
        value = self.number()
        if not value.is_integer() or not low <= value <= high:
            raise self.error(f"a whole number from {low} to {high}")
        return int(value)

    def boolean(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false")
        return self.value

    def one_of(self, *choices: object) -> None:
        """Raise unless it is one of these values."""
        if self.value not in choices or isinstance(self.value, bool):
            raise self.error(" or ".join(json.dumps(choice) for choice in choices))

    def _as_float(self) -> float:
        """The number, infinity for what is none."""
        if not isinstance(self.value, (int, float)) or isinstance(self.value, bool):
            return math.inf
        try:
            return float(self.value)
        except OverflowError:
            return math.inf
