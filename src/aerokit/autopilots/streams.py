"""Which messages come in which stream group, and how fast the values that programs read should come."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit.mavlink.messages import INDEX

__all__ = ["ARDUPILOT_GROUPS", "DEFAULT_RATES_HZ", "subscription_rate_hz"]

RAW_SENSORS, EXTENDED_STATUS, RC_CHANNELS, RAW_CONTROLLER, POSITION, EXTRA1, EXTRA2, EXTRA3 = (
    1,
    2,
    3,
    4,
    6,
    10,
    11,
    12,
)

_GROUPS: Mapping[int, tuple[str, ...]] = {
    RAW_SENSORS: (
        "RawImu",
        "ScaledImu2",
        "ScaledImu3",
        "ScaledPressure",
        "ScaledPressure2",
        "ScaledPressure3",
        "Airspeed",
    ),
    EXTENDED_STATUS: (
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
    POSITION: ("GlobalPositionInt", "LocalPositionNed"),
    RAW_CONTROLLER: ("RcChannelsScaled",),
    RC_CHANNELS: ("ServoOutputRaw", "RcChannels", "RcChannelsRaw"),
    EXTRA1: ("Attitude", "Simstate", "Ahrs2", "Rpm", "AoaSsa", "PidTuning", "EscTelemetry1To4"),
    EXTRA2: ("VfrHud",),
    EXTRA3: (
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

ARDUPILOT_GROUPS: Mapping[int, int] = {
    _IDS[name]: group for group, names in _GROUPS.items() for name in names
}
"""Message id → MAV_DATA_STREAM, from ArduPilot's GCS_MAVLink_Parameters.cpp."""

DEFAULT_RATES_HZ: Mapping[str, float] = {
    "Attitude": 10.0,
    "GlobalPositionInt": 10.0,
    "LocalPositionNed": 10.0,
    "VfrHud": 5.0,
    "ExtendedSysState": 5.0,
    "SysStatus": 2.0,
    "GpsRawInt": 2.0,
    "EkfStatusReport": 2.0,
    "EstimatorStatus": 2.0,
    "RcChannels": 2.0,
    "ServoOutputRaw": 2.0,
    "DistanceSensor": 5.0,
    "BatteryStatus": 1.0,
    "MissionCurrent": 1.0,
    "SystemTime": 1.0,
    "Vibration": 1.0,
    "Wind": 1.0,
    "WindCov": 1.0,
    "CurrentMode": 1.0,
}
"""Class name of a message → how fast it should come when nobody asks for another rate.

Names, so that this module does not have all messages imported.
"""

SUBSCRIPTION_HZ = 4.0
"""How fast a streamed message without a default rate is asked for by a subscription that names no rate."""

_ALSO_STREAMED = (
    *("ActuatorControlTarget", "ActuatorOutputStatus", "Ahrs2", "Ahrs3", "Altitude", "AttitudeQuaternion"),
    *(
        "AttitudeTarget",
        "Battery2",
        "EfiStatus",
    ),
    *("GimbalDeviceAttitudeStatus", "GimbalManagerStatus", "GlobalPositionIntCov", "GpsStatus", "Gps2Raw"),
    *("HighLatency2", "HighresImu", "HilActuatorControls", "HygrometerSensor", "LocalPositionNedCov"),
    *("LocalPositionNedSystemGlobalOffset", "ManualControl", "NavControllerOutput", "ObstacleDistance"),
    *("Odometry", "OpticalFlowRad", "OrbitExecutionStatus", "PositionTargetGlobalInt"),
    *("PositionTargetLocalNed", "RawRpm", "ScaledImu", "UtmGlobalPosition", "WaterDepth", "WheelDistance"),
)


def subscription_rate_hz(class_name: str) -> float | None:
    """The rate that a subscription asks for when it names none; None: the message is sent when there is need for it."""
    if class_name in DEFAULT_RATES_HZ:
        return DEFAULT_RATES_HZ[class_name]
    return SUBSCRIPTION_HZ if class_name in _STREAMED else None


_STREAMED = frozenset((*(name for names in _GROUPS.values() for name in names), *_ALSO_STREAMED))
