"""Parameter names and units of ArduPilot 4.6 and 4.7."""

from __future__ import annotations

import math
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.parameters import (
    Parameter,
    ParameterRenamedWarning,
    ParameterType,
    Renamed,
    find_rename,
    other_names,
    replacement_of,
    resolve_rename,
    translate_values,
)
from aerokit.parameters.parameter import check_name, checked_value, to_float32
from aerokit.parameters.rename_table import ONE_WAY, RENAMED_BEFORE_4_7, RENAMED_IN_4_7, REPLACED

INT16, INT32, REAL32 = ParameterType.INT16, ParameterType.INT32, ParameterType.REAL32


def known(asked: str, name: str) -> Renamed:
    found = resolve_rename(asked, {name})
    assert found is not None
    assert (found.requested, found.name) == (asked, name)
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
def test_renamed_values_convert(old: str, new: str, old_value: float, new_value: float) -> None:
    up, down = known(old, new), known(new, old)
    assert up.to_vehicle(old_value) == down.to_requested(old_value) == new_value
    assert down.to_vehicle(new_value) == up.to_requested(new_value) == old_value
    for renamed in (up, down):
        assert new in renamed.warning
        assert old in renamed.warning
    assert find_rename(old) is find_rename(new)


def test_rename_table_is_consistent() -> None:
    pairs = [pair.split(">") for _, _, text in RENAMED_IN_4_7 for pair in text.split()]
    assert len(pairs) == 258
    assert len({name for pair in pairs for name in pair}) == 2 * len(pairs)
    for name in (name for pair in pairs for name in pair):
        check_name(name)
    assert not {old for old, _ in pairs} & {new for _, new in pairs}


def test_known_name_is_not_renamed() -> None:
    assert resolve_rename("WP_SPD", {"WP_SPD"}) is None
    assert resolve_rename("WPNAV_SPEED", {"WPNAV_SPEED", "WP_SPD"}) is None
    assert resolve_rename("WPNAV_SPEED", set()) is None
    assert resolve_rename("PILOT_SPEED_UP", {"PILOT_SPEED_UP"}) is None  # Sub keeps the old name
    assert resolve_rename("NO_SUCH", {"WP_SPD"}) is None
    assert find_rename("NO_SUCH") is None
    assert other_names("NO_SUCH") == ()
    assert other_names("SYSID_THISMAV") == ("MAV_SYSID",)


def test_intermediate_names_are_resolved() -> None:
    assert other_names("PSC_JERK_XY") == ("PSC_NE_JERK", "PSC_JERK_NE")
    assert known("PSC_JERK_XY", "PSC_JERK_NE").to_vehicle(5.0) == 5.0
    renamed = known("PSC_NE_JERK", "PSC_JERK_NE")
    assert renamed.to_vehicle(5.0) == renamed.to_requested(5.0) == 5.0


def test_conversion_rounds_integers_and_is_decimal() -> None:
    down = known("PILOT_SPD_UP", "PILOT_SPEED_UP")
    assert down.to_vehicle(0.29, INT16) == 29  # 0.29 × 100 is 28.999999999999996
    assert down.to_vehicle(to_float32(0.29)) == 29.0
    assert down.to_vehicle(2.505, INT16) == 250
    assert type(down.to_vehicle(2.505, INT16)) is int
    up = known("PILOT_SPEED_UP", "PILOT_SPD_UP")
    assert up.to_vehicle(29) == 0.29
    assert up.to_requested(to_float32(0.29)) == 29.0
    assert up.to_requested(float("inf")) == float("inf")
    assert up.to_requested(float("nan")) != up.to_requested(float("nan"))


@given(st.integers(-(2**15), 2**15 - 1))
def test_converted_integer_round_trip(value: int) -> None:
    up = known("PILOT_SPEED_UP", "PILOT_SPD_UP")
    assert up.to_requested(to_float32(up.to_vehicle(value))) == value


@pytest.mark.parametrize(
    ("checks", "skipped"),
    [
        (1, 0),  # all checks
        (0, -1),  # neither no checks nor the checks of future versions
        (72, 0x1FFFFE - 72),  # GPS and RC only
        (0x1FFFFE, 0),
        (3, 0),  # "all" overrides the other bits
    ],
)
def test_arming_checks_convert_inverted(checks: int, skipped: int) -> None:
    up, down = known("ARMING_CHECK", "ARMING_SKIPCHK"), known("ARMING_SKIPCHK", "ARMING_CHECK")
    assert up.to_vehicle(float(checks), INT32) == down.to_requested(checks) == skipped
    back = {3: 1, 0x1FFFFE: 1}.get(checks, checks)
    assert up.to_requested(skipped) == down.to_vehicle(skipped) == back
    assert "inverted" in up.warning


