"""``Setting``: a parameter of a component by the extended protocol, and how its value travels: as the bytes C has.

https://mavlink.io/en/services/parameter_ext.html
"""

from __future__ import annotations

import math
import struct
from struct import Struct

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavParamExtType
from aerokit.parameters.parameter import ParameterType, checked_value

SettingValue = bool | int | float | str | bytes
"""What a setting can be: ``bool`` where a definition says so, ``str`` or ``bytes`` of the custom type."""

LONGEST_VALUE = 128
"""Bytes that one message carries."""

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
    """One setting of a component, as it was last told.

    ``type`` is a MAV_PARAM_EXT_TYPE. Of the custom type ``value`` is a ``str`` where its bytes are a text, else bytes.
    ``index`` is its place in the component's list, None while that has not been told.
    """

    name: str
    value: SettingValue
    type: int
    index: int | None = None


def setting_value(data: bytes, type: int) -> SettingValue:  # noqa: A002 - the standard's word
    """What the bytes of a message mean; of a type that nobody knows they stay bytes, without the zeros behind them."""
    packed = _STRUCTS.get(type)  # type: ignore[call-overload]
    if packed is not None:
        number: int | float = packed.unpack(data[: packed.size].ljust(packed.size, b"\0"))[0]
        return number
    data = data.rstrip(b"\0")
    if type == MavParamExtType.CUSTOM:
        try:
            text = data.decode()
        except UnicodeDecodeError:
            return data
        if all(each.isprintable() or each.isspace() for each in text):
            return text
    return data


def setting_bytes(value: SettingValue, type: int) -> bytes:  # noqa: A002
    """The bytes that a message carries; for values that :func:`checked_setting` has let through."""
    packed = _STRUCTS.get(type)  # type: ignore[call-overload]
    if packed is not None:
        data: bytes = packed.pack(value)
        return data
    return value.encode() if isinstance(value, str) else bytes(value)  # type: ignore[arg-type]


def checked_setting(name: str, value: object, type: int) -> SettingValue:  # noqa: A002
    """The value as the component holds it: an int, a float of 32 bits, a text or bytes.

    Raises :class:`InvalidArgument` for what the type cannot hold: 300 as a UINT8, 1.5 as an integer, a text for a
    number, a number for a text, more than 128 bytes.
    """
    if type in _STRUCTS:
        if isinstance(value, (str, bytes, bytearray)):
            raise InvalidArgument(f"{name} = {shown(value)} is not allowed: a number")
        return checked_value(name, value, ParameterType(type))  # type: ignore[arg-type]  # it checks that, too
    if not isinstance(value, (str, bytes, bytearray)):
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: a text or bytes")
    try:
        data = value.encode() if isinstance(value, str) else bytes(value)
    except UnicodeEncodeError:
        raise InvalidArgument(f"{name} = {shown(value)} has characters that cannot be encoded") from None
    if len(data) > LONGEST_VALUE:
        raise InvalidArgument(f"{name} = {shown(value)} has {len(data)} bytes, at most {LONGEST_VALUE} fit")
    if data.endswith(b"\0"):
        raise InvalidArgument(f"{name} = {shown(value)}: zeros at its end would be lost")
    return setting_value(data, type)


def settings_equal(one: SettingValue, other: SettingValue) -> bool:
    """Whether a component could not tell the two apart: equal, equal as 32-bit numbers, or both NaN."""
    if isinstance(one, (str, bytes)) or isinstance(other, (str, bytes)):
        return _text(one) == _text(other)
    if one == other or (one != one and other != other):
        return True
    if not isinstance(one, float) and not isinstance(other, float):
        return False
    try:
        return _FLOAT.pack(one) == _FLOAT.pack(other) and math.isfinite(one)
    except (OverflowError, struct.error):
        return False


_FLOAT = _STRUCTS[MavParamExtType.REAL32]


def setting_key(value: SettingValue) -> object:
    """The same for values that a component could not tell apart: for long lists of options."""
    if isinstance(value, (str, bytes)):
        return _text(value)
    if not isinstance(value, float):
        return value
    try:
        return _FLOAT.unpack(_FLOAT.pack(value))[0] if value == value else "NaN"
    except (OverflowError, struct.error):
        return value


def _text(value: SettingValue) -> object:
    return value.encode() if isinstance(value, str) else value
