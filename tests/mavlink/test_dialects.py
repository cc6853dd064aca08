"""Dialects: the standard one, and those loaded from XML files and pymavlink modules."""

from __future__ import annotations

import enum
import math
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from wire_samples import for_peer, samples

from aerokit.errors import InvalidArgument
from aerokit.mavlink import STANDARD, Dialect, FrameEncoder, Framer, Message, enums, messages
from aerokit.mavlink.generator import xml_folder

PRIVATE = """<?xml version="1.0"?>
<mavlink>
  <include>{include}</include>
  <enums>
    <enum name="WINCH_STATE">
      <description>What the winch does.</description>
      <entry value="0" name="WINCH_STATE_IDLE"><description>Nothing.</description></entry>
      <entry value="0x10" name="WINCH_STATE_3_METERS"/>
      <entry value="1&lt;&lt;5" name="WINCH_STATE_NONE"/>
      <entry name="WINCH_STATE_NEXT"/>
    </enum>
    <enum name="WINCH_FLAGS" bitmask="true">
      <entry value="0b1" name="WINCH_FLAGS_A"/>
      <entry value="2**3" name="WINCH_FLAGS_B"/>
    </enum>
    <enum name="MAV_CMD">
      <entry value="60000" name="MAV_CMD_WINCH_DROP"/>
    </enum>
  </enums>
  <messages>
    <message id="{id}" name="WINCH_REPORT">
      <description>How the winch is.</description>
      <field type="uint8_t" name="from" enum="WINCH_STATE">Before.</field>
      <field type="double" name="length" units="m" invalid="NaN">Rope out.</field>
      <field type="int16_t[3]" name="forces">Forces.</field>
      <field type="uint8_t[4]" name="serial">Serial number.</field>
      <field type="char[5]" name="name">Name.</field>
      <field type="uint16_t" name="encode">A name that the class needs itself.</field>
      <extensions/>
      <field type="float[6]" name="history">History.</field>
      <field type="char" name="letter">One letter.</field>
    </message>
  </messages>
</mavlink>
"""


def write(folder: Path, name: str = "private.xml", text: str = PRIVATE, **fields: Any) -> Path:
    path = folder / name
    path.write_text(text.format(**{"include": "common.xml", "id": 60_001, **fields}))
    return path


# ---------------------------------------------------------------------------------------- from XML


def test_private_dialect_includes_standard(tmp_path: Path) -> None:
    dialect = Dialect.from_xml(write(tmp_path))
    assert dialect.name == "private"
    assert len(dialect) > 200
    assert 60_001 in dialect
    assert dialect[0] is messages.Heartbeat, "the standard's messages are the standard's classes"
    assert repr(dialect) == f"<Dialect 'private': {len(dialect)} messages>"


def test_include_beside_file_takes_precedence(tmp_path: Path) -> None:
    text = one_message(7, "OWN", "float")
    (tmp_path / "common.xml").write_text(text)
    dialect = Dialect.from_xml(str(write(tmp_path)))
    assert [cls.NAME for cls in dialect] == ["OWN", "WINCH_REPORT"]


def test_circular_includes_are_read_once(tmp_path: Path) -> None:
    write(tmp_path, "a.xml", include="b.xml", id=60_001)
    text = "<mavlink><include>a.xml</include></mavlink>"
    (tmp_path / "b.xml").write_text(text)
    assert [cls.ID for cls in Dialect.from_xml(tmp_path / "a.xml")] == [60_001]


@pytest.fixture
def private(tmp_path: Path) -> Dialect:
    return Dialect.from_xml(write(tmp_path))


def winch(private: Dialect, **changes: Any) -> Any:
    fields = {
        "from_": 16,
        "length": 1.5,
        "forces": (1, -2, 3),
        "serial": b"\1\2\3\4",
        "name": "drum",
        "encode_": 9,
    }
    return private[60_001](**{**fields, **changes})


def test_private_message_class_like_generated(private: Dialect) -> None:
    message = winch(private)
    assert private.by_name("WINCH_REPORT") is private[60_001]
    assert (message.NAME, message.ID, type(message).__name__) == ("WINCH_REPORT", 60_001, "WinchReport")
    assert (message.LENGTH, message.BASE_LENGTH) == (51, 26)
    assert message.history == (0,) * 6
    assert message.letter == ""
    assert message == winch(private)
    assert message != winch(private, length=math.nan)
    assert repr(message).startswith(
        "WinchReport(from_=16, length=1.5, forces=(1, -2, 3), serial=b'\\x01\\x02\\x03\\x04'"
    )
    assert message.to_dict()["encode_"] == 9
    assert (type(message).__doc__ or "").startswith("WINCH_REPORT (60001): How the winch is.")
    fields = {field.name: field for field in message.FIELDS}
    assert (fields["length"].units, fields["length"].invalid, fields["from_"].enum) == (
        "m",
        "NaN",
        "WINCH_STATE",
    )
    assert [name for name, field in fields.items() if field.extension] == ["history", "letter"]


