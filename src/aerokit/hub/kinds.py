"""``Kind``: what may happen to a message that has to wait, because a link does not take more."""

from __future__ import annotations

from enum import Enum
from fnmatch import fnmatchcase
from functools import cache

__all__ = ["Kind", "kind_of"]


class Kind(Enum):
    """What may happen to a message that has to wait."""

    TELEMETRY = "telemetry"
    """A newer one of the same sender takes its place."""
    TRANSFER = "transfer"
    """It waits, in order, and is never replaced: a part of something larger, an answer, a text."""
    ORDER = "order"
    """The same, but for a second at most: an order never arrives late."""


# What is sent again and again, whole each time, and of which a sender has one. Messages with an instance in a field
# (batteries, range finders, named values) and whatever is not in here are never replaced.
_SENT_AGAIN_AND_AGAIN = """
    HEARTBEAT SYS_STATUS SYSTEM_TIME GPS_RAW_INT GPS2_RAW GPS_STATUS NAV_CONTROLLER_OUTPUT HIGH_LATENCY2
    SCALED_IMU SCALED_IMU2 SCALED_IMU3 RAW_PRESSURE
    SCALED_PRESSURE SCALED_PRESSURE2 SCALED_PRESSURE3 ATTITUDE ATTITUDE_QUATERNION ATTITUDE_QUATERNION_COV
    ATTITUDE_TARGET LOCAL_POSITION_NED LOCAL_POSITION_NED_COV GLOBAL_POSITION_INT GLOBAL_POSITION_INT_COV
    LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET POSITION_TARGET_LOCAL_NED POSITION_TARGET_GLOBAL_INT RC_CHANNELS
    MISSION_CURRENT VFR_HUD ALTITUDE HOME_POSITION GPS_GLOBAL_ORIGIN EXTENDED_SYS_STATE ESTIMATOR_STATUS
    EKF_STATUS_REPORT VIBRATION WIND WIND_COV AHRS AHRS2 AHRS3 HWSTATUS MEMINFO POWER_STATUS TERRAIN_REPORT
    RANGEFINDER SIMSTATE SIM_STATE AOA_SSA PID_TUNING FENCE_STATUS RADIO_STATUS RADIO EFI_STATUS
    AIRSPEED_AUTOCAL MOUNT_ORIENTATION CONTROL_SYSTEM_STATE HIGH_LATENCY LINK_NODE_STATUS
"""
_TELEMETRY = frozenset(_SENT_AGAIN_AND_AGAIN.split())
_ANSWERS = """
    COMMAND_ACK MISSION_ACK MISSION_REQUEST MISSION_REQUEST_INT MISSION_REQUEST_LIST MISSION_REQUEST_PARTIAL_LIST
    MISSION_CURRENT MISSION_ITEM_REACHED MISSION_CHECKSUM
"""
_NO_ORDERS = frozenset(_ANSWERS.split())
_ORDERS = (
    "COMMAND_*", "SET_*", "MANUAL_*", "RC_CHANNELS_OVERRIDE", "MISSION_*", "PARAM_SET", "PARAM_EXT_SET", "*_SET_*",
    "LOG_ERASE", "FENCE_POINT", "RALLY_POINT", "MOUNT_CONTROL", "MOUNT_CONFIGURE", "DIGICAM_CONTROL",
    "DIGICAM_CONFIGURE", "CHANGE_OPERATOR_CONTROL", "LED_CONTROL", "PLAY_TUNE*", "SERIAL_CONTROL", "HIL_CONTROLS",
    "HIL_ACTUATOR_CONTROLS", "LANDING_TARGET", "FOLLOW_TARGET",
)  # fmt: skip


@cache  # of each message of the dialects in use: a frame that has to wait costs no search
def kind_of(name: str, *, is_for_one: bool) -> Kind:
    """What a message of the standard's ``name`` is; ``is_for_one``: this frame names a target, and is no telemetry."""
    if name not in _NO_ORDERS and any(fnmatchcase(name, pattern) for pattern in _ORDERS):
        return Kind.ORDER
    if name in _TELEMETRY and not is_for_one:
        return Kind.TELEMETRY
    return Kind.TRANSFER
