"""Names for the bits of SYS_STATUS, EKF_STATUS_REPORT and ESTIMATOR_STATUS, stream groups, and firmware versions."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import EstimatorStatusFlags as Estimate
from aerokit.mavlink.enums import MavDataStream
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.mavlink.messages import INDEX

# This bit is the summary of all checks, and not a sensor.
PREARM_CHECK = Sensor.MAV_SYS_STATUS_PREARM_CHECK.value

POS_HORIZ_ABS = Estimate.POS_HORIZ_ABS.value

# In modes that need a position, arming requires these estimates and the horizontal position.
ATTITUDE_AND_HEIGHT = Estimate.ATTITUDE.value | Estimate.POS_VERT_ABS.value

# MAV_SYS_STATUS_SENSOR (https://mavlink.io/en/messages/common.html#MAV_SYS_STATUS_SENSOR)
SENSORS: Mapping[int, str] = {
    Sensor.SENSOR_3D_GYRO.value: "gyroscope",
    Sensor.SENSOR_3D_ACCEL.value: "accelerometer",
    Sensor.SENSOR_3D_MAG.value: "compass",
    Sensor.ABSOLUTE_PRESSURE.value: "barometer",
    Sensor.DIFFERENTIAL_PRESSURE.value: "airspeed sensor",
    Sensor.GPS.value: "GPS",
    Sensor.OPTICAL_FLOW.value: "optical flow",
    Sensor.VISION_POSITION.value: "vision position",
    Sensor.LASER_POSITION.value: "range finder",
    Sensor.EXTERNAL_GROUND_TRUTH.value: "external ground truth",
    Sensor.ANGULAR_RATE_CONTROL.value: "rate control",
    Sensor.ATTITUDE_STABILIZATION.value: "attitude stabilisation",
    Sensor.YAW_POSITION.value: "yaw control",
    Sensor.Z_ALTITUDE_CONTROL.value: "altitude control",
    Sensor.XY_POSITION_CONTROL.value: "horizontal position control",
    Sensor.MOTOR_OUTPUTS.value: "motor outputs",
    Sensor.RC_RECEIVER.value: "RC receiver",
    Sensor.SENSOR_3D_GYRO2.value: "second gyroscope",
    Sensor.SENSOR_3D_ACCEL2.value: "second accelerometer",
    Sensor.SENSOR_3D_MAG2.value: "second compass",
    Sensor.MAV_SYS_STATUS_GEOFENCE.value: "geofence",
    Sensor.MAV_SYS_STATUS_AHRS.value: "attitude and heading estimate",
    Sensor.MAV_SYS_STATUS_TERRAIN.value: "terrain data",
    Sensor.MAV_SYS_STATUS_REVERSE_MOTOR.value: "reversed motors",
    Sensor.MAV_SYS_STATUS_LOGGING.value: "logging",
    Sensor.BATTERY.value: "battery",
    Sensor.PROXIMITY.value: "proximity sensor",
    Sensor.SATCOM.value: "satellite link",
    Sensor.MAV_SYS_STATUS_PREARM_CHECK.value: "pre-arm checks",
    Sensor.MAV_SYS_STATUS_OBSTACLE_AVOIDANCE.value: "obstacle avoidance",
    Sensor.PROPULSION.value: "propulsion",
}

# The bits that EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS have in common.
ESTIMATES: Mapping[int, str] = {
    Estimate.ATTITUDE.value: "attitude",
    Estimate.VELOCITY_HORIZ.value: "horizontal velocity",
    Estimate.VELOCITY_VERT.value: "vertical velocity",
    Estimate.POS_HORIZ_REL.value: "relative horizontal position",
    Estimate.POS_HORIZ_ABS.value: "absolute horizontal position",
    Estimate.POS_VERT_ABS.value: "absolute altitude",
    Estimate.POS_VERT_AGL.value: "altitude above ground",
    Estimate.CONST_POS_MODE.value: "constant position mode",
    Estimate.PRED_POS_HORIZ_REL.value: "predicted relative horizontal position",
    Estimate.PRED_POS_HORIZ_ABS.value: "predicted absolute horizontal position",
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

_IDS: Mapping[str, int] = {class_name: message_id for message_id, (class_name, *_) in INDEX.items()}

# Maps message id to MAV_DATA_STREAM, from ArduPilot's GCS_MAVLink_Parameters.cpp.
ARDUPILOT_GROUPS: Mapping[int, int] = {_IDS[name]: group for group, names in _GROUPS.items() for name in names}

_ALSO_STREAMED = (
    "ActuatorControlTarget", "ActuatorOutputStatus", "Ahrs2", "Ahrs3", "Altitude", "AttitudeQuaternion",
    "AttitudeTarget", "Battery2", "EfiStatus", "GimbalDeviceAttitudeStatus", "GimbalManagerStatus",
    "GlobalPositionIntCov", "GpsStatus", "Gps2Raw", "HighLatency2", "HighresImu", "HilActuatorControls",
    "HygrometerSensor", "LocalPositionNedCov", "LocalPositionNedSystemGlobalOffset", "ManualControl",
    "NavControllerOutput", "ObstacleDistance", "Odometry", "OpticalFlowRad", "OrbitExecutionStatus",
    "PositionTargetGlobalInt", "PositionTargetLocalNed", "RawRpm", "ScaledImu", "UtmGlobalPosition", "WaterDepth",
    "WheelDistance",
)  # fmt: skip

# Class names of messages that at least one autopilot sends as a stream. Other messages are sent when needed.
STREAMED_MESSAGES = frozenset((*(name for names in _GROUPS.values() for name in names), *_ALSO_STREAMED))

# Pairs of a FIRMWARE_VERSION_TYPE and the suffix of version texts. Bytes between two types count as the lower type.
_VERSION_TYPES = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))


class AutopilotVersion(Snapshot):
    """Firmware and hardware of an autopilot (AUTOPILOT_VERSION).

    ``firmware`` is for example ``"4.7.0-dev"``, and ``number`` is (major, minor, patch). ``git_hash`` is the beginning
    of the commit hash, or empty. ``capabilities`` are MAV_PROTOCOL_CAPABILITY bits. ``uid`` identifies the hardware; it
    is 0 if not reported.
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
    major, minor, patch, release_type = flight_sw_version.to_bytes(4, "big")
    suffix = next(text for lowest_type, text in _VERSION_TYPES if release_type >= lowest_type)
    return f"{major}.{minor}.{patch}{suffix}", (major, minor, patch)
