"""Parameters of a simulated PX4 quadrotor: names, types, values and defaults of v1.17, sorted by name."""

from __future__ import annotations

import pkgutil

from aerokit.sim.parameters import Parameters

__all__ = ["px4_parameters"]

_USED = """
BAT1_CAPACITY BAT1_N_CELLS BAT1_SOURCE BAT_CRIT_THR BAT_EMERGEN_THR BAT_LOW_THR CAL_ACC0_ID
CBRK_SUPPLY_CHK COM_ARM_WO_GPS COM_DISARM_LAND COM_DISARM_PRFLT COM_DL_LOSS_T COM_FAIL_ACT_T
COM_DLL_EXCEPT COM_FLTMODE1 COM_LOW_BAT_ACT COM_OBL_RC_ACT COM_OF_LOSS_T COM_RCL_EXCEPT COM_RC_IN_MODE
COM_RC_LOSS_T COM_RC_OVERRIDE COM_RC_STICK_OV COM_SPOOLUP_TIME EKF2_EN EKF2_GPS_CHECK FW_AIRSPD_MAX
FW_AIRSPD_MIN FW_AIRSPD_TRIM FW_LND_ANG FW_T_CLMB_MAX FW_T_SINK_MAX FW_T_SINK_MIN FW_R_LIM GF_ACTION
GF_MAX_HOR_DIST GF_MAX_VER_DIST LNDMC_Z_VEL_MAX MAV_COMP_ID MAV_SYS_ID MAV_TYPE MIS_TAKEOFF_ALT
MPC_ACC_DOWN_MAX MPC_ACC_HOR MPC_ACC_UP_MAX MPC_LAND_ALT1 MPC_LAND_ALT2 MPC_LAND_SPEED MPC_MANTHR_MIN
MPC_MAN_TILT_MAX MPC_MAN_Y_MAX MPC_THR_HOVER MPC_TILTMAX_AIR MPC_TKO_RAMP_T MPC_TKO_SPEED MPC_VEL_MANUAL
MPC_XY_CRUISE MPC_XY_VEL_MAX MPC_Z_VEL_MAX_DN MPC_Z_VEL_MAX_UP MPC_YAWRAUTO_MAX MPC_Z_V_AUTO_DN
MPC_Z_V_AUTO_UP MIS_TKO_LAND_REQ NAV_ACC_RAD NAV_DLL_ACT NAV_FW_ALT_RAD NAV_LOITER_RAD NAV_RCL_ACT
RC_MAP_PITCH RC_MAP_ROLL RC_MAP_THROTTLE RC_MAP_YAW RTL_CONE_ANG RTL_DESCEND_ALT RTL_LAND_DELAY
RTL_LOITER_RAD RTL_MIN_DIST RTL_RETURN_ALT RTL_TYPE RWTO_RAMP_TIME SDLOG_MODE SYS_AUTOSTART SYS_HAS_GPS
"""
"""What the simulation reads, or what shows that there are such things."""


def px4_parameters(count: int | None = None, table: str = "quadrotor") -> Parameters:
    """All 910 of a quadrotor, or the 978 of an "airplane", or so many of them; those that are read are always there."""
    data = pkgutil.get_data(__name__, f"{table}.param.csv")
    assert data is not None
    return Parameters.from_text(data.decode(), used=_USED.split(), count=count)