def test_fields_after_default_are_keyword_only(tmp_path: Path) -> None:
    """The field mavlink_version has a fixed value; a private message may have such a field at the front."""
    fields = "".join(
        f'<field type="{kind}" name="{name}">N.</field>'
        for kind, name in (("uint8_t_mavlink_version", "version"), ("uint8_t", "one"), ("uint8_t", "two"))
    )
    path = tmp_path / "versioned.xml"
    path.write_text(f'<mavlink><messages><message id="7" name="MINE">{fields}</message></messages></mavlink>')
    mine: Any = Dialect.from_xml(path)[7]
    assert (mine(one=1, two=2).version, mine(4, one=1, two=2).version) == (3, 4)
    assert mine(one=1, two=2).encode() == b"\3\1\2"
    with pytest.raises(TypeError, match="positional argument"):
        mine(3, 1, 2)


def test_private_message_round_trip(private: Dialect) -> None:
    message = winch(private, history=(0.5,) * 6, letter="x")
    raw = FrameEncoder(1, 1).encode(message)
    (frame,) = Framer(private).receive(raw)
    decoded = private.decode(frame)
    assert decoded == message
    assert decoded.received_frame is frame
    assert Framer().receive(raw) == [], "it is not in the standard"


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"from_": 256}, "WINCH_REPORT.from_ = 256 cannot be sent: must be in 0..255"),
        ({"forces": (1, 2, 3, 4)}, "has 4 elements, at most 3 fit"),
        ({"serial": b"12345"}, "has 5 elements, at most 4 fit"),
        ({"name": "longer"}, "has 6 bytes, at most 5 fit"),
        ({"letter": "xy"}, "has 2 bytes, at most 1 fit"),
        ({"history": ("a",)}, "must be a number"),
        ({"length": "long"}, "must be a number"),
    ],
)
def test_private_message_error_names_field(private: Dialect, changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InvalidArgument, match=complaint.replace(".", r"\.")):
        winch(private, **changes).encode()


def test_private_enums(private: Dialect) -> None:
    state = private.enum("WINCH_STATE")
    assert issubclass(state, enum.IntEnum)
    assert {member.name: member.value for member in state} == {
        "IDLE": 0,
        "STATE_3_METERS": 16,
        "NONE": 32,
        "NEXT": 33,
    }
    flags: Any = private.enum("WINCH_FLAGS")
    assert issubclass(flags, enum.IntFlag)
    assert [member.value for member in flags] == [1, 8]


def test_private_entries_extend_standard_enum(private: Dialect) -> None:
    commands = private.enum("MAV_CMD")
    assert commands.WINCH_DROP == 60_000
    assert commands.NAV_TAKEOFF == enums.MavCmd.NAV_TAKEOFF


def one_message(id: object, name: str, type: str) -> str:  # noqa: A002
    field = f'<field type="{type}" name="a"/>'
    return f'<mavlink><messages><message id="{id}" name="{name}">{field}</message></messages></mavlink>'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("<mavlink", "is not a MAVLink dialect"),
        (
            '<mavlink><messages><message name="X"/></messages></mavlink>',
            "is not a MAVLink dialect: KeyError('id')",
        ),
        (one_message(1, "X", "int"), "unknown field type 'int'"),
        (one_message(1, "import os", "float"), "'import os' is not a name of letters"),
        (one_message(1 << 24, "X", "float"), "message id 16777216 is not in 0..16777215"),
        (one_message(1, "X", "double[32]"), "the payload has 256 bytes, but at most 255 fit in a frame"),
        (
            "<mavlink><include>nowhere.xml</include></mavlink>",
            "includes nowhere.xml, which is in none of these folders",
        ),
    ],
)
def test_invalid_dialect_file_is_rejected(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "wrong.xml"
    path.write_text(text)
    with pytest.raises(InvalidArgument) as caught:
        Dialect.from_xml(path)
    assert complaint in str(caught.value)
    assert "wrong.xml" in str(caught.value)


def test_missing_dialect_file_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"no dialect file .*nowhere\.xml"):
        Dialect.from_xml(tmp_path / "nowhere.xml")


def test_duplicate_message_id_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument) as caught:
        Dialect.from_xml(write(tmp_path, id=30))
    text = str(caught.value)
    assert text == "message id 30 is defined twice in private: ATTITUDE in common, WINCH_REPORT in private"


# -------------------------------------------------------------------------------- pymavlink's modules

DIALECTS = ("all", "matrixpilot", "paparazzi")  # the first includes all other dialects of pymavlink


