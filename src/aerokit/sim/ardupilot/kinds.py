"""Data of the four kinds of ArduPilot: their parameters, and when each of them knows what while it boots."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass, fields, replace
from typing import Literal

from aerokit.sim.parameters import Parameters

Kind = Literal["copter", "plane", "rover", "sub"]
"""Which of the firmwares."""

KINDS: tuple[Kind, ...] = ("copter", "plane", "rover", "sub")
"""All of them."""

_COMMON = """
ARMING_CHECK ARMING_OPTIONS ARMING_REQUIRE BATT_ARM_MAH BATT_ARM_VOLT BATT_CAPACITY BATT_CRT_VOLT BATT_CRT_MAH
BATT_FS_CRT_ACT BATT_FS_LOW_ACT BATT_LOW_MAH BATT_LOW_TIMER BATT_LOW_VOLT BATT_MONITOR BRD_SERIAL_NUM CAM1_TYPE
EK3_ENABLE FENCE_ACTION FENCE_ALT_MAX FENCE_ALT_MIN FENCE_AUTOENABLE FENCE_ENABLE FENCE_MARGIN FENCE_OPTIONS
FENCE_RADIUS FENCE_TYPE FS_OPTIONS GPS1_TYPE INITIAL_MODE MAV_GCS_SYSID MAV_SYSID MNT1_TYPE RC_OVERRIDE_TIME
RNGFND1_TYPE RALLY_INCL_HOME RALLY_LIMIT_KM SCHED_LOOP_RATE SIM_GPS1_ENABLE SIM_SPEEDUP STAT_BOOTCNT TERRAIN_ENABLE
"""
"""What the simulation of each vehicle reads, or what shows that there are such things."""

_OWN: dict[Kind, str] = {
    "copter": """
RC_FS_TIMEOUT SRTL_ACCURACY SRTL_POINTS
ANGLE_MAX CIRCLE_RADIUS DISARM_DELAY FLTMODE1 FLTMODE2 FLTMODE3 FLTMODE4 FLTMODE5 FLTMODE6 FLTMODE_CH FRAME_CLASS
FRAME_TYPE FS_EKF_ACTION FS_EKF_THRESH FS_GCS_ENABLE FS_GCS_TIMEOUT FS_THR_ENABLE FS_THR_VALUE GUID_OPTIONS
GUID_TIMEOUT LAND_ALT_LOW LAND_SPEED LAND_SPEED_HIGH LOIT_ACC_MAX LOIT_SPEED PILOT_ACCEL_Z PILOT_SPEED_DN
PILOT_SPEED_UP PILOT_THR_BHV RTL_ALT RTL_ALT_FINAL RTL_CLIMB_MIN RTL_CONE_SLOPE RTL_LOIT_TIME RTL_SPEED WPNAV_ACCEL
WPNAV_ACCEL_Z WPNAV_RADIUS WPNAV_SPEED WPNAV_SPEED_DN WPNAV_SPEED_UP WP_YAW_BEHAVIOR
""",
    "plane": """
AFS_ENABLE FENCE_RET_ALT FENCE_RET_RALLY
RC1_DZ RC1_TRIM RC2_DZ RC2_TRIM RC3_DZ RC3_TRIM RC4_DZ RC4_TRIM RC_OPTIONS
AIRSPEED_CRUISE AIRSPEED_MAX AIRSPEED_MIN CRUISE_ALT_FLOOR FBWB_CLIMB_RATE FLTMODE1 FLTMODE2 FLTMODE3 FLTMODE4
FLTMODE5 FLTMODE6 FLTMODE_CH FS_GCS_ENABL FS_LONG_ACTN FS_LONG_TIMEOUT FS_SHORT_ACTN FS_SHORT_TIMEOUT LAND_FLARE_ALT
LAND_FLARE_SEC MIN_GROUNDSPEED NAVL1_PERIOD PTCH_LIM_MAX_DEG PTCH_LIM_MIN_DEG Q_ENABLE RLL2SRV_TCONST
ROLL_LIMIT_DEG RTL_ALTITUDE RTL_AUTOLAND RTL_RADIUS TECS_CLMB_MAX TECS_SINK_MAX TECS_SINK_MIN THR_FAILSAFE
THR_FS_VALUE TKOFF_ALT TKOFF_DIST TKOFF_LVL_ALT TRIM_THROTTLE WP_LOITER_RAD WP_RADIUS
""",
    "rover": """
