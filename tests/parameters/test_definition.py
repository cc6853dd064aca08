"""Camera definition files: parsing, exclusions, and valid values of a setting."""

from __future__ import annotations

import lzma
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit._internal.files import MAX_FILE_SIZE
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavParamExtType
from aerokit.parameters import CameraDefinition, SettingValue, load_definition, parse_definition
from aerokit.parameters.parameter import checked_setting, setting_bytes, setting_value, settings_equal
from aerokit.sim import components

OWN = Path(components.__file__).with_name("camera_definition.xml")
CAMERA = load_definition(OWN)
VIDEO_BY_HAND = {"CAM_MODE": 1, "CAM_EXPMODE": 1, "CAM_VIDRES": 0}


def xml(parameters: str, more: str = "") -> bytes:
    text = f'<?xml version="1.0"?><mavlinkcamera><parameters>{parameters}</parameters>{more}</mavlinkcamera>'
    return text.encode()


def of(parameters: str, more: str = "") -> CameraDefinition:
    return parse_definition(xml(parameters, more))


def refusal(camera: CameraDefinition, name: str, value: object, **values: SettingValue) -> str:
    with pytest.raises(InvalidArgument) as caught:
        camera.checked(name, value, values)
    return str(caught.value)


# ----------------------------------------------------------------------------------------- reading


def test_definition_file_is_parsed() -> None:
    assert (CAMERA.vendor, CAMERA.model, CAMERA.version) == ("aerokit", "Simulated camera", 1)
    assert repr(CAMERA) == "<CameraDefinition of aerokit Simulated camera: 12 settings>"
    ev = CAMERA.settings["CAM_EV"]
    assert (ev.type, ev.wire_type, ev.description) == ("float", MavParamExtType.REAL32, "Brighter or darker")
    assert (ev.default, ev.minimum, ev.maximum, ev.step) == (0.0, -3, 3, 0.5)
    mode = CAMERA.settings["CAM_MODE"]
    assert (mode.updates, mode.is_control) == (("CAM_ISO", "CAM_SHUTTER"), False)
    assert [(option.name, option.value, option.excludes) for option in mode.options] == [
        ("Photo", 0, ("CAM_VIDRES",)),
        ("Video", 1, ("CAM_QUALITY",)),
    ]
    assert CAMERA.settings["CAM_STAMP"].default is False
    assert CAMERA.settings["CAM_LENS"].read_only
    pin = of('<parameter name="PIN" type="uint32" writeonly="1" control="0"/>').settings["PIN"]
    assert (pin.write_only, pin.read_only, pin.is_control) == (True, False, False)


def test_definition_file_may_be_compressed(tmp_path: Path) -> None:
    path = tmp_path / "camera.xml.xz"
    path.write_bytes(lzma.compress(OWN.read_bytes()))
    assert load_definition(path) == CAMERA


def test_definition_translations() -> None:
    for locale in ("de_DE", "de", "de_CH"):
        german = CAMERA.localized(locale).settings["CAM_WBMODE"]
        assert german.description == "Weißabgleich"
        assert [option.name for option in german.options] == ["Auto", "Sonnig", "Bewölkt"]
    assert CAMERA.localized("fr_FR") is CAMERA
    assert CAMERA.localized("de").checked("CAM_WBMODE", "Sonnig", {}) == 4


def test_invalid_definitions_are_ignored() -> None:
    camera = of(
        """<parameter name="A" type="uint8" default="300" min="low" max="nan" step="">
             <options><option name="big" value="999"/><option name="none"/><option name="x" value="x"/>
               <option name="one" value="1"><parameterranges>
                 <parameterrange parameter="NOWHERE"><roption name="1" value="1"/></parameterrange>
                 <parameterrange parameter="B" condition="A"><roption name="1" value="1"/></parameterrange>
                 <parameterrange parameter="B" condition="A=1 AND"><roption name="1" value="1"/></parameterrange>
               </parameterranges></option></options></parameter>
           <parameter type="uint8"/><parameter name="C" type="struct"/>
           <parameter name="B" type="int8"/><parameter name="B" type="float"/>"""
    )
    assert list(camera.settings) == ["A", "B"]
    first = camera.settings["A"]
    assert (first.default, first.minimum, first.maximum, first.step) == (None, None, None, None)
    assert [(option.name, option.ranges) for option in first.options] == [("one", ())]
    assert camera.settings["B"].type == "int8"


