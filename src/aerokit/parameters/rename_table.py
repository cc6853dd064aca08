"""Table of parameters that ArduPilot renamed.

The sources for version 4.7 are the metadata of 4.6 and 4.7, the conversions in the firmware (AC_WPNav, AC_Loiter,
AC_PosControl, AC_AttitudeControl, AC_Circle, AC_Avoid, AP_Arming, AP_RangeFinder, GCS, the vehicles' Parameters.cpp),
and https://ardupilot.org/copter/docs/common-param-name-changes.html. As in the firmware, PSC_ACCZ_FF, _PDMX and _D_FF
are not scaled, although P, I and D are scaled by 0.1.

The sources for earlier versions are the source code and the firmware's conversions (convert_old_parameters in the
vehicles' Parameters.cpp, AP_Mount, AP_Camera, AP_GPS, AP_BattMonitor …). If the meaning of a value changed and not only
its unit (gains, choices), nothing is converted: see `REPLACED`.
"""

from __future__ import annotations

from itertools import chain

_ALL = ("Copter", "Plane", "Rover", "Sub", "Tracker", "Blimp")

_COPTER = ("Copter",)

_COPTER_AND_SUB = ("Copter", "Sub")

_PLANE = ("Plane",)


def _prefixed(prefix: str, new_prefix: str, pairs: str) -> str:
    """Add prefixes to pairs: ``ACCEL>ACC`` becomes ``WPNAV_ACCEL>WP_ACC``."""
    halves = (pair.split(">") for pair in pairs.split())
    return " ".join(f"{prefix}{old}>{new_prefix}{new}" for old, new in halves)


def _change_prefix(prefix: str, new_prefix: str, names: str) -> str:
    return " ".join(f"{prefix}{name}>{new_prefix}{name}" for name in names.split())


_STREAMS = "RAW_SENS EXT_STAT RC_CHAN RAW_CTRL POSITION EXTRA1 EXTRA2 EXTRA3 PARAMS ADSB"

_LOITER = "SPEED>SPEED_MS ACC_MAX>ACC_MAX_M BRK_ACCEL>BRK_ACC_M BRK_JERK>BRK_JRK_M"

_WAYPOINT = "SPEED>SPD SPEED_UP>SPD_UP SPEED_DN>SPD_DN RADIUS>RADIUS_M ACCEL>ACC ACCEL_Z>ACC_Z ACCEL_C>ACC_CNR"

_ATTITUDE = "ACCEL_R_MAX>ACC_R_MAX ACCEL_P_MAX>ACC_P_MAX ACCEL_Y_MAX>ACC_Y_MAX SLEW_YAW>RATE_WPY_MAX"

_VELOCITY_CONTROLLER = "P I D FF FLTE FLTD"

_VERTICAL_ACCELERATION = "FF FLTT FLTE FLTD SMAX PDMX D_FF NTF NEF"


def _position_controller(prefix: str) -> tuple[tuple[int, str], ...]:
    """Return the renames of the position controller, each with its divisor."""
    # ArduPilot's position controller (PSC) changed from north-east-up in centimetres to north-east-down in metres.
    moved = (
        _change_prefix(f"{prefix}VELXY_", f"{prefix}NE_VEL_", _VELOCITY_CONTROLLER),
        _change_prefix(f"{prefix}VELZ_", f"{prefix}D_VEL_", _VELOCITY_CONTROLLER),
        _change_prefix(f"{prefix}ACCZ_", f"{prefix}D_ACC_", _VERTICAL_ACCELERATION),
        _prefixed(prefix, prefix, "POSXY_P>NE_POS_P POSZ_P>D_POS_P JERK_XY>NE_JERK JERK_Z>D_JERK"),
    )
    return (
        (1, " ".join(moved)),
        (10, _change_prefix(f"{prefix}ACCZ_", f"{prefix}D_ACC_", "P I D")),
        (100, _prefixed(prefix, prefix, "VELXY_IMAX>NE_VEL_IMAX VELZ_IMAX>D_VEL_IMAX")),
        (1000, _prefixed(prefix, prefix, "ACCZ_IMAX>D_ACC_IMAX")),
    )


_COPTER_CENTI = (
    "RTL_ALT>RTL_ALT_M RTL_SPEED>RTL_SPEED_MS RTL_ALT_FINAL>RTL_ALT_FINAL_M RTL_CLIMB_MIN>RTL_CLIMB_MIN_M "
    "LAND_SPEED>LAND_SPD_MS LAND_SPEED_HIGH>LAND_SPD_HIGH_MS LAND_ALT_LOW>LAND_ALT_LOW_M "
    "PILOT_SPEED_UP>PILOT_SPD_UP PILOT_SPEED_DN>PILOT_SPD_DN PILOT_ACCEL_Z>PILOT_ACC_Z "
    "PILOT_TKOFF_ALT>PILOT_TKO_ALT_M PHLD_BRAKE_ANGLE>PHLD_BRK_ANGLE AVOID_ANGLE_MAX>AVOID_ANG_MAX"
)