ARMING_NEED_LOC SRTL_ACCURACY SRTL_POINTS
RC1_DZ RC1_TRIM RC2_DZ RC2_TRIM RC3_DZ RC3_TRIM RC4_DZ RC4_TRIM RC_OPTIONS
ATC_ACCEL_MAX ATC_DECEL_MAX ATC_STOP_SPEED ATC_STR_RAT_MAX ATC_TURN_MAX_G CRUISE_SPEED CRUISE_THROTTLE FRAME_CLASS
FS_ACTION FS_CRASH_CHECK FS_EKF_ACTION FS_GCS_ENABLE FS_GCS_TIMEOUT FS_THR_ENABLE FS_THR_VALUE FS_TIMEOUT GUID_OPTIONS
LOIT_RADIUS LOIT_SPEED_GAIN LOIT_TYPE MIS_DONE_BEHAVE MODE1 MODE2 MODE3 MODE4 MODE5 MODE6 MODE_CH RTL_SPEED
SPEED_MAX TURN_RADIUS WP_ACCEL WP_JERK WP_PIVOT_ANGLE WP_PIVOT_RATE WP_RADIUS WP_SPEED
""",
    "sub": """
BTN4_FUNCTION BTN4_SFUNCTION RC1_DZ RC1_TRIM RC2_DZ RC2_TRIM RC3_DZ RC3_TRIM RC4_DZ RC4_TRIM RC_OPTIONS
FS_PRESS_MAX FS_TEMP_ENABLE FS_TEMP_MAX FS_THR_ENABLE FS_THR_VALUE
ANGLE_MAX FRAME_CONFIG FS_EKF_ACTION FS_EKF_THRESH FS_GCS_ENABLE FS_GCS_TIMEOUT FS_LEAK_ENABLE FS_PILOT_INPUT
FS_PILOT_TIMEOUT FS_PRESS_ENABLE PILOT_ACCEL_Z PILOT_SPEED PILOT_SPEED_DN PILOT_SPEED_UP SIM_BUOYANCY SURFACE_DEPTH
SURFACE_MAX_THR
WPNAV_ACCEL WPNAV_ACCEL_Z WPNAV_RADIUS WPNAV_SPEED WPNAV_SPEED_DN WPNAV_SPEED_UP WP_YAW_BEHAVIOR
""",
}


def parameters_of(kind: Kind, count: int | None = None) -> Parameters:
    """All that the firmware lists, or so many of them; those that the simulation reads are always among them."""
    data = pkgutil.get_data(__name__, f"{kind}.param.csv")
    assert data is not None
    used = (_COMMON + _OWN[kind]).split()
    return Parameters.from_text(data.decode(), used=used, count=count)


@dataclass(frozen=True)
class BootTimeline:
    """The defaults are what ArduCopter 4.7-dev was seen to need in simulation; ``scaled`` squeezes them."""

    heartbeat: float = 0.92
    ready: float = 2.36
    """Initialised: streams start, missions are taken, the state leaves BOOT half a second later."""
    estimator_active: float = 4.36
    tilt_aligned: float = 5.70
    yaw_aligned: float = 5.80
    gps_detected: float = 9.73
    gps_fix: float = 9.94
    origin_set: float = 19.93
    healthy: float = 22.40
    """The attitude reference counts as healthy; a second later the vehicle can be armed without GPS modes."""
    position_good: float = 41.55
    """The estimator uses GPS: modes that need a position work from here."""
    factor: float = 1.0
    """How much faster or slower than the real one it is."""
    estimator_leads_early: bool = True
    """Whether the estimator is the reference from its start, and not only when it uses GPS."""

    def scaled(self, seconds: float) -> BootTimeline:
        """The same boot, over after ``seconds``; 0 is ready at once."""
        factor = seconds / self.position_good
        times = {
            field.name: getattr(self, field.name) * factor for field in fields(self) if field.type == "float"
        }
        return replace(self, **times)


BOOT_TIMELINES: dict[Kind, BootTimeline] = {
    "copter": BootTimeline(),
    "plane": BootTimeline(
        ready=2.04,
        estimator_active=9.94,
        tilt_aligned=12.08,
        yaw_aligned=12.12,
        gps_detected=8.74,
        gps_fix=8.94,
        origin_set=19.12,
        healthy=21.40,
        position_good=20.15,
        estimator_leads_early=False,
    ),
    "rover": BootTimeline(
        ready=3.05,
        estimator_active=4.00,
        tilt_aligned=5.05,
        yaw_aligned=5.90,
        gps_detected=9.05,
        gps_fix=9.90,
        origin_set=19.05,
        healthy=22.90,
        position_good=42.05,
        estimator_leads_early=False,
    ),
    "sub": BootTimeline(
        ready=1.80,
        estimator_active=3.70,
        tilt_aligned=5.30,
        yaw_aligned=5.33,
        gps_detected=9.00,
        gps_fix=9.10,
        origin_set=19.20,
        healthy=21.80,
        position_good=41.00,
    ),
}
"""What each kind was seen to need, with the parameters that its simulation starts with."""
