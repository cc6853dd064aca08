"""Metadata files of both autopilots in four formats, and PX4's hash."""

from __future__ import annotations

import json
import lzma
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.parameters import (
    Metadata,
    Parameter,
    ParameterMetadata,
    ParameterTable,
    ParameterType,
    load_metadata,
    parse_metadata,
)
from aerokit.parameters.pack import px4_hash

ARDUPILOT_XML = """<?xml version="1.0" encoding="utf-8"?>
<!-- made by hand -->
<paramfile>
  <vehicles>
    <parameters name="ArduCopter">
      <param humanName="Cone" name="ArduCopter:RTL_CONE_SLOPE" documentation="A cone &gt; home" user="Standard">
        <field name="Range">0 10.0</field>
        <field name="Increment">0.1</field>
        <values><value code="0">Disabled</value><value code="3">Steep</value></values>
      </param>
    </parameters>
  </vehicles>
  <libraries>
    <parameters name="LOG_">
      <param humanName="Backend" name="LOG_BACKEND_TYPE" documentation="Where to" user="Advanced">
        <field name="RebootRequired">True</field>
        <field name="Bitmask">0:File,1:MAVLink</field>
        <bitmask><bit code="0">File</bit><bit code="1">MAVLink</bit></bitmask>
      </param>
      <param humanName="Ground pressure" name="BARO1_GND_PRESS" documentation="" user="Advanced">
        <field name="Units">Pa</field>
        <field name="UnitText">pascal</field>
        <field name="ReadOnly">True</field>
        <field name="Volatile">True</field>
      </param>
      <param humanName="A second one" name="LOG_BACKEND_TYPE" documentation="of another frame" />
    </parameters>
  </libraries>
</paramfile>
"""

ARDUPILOT_JSON: dict[str, Any] = {
    "json": {"version": 0},
    "ArduCopter": {
        "RTL_CONE_SLOPE": {
            "Description": "A cone > home",
            "DisplayName": "Cone",
            "Increment": "0.1",
            "Range": {"high": "10.0", "low": "0"},
            "User": "Standard",
            "Values": {"0": "Disabled", "3": "Steep"},
        }
    },
    "LOG_": {
        "LOG_BACKEND_TYPE": {
            "Bitmask": {"0": "File", "1": "MAVLink"},
            "Description": "Where to",
            "DisplayName": "Backend",
            "RebootRequired": "True",
            "User": "Advanced",
        },
        "BARO1_GND_PRESS": {
            "DisplayName": "Ground pressure",
            "Description": "",
            "ReadOnly": "True",
            "Units": "Pa",
            "User": "Advanced",
            "Volatile": "True",
        },
    },
}

PX4_XML = """<?xml version='1.0' encoding='UTF-8'?>
<parameters>
  <version>3</version>
  <group name="Commander">
    <parameter name="COM_FLIGHT_UUID" default="0" type="INT32" volatile="true" category="System">
      <short_desc>Next flight UUID</short_desc>
      <min>0</min>
    </parameter>
    <parameter name="COM_ARM_CHK" default="3" type="INT32">
      <short_desc>Checks</short_desc>
      <long_desc>Which checks
</long_desc>
      <reboot_required>True</reboot_required>
      <bitmask><bit index="0">Battery</bit><bit index="1">GPS</bit></bitmask>
    </parameter>
  </group>
  <group name="Speed">
    <parameter name="MPC_XY_CRUISE" default="5.0" type="FLOAT">
      <short_desc>Cruise</short_desc>
      <min>3</min>
      <max>20</max>
      <unit>m/s</unit>
      <decimal>1</decimal>
      <increment>0.5</increment>
      <values><value code="-1">As fast as it can</value></values>
    </parameter>
  </group>
</parameters>
"""

