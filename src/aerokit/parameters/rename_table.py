"""What ArduPilot renamed between 4.6 and 4.7, taken from the metadata of both and from the firmware's conversions.

One group a row: the vehicle types, the divisor from old to new units, ``OLD>NEW`` pairs. Conversions in the firmware:
AC_WPNav, AC_Loiter, AC_PosControl, AC_AttitudeControl, AC_Circle, AC_Avoid, AP_Arming, AP_RangeFinder, GCS, and the
vehicles' Parameters.cpp; https://ardupilot.org/copter/docs/common-param-name-changes.html. The firmware moves
PSC_ACCZ_FF, _PDMX and _D_FF unscaled although P, I and D are scaled by 0.1; so do we.
"""

from __future__ import annotations

from itertools import chain

__all__ = ["GROUPS", "INVERTED", "OTHER_NEW_NAMES"]

_ALL = ("Copter", "Plane", "Rover", "Sub", "Tracker", "Blimp")
_COPTER = ("Copter",)
_COPTER_AND_SUB = ("Copter", "Sub")
_PLANE = ("Plane",)


def _prefixed(prefix: str, new_prefix: str, pairs: str) -> str:
    """``ACCEL>ACC`` → ``WPNAV_ACCEL>WP_ACC``."""
    halves = (pair.split(">") for pair in pairs.split())
    return " ".join(f"{prefix}{old}>{new_prefix}{new}" for old, new in halves)


def _same(prefix: str, new_prefix: str, names: str) -> str:
    return " ".join(f"{prefix}{name}>{new_prefix}{name}" for name in names.split())


_STREAMS = "RAW_SENS EXT_STAT RC_CHAN RAW_CTRL POSITION EXTRA1 EXTRA2 EXTRA3 PARAMS ADSB"
_LOITER = "SPEED>SPEED_MS ACC_MAX>ACC_MAX_M BRK_ACCEL>BRK_ACC_M BRK_JERK>BRK_JRK_M"
_WAYPOINT = (
    "SPEED>SPD SPEED_UP>SPD_UP SPEED_DN>SPD_DN RADIUS>RADIUS_M ACCEL>ACC ACCEL_Z>ACC_Z ACCEL_C>ACC_CNR"
)
_ATTITUDE = "ACCEL_R_MAX>ACC_R_MAX ACCEL_P_MAX>ACC_P_MAX ACCEL_Y_MAX>ACC_Y_MAX SLEW_YAW>RATE_WPY_MAX"
_HORIZONTAL = "P I D FF FLTE FLTD"
_VERTICAL_ACCELERATION = "FF FLTT FLTE FLTD SMAX PDMX D_FF NTF NEF"


def _position(prefix: str) -> tuple[tuple[int, str], ...]:
    """The position controller, from north-east-up in centimetres to north-east-down in metres."""
    moved = (
        _same(f"{prefix}VELXY_", f"{prefix}NE_VEL_", _HORIZONTAL),
        _same(f"{prefix}VELZ_", f"{prefix}D_VEL_", _HORIZONTAL),
        _same(f"{prefix}ACCZ_", f"{prefix}D_ACC_", _VERTICAL_ACCELERATION),
        _prefixed(prefix, prefix, "POSXY_P>NE_POS_P POSZ_P>D_POS_P JERK_XY>NE_JERK JERK_Z>D_JERK"),
    )
    return (
        (1, " ".join(moved)),
        (10, _same(f"{prefix}ACCZ_", f"{prefix}D_ACC_", "P I D")),
        (100, _prefixed(prefix, prefix, "VELXY_IMAX>NE_VEL_IMAX VELZ_IMAX>D_VEL_IMAX")),
        (1000, _prefixed(prefix, prefix, "ACCZ_IMAX>D_ACC_IMAX")),
    )


