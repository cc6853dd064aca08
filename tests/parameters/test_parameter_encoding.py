"""Parameter values in messages: ArduPilot's cast and PX4's bytes, bit by bit."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import ParamSet, ParamValue
from aerokit.parameters import Parameter, ParameterType, checked_value
from aerokit.parameters.encoding import parameter_of, set_message, value_message, value_of

SMALL = [ParameterType.UINT8, ParameterType.INT8, ParameterType.UINT16, ParameterType.INT16]
TYPES = [*SMALL, ParameterType.UINT32, ParameterType.INT32, ParameterType.REAL32]


@st.composite
def parameters(draw: st.DrawFn) -> Parameter:
    type_ = draw(st.sampled_from(TYPES))
    value: int | float = (
        draw(st.integers(int(type_.minimum), int(type_.maximum)))
        if type_.is_integer
        else draw(st.floats(width=32, allow_nan=False, allow_infinity=False))
    )
    return Parameter("SIXTEEN_LETTERS_", value, type_, None, draw(st.none() | st.integers(0, 65534)))


def transmitted(message: ParamValue | ParamSet) -> Frame:
    return Frame.parse(FrameEncoder(1, 1).encode(message))


@settings(max_examples=100)
@given(parameters())
@example(Parameter("SIGNALLING", -5_000_000, ParameterType.INT32))
@example(Parameter("SIGNALLING", 0x7F800001, ParameterType.UINT32))
@example(Parameter("QUIET", -1, ParameterType.INT32))
@example(Parameter("ZERO", 0, ParameterType.INT32))
def test_bytewise_encoding_is_exact(parameter: Parameter) -> None:
    sent = value_message(parameter, 900, bytewise=True)
    frame = transmitted(sent)
    assert parameter_of(ParamValue.decode_body(frame.body, frame), bytewise=True) == parameter
    assert parameter_of(sent, bytewise=True) == parameter
    order = set_message(1, 1, parameter.name, parameter.value, parameter.type, bytewise=True)
    frame = transmitted(order)
    received = ParamSet.decode_body(frame.body, frame)
    assert value_of(received, bytewise=True) == value_of(order, bytewise=True) == parameter.value
    assert received.param_type == parameter.type


@given(parameters())
def test_cast_encoding_keeps_float32_precision(parameter: Parameter) -> None:
    sent = value_message(parameter, 900, bytewise=False)
    assert sent.param_value == struct.unpack("<f", struct.pack("<f", parameter.value))[0]
    back = value_of(sent, bytewise=False)
    assert type(back) is type(parameter.value)
    if parameter.type in (*SMALL, ParameterType.REAL32):
        assert back == parameter.value


@given(parameters())
def test_bytewise_encoding_matches_c(parameter: Parameter) -> None:
    format_ = dict(zip(TYPES, "BbHhIif", strict=True))[parameter.type]
    payload = value_message(parameter, 900, bytewise=True).encode()
    assert struct.unpack_from("<" + format_, payload) == (parameter.value,)


def test_float_is_exact_except_signalling_nan() -> None:
    for value in (0, 1, -1, 2**31 - 1, -(2**31)):
        sent = value_message(Parameter("A", value, ParameterType.INT32), 1, bytewise=True)
        assert value_of(ParamValue("A", sent.param_value, 6, 1, 0), bytewise=True) == value
    assert type(set_message(1, 1, "A", 5, ParameterType.INT32, True)) is ParamSet


def test_invalid_received_value_is_returned() -> None:
    def received(value: float, type_: ParameterType, bytewise: bool) -> float:
        return value_of(ParamValue("X", value, int(type_), 1, 65535), bytewise)

    assert math.isnan(received(math.nan, ParameterType.INT8, False))
    assert received(1.5, ParameterType.INT8, False) == 1.5
    assert received(math.inf, ParameterType.REAL32, True) == math.inf
    message = ParamValue("X", math.nan, 0, 1, 65535)  # an unknown type
    assert parameter_of(message, True).type is ParameterType.REAL32
    assert parameter_of(message, True).index is None


def test_eight_byte_type_is_rejected() -> None:
    value = checked_value("X", 5, ParameterType.INT64)
    with pytest.raises(InvalidArgument, match="INT64"):
        set_message(1, 1, "X", value, ParameterType.INT64, bytewise=True)
    assert set_message(1, 1, "X", value, ParameterType.INT64, bytewise=False).param_value == 5.0


def test_number_too_large_for_message_is_rejected() -> None:
    with pytest.raises(InvalidArgument, match=r"1e\+300 cannot be sent"):
        set_message(1, 1, "X", 1e300, ParameterType.REAL64, bytewise=False)