# ------------------------------------------------------------------------------------ exclusions


def test_excluded_setting_cannot_be_set() -> None:
    text = refusal(CAMERA, "CAM_ISO", 400, CAM_EXPMODE=0)
    assert text == "CAM_ISO = 400 is not allowed now: the setting is excluded by CAM_EXPMODE = Auto"
    assert CAMERA.checked("CAM_ISO", 400, {"CAM_EXPMODE": 1}) == 400
    assert CAMERA.excluded_by("CAM_EV", {"CAM_EXPMODE": 1}) == ("CAM_EXPMODE = Manual",)
    assert CAMERA.excluded_by("CAM_EV", {}) == ()


def test_range_applies_under_its_condition() -> None:
    assert len(CAMERA.options("CAM_ISO", {"CAM_MODE": 1})) == 5
    assert [option.name for option in CAMERA.options("CAM_ISO", VIDEO_BY_HAND)] == ["100", "200", "400"]
    text = refusal(CAMERA, "CAM_ISO", 800, CAM_MODE=1, CAM_EXPMODE=1)
    assert text == (
        "CAM_ISO = 800 is not allowed while CAM_MODE = Video: it must be one of '100' (100), '200' (200), '400' (400)"
    )
    assert "1/30" in refusal(CAMERA, "CAM_SHUTTER", "1/30", **VIDEO_BY_HAND)
    assert len(CAMERA.options("CAM_SHUTTER", {**VIDEO_BY_HAND, "CAM_MODE": 0})) == 4


@pytest.mark.parametrize(
    ("condition", "values", "holds"),
    [
        ("A=1", {"A": 1}, True),
        ("A=1", {"A": 2}, False),
        ("A=1", {}, False),
        ("A != 1", {"A": 2}, True),
        ("A>=2 AND B<0.5", {"A": 2, "B": 0.4}, True),
        ("A>2 AND B<0.5", {"A": 2, "B": 0.4}, False),
        ("A<=2 OR B=7", {"A": 3, "B": 7}, True),
        ("A=1 AND B=1 OR C=1", {"A": 0, "B": 0, "C": 1}, True),
        ("A=text", {"A": "text"}, True),
        ("A!=text", {"A": "text"}, False),
        ("A>text", {"A": "text"}, False),
        ("A = Auto Low AND B=1", {"A": "Auto Low", "B": 1}, True),
        ("A=text", {"A": 1}, False),
        ("A=0.016666", {"A": 0.016666000708937645}, True),
    ],
)
def test_condition_evaluation(condition: str, values: dict[str, SettingValue], holds: bool) -> None:
    condition = condition.replace("<", "&lt;").replace(">", "&gt;")
    camera = of(
        f"""<parameter name="R" type="uint8"><options><option name="on" value="1"><parameterranges>
              <parameterrange parameter="S" condition="{condition}"><roption name="five" value="5"/></parameterrange>
              </parameterranges></option></options></parameter><parameter name="S" type="uint8"/>
            <parameter name="A" type="float"/><parameter name="B" type="float"/>"""
    )
    assert bool(camera.options("S", {"R": 1, **values})) == holds
    assert set(camera.dependencies("S")) >= {"R"}


