"""Hostile files raise documented errors within bounded memory and time."""

from __future__ import annotations

import itertools
import json
import lzma
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from for_each import for_each

from aerokit._internal.files import MAX_FILE_SIZE
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink import Dialect
from aerokit.missions import Mission, MissionItem, Plan, read_plan_file
from aerokit.missions.plan_file import format_plan, parse_plan
from aerokit.missions.waypoint_file import parse_waypoints
from aerokit.parameters import load_metadata, parse_metadata, parse_parameter_file, read_parameter_file

MEGABYTE = 1 << 20
BOMB = """<?xml version="1.0"?>
<!DOCTYPE paramfile [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
<paramfile><parameters name="&b;"/></paramfile>
"""


def px4(**changes: Any) -> bytes:
    entry = {"name": "MPC_XY_VEL_MAX", "shortDesc": "Fast", "min": 0, **changes}
    return json.dumps({"parameters": [entry]}).encode()


# ----------------------------------------------------------------------------------------- metadata


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 100_000,
        b'{"parameters": ' + b"[" * 100_000,
        b"[1, 2]",
        px4(name=["A"]),
        px4(name=None),
        px4(shortDesc=3),
        px4(values=3),
        px4(bitmask=[3]),
        b'{"GROUP": {"A": {"DisplayName": ["list"]}}}',
        b'{"GROUP": {"A": 3}}',
        BOMB.encode(),
        b"\xfd7zXZ\x00",
        lzma.compress(px4())[:-5],
    ],
    ids=lambda data: repr(data[:30]),
)
def test_invalid_metadata_is_rejected(data: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"^metadata "):
        parse_metadata(data)


@pytest.mark.parametrize("number", ["inf", "1e999", "nan", "9" * 5000, "0x" + "f" * 5000, 1e400, -1, 1.5, 64])
def test_metadata_ignores_invalid_bit(number: object) -> None:
    bitmask = [{"index": number, "description": "No bit"}, {"index": 3, "description": "A bit"}]
    assert parse_metadata(px4(bitmask=bitmask))["MPC_XY_VEL_MAX"].bitmask == {3: "A bit"}


@pytest.mark.parametrize("places", ["inf", 1e400, 1.5, "many", [1]])
def test_metadata_ignores_invalid_decimal_places(places: object) -> None:
    assert parse_metadata(px4(decimalPlaces=places))["MPC_XY_VEL_MAX"].decimal_places is None


@pytest.mark.parametrize("value", [float("inf"), float("nan"), -float("inf"), 1e300])
def test_metadata_describes_any_value(value: float) -> None:
    known = parse_metadata(px4(bitmask=[{"index": 1, "description": "A bit"}]))["MPC_XY_VEL_MAX"]
    assert isinstance(known.describe(value), str)