# Renames in version 4.7. Each entry has the vehicle types, the divisor from old to new units, and ``OLD>NEW`` pairs.
RENAMED_IN_4_7: tuple[tuple[tuple[str, ...], int, str], ...] = (
    (_ALL, 1, "SYSID_THISMAV>MAV_SYSID SYSID_MYGCS>MAV_GCS_SYSID TELEM_DELAY>MAV_TELEM_DELAY"),
    (_ALL, 1, "ARMING_CHECK>ARMING_SKIPCHK EK3_MAX_FLOW>EK3_FLOW_MAX"),
    *((_ALL, 1, _change_prefix(f"SR{port}_", f"MAV{port + 1}_", _STREAMS)) for port in range(10)),
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
    (_COPTER_AND_SUB, 1, _change_prefix("WPNAV_", "WP_", "JERK RFND_USE TER_MARGIN")),
    (_COPTER_AND_SUB, 100, _prefixed("LOIT_", "LOIT_", _LOITER)),
    (_COPTER_AND_SUB, 100, _prefixed("ATC_", "ATC_", _ATTITUDE)),
    (_COPTER_AND_SUB, 100, "ANGLE_MAX>ATC_ANGLE_MAX CIRCLE_RADIUS>CIRCLE_RADIUS_M"),
    *((_COPTER_AND_SUB, divisor, pairs) for divisor, pairs in _position_controller("PSC_")),
    (_PLANE, 100, _prefixed("Q_WP_", "Q_WP_", _WAYPOINT)),
    (_PLANE, 100, _prefixed("Q_LOIT_", "Q_LOIT_", _LOITER)),
    (_PLANE, 100, _prefixed("Q_A_", "Q_A_", _ATTITUDE)),
    (_PLANE, 100, "Q_ANGLE_MAX>Q_A_ANGLE_MAX"),
    *((_PLANE, divisor, pairs) for divisor, pairs in _position_controller("Q_P_")),
    (_PLANE, 1, "GLIDE_SLOPE_MIN>ALT_SLOPE_MIN GLIDE_SLOPE_THR>ALT_SLOPE_MAXHGT"),
    (("Sub",), 1, _change_prefix("ORIGIN_", "AHRS_ORIGIN_", "LAT LON ALT")),
)

INVERTED = frozenset({"ARMING_CHECK"})

# Maps names of version 4.7.1 to the names that these parameters have in 4.7.0 only.
OTHER_NEW_NAMES: dict[str, tuple[str, ...]] = dict(
    chain.from_iterable(
        ((f"{prefix}NE_JERK", (f"{prefix}JERK_NE",)), (f"{prefix}D_JERK", (f"{prefix}JERK_D",)))
        for prefix in ("PSC_", "Q_P_")
    )
)

_OLDER_ALL = ("Copter", "Plane", "Rover", "Sub")

_OLDER_COPTER, _OLDER_PLANE, _ROVER = ("Copter",), ("Plane",), ("Rover",)


def _moved(prefix: str, new_prefix: str, names: str) -> str:
    """Make pairs of names by adding prefixes: ``TYPE`` becomes ``RNGFND_TYPE>RNGFND1_TYPE``."""
    # A name may also be a pair such as ``A>B``.
    halves = (name.partition(">") for name in names.split())
    return " ".join(f"{prefix}{old}>{new_prefix}{new or old}" for old, _, new in halves)


_XYZ = ["X", "Y", "Z"]

_ANGLES = (
    "ANGMIN_ROL>ROLL_MIN ANGMAX_ROL>ROLL_MAX ANGMIN_TIL>PITCH_MIN ANGMAX_TIL>PITCH_MAX "
    "ANGMIN_PAN>YAW_MIN ANGMAX_PAN>YAW_MAX"
)

_RANGEFINDER = (
    "TYPE PIN SCALING OFFSET FUNCTION MIN_CM MAX_CM STOP_PIN RMETRIC PWRRNG GNDCLEAR ADDR ORIENT POS_X POS_Y POS_Z"
)

_OLDER_LOITER = "SPEED>SPEED JERK>BRK_JERK MAXA>ACC_MAX MINA>BRK_ACCEL"