def test_several_ranges_apply_together() -> None:
    def ruler(name: str, *allowed: int) -> str:
        options = "".join(f'<roption name="{value}" value="{value}"/>' for value in allowed)
        return f"""<parameter name="{name}" type="uint8"><options><option name="on" value="1"><parameterranges>
            <parameterrange parameter="S">{options}</parameterrange></parameterranges></option></options></parameter>"""

    camera = of(f'{ruler("A", 1, 2)}{ruler("B", 2, 3)}<parameter name="S" type="uint8"/>')
    assert camera.dependencies("S") == ("A", "B")
    assert [option.value for option in camera.options("S", {"A": 1, "B": 1})] == [2]
    assert "while A = on, B = on: it must be '2' (2)" in refusal(camera, "S", 3, A=1, B=1)


def test_option_cannot_exclude_own_setting() -> None:
    camera = of(
        """<parameter name="A" type="uint8"><options><option name="off" value="0"><exclusions>
             <exclude>A</exclude></exclusions></option><option name="on" value="1"/></options></parameter>"""
    )
    assert camera.checked("A", "on", {"A": 0}) == 1


def test_setting_dependencies() -> None:
    assert CAMERA.dependencies("CAM_SHUTTER") == ("CAM_EXPMODE", "CAM_VIDRES", "CAM_MODE")
    assert CAMERA.dependencies("CAM_WBMODE") == ()


# -------------------------------------------------------------------------------- valid values


@pytest.mark.parametrize(
    ("name", "value", "sent"),
    [
        ("CAM_WBMODE", "Sunny", 4),
        ("CAM_WBMODE", 5, 5),
        ("CAM_EV", -2.5, -2.5),
        ("CAM_EV", 0.3, pytest.approx(0.3)),
        ("CAM_QUALITY", 95, 95),
        ("CAM_STAMP", True, True),
        ("CAM_STAMP", 0, False),
        ("CAM_OWNER", "Zoë", "Zoë"),
        ("CAM_OFFSET", -100, -100),
    ],
)
def test_definition_accepts_value(name: str, value: object, sent: object) -> None:
    taken = CAMERA.checked(name, value, {})
    assert taken == sent
    assert type(taken) is type(sent) or not isinstance(sent, bool)


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("CAM_WBMODE", 3, r"= 3 is not allowed: it must be one of 'Auto' \(0\), 'Sunny' \(4\), 'Cloudy' \(5\)"),
        ("CAM_WBMODE", "sunny", r"did you mean 'Sunny'\?"),
        ("CAM_OFFSET", 70000, r"-32768\.\.32767"),
        ("CAM_EV", 3.1, r"CAM_EV = 3\.1 is not allowed: it must be -3\.\.3"),
        ("CAM_EV", "bright", "a number"),
        ("CAM_EV", float("nan"), "a finite number"),
        ("CAM_QUALITY", 91, r"10, 15, 20 …"),
        ("CAM_QUALITY", 5, r"10\.\.100"),
        ("CAM_QUALITY", 50.5, "a whole number"),
        ("CAM_STAMP", 2, "True or False"),
        ("CAM_OWNER", 5, "text or bytes"),
        ("CAM_OWNER", "x" * 129, "at most 128"),
        ("CAM_OWNER", b"\0", "zeros at its end"),
        ("CAM_LENS", "new", "can only be read"),
    ],
)
def test_definition_rejects_value(name: str, value: object, complaint: str) -> None:
    with pytest.raises(InvalidArgument, match=complaint) as caught:
        CAMERA.checked(name, value, {})
    assert str(caught.value).startswith(f"{name} = ")


# ------------------------------------------------------------------------------- values as bytes

NUMBERS = st.one_of(
    *(
        st.tuples(st.integers(int(lowest), int(highest)), st.just(kind))
        for kind, (lowest, highest) in {
            MavParamExtType.UINT8: (0, 255),
            MavParamExtType.INT8: (-128, 127),
            MavParamExtType.UINT16: (0, 0xFFFF),
            MavParamExtType.INT32: (-(1 << 31), (1 << 31) - 1),
            MavParamExtType.UINT64: (0, (1 << 64) - 1),
            MavParamExtType.INT64: (-(1 << 63), (1 << 63) - 1),
        }.items()
    ),
    st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.just(MavParamExtType.REAL64)),
    st.tuples(st.floats(width=32, allow_nan=False, allow_infinity=False), st.just(MavParamExtType.REAL32)),
    st.tuples(st.text(max_size=30).filter(lambda text: not text.endswith("\0")), st.just(MavParamExtType.CUSTOM)),
    st.tuples(st.binary(max_size=128).filter(lambda data: data[-1:] != b"\0"), st.just(MavParamExtType.CUSTOM)),
)