@pytest.mark.exhaustive
def test_decompression_bomb_is_rejected() -> None:
    packer = lzma.LZMACompressor(preset=0)
    zeros = bytes(MEGABYTE)
    bomb = b"".join((*(packer.compress(zeros) for _ in range(100)), packer.flush()))
    del zeros
    tracemalloc.start()
    try:
        with pytest.raises(FileFormatError, match=r"^metadata is too large: more than 16 MB"):
            parse_metadata(bomb)
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_FILE_SIZE
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("read", [load_metadata, read_parameter_file, read_plan_file, Dialect.from_xml])
def test_large_file_is_rejected(read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(MAX_FILE_SIZE + 1)
    with pytest.raises(FileFormatError, match=r"large is too large: more than 16 MB"):
        read(path)


# ------------------------------------------------------------------------------- parameters, plans


@pytest.mark.parametrize("value", ["nan", "inf", "1e999", "9" * 5000, "0x" + "f" * 5000, "1e39"])
def test_parameter_file_rejects_impossible_value(value: str) -> None:
    with pytest.raises(FileFormatError, match=r"line 2"):
        parse_parameter_file(f"RTL_ALT,1500\nRTL_SPEED,{value}\n")


def nested_plan(depth: int) -> str:
    unknown = "[" * depth + "]" * depth
    return json.dumps({"fileType": "Plan", "version": 1, "rallyPoints": {"points": [], "version": 2}})[:-1] + (
        f', "groundStation": {unknown}}}'
    )


def test_deeply_nested_plan_is_rejected() -> None:
    with pytest.raises(FileFormatError):
        parse_plan(nested_plan(100_000))


def test_plan_error_shortens_deep_or_large_value() -> None:
    deep = "[" * 300 + "]" * 300
    with pytest.raises(FileFormatError, match=r"fileType = \[{37}\.\.\.: expected"):
        parse_plan(f'{{"fileType": {deep}}}')


def deepest_plan() -> Plan:
    for depth in range(2_000 if sys.version_info < (3, 12) else 100_000, 0, -1 if sys.version_info < (3, 12) else -100):
        try:
            return parse_plan(nested_plan(depth))
        except FileFormatError:
            continue
    raise AssertionError("no plan can be read")


def test_deeply_nested_plan_cannot_be_written() -> None:
    with pytest.raises(InvalidArgument):
        format_plan(deepest_plan())


# ----------------------------------------------------------------------------------------- dialects


def dialect(body: str) -> str:
    return f'<?xml version="1.0"?><mavlink>{body}</mavlink>'


def message(body: str, name: str = "WINCH", attributes: str = "") -> str:
    return dialect(f'<messages><message id="52000" name="{name}" {attributes}>{body}</message></messages>')


def entries(*values: str, name: str = "E") -> str:
    rows = "".join(f'<entry name="{name}_{i}" value="{value}"/>' for i, value in enumerate(values))
    return dialect(f'<enums><enum name="{name}">{rows}</enum></enums>')


FIELD = '<field type="uint8_t" name="a">Text</field>'


def test_enum_values_must_fit_64_bits(tmp_path: Path) -> None:
    highest = (1 << 64) - 1
    values = (
        "0**64",
        "1&lt;&lt;63",
        f"{highest}**1",
        f"{highest}&lt;&lt;0",
        str(highest),
        str(-(1 << 63)),
        "0**0",
    )
    path = tmp_path / "own.xml"
    path.write_text(entries(*values))
    loaded = Dialect.from_xml(path).enum("E")
    assert {member.value for member in loaded.__members__.values()} == {0, 1 << 63, highest, -(1 << 63), 1}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (message(FIELD + FIELD), "WINCH: the field a is defined twice"),
        (message('<field type="int8_t" name="from"/><field type="int8_t" name="from_"/>'), "defined twice"),
        (message('<field type="uint8_t[0]" name="a"/>'), "unknown field type"),
        (message(f'<field type="uint8_t[{"9" * 5000}]" name="a"/>'), "unknown field type"),
        (message('<field type="uint8_t[999]" name="a"/>'), "at most 255 fit"),
        (message(FIELD, name="A&#10;B"), "is not a name"),
        (entries("1&lt;&lt;99999999999"), "is not a valid enum value"),
        (entries("9**99999999999"), "is not a valid enum value"),
        (entries("2**-1"), "is not a valid enum value"),
        (entries("2**65"), "is not a valid enum value"),
        (entries("1&lt;&lt;65"), "is not a valid enum value"),
        (entries("1&lt;&lt;64"), "exceeds 64 bits"),
        (entries(f"{1 << 64}**0"), "is not a valid enum value"),
        (entries("0x1" + "0" * 20), "exceeds 64 bits"),
        (entries(str(1 << 64)), "exceeds 64 bits"),
        (entries(str(-(1 << 63) - 1)), "exceeds 64 bits"),
        (entries("9" * 5000), "is not a MAVLink dialect"),
        (dialect('<enums><enum name="E"><entry name="E_A"/><entry name="E_A"/></enum></enums>'), "enum E of"),
        (dialect('<enums><enum name="E"><entry name="E__X_"/></enum></enums>'), "enum E of"),
        (dialect(f"<include>{'a' * 5000}</include>"), "which is in none of these folders"),
        (dialect("<include/>"), "which is in none of these folders"),
        ('<?xml version="1.0" encoding="nonsense"?><mavlink/>', "is not a MAVLink dialect"),
        (BOMB, "is not a MAVLink dialect"),
        ("", "is not a MAVLink dialect"),
    ],
    ids=lambda text: text[-60:],
)
def test_invalid_dialect_is_rejected(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "private.xml"
    path.write_text(text)
    with pytest.raises(InvalidArgument, match=complaint):
        Dialect.from_xml(path)


MESSAGE_NAMES = ("NONE", "TRUE", "FALSE", "STRUCT", "MESSAGE", "FRAME")
FIELD_NAMES = ("tuple", "bytes", "values", "body", "frame", "None", "struct")


@for_each("name, field", list(itertools.product(MESSAGE_NAMES, FIELD_NAMES)))
def test_dialect_with_reserved_names(name: str, field: str, tmp_path: Path) -> None:
    path = tmp_path / "private.xml"
    path.write_text(message(f'<field type="uint8_t" name="{field}"/><field type="int16_t[5]" name="b"/>', name=name))
    (winch,) = Dialect.from_xml(path)
    attribute = winch.FIELDS[0].name
    made = winch(**{attribute: 3, "b": (1, 2, 3, 4, 5)})
    assert name == made.NAME
    assert winch.decode(made.encode()) == made


def test_dialect_keeps_control_characters_in_texts(tmp_path: Path) -> None:
    path = tmp_path / "private.xml"
    path.write_text(message('<field type="uint8_t" name="a" units="m&#10;s&quot;\\" invalid="&#13;&#9;">T</field>'))
    (winch,) = Dialect.from_xml(path)
    assert (winch.FIELDS[0].units, winch.FIELDS[0].invalid) == ('m\ns"\\', "\r\t")


def test_dialect_with_empty_enum(tmp_path: Path) -> None:
    path = tmp_path / "private.xml"
    path.write_text(dialect('<enums><enum name="EMPTY"/></enums>'))
    assert Dialect.from_xml(path).enum("EMPTY").__members__ == {}


# ----------------------------------------------------------------------------------------- huge numbers


@pytest.mark.parametrize("columns", ["1\t1\tA\t5\t{}", "1\t{}\tA\t5\t9", "{}\t1\tA\t5\t9"])
def test_parameter_file_with_thousands_of_digits_is_rejected(columns: str) -> None:
    with pytest.raises(FileFormatError, match="line 1"):
        parse_parameter_file(columns.format("1" * 5000))


def test_huge_local_coordinate_in_waypoint_file_fails_the_check() -> None:
    mission = parse_waypoints("QGC WPL 120\n0\t0\t1\t16\t0\t0\t0\t0\t1e305\t0\t0\t1\n")
    with pytest.raises(InvalidArgument, match=r"x = 1e\+305"):
        mission.check()


def test_huge_number_in_metadata_is_ignored() -> None:
    parsed = parse_metadata(px4(max="9" * 400, values=[{"value": "9" * 400, "description": "x"}]))
    assert parsed["MPC_XY_VEL_MAX"].maximum is None
    with pytest.raises(InvalidArgument, match=r"-1 is not in 0\.\."):
        parsed.check("MPC_XY_VEL_MAX", -1)


def test_mission_with_huge_parameter_can_be_compared() -> None:
    huge, small = (Mission([MissionItem(93, 2, param1)]) for param1 in (1e39, 1.0))
    assert huge.differences(small) == ("item 0 (NAV_DELAY): param1 is 1.0 instead of 1e+39",)
