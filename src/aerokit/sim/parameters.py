"""The parameters of a simulated vehicle: names, values, types and defaults."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from aerokit.mavlink.enums import MavParamType

__all__ = ["ParameterRow", "Parameters", "stored"]

_RANGES = {
    MavParamType.UINT8: (0, (1 << 8) - 1),
    MavParamType.INT8: (-(1 << 7), (1 << 7) - 1),
    MavParamType.UINT16: (0, (1 << 16) - 1),
    MavParamType.INT16: (-(1 << 15), (1 << 15) - 1),
    MavParamType.UINT32: (0, (1 << 32) - 1),
    MavParamType.INT32: (-(1 << 31), (1 << 31) - 1),
}


@dataclass
class ParameterRow:
    """One parameter."""

    name: str
    type: int
    """MAV_PARAM_TYPE."""
    value: float
    default: float
    is_volatile: bool = False
    """Left out of PX4's hash: the vehicle changes it by itself."""


class Parameters:
    """By name, in the vehicle's order. They survive a reboot.

    A value is what the vehicle can store: 32-bit floats, whole numbers within the type's range.
    """

    def __init__(self, rows: Iterable[ParameterRow]) -> None:
        self._rows = {row.name: row for row in rows}
        self._names: tuple[str, ...] | None = None
        self._indices: dict[str, int] = {}

    @classmethod
    def from_text(cls, text: str, *, used: Iterable[str] = (), count: int | None = None) -> Parameters:
        """One ``name,type,value[,default[,v]]`` a line; ``v`` is volatile.

        ``count``: only so many, in the text's order, the ``used`` ones among them in any case.
        """
        lines = text.split()
        if count is not None:
            lines = _some_of(lines, frozenset(used), count)
        return cls(_row(line.split(",")) for line in lines)

    def __getitem__(self, name: str) -> float:
        return self._rows[name].value

    def __setitem__(self, name: str, value: float) -> None:
        """Raises KeyError for an unknown name."""
        row = self._rows[name]
        row.value = stored(value, row.type)

    def __contains__(self, name: object) -> bool:
        return name in self._rows

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def names(self) -> tuple[str, ...]:
        """In the vehicle's order: the place here is the index in messages."""
        if self._names is None:
            self._names = tuple(self._rows)
            self._indices = {name: index for index, name in enumerate(self._names)}
        return self._names

    def index(self, name: str) -> int:
        """The place in ``names``."""
        _ = self.names
        return self._indices[name]

    def type(self, name: str) -> int:
        """The MAV_PARAM_TYPE."""
        return self._rows[name].type

    def default(self, name: str) -> float:
        """What it is after a reset."""
        return self._rows[name].default

    def row(self, name: str) -> ParameterRow:
        """Everything about one of them."""
        return self._rows[name]

    def add(self, name: str, value: float, type: int = MavParamType.REAL32) -> None:  # noqa: A002
        """One more at the end, as when a feature is switched on: the count changes while the vehicle runs."""
        self._rows[name] = ParameterRow(name, type, stored(value, type), stored(value, type))
        self._names = None

    def remove(self, name: str) -> None:
        """One less: the indices behind it change."""
        del self._rows[name]
        self._names = None


def stored(value: float, type_: int) -> float:
    """What a parameter of this MAV_PARAM_TYPE holds after it was given a value."""
    range_ = _RANGES.get(MavParamType(type_))
    if range_ is None:
        return float(struct.unpack("<f", struct.pack("<f", value))[0]) if math.isfinite(value) else value
    return float(max(range_[0], min(range_[1], int(value))))


def _row(fields: list[str]) -> ParameterRow:
    name, type_, value = fields[0], int(fields[1]), float(fields[2])
    default = float(fields[3]) if len(fields) > 3 else value
    return ParameterRow(name, type_, stored(value, type_), stored(default, type_), len(fields) > 4)


def _some_of(lines: list[str], used: frozenset[str], count: int) -> list[str]:
    is_used = [line.partition(",")[0] in used for line in lines]
    others = max(0, count - sum(is_used))
    chosen: list[str] = []
    for line, needed in zip(lines, is_used, strict=True):
        if needed or others > 0:
            chosen.append(line)
            others -= not needed
    return chosen
