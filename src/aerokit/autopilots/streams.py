"""Which messages come in streams, and in which stream group."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit.mavlink.enums import MavDataStream
from aerokit.mavlink.messages import INDEX

__all__ = ["ARDUPILOT_GROUPS", "STREAMED"]


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

ARDUPILOT_GROUPS: Mapping[int, int] = {
    _IDS[name]: group for group, names in _GROUPS.items() for name in names
}
"""Message id → MAV_DATA_STREAM, from ArduPilot's GCS_MAVLink_Parameters.cpp."""

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

STREAMED = frozenset((*(name for names in _GROUPS.values() for name in names), *_ALSO_STREAMED))
"""Class names of the messages that come in streams, of any autopilot; the others are sent when there is need."""
