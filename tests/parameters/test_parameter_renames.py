"""Names and units of ArduPilot 4.6 and 4.7."""

from __future__ import annotations

import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.parameters import (
    Parameter,
    ParameterRenamedWarning,
    ParameterType,
    Renamed,
    find_rename,
    other_names,
    to_known,
    translate_values,
)
from aerokit.parameters.parameter import check_name, to_float32
from aerokit.parameters.rename_table import GROUPS

INT16, INT32, REAL32 = ParameterType.INT16, ParameterType.INT32, ParameterType.REAL32


def known(asked: str, name: str) -> Renamed:
    found = to_known(asked, {name})
    assert found is not None
    assert (found.asked, found.name) == (asked, name)
    return found


@pytest.mark.parametrize(
    ("old", "new", "old_value", "new_value"),
    [
        ("WPNAV_SPEED", "WP_SPD", 500, 5),
        ("WPNAV_ACCEL_C", "WP_ACC_CNR", 250, 2.5),
        ("WPNAV_JERK", "WP_JERK", 1.0, 1.0),
        ("SYSID_THISMAV", "MAV_SYSID", 1, 1),
        ("SR0_POSITION", "MAV1_POSITION", 4, 4),
        ("SR9_RAW_SENS", "MAV10_RAW_SENS", 4, 4),
        ("RNGFND1_MAX_CM", "RNGFND1_MAX", 700, 7),
        ("RNGFNDA_GNDCLEAR", "RNGFNDA_GNDCLR", 15, 0.15),
        ("ANGLE_MAX", "ATC_ANGLE_MAX", 3000, 30),
        ("RTL_ALT", "RTL_ALT_M", 1500, 15),
        ("PSC_ACCZ_P", "PSC_D_ACC_P", 0.5, 0.05),
        ("PSC_ACCZ_IMAX", "PSC_D_ACC_IMAX", 800, 0.8),
        ("PSC_ACCZ_FF", "PSC_D_ACC_FF", 0.5, 0.5),
        ("Q_P_VELXY_IMAX", "Q_P_NE_VEL_IMAX", 1000, 10),
        ("Q_WP_SPEED_DN", "Q_WP_SPD_DN", 150, 1.5),
        ("ORIGIN_LAT", "AHRS_ORIGIN_LAT", 47.4, 47.4),
        ("GLIDE_SLOPE_THR", "ALT_SLOPE_MAXHGT", 15, 15),
    ],
)
def test_pairs(old: str, new: str, old_value: float, new_value: float) -> None:
    up, down = known(old, new), known(new, old)
    assert up.to_vehicle(old_value) == down.to_asked(old_value) == new_value
    assert down.to_vehicle(new_value) == up.to_asked(new_value) == old_value
    for renamed in (up, down):
        assert new in renamed.warning
        assert old in renamed.warning
    assert find_rename(old) is find_rename(new)


def test_the_table_is_sound() -> None:
    pairs = [pair.split(">") for _, _, text in GROUPS for pair in text.split()]
    assert len(pairs) == 258
    assert len({name for pair in pairs for name in pair}) == 2 * len(pairs)
    for name in (name for pair in pairs for name in pair):
        check_name(name)
    assert not {old for old, _ in pairs} & {new for _, new in pairs}


def test_the_vehicles_own_name_needs_no_translation() -> None:
    assert to_known("WP_SPD", {"WP_SPD"}) is None
    assert to_known("WPNAV_SPEED", {"WPNAV_SPEED", "WP_SPD"}) is None
    assert to_known("WPNAV_SPEED", set()) is None
    assert to_known("PILOT_SPEED_UP", {"PILOT_SPEED_UP"}) is None  # Sub keeps it
    assert to_known("NO_SUCH", {"WP_SPD"}) is None
    assert find_rename("NO_SUCH") is None
    assert other_names("NO_SUCH") == ()
    assert other_names("SYSID_THISMAV") == ("MAV_SYSID",)


def test_names_between_two_versions() -> None:
    assert other_names("PSC_JERK_XY") == ("PSC_NE_JERK", "PSC_JERK_NE")
    assert known("PSC_JERK_XY", "PSC_JERK_NE").to_vehicle(5.0) == 5.0
    renamed = known("PSC_NE_JERK", "PSC_JERK_NE")
    assert renamed.to_vehicle(5.0) == renamed.to_asked(5.0) == 5.0


