"""What REQUEST_DATA_STREAM and SET_MESSAGE_INTERVAL can ask an ArduCopter for."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavDataStream

__all__ = ["COPTER_GROUPS", "KNOWN_MESSAGES"]

COPTER_GROUPS: dict[int, tuple[int, ...]] = {
    MavDataStream.RAW_SENSORS: (
        m.RawImu.ID,
        m.ScaledImu2.ID,
        m.ScaledImu3.ID,
        m.ScaledPressure.ID,
        m.ScaledPressure2.ID,
    ),
    MavDataStream.EXTENDED_STATUS: (
        m.SysStatus.ID,
        m.PowerStatus.ID,
        m.Meminfo.ID,
        m.MissionCurrent.ID,
        m.GpsRawInt.ID,
        m.NavControllerOutput.ID,
        m.FenceStatus.ID,
        m.PositionTargetGlobalInt.ID,
    ),
    MavDataStream.RC_CHANNELS: (m.ServoOutputRaw.ID, m.RcChannels.ID, m.RcChannelsRaw.ID),
    MavDataStream.RAW_CONTROLLER: (),
    MavDataStream.POSITION: (m.GlobalPositionInt.ID, m.LocalPositionNed.ID),
    MavDataStream.EXTRA1: (m.Attitude.ID, m.Simstate.ID, m.Ahrs2.ID, m.EscTelemetry1To4.ID),
    MavDataStream.EXTRA2: (m.VfrHud.ID,),
    MavDataStream.EXTRA3: (
        m.Ahrs.ID,
        m.Wind.ID,
        m.Rangefinder.ID,
        m.DistanceSensor.ID,
        m.SystemTime.ID,
        m.TerrainReport.ID,
        m.BatteryStatus.ID,
        m.GimbalDeviceAttitudeStatus.ID,
        m.EkfStatusReport.ID,
        m.Vibration.ID,
    ),
}
"""Stream → messages, in the order of the firmware."""

KNOWN_MESSAGES: frozenset[int] = frozenset(
    {
        m.Heartbeat.ID,
        m.HomePosition.ID,
        m.GpsGlobalOrigin.ID,
        m.AttitudeQuaternion.ID,
        m.AttitudeTarget.ID,
        m.PositionTargetLocalNed.ID,
        m.ExtendedSysState.ID,
        m.AutopilotVersion.ID,
        m.AvailableModes.ID,
        m.AvailableModesMonitor.ID,
        m.GimbalManagerInformation.ID,
        m.GimbalManagerStatus.ID,
        m.ParamValue.ID,
        m.CameraInformation.ID,
        m.CameraSettings.ID,
        m.CameraCaptureStatus.ID,
        m.CameraFeedback.ID,
        *(message_id for group in COPTER_GROUPS.values() for message_id in group),
    }
)
"""What can be asked for by id; the rest is DENIED as a stream and FAILED as a single message."""
