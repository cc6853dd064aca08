"""Parameter files of three programs: reading, writing, damage and comparison."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.mavparm import MAVParmDict

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.parameters import (
    Parameter,
    ParameterTable,
    ParameterType,
    diff,
    parse_parameter_file,
    read_parameter_file,
    write_parameter_file,
)
from aerokit.parameters.encoding import number_text, parse_number
from aerokit.parameters.files import FileFormat, parameter_file_text
from aerokit.parameters.parameter import same_value, to_float32

FORMATS: tuple[FileFormat, ...] = ("missionplanner", "mavproxy", "qgroundcontrol")
NAMES = st.text("ABCXYZ019_", min_size=1, max_size=16)
FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)

QGC = """# Onboard parameters for Vehicle 1
#
# Stack: PX4 Pro
# Vehicle-Id Component-Id Name Value Type
1\t1\tBAT1_CAPACITY\t-1.000000000000000000\t9
1\t1\tCOM_RC_IN_MODE\t1\t6
1\t154\tGMB_GAIN\t0.25\t9
"""


@st.composite
def tables(draw: st.DrawFn) -> ParameterTable:
    rows = []
    for name in draw(st.lists(NAMES, min_size=1, max_size=20, unique=True)):
        type_ = draw(st.sampled_from(ParameterType))
        if type_.is_integer:
            rows.append(Parameter(name, draw(st.integers(int(type_.minimum), int(type_.maximum))), type_))
        else:
            rows.append(Parameter(name, draw(FLOATS), type_))
    return ParameterTable(rows)


@settings(max_examples=100)
@given(FLOATS)
def test_number_text_is_exact_and_short(value: float) -> None:
    text = number_text(value)
    assert to_float32(float(text)) == value
    assert struct.pack("<f", float(text)) == struct.pack("<f", value)  # compares the sign of zero as well
    assert len(text) <= 15


def test_number_text_of_common_numbers() -> None:
    numbers = [0.1, to_float32(0.1), 3.0, 100000.0, 1e-7, 1.5e20, -0.0, 2**31 - 1, 16777217, True]
    texts = ["0.1", "0.1", "3", "100000", "1e-07", "1.5e+20", "-0.0", "2147483647", "16777217", "1"]
    assert [number_text(number) for number in numbers] == texts


@pytest.mark.parametrize("text", ["nan", "inf", "-Infinity", "1_000", "1,5", "", "0x", "--1", "1e", ".", "٣"])
def test_parse_number_rejects_other_text(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - of whatever text
        parse_number(text)


@given(tables(), st.sampled_from(FORMATS))
def test_parameter_file_round_trip(table: ParameterTable, format_: FileFormat) -> None:
    if format_ != "qgroundcontrol":  # QGroundControl writes 32-bit numbers only
        small = (p for p in table.values() if p.type not in (ParameterType.UINT64, ParameterType.INT64))
        table = ParameterTable(small)
        if not table:
            return
    read = parse_parameter_file(parameter_file_text(table, format_, comments=["two", "lines"]))
    assert read.format == format_
    assert read.comments[:2] == ("two", "lines")
    assert read.keys() == table.keys()
    assert all(same_value(read[name], table[name].value) for name in table)
    integers = {name for name in table if table[name].type.is_integer}
    assert all(read[name] == table[name].value for name in integers)
    if format_ == "qgroundcontrol":
        assert read.types == table.types_by_name()
        assert all(type(read[name]) is int for name in integers)
        again = parameter_file_text(read, format_)
        assert again == parameter_file_text(table, format_)


@given(values=st.dictionaries(NAMES, FLOATS, min_size=1, max_size=10))
@pytest.mark.parametrize("format_", ["missionplanner", "mavproxy"])
def test_mavproxy_reads_our_parameter_file(
    values: dict[str, float], format_: FileFormat, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.param"
    write_parameter_file(path, values, format_, comments=["for MAVProxy"])
    oracle = MAVParmDict()
    oracle.load(str(path), use_excludes=False)
    assert {name: to_float32(value) for name, value in oracle.items()} == values


def test_parameter_file_of_mavproxy_is_read(tmp_path: Path) -> None:
    oracle = MAVParmDict()
    oracle.update({"WP_SPD": 5.0, "SIXTEEN_LETTERS_": -1.5, "LOG_BITMASK": 65535.0})
    path = tmp_path / "written.parm"
    oracle.save(str(path))
    read = read_parameter_file(path)
    assert dict(read) == dict(oracle)
    assert read.format == "mavproxy"


def test_mission_planner_parameter_file() -> None:
    text = "\ufeff#NOTE: 10/21/2026 Copter: hexa\r\nACRO_TRAINER,2\r\nINS_ACCSCAL_X,1.001269\r\nEMPTY_,0x1F # hex\r\n"
    read = parse_parameter_file(text.removeprefix("\ufeff"), "copter.param")
    assert dict(read) == {"ACRO_TRAINER": 2, "INS_ACCSCAL_X": 1.001269, "EMPTY_": 31}
    assert read.format == "missionplanner"
    assert read.comments == ("NOTE: 10/21/2026 Copter: hexa",)
    assert read.table()["ACRO_TRAINER"].type is ParameterType.REAL32
    assert repr(read) == "<ParameterFile: 3 parameters (missionplanner)>"


def test_parameter_file_with_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.param"
    path.write_bytes(b"\xef\xbb\xbfA,1\r\n")
    assert dict(read_parameter_file(path)) == dict(read_parameter_file(str(path))) == {"A": 1}


def test_qgroundcontrol_parameter_file() -> None:
    read = parse_parameter_file(QGC)
    assert dict(read) == {"BAT1_CAPACITY": -1.0, "COM_RC_IN_MODE": 1}
    assert read.types["COM_RC_IN_MODE"] is ParameterType.INT32
    assert read.component_id == 1
    assert "Stack: PX4 Pro" in read.comments
    assert dict(parse_parameter_file(QGC, component_id=154)) == {"GMB_GAIN": 0.25}
    with pytest.raises(FileFormatError, match="no parameters of component 7, only of: 1, 154"):
        parse_parameter_file(QGC, component_id=7)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("WP_SPD", "is not NAME,VALUE"),
        ("WP_SPD,", "is not NAME,VALUE"),
        ("WP_SPD,5,6", "is not NAME,VALUE"),
        ("WP_SPD,fast", "WP_SPD = 'fast' is not a finite number"),
        ("WP_SPD,nan", "not a finite number"),
        ("WP_SPD,1e400", "finite"),
        ("WP_SPD,1e39", "must be in"),
        ("SEVENTEEN_LETTERS,1", "17 characters"),
        ("GESCHW\N{LATIN CAPITAL LETTER A WITH DIAERESIS},1", "ASCII"),
        ("GOOD 2", "a second time"),
        ("@include other.parm", "@include"),
        ("WP_SPD 5 @READONLY", "@READONLY"),
        ("<html>", "is not NAME,VALUE"),
    ],
)
def test_parameter_file_error_names_line(line: str, text: str) -> None:
    with pytest.raises(FileFormatError, match=f"^my.param, line 3: .*{text}"):
        parse_parameter_file(f"# comment\nGOOD 1\n{line}\n", "my.param")


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("1\t1\tA\t5", "is not system id"),
        ("1\tone\tA\t5\t6", "is not system id"),
        ("A,5", "is not system id"),
        ("1\t1\tA\t5\t11", "type 11"),
        ("1\t1\tA\t5.5\t6", "whole number"),
        ("1\t1\tA\t300\t2", "-128..127"),
        ("1\t1\tCOM_RC_IN_MODE\t1\t6", "a second time"),
    ],
)
def test_qgroundcontrol_file_error_names_line(line: str, text: str) -> None:
    with pytest.raises(FileFormatError, match=f"line 8: .*{text}"):
        parse_parameter_file(f"{QGC}{line}\n")


def test_parameter_file_without_parameters_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "bad.param"
    path.write_bytes(b"\x00\xff\xfe")
    with pytest.raises(FileFormatError, match=r"bad\.param is not a parameter file"):
        read_parameter_file(path)
    path.write_text("# nothing\n")
    with pytest.raises(FileFormatError, match="contains no parameters"):
        read_parameter_file(path)
    with pytest.raises(FileNotFoundError):
        read_parameter_file(tmp_path / "none.param")


@given(st.text("A1,.# \t\n-e\x0b\u2028\0", max_size=40))
def test_parameter_file_parses_noise_or_raises(text: str) -> None:
    try:
        read = parse_parameter_file(text)
    except FileFormatError:
        return
    assert dict(parse_parameter_file(parameter_file_text(read, read.format))) == dict(read)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"SEVENTEEN_LETTERS": 1}, "17 characters"),
        ({"A,B": 1}, "comma"),
        ({"A": float("nan")}, "finite"),
        ({"A": 1e39}, "must be in"),
        ({"A": 2**40}, "must be in"),
        ({}, "no parameters"),
    ],
)
def test_invalid_parameter_writes_nothing(values: dict[str, Any], text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.param"
    write_parameter_file(path, {"OLD": 1})
    with pytest.raises(InvalidArgument, match=text):
        write_parameter_file(path, {"GOOD": 1, **values} if values else values)
    assert path.read_text() == "OLD,1\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.param"]


def test_unknown_parameter_file_format_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match="missionplanner, mavproxy or qgroundcontrol"):
        write_parameter_file(tmp_path / "a", {"A": 1}, format="xml")  # type: ignore[arg-type]


# ----------------------------------------------------------------------------------- differences


def test_parameter_diff() -> None:
    table = ParameterTable(
        [Parameter("A", to_float32(0.1), ParameterType.REAL32), Parameter("B", 5, ParameterType.INT8)]
    )
    differences = diff({"B": 6, "A": 0.1, "C": 1.25}, table)
    assert [str(difference) for difference in differences] == ["B: 6 → 5", "C: 1.25 → missing"]
    assert diff(table, table) == ()
    assert diff({"A": 1.0}, {"A": 1.05}, tolerance=0.1) == ()
    assert [difference.name for difference in diff({"A": 1}, {"B": 1, "C": 1})] == ["A", "B", "C"]
    assert [difference.name for difference in diff({"B": 4}, table, names={"B": 4})] == ["B"]
    assert str(diff({"A": float("nan")}, {"A": 1e300})[0]) == "A: nan → 1e+300"
    assert str(diff({"A": 10**309}, {"A": 1.5})[0]) == f"A: {10**309} → 1.5"


@given(tables())
def test_written_file_has_no_differences(table: ParameterTable) -> None:
    read = parse_parameter_file(parameter_file_text(table, "qgroundcontrol"))
    assert diff(read, table) == ()