def test_whole_numbers_are_rounded_and_decimals_are_exact() -> None:
    down = known("PILOT_SPD_UP", "PILOT_SPEED_UP")
    assert down.to_vehicle(0.29, INT16) == 29  # 0.29 × 100 is 28.999999999999996
    assert down.to_vehicle(to_float32(0.29)) == 29.0
    assert down.to_vehicle(2.505, INT16) == 250
    assert type(down.to_vehicle(2.505, INT16)) is int
    up = known("PILOT_SPEED_UP", "PILOT_SPD_UP")
    assert up.to_vehicle(29) == 0.29
    assert up.to_asked(to_float32(0.29)) == 29.0
    assert up.to_asked(float("inf")) == float("inf")
    assert up.to_asked(float("nan")) != up.to_asked(float("nan"))


@given(st.integers(-(2**15), 2**15 - 1))
def test_every_integer_comes_back(value: int) -> None:
    up = known("PILOT_SPEED_UP", "PILOT_SPD_UP")
    assert up.to_asked(to_float32(up.to_vehicle(value))) == value


@pytest.mark.parametrize(
    ("checks", "skipped"),
    [
        (1, 0),  # all
        (0, -1),  # none, those of future versions neither
        (72, 0x1FFFFE - 72),  # GPS and RC only
        (0x1FFFFE, 0),
        (3, 0),  # "all" counts whatever else is set
    ],
)
def test_arming_checks_are_inverted(checks: int, skipped: int) -> None:
    up, down = known("ARMING_CHECK", "ARMING_SKIPCHK"), known("ARMING_SKIPCHK", "ARMING_CHECK")
    assert up.to_vehicle(float(checks), INT32) == down.to_asked(checks) == skipped
    back = {3: 1, 0x1FFFFE: 1}.get(checks, checks)
    assert up.to_asked(skipped) == down.to_vehicle(skipped) == back
    assert "inverted" in up.warning


@given(st.integers(0, 0x1FFFFF))
def test_skipped_checks_come_back(skipped: int) -> None:
    rename = find_rename("ARMING_SKIPCHK")
    assert rename is not None
    wanted = skipped & 0x1FFFFE
    assert rename.to_new(rename.to_old(skipped)) == (
        0 if skipped == 0 else -1 if wanted == 0x1FFFFE else wanted
    )


def test_a_parameter_under_the_asked_name() -> None:
    vehicles = Parameter("WP_SPD", to_float32(2.3), REAL32, 5.0, 7)
    asked = known("WPNAV_SPEED", "WP_SPD").parameter(vehicles)
    assert asked == Parameter("WPNAV_SPEED", 230.0, REAL32, 500.0, 7)
    vehicles = Parameter("PILOT_SPEED_UP", 250, INT16)
    assert known("PILOT_SPD_UP", "PILOT_SPEED_UP").parameter(vehicles) == Parameter(
        "PILOT_SPD_UP", 2.5, REAL32
    )
    vehicles = Parameter("MAV_SYSID", 3, INT16, 1, 0)
    assert known("SYSID_THISMAV", "MAV_SYSID").parameter(vehicles) == vehicles.replace(name="SYSID_THISMAV")
    vehicles = Parameter("ARMING_SKIPCHK", 0, INT32, 0, 0)
    assert known("ARMING_CHECK", "ARMING_SKIPCHK").parameter(vehicles).value == 1


def test_a_whole_file() -> None:
    old = {"WPNAV_SPEED": 500, "RTL_ALT": 1500, "LOG_BITMASK": 65535, "WPNAV_RADIUS": 200, "UNKNOWN": 1}
    vehicle = {"WP_SPD", "RTL_ALT_M", "LOG_BITMASK", "WPNAV_RADIUS"}  # a version between the two
    values, renamed = translate_values(old, vehicle)
    assert values == {"WP_SPD": 5, "RTL_ALT_M": 15, "LOG_BITMASK": 65535, "WPNAV_RADIUS": 200, "UNKNOWN": 1}
    assert [each.asked for each in renamed] == ["WPNAV_SPEED", "RTL_ALT"]
    back, _ = translate_values(values, set(old), {"RTL_ALT": INT32})
    assert back == old
    both, renamed = translate_values({"WPNAV_SPEED": 100, "WP_SPD": 7}, {"WP_SPD"})
    assert (both, renamed) == ({"WP_SPD": 7}, ())


def test_the_warning_can_be_told_from_others() -> None:
    text = known("WPNAV_SPEED", "WP_SPD").warning
    with pytest.warns(ParameterRenamedWarning, match=r"Use WP_SPD, its name since ArduPilot 4\.7"):
        warnings.warn(text, ParameterRenamedWarning, stacklevel=1)
    assert "still called WPNAV_SPEED" in known("WP_SPD", "WPNAV_SPEED").warning
    assert "values were converted" in known("WP_SPD", "WPNAV_SPEED").warning
    assert "converted" not in known("SYSID_THISMAV", "MAV_SYSID").warning
