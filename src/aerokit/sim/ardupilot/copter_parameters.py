"""Parameters of a simulated ArduCopter: names, types, values and defaults of 4.7-dev, in its order."""

from __future__ import annotations

import pkgutil

from aerokit.sim.parameters import Parameters

__all__ = ["copter_parameters"]

_USED = """
ANGLE_MAX ARMING_CHECK ARMING_OPTIONS BATT_ARM_VOLT BATT_CAPACITY BATT_CRT_VOLT BATT_FS_CRT_ACT
BATT_FS_LOW_ACT BATT_LOW_MAH BATT_LOW_TIMER BATT_LOW_VOLT BATT_MONITOR BRD_SERIAL_NUM CIRCLE_RADIUS
DISARM_DELAY EK3_ENABLE FENCE_ENABLE FLTMODE1 FLTMODE2 FLTMODE3 FLTMODE4 FLTMODE5 FLTMODE6
FLTMODE_CH FRAME_CLASS FRAME_TYPE FS_EKF_ACTION FS_EKF_THRESH FS_GCS_ENABLE FS_GCS_TIMEOUT
FS_OPTIONS FS_THR_ENABLE FS_THR_VALUE GPS1_TYPE GUID_OPTIONS GUID_TIMEOUT INITIAL_MODE LAND_ALT_LOW
LAND_SPEED LAND_SPEED_HIGH LOIT_ACC_MAX LOIT_SPEED MAV_GCS_SYSID MAV_SYSID MNT1_TYPE PILOT_ACCEL_Z
PILOT_SPEED_DN PILOT_SPEED_UP PILOT_THR_BHV RC_OVERRIDE_TIME RNGFND1_TYPE RTL_ALT RTL_ALT_FINAL RTL_CLIMB_MIN
RTL_CONE_SLOPE RTL_LOIT_TIME RTL_SPEED SCHED_LOOP_RATE SIM_SPEEDUP STAT_BOOTCNT TERRAIN_ENABLE
WPNAV_ACCEL WPNAV_ACCEL_Z WPNAV_RADIUS WPNAV_SPEED WPNAV_SPEED_DN WPNAV_SPEED_UP WP_YAW_BEHAVIOR
"""
"""What the simulation reads, or what shows that there are such things."""


def copter_parameters(count: int | None = None) -> Parameters:
    """All 1,349, or so many of them; those that the simulation reads are always among them."""
    data = pkgutil.get_data(__name__, "copter.param.csv")
    assert data is not None
    return Parameters.from_text(data.decode(), used=_USED.split(), count=count)