_COPTER_CENTI = (
    "RTL_ALT>RTL_ALT_M RTL_SPEED>RTL_SPEED_MS RTL_ALT_FINAL>RTL_ALT_FINAL_M RTL_CLIMB_MIN>RTL_CLIMB_MIN_M "
    "LAND_SPEED>LAND_SPD_MS LAND_SPEED_HIGH>LAND_SPD_HIGH_MS LAND_ALT_LOW>LAND_ALT_LOW_M "
    "PILOT_SPEED_UP>PILOT_SPD_UP PILOT_SPEED_DN>PILOT_SPD_DN PILOT_ACCEL_Z>PILOT_ACC_Z "
    "PILOT_TKOFF_ALT>PILOT_TKO_ALT_M PHLD_BRAKE_ANGLE>PHLD_BRK_ANGLE AVOID_ANGLE_MAX>AVOID_ANG_MAX"
)

GROUPS: tuple[tuple[tuple[str, ...], int, str], ...] = (
    (_ALL, 1, "SYSID_THISMAV>MAV_SYSID SYSID_MYGCS>MAV_GCS_SYSID TELEM_DELAY>MAV_TELEM_DELAY"),
    (_ALL, 1, "ARMING_CHECK>ARMING_SKIPCHK EK3_MAX_FLOW>EK3_FLOW_MAX"),
    *((_ALL, 1, _same(f"SR{port}_", f"MAV{port + 1}_", _STREAMS)) for port in range(10)),
    *(
        (
            _ALL,
            100,
            _prefixed(f"RNGFND{number}_", f"RNGFND{number}_", "MIN_CM>MIN MAX_CM>MAX GNDCLEAR>GNDCLR"),
        )
        for number in "123456789A"
    ),
    (
        _ALL,
        1,
        _prefixed(
            "CAM_RC_",
            "CAM2_RC_",
            "TYPE>TYPE FEATURES>FEATURES BT_DELAY>BT_DELAY BTN_DELAY>BTN_DELY MDE_DELAY>MDE_DELY CONTROL>CONTROL",
        ),
    ),
    (_COPTER, 100, _COPTER_CENTI),
    (_COPTER, 1, "PHLD_BRAKE_RATE>PHLD_BRK_RATE"),
    (_COPTER_AND_SUB, 100, _prefixed("WPNAV_", "WP_", _WAYPOINT)),
    (_COPTER_AND_SUB, 1, _same("WPNAV_", "WP_", "JERK RFND_USE TER_MARGIN")),
    (_COPTER_AND_SUB, 100, _prefixed("LOIT_", "LOIT_", _LOITER)),
    (_COPTER_AND_SUB, 100, _prefixed("ATC_", "ATC_", _ATTITUDE)),
    (_COPTER_AND_SUB, 100, "ANGLE_MAX>ATC_ANGLE_MAX CIRCLE_RADIUS>CIRCLE_RADIUS_M"),
    *((_COPTER_AND_SUB, divisor, pairs) for divisor, pairs in _position("PSC_")),
    (_PLANE, 100, _prefixed("Q_WP_", "Q_WP_", _WAYPOINT)),
    (_PLANE, 100, _prefixed("Q_LOIT_", "Q_LOIT_", _LOITER)),
    (_PLANE, 100, _prefixed("Q_A_", "Q_A_", _ATTITUDE)),
    (_PLANE, 100, "Q_ANGLE_MAX>Q_A_ANGLE_MAX"),
    *((_PLANE, divisor, pairs) for divisor, pairs in _position("Q_P_")),
    (_PLANE, 1, "GLIDE_SLOPE_MIN>ALT_SLOPE_MIN GLIDE_SLOPE_THR>ALT_SLOPE_MAXHGT"),
    (("Sub",), 1, _same("ORIGIN_", "AHRS_ORIGIN_", "LAT LON ALT")),
)

INVERTED = frozenset({"ARMING_CHECK"})

OTHER_NEW_NAMES: dict[str, tuple[str, ...]] = dict(
    chain.from_iterable(
        ((f"{prefix}NE_JERK", (f"{prefix}JERK_NE",)), (f"{prefix}D_JERK", (f"{prefix}JERK_D",)))
        for prefix in ("PSC_", "Q_P_")
    )
)
"""Version 4.7.0 had other new names for these than 4.7.1."""