@cache
def loaded(name: str) -> tuple[ModuleType, Dialect]:
    module = import_module(f"pymavlink.dialects.v20.{name}")
    return module, Dialect.from_pymavlink(module)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", DIALECTS)
def test_pymavlink_dialect_equals_xml_dialect(name: str) -> None:
    module, dialect = loaded(name)
    xml = Dialect.from_xml(xml_folder() / f"{name}.xml")
    assert {cls.ID: cls.CRC_EXTRA for cls in dialect} == {i: cls.crc_extra for i, cls in module.mavlink_map.items()}
    assert dialect.rows == xml.rows
    for one, other in zip(dialect, xml, strict=True):
        assert one.NAME == other.NAME
        assert vars(one)["__match_args__"] == vars(other)["__match_args__"]
        assert [field.extension for field in one.FIELDS] == [field.extension for field in other.FIELDS]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", DIALECTS)
def test_private_message_bytes_match_pymavlink(name: str) -> None:
    module, dialect = loaded(name)
    own = [cls for cls in dialect if cls is not STANDARD.get(cls.ID)]
    assert own
    for message_class in own:
        for message in samples(message_class, 3):
            raw = FrameEncoder(7, 42).encode(message)
            assert raw == peer_bytes(module, message)
            (frame,) = Framer(dialect).receive(raw)
            assert dialect.decode(frame) == message


def peer_bytes(module: ModuleType, message: Message) -> bytes:
    values = {field.name: for_peer(field, getattr(message, field.name)) for field in message.FIELDS}
    theirs = module.mavlink_map[message.ID](**values)
    return bytes(theirs.pack(module.MAVLink(None, 7, 42)))


@pytest.mark.parametrize("name", ["storm32", "pymavlink.dialects.v20.storm32"])
def test_pymavlink_dialect_by_name(name: str) -> None:
    dialect = Dialect.from_pymavlink(name)
    assert dialect.name == "storm32"
    assert dialect.by_name("QSHOT_STATUS").ID == 60020
    assert dialect.enum("MAV_CMD").QSHOT_DO_CONFIGURE == 60020


def test_private_pymavlink_module_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "private_dialect.py").write_text(
        "from pymavlink.dialects.v20.test import *\nfrom pymavlink.dialects.v20.test import mavlink_map, enums\n"
    )
    assert [cls.NAME for cls in Dialect.from_pymavlink("private_dialect")] == ["TEST_TYPES"]


@pytest.mark.parametrize("name", ["nowhere", "nowhere.at.all", "pymavlink.dialects.v20.nowhere"])
def test_missing_pymavlink_module_is_rejected(name: str) -> None:
    with pytest.raises(InvalidArgument, match=f"no pymavlink dialect '{name}'"):
        Dialect.from_pymavlink(name)


def test_other_module_is_rejected_as_dialect() -> None:
    with pytest.raises(InvalidArgument, match=r"pymavlink\.mavutil is not a pymavlink dialect: it has no mavlink_map"):
        Dialect.from_pymavlink("pymavlink.mavutil")


def test_pymavlink_module_import_error_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "broken_dialect.py").write_text("import a_module_that_is_not_there\n")
    with pytest.raises(ModuleNotFoundError, match="a_module_that_is_not_there"):
        Dialect.from_pymavlink("broken_dialect")


def test_missing_module_with_similar_name_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "absent_module_dialect.py").write_text("import absent_module\n")
    with pytest.raises(ModuleNotFoundError, match="absent_module"):
        Dialect.from_pymavlink("absent_module_dialect")


# -------------------------------------------------------------------------------- combined dialects


def test_dialect_extended_by(tmp_path: Path) -> None:
    (tmp_path / "empty.xml").write_text("<mavlink/>")
    private = Dialect.from_xml(write(tmp_path, include="empty.xml"))
    both = STANDARD.extended_by(private)
    assert both.name == "standard+private"
    assert len(both) == len(STANDARD) + 1
    assert both[0] is messages.Heartbeat
    assert both[60_001] is private[60_001]
    assert both.get(60_002) is None
    assert 60_001 not in STANDARD
    assert both.by_name("WINCH_REPORT") is private[60_001]
    assert both.by_name("HEARTBEAT") is messages.Heartbeat
    assert both.enum("WINCH_STATE") is private.enum("WINCH_STATE")
    assert both.enum("MAV_RESULT") is enums.MavResult
    (frame,) = Framer(both).receive(FrameEncoder(1, 1).encode(winch(private)))
    assert both.decode(frame) == winch(private)
    assert sorted(cls.ID for cls in both) == sorted([*STANDARD.rows, 60_001])


