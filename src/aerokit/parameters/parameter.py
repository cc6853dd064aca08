"""``Parameter`` and ``ParameterType``, and what a name and a value must be before they are sent."""

from __future__ import annotations

import math
from enum import IntEnum
from struct import Struct
from typing import SupportsFloat, SupportsIndex

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument

MOST_PARAMETERS = 8192
"""Names beyond so many that come from the air are not taken for parameters; ArduPilot has 1,500, PX4 2,000."""

NAME_LENGTH = 16
"""The longest name that the protocol can carry."""

_FLOAT32 = Struct("<f")
_INTEGER_BITS = {1: 8, 2: 8, 3: 16, 4: 16, 5: 32, 6: 32, 7: 64, 8: 64}


class ParameterType(IntEnum):
    """MAV_PARAM_TYPE: https://mavlink.io/en/messages/common.html#MAV_PARAM_TYPE.

    ArduPilot has INT8, INT16, INT32 and REAL32, PX4 has INT32 and REAL32; other components use all of them.
    """

    UINT8 = 1
    INT8 = 2
    UINT16 = 3
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    UINT64 = 7
    INT64 = 8
    REAL32 = 9
    REAL64 = 10

    @classmethod
    def from_wire(cls, number: int) -> ParameterType:
        """The type that a message tells; REAL32, in which every value travels, when the number is not known."""
        return cls(number) if 1 <= number <= 10 else cls.REAL32

    @property
    def is_integer(self) -> bool:
        """Whether values are whole numbers, ``int`` in Python."""
        return self < ParameterType.REAL32

    @property
    def is_signed(self) -> bool:
        """Whether values can be below zero."""
        return self >= ParameterType.REAL32 or self % 2 == 0

    @property
    def low(self) -> int | float:
        """The lowest value of the type."""
        if not self.is_integer:
            return -self.high
        return -(1 << (_INTEGER_BITS[self] - 1)) if self.is_signed else 0

    @property
    def high(self) -> int | float:
        """The highest value of the type."""
        if self.is_integer:
            return (1 << (_INTEGER_BITS[self] - self.is_signed)) - 1
        return 3.4028234663852886e38 if self is ParameterType.REAL32 else 1.7976931348623157e308


class Parameter(Snapshot):
    """One parameter of a vehicle, as it was last told.

    ``value`` is an ``int`` for integer types, else a ``float``: the 32-bit number that the vehicle holds.
    ``default`` is None when it is not known (only MAVFTP tells it), ``index`` is the place in the vehicle's list,
    None when it has not been told. Nothing is checked: a vehicle may hold NaN.
    """

    name: str
    value: int | float
    type: ParameterType
    default: int | float | None = None
    index: int | None = None

    @property
    def is_changed(self) -> bool | None:
        """Whether the value is another than the default; None when the default is not known."""
        return None if self.default is None else not same_value(self.value, self.default)


def check_name(name: str) -> str:
    """The name, when a message can carry it.

    Raises :class:`InvalidArgument` unless it is 1 to 16 printable ASCII characters without spaces.
    """
    if not isinstance(name, str):
        raise InvalidArgument(f"parameter name = {shown(name)} is no text")
    if not 0 < len(name) <= NAME_LENGTH:
        raise InvalidArgument(
            f"parameter name = {shown(name)} has {len(name)} characters, 1 to {NAME_LENGTH} are possible"
        )
    if not all("!" <= character <= "~" for character in name):
        raise InvalidArgument(f"parameter name = {shown(name)}: ASCII without spaces is possible only")
    return name


def checked_value(name: str, value: float, type: ParameterType) -> int | float:  # noqa: A002
    """The value as a vehicle holds it in that type: an int, or the nearest 32-bit number.

    Raises :class:`InvalidArgument` for what the type cannot hold: NaN, infinity, 300 as an INT8, 1.5 as an
    integer. ``True`` is 1.
    """
    number = number_of(name, value)
    if isinstance(number, float) and not math.isfinite(number):
        raise InvalidArgument(f"{name} = {shown(value)}: a finite number is allowed only")
    if type.is_integer and number != int(number):
        raise InvalidArgument(
            f"{name} = {shown(value)}: whole numbers are allowed only (it is an {type.name})"
        )
    if not type.low <= number <= type.high:
        raise InvalidArgument(
            f"{name} = {shown(value)} must be in {type.low}..{type.high} (it is an {type.name})"
        )
    if type.is_integer:
        return int(number)
    return to_float32(number) if type is ParameterType.REAL32 else float(number)


def number_of(name: str, value: object) -> int | float:
    """An int, a float, or what says that it is one of them, as numpy's numbers do; else InvalidArgument."""
    if isinstance(value, (int, float)):
        return value
    if isinstance(value, SupportsIndex):
        return value.__index__()
    if isinstance(value, SupportsFloat):
        return float(value)
    raise InvalidArgument(f"{name} = {shown(value)} is no number")


def to_float32(value: float) -> float:
    """The nearest 32-bit floating-point number; OverflowError when it is beyond them."""
    return float(_FLOAT32.unpack(_FLOAT32.pack(value))[0])


def same_value(one: float, other: float) -> bool:
    """Whether a vehicle could not tell the two apart: equal, equal as 32-bit numbers, or both NaN."""
    if one == other or (one != one and other != other):
        return True
    if isinstance(one, int) and isinstance(other, int):
        return False
    try:
        return to_float32(one) == to_float32(other)
    except OverflowError:
        return False
