"""Which messages come in which stream group, and how fast the values that programs read should come."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit.mavlink import messages as m
from aerokit.mavlink.message import Message

__all__ = ["ARDUPILOT_GROUPS", "DEFAULT_RATES_HZ"]

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

_GROUPS: Mapping[int, tuple[type[Message], ...]] = {
    RAW_SENSORS: (
        m.RawImu,
        m.ScaledImu2,
        m.ScaledImu3,
        m.ScaledPressure,
        m.ScaledPressure2,
        m.ScaledPressure3,
        m.Airspeed,
    ),
    EXTENDED_STATUS: (
        m.SysStatus,
        m.PowerStatus,
        m.McuStatus,
        m.Meminfo,
        m.MissionCurrent,
        m.GpsRawInt,
        m.GpsRtk,
        m.Gps2Raw,
        m.Gps2Rtk,
        m.NavControllerOutput,
        m.FenceStatus,
        m.PositionTargetGlobalInt,
    ),
    POSITION: (m.GlobalPositionInt, m.LocalPositionNed),
    RAW_CONTROLLER: (m.RcChannelsScaled,),
    RC_CHANNELS: (m.ServoOutputRaw, m.RcChannels, m.RcChannelsRaw),
    EXTRA1: (m.Attitude, m.Simstate, m.Ahrs2, m.Rpm, m.AoaSsa, m.PidTuning, m.EscTelemetry1To4),
    EXTRA2: (m.VfrHud,),
    EXTRA3: (
        m.Ahrs,
        m.Wind,
        m.Rangefinder,
        m.DistanceSensor,
        m.SystemTime,
        m.TerrainReport,
        m.BatteryStatus,
        m.OpticalFlow,
        m.MagCalReport,
        m.MagCalProgress,
        m.EkfStatusReport,
        m.Vibration,
    ),
}

ARDUPILOT_GROUPS: Mapping[int, int] = {
    message.ID: group for group, messages in _GROUPS.items() for message in messages
}
"""Message id → MAV_DATA_STREAM, from ArduPilot's GCS_MAVLink_Parameters.cpp."""

DEFAULT_RATES_HZ: Mapping[type[Message], float] = {
    m.Attitude: 10.0,
    m.AttitudeQuaternion: 10.0,
    m.GlobalPositionInt: 10.0,
    m.LocalPositionNed: 10.0,
    m.VfrHud: 5.0,
    m.ExtendedSysState: 5.0,
    m.SysStatus: 2.0,
    m.GpsRawInt: 2.0,
    m.Gps2Raw: 2.0,
    m.EkfStatusReport: 2.0,
    m.EstimatorStatus: 2.0,
    m.RcChannels: 2.0,
    m.ServoOutputRaw: 2.0,
    m.DistanceSensor: 5.0,
    m.Rangefinder: 5.0,
    m.BatteryStatus: 1.0,
    m.MissionCurrent: 1.0,
    m.SystemTime: 1.0,
    m.Vibration: 1.0,
    m.Wind: 1.0,
    m.WindCov: 1.0,
    m.HomePosition: 0.5,
    m.GpsGlobalOrigin: 0.5,
    m.CurrentMode: 1.0,
}
"""How fast the values of a vehicle should come when nobody asks for another rate."""