def test_extended_dialect_merges_enums(private: Dialect) -> None:
    both = STANDARD.extended_by(private)
    commands = both.enum("MAV_CMD")
    assert (commands.WINCH_DROP, commands.NAV_TAKEOFF) == (60_000, 22)
    assert commands.DO_SET_RESUME_REPEAT_DIST == 215, "ArduPilot's message, which is not in the private dialect"
    assert commands is both.enum("MAV_CMD")
    assert both.enum("MAV_RESULT") is enums.MavResult, "nothing was added"
    assert both.enum("WINCH_FLAGS") is private.enum("WINCH_FLAGS")


@pytest.mark.parametrize("name", ["ardupilotmega", "development"])
def test_message_with_fewer_extensions_uses_standard_class(name: str) -> None:
    """Pymavlink's MISSION_ACK lacks ``opaque_id``; a program that loads its dialect still gets one class."""
    module, dialect = loaded(name)
    assert "opaque_id" not in module.mavlink_map[messages.MissionAck.ID].fieldnames
    assert dialect[messages.MissionAck.ID] is messages.MissionAck
    both = STANDARD.extended_by(dialect)
    (frame,) = Framer(both).receive(FrameEncoder(1, 1).encode(messages.MissionAck(255, 190, 0, 0, 77)))
    assert both.decode(frame) == messages.MissionAck(255, 190, 0, opaque_id=77)


def test_conflicting_dialects_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "empty.xml").write_text("<mavlink/>")
    private = Dialect.from_xml(write(tmp_path, include="empty.xml", id=30))
    with pytest.raises(InvalidArgument) as caught:
        STANDARD.extended_by(private)
    assert "message id 30 is ATTITUDE (CRC_EXTRA 39, 28 bytes) in 'standard', but WINCH_REPORT" in str(caught.value)


# ------------------------------------------------------------------------------------- the standard


def test_standard_dialect_lookup() -> None:
    assert STANDARD.name == "standard"
    assert len(STANDARD) == len(list(STANDARD)) == 340
    assert [cls.ID for cls in STANDARD] == sorted(STANDARD.rows)
    assert STANDARD.get(33) is messages.GlobalPositionInt
    assert STANDARD.get(16_000_000) is None
    assert 16_000_000 not in STANDARD
    assert STANDARD.by_name("GLOBAL_POSITION_INT") is messages.GlobalPositionInt
    assert STANDARD.enum("MAV_CMD") is enums.MavCmd
    with pytest.raises(KeyError):
        STANDARD[16_000_000]
    with pytest.raises(InvalidArgument, match="dialect 'standard' has no message 'NOPE'"):
        STANDARD.by_name("NOPE")
    with pytest.raises(InvalidArgument, match="dialect 'standard' has no enum 'NOPE'"):
        STANDARD.enum("NOPE")


def test_decode_of_unknown_message_raises_key_error(private: Dialect) -> None:
    (frame,) = Framer(private).receive(FrameEncoder(1, 1).encode(winch(private)))
    with pytest.raises(KeyError):
        STANDARD.decode(frame)


def test_enum_member_names() -> None:
    assert enums.MavCmd.NAV_TAKEOFF.value == 22
    assert enums.MavResult.ACCEPTED.value == 0
    assert enums.GpsFixType.TYPE_3D_FIX.value == 3
    assert issubclass(enums.MavModeFlag, enum.IntFlag)
    assert enums.MavModeFlag(0x81) == enums.MavModeFlag.SAFETY_ARMED | enums.MavModeFlag.CUSTOM_MODE_ENABLED
    assert enums.MavCmd.__doc__ is not None


@pytest.mark.parametrize("package", [messages, enums])
def test_generated_packages_are_lazy(package: ModuleType) -> None:
    assert set(package.__all__) <= set(dir(package))
    assert len(dir(package)) == len(set(dir(package)))
    assert all(getattr(package, name).__name__ == name for name in package.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'Nope'"):
        package.Nope  # noqa: B018


def test_char_arrays_with_bytes_in_any_dialect(tmp_path: Path) -> None:
    """A dialect's message with an additional field gets a class of its own."""
    own = """<?xml version="1.0"?><mavlink><messages><message id="324" name="PARAM_EXT_ACK">
        <field type="char[16]" name="param_id">Name.</field><field type="char[128]" name="param_value">V.</field>
        <field type="uint8_t" name="param_type">T.</field><field type="uint8_t" name="param_result">R.</field>
        <field type="uint16_t" name="own">Own.</field></message></messages></mavlink>"""
    path = tmp_path / "own.xml"
    path.write_text(own)
    ack: Any = Dialect.from_xml(path)[324]
    assert ack is not messages.ParamExtAck
    decoded = ack.decode(ack(param_id="A", param_value=b"\0\1", param_type=3, param_result=0, own=7).encode())
    assert decoded.to_dict()["param_value"] == b"\0\1".ljust(128, b"\0")