PX4_JSON: dict[str, Any] = {
    "version": 1,
    "parameters": [
        {
            "category": "System",
            "default": 0,
            "group": "Commander",
            "min": 0,
            "name": "COM_FLIGHT_UUID",
            "shortDesc": "Next flight UUID",
            "type": "Int32",
            "volatile": True,
        },
        {
            "bitmask": [{"description": "Battery", "index": 0}, {"description": "GPS", "index": 1}],
            "category": "Standard",
            "default": 3,
            "group": "Commander",
            "longDesc": "Which checks\n",
            "name": "COM_ARM_CHK",
            "rebootRequired": True,
            "shortDesc": "Checks",
            "type": "Int32",
        },
        {
            "category": "Standard",
            "decimalPlaces": 1,
            "default": 5.0,
            "group": "Speed",
            "increment": 0.5,
            "max": 20.0,
            "min": 3.0,
            "name": "MPC_XY_CRUISE",
            "shortDesc": "Cruise",
            "type": "Float",
            "units": "m/s",
            "values": [{"description": "As fast as it can", "value": -1}],
        },
    ],
}


def test_ardupilot_metadata_files() -> None:
    metadata = parse_metadata(ARDUPILOT_XML.encode())
    assert list(metadata) == ["RTL_CONE_SLOPE", "LOG_BACKEND_TYPE", "BARO1_GND_PRESS"]
    assert repr(metadata) == "<Metadata of 3 parameters>"
    assert metadata["RTL_CONE_SLOPE"] == ParameterMetadata(
        "RTL_CONE_SLOPE",
        short_description="Cone",
        description="A cone > home",
        minimum=0,
        maximum=10,
        increment=0.1,
        values={0: "Disabled", 3: "Steep"},
        bitmask={},
        group="ArduCopter",
        category="Standard",
    )
    backend, pressure = metadata["LOG_BACKEND_TYPE"], metadata["BARO1_GND_PRESS"]
    assert (backend.short_description, backend.reboot_required) == ("Backend", True)
    assert (pressure.unit, pressure.read_only, pressure.volatile) == ("Pa", True, True)
    assert dict(parse_metadata(json.dumps(ARDUPILOT_JSON).encode())) == dict(metadata)


def test_px4_metadata_files(tmp_path: Path) -> None:
    data = json.dumps(PX4_JSON).encode()
    metadata = parse_metadata(data)
    assert metadata.volatile == {"COM_FLIGHT_UUID"}
    assert metadata.reboot_required(["COM_ARM_CHK", "MPC_XY_CRUISE", "UNKNOWN"]) == ("COM_ARM_CHK",)
    cruise = metadata["MPC_XY_CRUISE"]
    assert (cruise.default, cruise.decimal_places, cruise.unit, cruise.group) == (5.0, 1, "m/s", "Speed")
    assert dict(parse_metadata(PX4_XML.encode())) == dict(metadata)
    path = tmp_path / "parameters.json.xz"
    path.write_bytes(lzma.compress(data))
    assert dict(load_metadata(path)) == dict(load_metadata(str(path))) == dict(metadata)


def test_metadata_describes_values() -> None:
    metadata = {**parse_metadata(json.dumps(PX4_JSON).encode()), **parse_metadata(ARDUPILOT_XML.encode())}
    cruise, checks = metadata["MPC_XY_CRUISE"], metadata["COM_ARM_CHK"]
    assert cruise.describe(-1) == "As fast as it can"
    assert cruise.describe(7.5) == "7.5 m/s"
    assert [checks.describe(value) for value in (3, 4, 0, -1)] == ["Battery, GPS", "bit 2", "none", "-1"]
    assert metadata["RTL_CONE_SLOPE"].describe(3.0) == "Steep"


def test_px4_boolean_parameter_has_integer_values() -> None:
    xml = '<parameters><group name="G"><parameter name="A" boolean="true" type="INT32"/></group></parameters>'
    values = parse_metadata(xml.encode())["A"].values
    assert {str(value): text for value, text in values.items()} == {"0": "Disabled", "1": "Enabled"}


