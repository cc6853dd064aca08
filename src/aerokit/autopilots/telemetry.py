"""Names for the bits of SYS_STATUS, EKF_STATUS_REPORT and ESTIMATOR_STATUS, stream groups, and firmware versions."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import EstimatorStatusFlags, MavDataStream, MavSysStatusSensor
from aerokit.mavlink.messages import INDEX

_E, _S = EstimatorStatusFlags, MavSysStatusSensor

# The summary of all checks, not a sensor.
PREARM_CHECK = _S.MAV_SYS_STATUS_PREARM_CHECK.value

POS_HORIZ_ABS = _E.POS_HORIZ_ABS.value

# Besides the position itself, these are required to arm in a mode that needs a position.
ATTITUDE_AND_HEIGHT = _E.ATTITUDE.value | _E.POS_VERT_ABS.value

# MAV_SYS_STATUS_SENSOR (https://mavlink.io/en/messages/common.html#MAV_SYS_STATUS_SENSOR)
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

# The bits that EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS have in common.
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


def bit_names(bits: int, names: Mapping[int, str]) -> tuple[str, ...]:
    """Return the names of the bits that are set. Bits without a name are ignored."""
    return tuple(name for bit, name in names.items() if bits & bit)


_GROUPS: Mapping[int, tuple[str, ...]] = {
    MavDataStream.RAW_SENSORS: (
        "RawImu",
        "ScaledImu2",
        "ScaledImu3",
        "ScaledPressure",
        "ScaledPressure2",
        "ScaledPressure3",
        "Airspeed",
    ),
    MavDataStream.EXTENDED_STATUS: (
        "SysStatus",
        "PowerStatus",
        "McuStatus",
        "Meminfo",
        "MissionCurrent",
        "GpsRawInt",
        "GpsRtk",
        "Gps2Raw",
        "Gps2Rtk",
        "NavControllerOutput",
        "FenceStatus",
        "PositionTargetGlobalInt",
    ),
    MavDataStream.POSITION: ("GlobalPositionInt", "LocalPositionNed"),
    MavDataStream.RAW_CONTROLLER: ("RcChannelsScaled",),
    MavDataStream.RC_CHANNELS: ("ServoOutputRaw", "RcChannels", "RcChannelsRaw"),
    MavDataStream.EXTRA1: ("Attitude", "Simstate", "Ahrs2", "Rpm", "AoaSsa", "PidTuning", "EscTelemetry1To4"),
    MavDataStream.EXTRA2: ("VfrHud",),
    MavDataStream.EXTRA3: (
        "Ahrs",
        "Wind",
        "Rangefinder",
        "DistanceSensor",
        "SystemTime",
        "TerrainReport",
        "BatteryStatus",
        "OpticalFlow",
        "MagCalReport",
        "MagCalProgress",
        "EkfStatusReport",
        "Vibration",
    ),
}

_IDS: Mapping[str, int] = {row[0]: message_id for message_id, row in INDEX.items()}

# Message id → MAV_DATA_STREAM, from ArduPilot's GCS_MAVLink_Parameters.cpp.
ARDUPILOT_GROUPS: Mapping[int, int] = {_IDS[name]: group for group, names in _GROUPS.items() for name in names}

_ALSO_STREAMED = (
    *("ActuatorControlTarget", "ActuatorOutputStatus", "Ahrs2", "Ahrs3", "Altitude", "AttitudeQuaternion"),
    *("AttitudeTarget", "Battery2", "EfiStatus"),
    *("GimbalDeviceAttitudeStatus", "GimbalManagerStatus", "GlobalPositionIntCov", "GpsStatus", "Gps2Raw"),
    *("HighLatency2", "HighresImu", "HilActuatorControls", "HygrometerSensor", "LocalPositionNedCov"),
    *("LocalPositionNedSystemGlobalOffset", "ManualControl", "NavControllerOutput", "ObstacleDistance"),
    *("Odometry", "OpticalFlowRad", "OrbitExecutionStatus", "PositionTargetGlobalInt"),
    *("PositionTargetLocalNed", "RawRpm", "ScaledImu", "UtmGlobalPosition", "WaterDepth", "WheelDistance"),
)

# Class names of messages that any autopilot sends as a stream. Other messages are sent when needed.
STREAMED_MESSAGES = frozenset((*(name for names in _GROUPS.values() for name in names), *_ALSO_STREAMED))

# First number of each FIRMWARE_VERSION_TYPE, and the suffix for its version texts.
_VERSION_TYPES = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))


class AutopilotVersion(Snapshot):
    """Firmware and hardware of an autopilot (AUTOPILOT_VERSION).

    ``firmware`` is for example ``"4.7.0-dev"``, ``number`` its (major, minor, patch), ``git_hash`` the beginning of the
    commit hash or an empty string. ``capabilities`` are MAV_PROTOCOL_CAPABILITY bits. ``uid`` identifies the hardware,
    0 if not reported.
    """

    firmware: str
    number: tuple[int, int, int]
    git_hash: str
    capabilities: int
    vendor_id: int
    product_id: int
    board_version: int
    uid: int

    def __str__(self) -> str:
        return f"{self.firmware} ({self.git_hash})" if self.git_hash else self.firmware


def version_text(flight_sw_version: int) -> tuple[str, tuple[int, int, int]]:
    """Convert ``flight_sw_version`` to text and (major, minor, patch): ``("4.6.1-rc", (4, 6, 1))``."""
    major, minor, patch, kind = flight_sw_version.to_bytes(4, "big")
    suffix = next(text for first, text in _VERSION_TYPES if kind >= first)
    return f"{major}.{minor}.{patch}{suffix}", (major, minor, patch)