_IGNORED_SECTORS = " ".join(f"IGN_{name}{number}" for name in ("ANG", "WID") for number in range(1, 5))

# Renames before 4.7. Each entry has the first version with the new names, the vehicle types, the divisor from old to
# new units, and ``OLD>NEW`` pairs.
RENAMED_BEFORE_4_7: tuple[tuple[str, tuple[str, ...], int, str], ...] = (
    ("3.4", _OLDER_COPTER, 1, _moved("STB_", "ATC_ANG_", "RLL_P PIT_P YAW_P")),
    ("3.4", _OLDER_COPTER, 1, "MOT_THST_BAT_MAX>MOT_BAT_VOLT_MAX MOT_THST_BAT_MIN>MOT_BAT_VOLT_MIN"),
    ("3.4", _OLDER_COPTER, 1, "MOT_CURR_MAX>MOT_BAT_CURR_MAX FRAME>FRAME_TYPE"),
    ("3.4", _OLDER_COPTER, 1, _moved("MOT_", "ATC_", "THR_MIX_MIN THR_MIX_MAX")),
    ("3.4", _OLDER_COPTER, 1000, "THR_MID>MOT_THST_HOVER"),
    (
        "3.5",
        _OLDER_ALL,
        1,
        " ".join(f"RC{number}_FUNCTION>SERVO{number}_FUNCTION" for number in range(4, 15)),
    ),
    ("3.6", _OLDER_COPTER, 1, _moved("ACCEL_Z_", "PSC_ACCZ_", "P I D IMAX FILT>FLTE FILT_HZ>FLTE")),
    ("3.6", _OLDER_COPTER, 1, "POS_XY_P>PSC_POSXY_P POS_Z_P>PSC_POSZ_P VEL_Z_P>PSC_VELZ_P"),
    ("3.6", _OLDER_COPTER, 1, _moved("VEL_XY_", "PSC_VELXY_", "P I IMAX")),
    (
        "3.6",
        _OLDER_COPTER,
        1,
        _moved("WPNAV_LOIT_", "LOIT_", _OLDER_LOITER) + " PILOT_VELZ_MAX>PILOT_SPEED_UP",
    ),
    ("3.9", _OLDER_PLANE, 1, _moved("Q_WP_LOIT_", "Q_LOIT_", _OLDER_LOITER)),
    ("3.6", _OLDER_ALL, 1, "BATT_AMP_PERVOLT>BATT_AMP_PERVLT BATT2_AMP_PERVOL>BATT2_AMP_PERVLT"),
    (
        "3.6",
        _OLDER_ALL,
        1,
        "FS_BATT_ENABLE>BATT_FS_LOW_ACT FS_BATT_VOLTAGE>BATT_LOW_VOLT FS_BATT_MAH>BATT_LOW_MAH",
    ),
    ("4.0", _OLDER_ALL, 1, _moved("RNGFND_", "RNGFND1_", _RANGEFINDER)),
    ("4.0", _OLDER_ALL, 1, "ARMING_MIN_VOLT>BATT_ARM_VOLT ARMING_MIN_VOLT2>BATT2_ARM_VOLT"),
    ("4.0", _OLDER_ALL, 1, "ARMING_VOLT_MIN>BATT_ARM_VOLT ARMING_VOLT2_MIN>BATT2_ARM_VOLT"),
    ("4.0", _OLDER_ALL, 1, "MAG_ENABLE>COMPASS_ENABLE MAG_ENABLED>COMPASS_ENABLE"),
    ("4.0", _OLDER_COPTER, 1, " ".join(f"CH{number}_OPT>RC{number}_OPTION" for number in range(7, 13))),
    ("4.0", _OLDER_COPTER, 1, "PSC_ACCZ_FILT>PSC_ACCZ_FLTE PSC_VELXY_FILT>PSC_VELXY_FLTE"),
    ("4.0", _OLDER_COPTER, 1, "PSC_VELXY_D_FILT>PSC_VELXY_FLTD"),
    (
        "4.1",
        _OLDER_ALL,
        1,
        _moved("GND_", "BARO_", "TEMP>GND_TEMP ALT_OFFSET PRIMARY EXT_BUS FLTR_RNG PROBE_EXT SPEC_GRAV"),
    ),
    ("4.1", _OLDER_ALL, 1, "GND_ABS_PRESS>BARO1_GND_PRESS GND_ABS_PRESS2>BARO2_GND_PRESS"),
    ("4.1", _OLDER_ALL, 1, "GND_ABS_PRESS3>BARO3_GND_PRESS BRD_IMU_TARGTEMP>BRD_HEAT_TARG"),
    (
        "4.1",
        _OLDER_PLANE,
        1,
        "FENCE_MAXALT>FENCE_ALT_MAX FENCE_MINALT>FENCE_ALT_MIN FENCE_RETALT>FENCE_RET_ALT",
    ),
    ("4.1", _ROVER, 1, "TURN_MAX_G>ATC_TURN_MAX_G"),
    ("4.1", _OLDER_ALL, 1, _moved("RPM_", "RPM1_", "TYPE SCALING MAX MIN MIN_QUAL PIN")),
    ("4.1", _OLDER_ALL, 1, _moved("PRX_", "PRX1_", f"TYPE ORIENT YAW_CORR {_IGNORED_SECTORS}")),
    ("4.3", _OLDER_ALL, 1, _moved("MNT_", "MNT1_", "TYPE DEFLT_MODE LEAD_RLL LEAD_PTCH")),
    ("4.3", _OLDER_ALL, 1, _moved("MNT_RETRACT_", "MNT1_RETRACT_", " ".join(_XYZ))),
    ("4.3", _OLDER_ALL, 1, _moved("MNT_NEUTRAL_", "MNT1_NEUTRAL_", " ".join(_XYZ))),
    ("4.3", _OLDER_ALL, 100, _moved("MNT_", "MNT1_", _ANGLES)),
    ("4.3", _OLDER_ALL, 100, _moved("MNT2_", "MNT2_", _ANGLES)),
    ("4.4", _OLDER_ALL, 10, "CAM_DURATION>CAM1_DURATION"),
    ("4.4", _OLDER_ALL, 1000, "CAM_MIN_INTERVAL>CAM1_INTRVAL_MIN"),
    ("4.4", _OLDER_ALL, 1, _moved("CAM_", "CAM1_", "TRIGG_DIST SERVO_ON SERVO_OFF RELAY_ON")),
    ("4.4", _OLDER_ALL, 1, "CAM_FEEDBACK_PIN>CAM1_FEEDBAK_PIN CAM_FEEDBACK_POL>CAM1_FEEDBAK_POL"),
    ("4.4", _OLDER_ALL, 1, "BRD_SAFETYENABLE>BRD_SAFETY_DEFLT"),
    ("4.5", _OLDER_ALL, 1, "COMPASS_TYPEMASK>COMPASS_DISBLMSK"),
    ("4.5", _OLDER_PLANE, 1, "ARSPD_FBW_MIN>AIRSPEED_MIN ARSPD_FBW_MAX>AIRSPEED_MAX"),
    ("4.5", _OLDER_PLANE, 100, "TRIM_ARSPD_CM>AIRSPEED_CRUISE MIN_GNDSPD_CM>MIN_GROUNDSPEED"),
    ("4.5", _OLDER_PLANE, 100, "ALT_HOLD_RTL>RTL_ALTITUDE ALT_HOLD_FBWCM>CRUISE_ALT_FLOOR"),
    ("4.5", _OLDER_PLANE, 100, "LIM_PITCH_MAX>PTCH_LIM_MAX_DEG LIM_PITCH_MIN>PTCH_LIM_MIN_DEG"),
    (
        "4.5",
        _OLDER_PLANE,
        100,
        "LIM_ROLL_CD>ROLL_LIMIT_DEG TRIM_PITCH_CD>PTCH_TRIM_DEG LAND_PITCH_CD>LAND_PITCH_DEG",
    ),
    ("4.5", _OLDER_PLANE, 100, "Q_LAND_SPEED>Q_LAND_FINAL_SPD Q_ACCEL_Z>Q_PILOT_ACCEL_Z"),
    ("4.5", _OLDER_PLANE, 100, "Q_VELZ_MAX>Q_PILOT_SPD_UP Q_VELZ_MAX_DN>Q_PILOT_SPD_DN"),
    (
        "4.6",
        _OLDER_ALL,
        1,
        "GPS_TYPE>GPS1_TYPE GPS_TYPE2>GPS2_TYPE GPS_RATE_MS>GPS1_RATE_MS GPS_RATE_MS2>GPS2_RATE_MS",
    ),
    ("4.6", _OLDER_ALL, 1, "GPS_GNSS_MODE>GPS1_GNSS_MODE GPS_GNSS_MODE2>GPS2_GNSS_MODE"),
    ("4.6", _OLDER_ALL, 1, "GPS_DELAY_MS>GPS1_DELAY_MS GPS_DELAY_MS2>GPS2_DELAY_MS"),
    ("4.6", _OLDER_ALL, 1, "GPS_COM_PORT>GPS1_COM_PORT GPS_COM_PORT2>GPS2_COM_PORT"),
    ("4.6", _OLDER_ALL, 1, " ".join(f"GPS_POS{k}_{axis}>GPS{k}_POS_{axis}" for k in (1, 2) for axis in _XYZ)),
    ("4.6", _OLDER_ALL, 1, "GPS_CAN_NODEID1>GPS1_CAN_NODEID GPS_CAN_NODEID2>GPS2_CAN_NODEID"),
)