def test_metadata_checks_ranges() -> None:
    metadata = parse_metadata(json.dumps(PX4_JSON).encode())
    for name, value in {
        "MPC_XY_CRUISE": 20,
        "COM_FLIGHT_UUID": 1e9,
        "UNKNOWN": -5,
        "COM_ARM_CHK": 99,
    }.items():
        metadata.check(name, value)
    metadata.check("MPC_XY_CRUISE", -1)  # a named value below the minimum
    with pytest.raises(InvalidArgument, match=r"MPC_XY_CRUISE = 25 is not in 3\.\.20 m/s"):
        metadata.check("MPC_XY_CRUISE", 25)
    with pytest.raises(InvalidArgument, match=r"COM_FLIGHT_UUID = -1 is not in 0\.\."):
        metadata.check("COM_FLIGHT_UUID", -1)
    with pytest.raises(InvalidArgument, match="not a number"):
        metadata.check("MPC_XY_CRUISE", float("nan"))
    with pytest.raises(InvalidArgument, match="can only be read"):
        parse_metadata(ARDUPILOT_XML.encode()).check("BARO1_GND_PRESS", 1)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[]",
        b"{}",
        b"null",
        b"\xff\xfe\x00",
        b"<html></html>",
        b"<paramfile>",
        b"<paramfile/>",
        b'{"a": 1}',
        b'{"a": {"b": 1}}',
        b'{"parameters": [{"shortDesc": "nameless"}]}',
        b'{"parameters": [1]}',
        b"\xfd7zXZ\x00garbage",
        lzma.compress(b"[]"),
    ],
)
def test_other_files_are_rejected_as_metadata(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"some\.json"):
        load_metadata(path)


@given(st.binary(max_size=60))
def test_metadata_parses_noise_or_raises(data: bytes) -> None:
    with pytest.raises(FileFormatError):
        parse_metadata(data)


def test_metadata_from_other_sources() -> None:
    metadata = Metadata([ParameterMetadata("A", maximum=3), ParameterMetadata("A", maximum=9)])
    assert metadata["A"].maximum == 3
    assert len({metadata["A"], ParameterMetadata("A", maximum=3)}) == 1


# ---------------------------------------------------------------------------------------- PX4's hash


def crc32part(data: bytes, crc: int) -> int:
    """Compute the hash bit by bit from its definition."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


@given(st.dictionaries(st.text("ABC_", min_size=1, max_size=16), st.integers(-(2**31), 2**31 - 1)))
def test_px4_hash_is_crc_of_parameters(values: dict[str, int]) -> None:
    table = ParameterTable.from_values(values, dict.fromkeys(values, ParameterType.INT32))
    expected = 0
    for name in sorted(values):
        expected = crc32part(struct.pack("<i", values[name]), crc32part(name.encode(), expected))
    assert px4_hash(table) == expected


def test_px4_hash_ignores_volatile_parameters() -> None:
    kept = Parameter("MPC_XY_CRUISE", 5.0, ParameterType.REAL32)
    table = ParameterTable([kept, Parameter("COM_FLIGHT_UUID", 7, ParameterType.INT32)])
    volatile = parse_metadata(json.dumps(PX4_JSON).encode()).volatile
    assert px4_hash(table, volatile) == px4_hash(ParameterTable([kept])) != px4_hash(table)
    expected = crc32part(b"MPC_XY_CRUISE" + struct.pack("<f", 5.0), 0)
    assert px4_hash(table, volatile) == expected


def test_values_without_range_are_the_allowed_ones() -> None:
    entry = ParameterMetadata("FS_THR_ENABLE", values={0: "Disabled", 1: "Enabled always RTL"})
    assert entry.problem(1) is None
    assert entry.problem(99) == ("FS_THR_ENABLE = 99 is not a documented value: 0 Disabled, 1 Enabled always RTL")
    assert ParameterMetadata("FLAGS", values={0: "None"}, bitmask={0: "One", 1: "Two"}).problem(3) is None
