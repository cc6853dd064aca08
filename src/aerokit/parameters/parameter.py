"""``Parameter`` and ``Setting``, and checks and encoding of names and values.

A setting is a parameter of a component in the extended protocol: https://mavlink.io/en/services/parameter_ext.html
"""

from __future__ import annotations

import math
from enum import IntEnum
from struct import Struct
from typing import SupportsFloat, SupportsIndex

from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavParamExtType

# Limits the memory that a faulty vehicle can fill. ArduPilot has 1,500 parameters, PX4 2,000.
MAX_PARAMETERS = 8192

NAME_LENGTH = 16
"""Maximum length of a parameter name in MAVLink."""

_FLOAT32 = Struct("<f")
_INTEGER_BITS = {1: 8, 2: 8, 3: 16, 4: 16, 5: 32, 6: 32, 7: 64, 8: 64}


class ParameterType(IntEnum):
    """Type of a parameter: MAV_PARAM_TYPE (https://mavlink.io/en/messages/common.html#MAV_PARAM_TYPE).

    ArduPilot uses INT8, INT16, INT32 and REAL32, PX4 INT32 and REAL32; other components may use all of them.
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
        """Return the type with this MAV_PARAM_TYPE number.

        The result is REAL32 for unknown numbers, because every value is sent as a float.
        """
        return _TYPES.get(number) or cls.REAL32

    @property
    def is_integer(self) -> bool:
        """True if values are whole numbers, ``int`` in Python."""
        return self < 9  # 9 is REAL32. Looking up the member would take longer.

    @property
    def is_signed(self) -> bool:
        """True if values can be negative."""
        return self >= ParameterType.REAL32 or self % 2 == 0  # The signed integer types have even numbers.

    @property
    def minimum(self) -> int | float:
        """The lowest value that the type can hold."""
        if not self.is_integer:
            return -self.maximum
        return -(1 << (_INTEGER_BITS[self] - 1)) if self.is_signed else 0

    @property
    def maximum(self) -> int | float:
        """The highest value that the type can hold."""
        if self.is_integer:
            value_bits = _INTEGER_BITS[self] - (1 if self.is_signed else 0)
            return (1 << value_bits) - 1
        return 3.4028234663852886e38 if self is ParameterType.REAL32 else 1.7976931348623157e308


_TYPES = {int(type_): type_ for type_ in ParameterType}


class Parameter(Snapshot):
    """One parameter of a vehicle, as last reported.

    ``value`` is an ``int`` for integer types, else a ``float`` with 32-bit precision. ``default`` is None if unknown;
    only MAVFTP reports defaults. ``index`` is the index in the vehicle's list, or None if not reported. Values are not
    checked: NaN, or a fraction that a vehicle reports for an integer type, remains a ``float``.
    """

    name: str
    value: int | float
    type: ParameterType
    default: int | float | None = None
    index: int | None = None

    @property
    def is_changed(self) -> bool | None:
        """True if the value differs from the default; None if the default is unknown."""
        return None if self.default is None else not same_value(self.value, self.default)


def check_name(name: str) -> str:
    """Check that a name can be sent, and return it.

    Raises:
        InvalidArgument: the name is not 1 to 16 printable ASCII characters without spaces.
    """
    if not isinstance(name, str):
        raise InvalidArgument(f"parameter name = {short_repr(name)} is not a string")
    if not 0 < len(name) <= NAME_LENGTH:
        raise InvalidArgument(
            f"parameter name = {short_repr(name)} has {len(name)} characters; 1 to {NAME_LENGTH} are possible"
        )
    if not all("!" <= character <= "~" for character in name):
        raise InvalidArgument(
            f"parameter name = {short_repr(name)} is not allowed: it must be printable ASCII without spaces"
        )
    return name


def checked_value(name: str, value: float, type: ParameterType) -> int | float:  # noqa: A002
    """Convert a value to its type: an int, the nearest 32-bit float (REAL32), or a float (REAL64).

    Raises:
        InvalidArgument: the type cannot hold the value: NaN, infinity, 300 as an INT8, 1.5 as an integer.
    """
    number = number_of(name, value)
    if isinstance(number, float) and not math.isfinite(number):
        raise InvalidArgument(f"{name} = {short_repr(value)} must be a finite number")
    if type.is_integer and number != int(number):
        raise InvalidArgument(f"{name} = {short_repr(value)} must be a whole number (its type is {type.name})")
    if not type.minimum <= number <= type.maximum:
        raise InvalidArgument(
            f"{name} = {short_repr(value)} must be in {type.minimum}..{type.maximum} (its type is {type.name})"
        )
    if type.is_integer:
        return int(number)
    return to_float32(number) if type is ParameterType.REAL32 else float(number)


def number_of(name: str, value: object) -> int | float:
    """Convert to an int or a float. Numbers of other libraries, such as numpy, are accepted.

    Raises InvalidArgument for all other values.
    """
    if isinstance(value, (int, float)):
        return value
    if isinstance(value, SupportsIndex):
        return value.__index__()
    if isinstance(value, SupportsFloat):
        return float(value)
    raise InvalidArgument(f"{name} = {short_repr(value)} is not a number")


def to_float32(value: float) -> float:
    """Round to the nearest 32-bit float. Raises OverflowError if the value is too large."""
    return float(_FLOAT32.unpack(_FLOAT32.pack(float(value)))[0])


def same_value(left: float, right: float) -> bool:
    """Return True if the values are equal or both NaN. They are compared as 32-bit floats, unless both are ints."""
    are_both_nan = left != left and right != right
    if left == right or are_both_nan:
        return True
    if isinstance(left, int) and isinstance(right, int):
        return False  # Large integers may differ although they are equal as 32-bit floats.
    try:
        return to_float32(left) == to_float32(right)
    except OverflowError:
        return False


# ------------------------------------------------------------------------------------- settings

SettingValue = bool | int | float | str | bytes
"""The value of a setting: ``bool`` only if a definition says so, ``str`` or ``bytes`` for the custom type."""

MAX_VALUE_SIZE = 128  # maximum bytes of a value, which one message can carry

_STRUCTS = {
    MavParamExtType.UINT8: Struct("<B"),
    MavParamExtType.INT8: Struct("<b"),
    MavParamExtType.UINT16: Struct("<H"),
    MavParamExtType.INT16: Struct("<h"),
    MavParamExtType.UINT32: Struct("<I"),
    MavParamExtType.INT32: Struct("<i"),
    MavParamExtType.UINT64: Struct("<Q"),
    MavParamExtType.INT64: Struct("<q"),
    MavParamExtType.REAL32: Struct("<f"),
    MavParamExtType.REAL64: Struct("<d"),
}


class Setting(Snapshot):
    """One setting of a component, as last reported.

    ``type`` is a MAV_PARAM_EXT_TYPE. For the custom type, ``value`` is a ``str`` if its bytes are text, else
    ``bytes``. ``index`` is the index in the component's list, or None if not reported.
    """

    name: str
    value: SettingValue
    type: int
    index: int | None = None


def setting_value(data: bytes, type: int) -> SettingValue:  # noqa: A002 - the name of the field in the standard
    """Decode the bytes of a value in a message. For unknown types, return the bytes without trailing zeros."""
    layout = _STRUCTS.get(type)  # type: ignore[call-overload]
    if layout is not None:
        # MAVLink 2 cuts the zeros at the end of a message.
        number: int | float = layout.unpack(data[: layout.size].ljust(layout.size, b"\0"))[0]
        return number
    data = data.rstrip(b"\0")
    if type == MavParamExtType.CUSTOM:
        try:
            text = data.decode()
        except UnicodeDecodeError:
            return data
        if all(char.isprintable() or char.isspace() for char in text):
            return text
    return data


def setting_bytes(value: SettingValue, type: int) -> bytes:  # noqa: A002
    """Encode a value that :func:`checked_setting` has accepted."""
    layout = _STRUCTS.get(type)  # type: ignore[call-overload]
    if layout is not None:
        data: bytes = layout.pack(value)
        return data
    return value.encode() if isinstance(value, str) else bytes(value)  # type: ignore[arg-type]


def checked_setting(name: str, value: object, type: int) -> SettingValue:  # noqa: A002
    """Convert a value to its type: an int, a float (rounded to 32 bits for REAL32), a string or bytes.

    Raises:
        InvalidArgument: the type cannot hold the value: 300 as a UINT8, 1.5 as an integer, a string for a number, a
            number for a string, or more than 128 bytes.
    """
    if type in _STRUCTS:
        if isinstance(value, (str, bytes, bytearray)):
            raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: it must be a number")
        return checked_value(name, value, ParameterType(type))  # type: ignore[arg-type]  # checked there
    if not isinstance(value, (str, bytes, bytearray)):
        raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: it must be text or bytes")
    try:
        data = value.encode() if isinstance(value, str) else bytes(value)
    except UnicodeEncodeError:
        raise InvalidArgument(f"{name} = {short_repr(value)} has characters that cannot be encoded") from None
    if len(data) > MAX_VALUE_SIZE:
        raise InvalidArgument(
            f"{name} = {short_repr(value)} has {len(data)} bytes; at most {MAX_VALUE_SIZE} fit into the message"
        )
    if data.endswith(b"\0"):
        raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: zeros at its end would be lost")
    return setting_value(data, type)


def settings_equal(left: SettingValue, right: SettingValue) -> bool:
    """Return True if two texts are equal, or if two numbers are equal according to :func:`same_value`."""
    if isinstance(left, (str, bytes)) or isinstance(right, (str, bytes)):
        return _encoded(left) == _encoded(right)
    return same_value(left, right)


def setting_key(value: SettingValue) -> object:
    """Return a key that is the same for values that are equal according to :func:`settings_equal`.

    There is one exception: an int beyond ±2**24 and a float that are equal may have different keys.
    """
    if isinstance(value, (str, bytes)):
        return _encoded(value)
    if not isinstance(value, float):
        return value
    if math.isnan(value):
        return "NaN"  # A float NaN would differ from itself.
    try:
        return to_float32(value)
    except OverflowError:
        return value


def _encoded(value: SettingValue) -> object:
    return value.encode() if isinstance(value, str) else value