# Renames that are applied only from old to new names, in the format of `RENAMED_BEFORE_4_7`. The old name still exists
# on another vehicle type, where it has another meaning.
ONE_WAY: tuple[tuple[str, tuple[str, ...], int, str], ...] = (
    ("3.4", _OLDER_COPTER, 1000, "THR_MIN>MOT_SPIN_MIN"),
    ("3.3", _ROVER, 1, "THR_MIN>MOT_THR_MIN THR_MAX>MOT_THR_MAX"),
)

_SWITCH = "RCn_OPTION of that channel"

_OUTPUT = "SERVOn_FUNCTION and SERVOn_REVERSED of the outputs"

_GAINS = "its gains are counted differently"

# Maps each name without a direct successor to a text about what replaces it.
REPLACED: dict[str, str] = {
    **{f"RATE_{axis}_{gain}": f"ATC_RAT_{axis}_{gain}; {_GAINS}" for axis in ("RLL", "PIT", "YAW") for gain in "PID"},
    **{f"RATE_{axis}_IMAX": f"ATC_RAT_{axis}_IMAX; {_GAINS}" for axis in ("RLL", "PIT", "YAW")},
    **{
        f"ATC_RAT_{axis}_FILT": f"ATC_RAT_{axis}_FLTT, ATC_RAT_{axis}_FLTE and ATC_RAT_{axis}_FLTD"
        for axis in ("RLL", "PIT", "YAW")
    },
    **{f"RLL2SRV_{gain}": f"RLL_RATE_{gain}; {_GAINS}" for gain in ("P", "I", "D", "FF", "IMAX")},
    **{f"PTCH2SRV_{gain}": f"PTCH_RATE_{gain}; {_GAINS}" for gain in ("P", "I", "D", "FF", "IMAX")},
    **{f"SPEED2THR_{gain}": f"ATC_SPEED_{gain}; {_GAINS}" for gain in ("P", "I", "D", "IMAX")},
    **{f"RC{number}_REV": f"RC{number}_REVERSED, 1 for reversed" for number in range(1, 15)},
    **dict.fromkeys(("FENCE_CHANNEL", "RST_MISSION_CH", "CHUTE_CHAN", "FBWA_TDRAG_CHAN", "FLAP_IN_CHANNEL"), _SWITCH),
    **dict.fromkeys(("INVERTEDFLT_CH", "SOAR_ENABLE_CH", "LEARN_CH"), _SWITCH),
    **dict.fromkeys(("MNT_RC_IN_ROLL", "MNT_RC_IN_TILT", "MNT_RC_IN_PAN"), _SWITCH),
    **{f"ELEVON_{name}": _OUTPUT for name in ("MIXING", "OUTPUT", "REVERSE", "CH1_REV", "CH2_REV")},
    **dict.fromkeys(("VTAIL_OUTPUT", "FLAPERON_OUTPUT", "SKID_STEER_OUT", "BRD_PWM_COUNT"), _OUTPUT),
    **dict.fromkeys(("MNT_STAB_ROLL", "MNT_STAB_TILT", "MNT_STAB_PAN"), "MNT1_TYPE, 7 for not stabilized"),
    "MNT_JSTICK_SPD": "MNT1_RC_RATE in degrees per second",
    "CAM_TRIGG_TYPE": "CAM1_TYPE with other values",
    "ACRO_RP_P": "ACRO_RP_RATE in degrees per second",
    "ACRO_YAW_P": "ACRO_Y_RATE in degrees per second",
    "RC_FEEL_RP": "ATC_INPUT_TC in seconds",
    "MOT_SPIN_ARMED": "MOT_SPIN_ARM from 0 to 1",
    "FS_GPS_ENABLE": "FS_EKF_ACTION",
    "FLOW_ENABLE": "FLOW_TYPE with other values",
    "COMPASS_PRIMARY": "COMPASS_PRIO1_ID",
    "SYS_NUM_RESETS": "STAT_BOOTCNT",
    "SYSID_ENFORCE": "a bit of MAV_OPTIONS",
    "SKIP_GYRO_CAL": "INS_GYR_CAL",
    "RNGFND_GAIN": "RNGFND_FILT",
}