@given(NUMBERS)
def test_setting_value_round_trip(given_value: tuple[SettingValue, MavParamExtType]) -> None:
    value, kind = given_value
    try:
        wanted = checked_setting("A", value, kind)
    except InvalidArgument:
        assert isinstance(value, str)  # half of a surrogate pair
        return
    decoded = setting_value(setting_bytes(wanted, kind).ljust(128, b"\0"), kind)
    assert decoded == wanted
    assert settings_equal(decoded, value)


@given(st.binary(max_size=128), st.integers(0, 255))
def test_setting_value_decodes_any_bytes(data: bytes, kind: int) -> None:
    value = setting_value(data, kind)
    assert settings_equal(value, value)


def test_setting_bytes_match_c() -> None:
    assert setting_bytes(-2, MavParamExtType.INT16) == b"\xfe\xff"
    assert setting_bytes(0.5, MavParamExtType.REAL32) == b"\0\0\0\x3f"
    assert setting_value(b"\xff", 77) == b"\xff"


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [(1, True, True), (0.1, 0.10000000149, True), (1, 2, False), ("a", b"a", True), ("1", 1, False)],
)
def test_settings_equal_as_32_bit_floats(one: SettingValue, other: SettingValue, same: bool) -> None:
    assert settings_equal(one, other) == settings_equal(other, one) == same


# ------------------------------------------------------------------------------- hostile files

BOMB = b"""<?xml version="1.0"?><!DOCTYPE mavlinkcamera [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]>
<mavlinkcamera><parameters><parameter name="&b;" type="uint8"/></parameters></mavlinkcamera>"""


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"<",
        b"<mavlinkcamera/>",
        b"<mavlink/>",
        xml(""),
        b'<?xml version="1.0" encoding="nonsense"?><mavlinkcamera/>',
        BOMB,
        b"\xfd7zXZ\x00",
        lzma.compress(OWN.read_bytes())[:-5],
        b"<a>" * 100_000,
    ],
    ids=lambda data: repr(data[-30:]),
)
def test_other_files_are_rejected_as_definition(data: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"^camera definition (is|defines) "):
        parse_definition(data)


def test_definition_rejects_large_decompressed_file() -> None:
    bomb = lzma.compress(bytes(MAX_FILE_SIZE + (1 << 20)), preset=0)
    tracemalloc.start()
    try:
        with pytest.raises(FileFormatError, match=r"^camera definition is too large: more than 16 MB"):
            parse_definition(bomb)
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_FILE_SIZE
    finally:
        tracemalloc.stop()
    with pytest.raises(FileFormatError, match="more than 16 MB"):
        parse_definition(bytes(MAX_FILE_SIZE + 1))


@pytest.mark.exhaustive
def test_long_condition_and_many_options_are_fast() -> None:
    options = "".join(f'<option name="{n}" value="{n}"/>' for n in range(10_000))
    condition = " " * 200_000 + "A=1" + " AND A=1" * 20_000
    camera = of(
        f"""<parameter name="A" type="uint32"><options>{options}<option name="on" value="70000"><parameterranges>
            <parameterrange parameter="B" condition="{condition}"><roption name="1" value="1"/></parameterrange>
            </parameterranges></option></options></parameter><parameter name="B" type="uint8"/>"""
    )
    assert len(refusal(camera, "A", 30_000)) < 1000
    assert camera.checked("B", 7, {"A": 70000}) == 7
