"""Parameter names, values, types and tables."""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument, ValueUnknownError
from aerokit.mavlink.enums import MavParamType
from aerokit.parameters import Parameter, ParameterTable, ParameterType, check_name, checked_value
from aerokit.parameters.parameter import same_value

INT8, INT32, REAL32 = ParameterType.INT8, ParameterType.INT32, ParameterType.REAL32


def test_parameter_types_match_standard() -> None:
    assert {t.name: t.value for t in ParameterType} == {t.name: t.value for t in MavParamType}
    assert ParameterType.from_wire(6) is INT32
    assert ParameterType.from_wire(0) is ParameterType.from_wire(77) is REAL32


@pytest.mark.parametrize(("type_", "format_"), list(zip(ParameterType, "BbHhIiQqfd", strict=True)))
def test_parameter_type_ranges(type_: ParameterType, format_: str) -> None:
    for value in (type_.minimum, type_.maximum):
        assert struct.unpack("<" + format_, struct.pack("<" + format_, value)) == (value,)
        beyond = value + (1 if value > 0 else -1) if type_.is_integer else value * 1.1
        with pytest.raises((struct.error, OverflowError)):
            assert not math.isfinite(struct.unpack("<" + format_, struct.pack("<" + format_, beyond))[0])
            raise OverflowError


@pytest.mark.parametrize("name", ["", "SEVENTEEN_LETTERS", "WP SPD", "WP_SPD\n", "GESCHWINDIGKEIT\N{DEGREE SIGN}", 5])
def test_check_name_rejects_invalid_names(name: Any) -> None:
    with pytest.raises(InvalidArgument, match="parameter name = "):
        check_name(name)


def test_check_name_accepts_valid_names() -> None:
    assert [check_name(name) for name in ("A", "_HASH_CHECK", "SIXTEEN_LETTERS_")]


@pytest.mark.parametrize(
    ("value", "type_", "text"),
    [
        (math.nan, REAL32, "finite"),
        (-math.inf, REAL32, "finite"),
        (1e39, REAL32, "must be in"),
        (10**400, REAL32, "must be in"),
        (math.nan, INT8, "finite"),
        (1.5, INT8, "whole"),
        (128, INT8, r"-128\.\.127"),
        (-1, ParameterType.UINT32, r"0\.\.4294967295"),
        ("5", INT8, "not a number"),
        (None, REAL32, "not a number"),
        (1j, REAL32, "not a number"),
    ],
)
def test_checked_value_rejects_invalid_values(value: Any, type_: ParameterType, text: str) -> None:
    with pytest.raises(InvalidArgument, match=rf"^X = .*{text}"):
        checked_value("X", value, type_)


def test_checked_value_converts_valid_values() -> None:
    assert checked_value("X", True, INT8) == 1
    assert type(checked_value("X", 3.0, INT8)) is int
    assert checked_value("X", 0.1, REAL32) == struct.unpack("<f", struct.pack("<f", 0.1))[0] != 0.1
    assert checked_value("X", 0.1, ParameterType.REAL64) == 0.1
    assert checked_value("X", Fraction(1, 2), REAL32) == 0.5  # type: ignore[arg-type]
    assert type(checked_value("X", 7, REAL32)) is float


@given(st.floats(width=32), st.floats(width=32))
def test_same_value_compares_as_float32(one: float, other: float) -> None:
    assert same_value(one, other) == (one == other or (one != one and other != other))
    assert same_value(one, one)


def test_same_value_of_numbers_equal_as_float32() -> None:
    assert same_value(0.1, struct.unpack("<f", struct.pack("<f", 0.1))[0])
    assert not same_value(2**24, 2**24 + 1)  # whole numbers are compared exactly
    assert not same_value(1e300, 1.0)
    assert not same_value(10**400, 1.0)  # too large for any float


TABLE = ParameterTable(
    [
        Parameter("B", 1, INT8, 0, 0),
        Parameter("A", 0.1, REAL32, checked_value("A", 0.1, REAL32), 1),
        Parameter("C", 7, INT32, None, 2),
    ]
)


def test_table_is_mapping_in_vehicle_order() -> None:
    assert list(TABLE) == ["B", "A", "C"]
    assert len(TABLE) == 3
    assert TABLE.values_by_name() == {"B": 1, "A": 0.1, "C": 7}
    assert TABLE.types_by_name()["C"] is INT32
    assert "A" in TABLE
    assert ParameterTable(TABLE.values()) == TABLE
    assert hash(TABLE) == hash(ParameterTable(TABLE.values()))
    assert dict(TABLE) != TABLE
    assert repr(TABLE) == "<ParameterTable: 3 parameters>"
    with pytest.raises(KeyError):
        TABLE["D"]


def test_table_changed_from_default() -> None:
    assert list(TABLE.changed_from_default()) == ["B"]
    assert not TABLE.has_defaults
    assert TABLE.without(["C"]).has_defaults
    assert not ParameterTable().changed_from_default()
    with pytest.raises(ValueUnknownError):
        TABLE.without("AB").changed_from_default()


def test_table_update_keeps_default_and_index() -> None:
    table = TABLE.updated_with([Parameter("B", 5, INT8), Parameter("D", 1.0, REAL32, None, 3)])
    assert list(table) == ["B", "A", "C", "D"]
    assert table["B"] == Parameter("B", 5, INT8, 0, 0)
    assert TABLE["B"].value == 1


def test_table_selection() -> None:
    assert list(TABLE.matching("[ab]")) == ["B", "A"]
    assert TABLE.by_index()[2].name == "C"
    shuffled = ParameterTable([Parameter("X", 1, INT8), TABLE["C"], TABLE["B"], TABLE["A"]])
    assert list(shuffled.in_order_of_index()) == ["B", "A", "C", "X"]
    assert ParameterTable.from_values({"X": 1, "Y": 2}, {"X": INT8})["Y"] == Parameter("Y", 2, REAL32, None, 1)
