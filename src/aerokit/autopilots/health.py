"""What the bits of SYS_STATUS, EKF_STATUS_REPORT and ESTIMATOR_STATUS say, in words."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit.mavlink.enums import EstimatorStatusFlags, MavSysStatusSensor

__all__ = [
    "ATTITUDE_AND_HEIGHT",
    "ESTIMATES",
    "POS_HORIZ_ABS",
    "PREARM_CHECK",
    "SENSORS",
    "names_of",
]

_E, _S = EstimatorStatusFlags, MavSysStatusSensor
PREARM_CHECK = _S.MAV_SYS_STATUS_PREARM_CHECK.value
"""MAV_SYS_STATUS_PREARM_CHECK: the summary of all checks, not a sensor."""
POS_HORIZ_ABS = _E.POS_HORIZ_ABS.value
ATTITUDE_AND_HEIGHT = _E.ATTITUDE.value | _E.POS_VERT_ABS.value
"""What arming in a mode that needs a position takes at least, besides the position itself."""

SENSORS: Mapping[int, str] = {
    _S.SENSOR_3D_GYRO.value: "gyroscope",
    _S.SENSOR_3D_ACCEL.value: "accelerometer",
    _S.SENSOR_3D_MAG.value: "compass",
    _S.ABSOLUTE_PRESSURE.value: "barometer",
    _S.DIFFERENTIAL_PRESSURE.value: "airspeed sensor",
    _S.GPS.value: "GPS",
    _S.OPTICAL_FLOW.value: "optical flow",
    _S.VISION_POSITION.value: "vision position",
    _S.LASER_POSITION.value: "range finder",
    _S.EXTERNAL_GROUND_TRUTH.value: "external ground truth",
    _S.ANGULAR_RATE_CONTROL.value: "rate control",
    _S.ATTITUDE_STABILIZATION.value: "attitude stabilisation",
    _S.YAW_POSITION.value: "yaw control",
    _S.Z_ALTITUDE_CONTROL.value: "altitude control",
    _S.XY_POSITION_CONTROL.value: "horizontal position control",
    _S.MOTOR_OUTPUTS.value: "motor outputs",
    _S.RC_RECEIVER.value: "RC receiver",
    _S.SENSOR_3D_GYRO2.value: "second gyroscope",
    _S.SENSOR_3D_ACCEL2.value: "second accelerometer",
    _S.SENSOR_3D_MAG2.value: "second compass",
    _S.MAV_SYS_STATUS_GEOFENCE.value: "geofence",
    _S.MAV_SYS_STATUS_AHRS.value: "attitude and heading estimate",
    _S.MAV_SYS_STATUS_TERRAIN.value: "terrain data",
    _S.MAV_SYS_STATUS_REVERSE_MOTOR.value: "reversed motors",
    _S.MAV_SYS_STATUS_LOGGING.value: "logging",
    _S.BATTERY.value: "battery",
    _S.PROXIMITY.value: "proximity sensor",
    _S.SATCOM.value: "satellite link",
    _S.MAV_SYS_STATUS_PREARM_CHECK.value: "pre-arm checks",
    _S.MAV_SYS_STATUS_OBSTACLE_AVOIDANCE.value: "obstacle avoidance",
    _S.PROPULSION.value: "propulsion",
}
"""MAV_SYS_STATUS_SENSOR (https://mavlink.io/en/messages/common.html#MAV_SYS_STATUS_SENSOR) in words."""

ESTIMATES: Mapping[int, str] = {
    _E.ATTITUDE.value: "attitude",
    _E.VELOCITY_HORIZ.value: "horizontal velocity",
    _E.VELOCITY_VERT.value: "vertical velocity",
    _E.POS_HORIZ_REL.value: "relative horizontal position",
    _E.POS_HORIZ_ABS.value: "absolute horizontal position",
    _E.POS_VERT_ABS.value: "absolute altitude",
    _E.POS_VERT_AGL.value: "altitude above ground",
    _E.CONST_POS_MODE.value: "constant position mode",
    _E.PRED_POS_HORIZ_REL.value: "predicted relative horizontal position",
    _E.PRED_POS_HORIZ_ABS.value: "predicted absolute horizontal position",
}
"""The bits that EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS have in common, in words."""


def names_of(bits: int, names: Mapping[int, str]) -> tuple[str, ...]:
    """The names of the bits that are set; a bit without a name is left out."""
    return tuple(name for bit, name in names.items() if bits & bit)