@given(st.integers(0, 0x1FFFFF))
def test_skipped_checks_round_trip(skipped: int) -> None:
    rename = find_rename("ARMING_SKIPCHK")
    assert rename is not None
    wanted = skipped & 0x1FFFFE
    assert rename.to_new(rename.to_old(skipped)) == (0 if skipped == 0 else -1 if wanted == 0x1FFFFE else wanted)


def test_parameter_under_requested_name() -> None:
    vehicles = Parameter("WP_SPD", to_float32(2.3), REAL32, 5.0, 7)
    asked = known("WPNAV_SPEED", "WP_SPD").as_requested(vehicles)
    assert asked == Parameter("WPNAV_SPEED", 230.0, REAL32, 500.0, 7)
    vehicles = Parameter("PILOT_SPEED_UP", 250, INT16)
    assert known("PILOT_SPD_UP", "PILOT_SPEED_UP").as_requested(vehicles) == Parameter("PILOT_SPD_UP", 2.5, REAL32)
    vehicles = Parameter("MAV_SYSID", 3, INT16, 1, 0)
    assert known("SYSID_THISMAV", "MAV_SYSID").as_requested(vehicles) == vehicles.replace(name="SYSID_THISMAV")
    vehicles = Parameter("ARMING_SKIPCHK", 0, INT32, 0, 0)
    assert known("ARMING_CHECK", "ARMING_SKIPCHK").as_requested(vehicles).value == 1


def test_translate_values_of_whole_file() -> None:
    old = {"WPNAV_SPEED": 500, "RTL_ALT": 1500, "LOG_BITMASK": 65535, "WPNAV_RADIUS": 200, "UNKNOWN": 1}
    vehicle = {"WP_SPD", "RTL_ALT_M", "LOG_BITMASK", "WPNAV_RADIUS"}  # between the two versions
    values, renamed = translate_values(old, vehicle)
    assert values == {"WP_SPD": 5, "RTL_ALT_M": 15, "LOG_BITMASK": 65535, "WPNAV_RADIUS": 200, "UNKNOWN": 1}
    assert [warning.requested for warning in renamed] == ["WPNAV_SPEED", "RTL_ALT"]
    back, _ = translate_values(values, set(old), {"RTL_ALT": INT32})
    assert back == old
    both, renamed = translate_values({"WPNAV_SPEED": 100, "WP_SPD": 7}, {"WP_SPD"})
    assert (both, renamed) == ({"WP_SPD": 7}, ())


def test_rename_warning_has_own_category() -> None:
    text = known("WPNAV_SPEED", "WP_SPD").warning
    with pytest.warns(ParameterRenamedWarning, match=r"Use WP_SPD, its name since ArduPilot 4\.7"):
        warnings.warn(text, ParameterRenamedWarning, stacklevel=1)
    older = known("WP_SPD", "WPNAV_SPEED").warning
    assert older.startswith("WP_SPD is called WPNAV_SPEED by this vehicle's firmware; values were converted")
    assert older.endswith("The firmware, perhaps a -dev version, is older than the change in 4.7.")
    assert "Use" not in older
    assert "converted" not in known("SYSID_THISMAV", "MAV_SYSID").warning
    assert "Use PSC_JERK_NE," in known("PSC_NE_JERK", "PSC_JERK_NE").warning


