"""Encoding of parameter values in the 32-bit float of PARAM_VALUE and PARAM_SET.

ArduPilot casts integers to float: 5 becomes 5.0, and an INT32 beyond 2**24 loses its last bits. PX4 copies the bytes of
the integer (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE). The bytes of some integers, such as -5,000,000, form
signalling NaNs, in which a Python float changes one bit. :func:`parameter_of`, :func:`set_message` and
:func:`value_message` preserve this bit.

https://mavlink.io/en/services/parameter.html#parameter-encoding
"""

from __future__ import annotations

import math
import re
from struct import Struct
from typing import TypeVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import HEADER_LENGTH
from aerokit.mavlink.messages import ParamSet, ParamValue
from aerokit.parameters.parameter import Parameter, ParameterType, to_float32

# The ``param_index`` of a PARAM_VALUE that is not part of a list. ArduPilot and PX4 send it after PARAM_SET.
UNKNOWN_INDEX = 0xFFFF

_FLOAT = Struct("<f")

_FORMATS = {
    1: Struct("<B"),
    2: Struct("<b"),
    3: Struct("<H"),
    4: Struct("<h"),
    5: Struct("<I"),
    6: Struct("<i"),
}

_M = TypeVar("_M", ParamSet, ParamValue)


def to_bits(value: float, type: ParameterType, bytewise: bool) -> bytes:  # noqa: A002
    """Encode a value as the four bytes of ``param_value``. :func:`checked_value` must have accepted the value."""
    if not bytewise or type is ParameterType.REAL32:  # Without `bytewise`, integers are sent as floats.
        try:
            return _FLOAT.pack(value)
        except OverflowError:
            raise InvalidArgument(f"{value!r} cannot be sent: it is too large for a 32-bit float") from None
    if type not in _FORMATS:
        raise InvalidArgument(f"{value!r} cannot be sent: {type.name} has eight bytes, but the message holds four")
    return _FORMATS[type].pack(value).ljust(4, b"\0")


def value_of(message: ParamSet | ParamValue, bytewise: bool) -> int | float:
    """Return the value in a message; a fraction or NaN that a vehicle sends for an integer type remains a float."""
    return _value_of(message, ParameterType.from_wire(message.param_type), bytewise)


def parameter_of(message: ParamValue, bytewise: bool) -> Parameter:
    """Convert a PARAM_VALUE to a parameter without a default.

    The index is None if the message is not part of a list.
    """
    index = None if message.param_index == UNKNOWN_INDEX else message.param_index
    type_ = ParameterType.from_wire(message.param_type)
    return Parameter(message.param_id, _value_of(message, type_, bytewise), type_, None, index)


def set_message(
    target_system: int,
    target_component: int,
    name: str,
    value: float,
    type: ParameterType,  # noqa: A002
    bytewise: bool,
) -> ParamSet:
    """Create a PARAM_SET for a checked name and value."""
    bits = to_bits(value, type, bytewise)
    message = ParamSet(target_system, target_component, name, _FLOAT.unpack(bits)[0], int(type))
    # The bits of an integer may be those of a NaN, which a Python float does not keep exactly.
    return _with_exact_bits(message, _ExactParamSet, bits)


def value_message(parameter: Parameter, count: int, bytewise: bool) -> ParamValue:
    bits = to_bits(parameter.value, parameter.type, bytewise)
    index = UNKNOWN_INDEX if parameter.index is None else parameter.index
    message = ParamValue(parameter.name, _FLOAT.unpack(bits)[0], int(parameter.type), count, index)
    return _with_exact_bits(message, _ExactParamValue, bits)


# ------------------------------------------------------------------------------------------ bits
class _ExactParamSet(ParamSet):
    """A PARAM_SET whose ``param_value`` is a signalling NaN, which conversion to a Python float would change."""

    bits: bytes

    def encode(self) -> bytes:
        return self.bits + super().encode()[4:]  # The value is the first field.


class _ExactParamValue(ParamValue):
    """A PARAM_VALUE whose ``param_value`` is a signalling NaN."""

    bits: bytes

    def encode(self) -> bytes:
        return self.bits + super().encode()[4:]


def _with_exact_bits(message: _M, exact_type: type[_ExactParamSet] | type[_ExactParamValue], bits: bytes) -> _M:
    """Return the message, or a copy of it, with ``param_value`` encoded as ``bits``."""
    if _FLOAT.pack(message.param_value) == bits:
        return message
    exact = exact_type(**message.to_dict())
    exact.bits = bits  # type: ignore[misc]
    return exact  # type: ignore[return-value]


def _exact_bits(message: ParamSet | ParamValue) -> bytes:
    if isinstance(message, (_ExactParamSet, _ExactParamValue)):
        return message.bits
    if message.received_frame is None:
        return _FLOAT.pack(message.param_value)
    # ``param_value`` is the first field of both messages.
    return message.received_frame.body[HEADER_LENGTH : HEADER_LENGTH + 4].ljust(4, b"\0")


def _value_of(message: ParamSet | ParamValue, type_: ParameterType, bytewise: bool) -> int | float:
    if bytewise and type_ in _FORMATS:
        return int(_FORMATS[type_].unpack_from(_exact_bits(message))[0])
    number = message.param_value
    return int(number) if type_.is_integer and float(number).is_integer() else number


_INTEGER = re.compile(r"[+-]?[0-9]{1,999}")

_HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]{1,999}")

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def number_text(value: float) -> str:
    """Format a number with the fewest digits: ``0.1`` for the 32-bit float nearest to 0.1, ``3`` for 3.0.

    An int is formatted with all its digits.

    Raises:
        OverflowError: the number exceeds a 32-bit float.
        ValueError: the number is NaN.
    """
    if isinstance(value, int):
        return str(int(value))
    if value == int(value) and abs(value) < 1e9:  # Larger numbers get an exponent.
        return "-0.0" if str(value) == "-0.0" else str(int(value))  # int() would lose the sign of -0.0.
    number = to_float32(value)
    # Nine digits identify every 32-bit float.
    candidates = (f"{number:.{digits}g}" for digits in range(6, 10))
    return next(text for text in candidates if to_float32(float(text)) == number)


def parse_number(text: str) -> int | float:
    """Parse an int or a float. Raises ValueError for anything else, including NaN and infinities."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16)
    if not _DECIMAL.fullmatch(text):
        raise ValueError(text)
    number = float(text)
    if math.isinf(number):  # The text is for example "1e999".
        raise ValueError(text)
    return number


def number_or_none(value: object) -> int | float | None:
    """Parse a number. Return None for anything else."""
    if not isinstance(value, (int, float, str)):
        return None
    try:
        number = parse_number(str(value).strip())
        float(number)
        return number
    except (ValueError, OverflowError):  # OverflowError means that the number is too large for a float.
        return None