@pytest.mark.parametrize(
    ("old", "new", "old_value", "new_value"),
    [
        ("GPS_TYPE", "GPS1_TYPE", 1, 1),
        ("THR_MID", "MOT_THST_HOVER", 350, 0.35),
        ("STB_RLL_P", "ATC_ANG_RLL_P", 4.5, 4.5),
        ("POS_XY_P", "PSC_NE_POS_P", 1.0, 1.0),
        ("ACCEL_Z_P", "PSC_D_ACC_P", 0.5, 0.05),
        ("ACCEL_Z_FILT_HZ", "PSC_ACCZ_FLTE", 20, 20),
        ("WPNAV_LOIT_SPEED", "LOIT_SPEED", 500, 500),
        ("WPNAV_LOIT_SPEED", "LOIT_SPEED_MS", 500, 5),
        ("WPNAV_LOIT_MAXA", "LOIT_ACC_MAX_M", 250, 2.5),
        ("PILOT_VELZ_MAX", "PILOT_SPD_UP", 250, 2.5),
        ("RNGFND_MAX_CM", "RNGFND1_MAX_CM", 700, 700),
        ("RNGFND_MAX_CM", "RNGFND1_MAX", 700, 7),
        ("FS_BATT_VOLTAGE", "BATT_LOW_VOLT", 10.5, 10.5),
        ("ARMING_VOLT_MIN", "BATT_ARM_VOLT", 10.5, 10.5),
        ("CH7_OPT", "RC7_OPTION", 18, 18),
        ("RC9_FUNCTION", "SERVO9_FUNCTION", 6, 6),
        ("GND_ABS_PRESS", "BARO1_GND_PRESS", 94500, 94500),
        ("MNT_ANGMIN_TIL", "MNT1_PITCH_MIN", -9000, -90),
        ("CAM_MIN_INTERVAL", "CAM1_INTRVAL_MIN", 500, 0.5),
        ("TRIM_ARSPD_CM", "AIRSPEED_CRUISE", 1200, 12),
        ("ALT_HOLD_RTL", "RTL_ALTITUDE", 10000, 100),
        ("LIM_ROLL_CD", "ROLL_LIMIT_DEG", 6500, 65),
        ("FENCE_MAXALT", "FENCE_ALT_MAX", 120, 120),
        ("Q_VELZ_MAX", "Q_PILOT_SPD_UP", 250, 2.5),
        ("TURN_MAX_G", "ATC_TURN_MAX_G", 0.6, 0.6),
    ],
)
def test_older_renamed_values_convert(old: str, new: str, old_value: float, new_value: float) -> None:
    up, down = known(old, new), known(new, old)
    assert up.to_vehicle(old_value) == down.to_requested(old_value) == new_value
    assert down.to_vehicle(new_value) == up.to_requested(new_value) == old_value
    assert old in up.warning
    assert new in up.warning
    assert ("converted" in up.warning) == (old_value != new_value)


def test_ambiguous_old_name_converts_one_way() -> None:
    """ArduPlane's THR_MIN is in percent."""
    assert known("THR_MIN", "MOT_SPIN_MIN").to_vehicle(130) == 0.13
    assert known("THR_MIN", "MOT_THR_MIN").to_vehicle(5) == 5
    assert resolve_rename("MOT_SPIN_MIN", {"THR_MIN"}) is None
    assert resolve_rename("THR_MIN", {"THR_MIN", "MOT_SPIN_MIN"}) is None


def test_older_rename_table_is_consistent() -> None:
    rows = [pair for _, _, _, text in (*RENAMED_BEFORE_4_7, *ONE_WAY) for pair in text.split()]
    assert len(rows) == len({*rows})
    old, new = ({pair.split(">")[place] for pair in rows} for place in (0, 1))
    for name in (*old, *new, *REPLACED):
        check_name(name)
    # `_by_name` has one divisor for a name that was renamed twice, so the earlier divisor must be 1.
    renamed_twice = {pair.split(">")[0] for _, _, pairs in RENAMED_IN_4_7 for pair in pairs.split()}
    for _, _, divisor, text in RENAMED_BEFORE_4_7:
        assert divisor == 1 or not {pair.split(">")[1] for pair in text.split()} & renamed_twice
    assert not old & REPLACED.keys()
    assert not any(find_rename(name) for name in REPLACED)
    for name in old:
        assert find_rename(name) is not None
        assert name not in other_names(name)


def test_replaced_parameter_names_replacement() -> None:
    assert replacement_of("FLOW_ENABLE").startswith("FLOW_TYPE")
    assert replacement_of("RATE_RLL_P").startswith("ATC_RAT_RLL_P")
    assert replacement_of("MNT_RC_IN_TILT").startswith("RCn_OPTION")
    assert replacement_of("WP_SPD") == replacement_of("NOPE") == ""


@pytest.mark.parametrize("value", [0.7, 1.5, math.nan, math.inf, 2.0**31])
def test_invalid_mask_is_not_converted_to_other_checks(value: float) -> None:
    """ARMING_CHECK = 0.7 must not skip all checks: the vehicle's type then refuses the unchanged value."""
    for requested, name in (("ARMING_CHECK", "ARMING_SKIPCHK"), ("ARMING_SKIPCHK", "ARMING_CHECK")):
        renamed = resolve_rename(requested, {name})
        assert renamed is not None
        with pytest.raises(InvalidArgument):
            checked_value(name, renamed.to_vehicle(value, ParameterType.INT32), ParameterType.INT32)
