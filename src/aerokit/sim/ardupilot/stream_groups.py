"""What REQUEST_DATA_STREAM, the parameters MAVn_… and SET_MESSAGE_INTERVAL can ask each ArduPilot for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavDataStream

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.parameter_tables import Kind

__all__ = ["KNOWN_MESSAGES", "RATE_PARAMETERS", "STREAM_GROUPS"]

Groups = dict[int, tuple[int, ...]]

_COMMON: Groups = {
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
    MavDataStream.EXTRA1: (m.Attitude.ID, m.Simstate.ID, m.Ahrs2.ID),
    MavDataStream.EXTRA2: (m.VfrHud.ID,),
    MavDataStream.EXTRA3: (
        m.Ahrs.ID,
        m.Rangefinder.ID,
        m.DistanceSensor.ID,
        m.SystemTime.ID,
        m.BatteryStatus.ID,
        m.GimbalDeviceAttitudeStatus.ID,
        m.MagCalReport.ID,
        m.MagCalProgress.ID,
        m.EkfStatusReport.ID,
        m.Vibration.ID,
    ),
}
_FLYING: Groups = {
    MavDataStream.EXTRA1: (m.EscTelemetry1To4.ID,),
    MavDataStream.EXTRA3: (m.Wind.ID, m.TerrainReport.ID, m.TerrainRequest.ID),
}


def _together(*parts: Groups) -> Groups:
    return {stream: sum((part.get(stream, ()) for part in parts), ()) for stream in _COMMON}


STREAM_GROUPS: dict[Kind, Groups] = {
    "copter": _together(_COMMON, _FLYING),
    "plane": _together(
        _COMMON,
        _FLYING,
        {MavDataStream.RAW_SENSORS: (m.Airspeed.ID,), MavDataStream.EXTRA1: (m.AoaSsa.ID,)},
    ),
    "rover": _together(_COMMON, {MavDataStream.RAW_CONTROLLER: (m.RcChannelsScaled.ID,)}),
    "sub": _together(
        _COMMON,
        {
            MavDataStream.RAW_SENSORS: (m.ScaledPressure3.ID,),
            MavDataStream.EXTENDED_STATUS: (m.NamedValueFloat.ID,),
            MavDataStream.EXTRA3: (m.TerrainReport.ID,),
        },
    ),
}
"""Kind → stream → messages that it may send; some of them only under conditions."""

RATE_PARAMETERS: dict[int, str] = {
    MavDataStream.RAW_SENSORS: "RAW_SENS",
    MavDataStream.EXTENDED_STATUS: "EXT_STAT",
    MavDataStream.RC_CHANNELS: "RC_CHAN",
    MavDataStream.RAW_CONTROLLER: "RAW_CTRL",
    MavDataStream.POSITION: "POSITION",
    MavDataStream.EXTRA1: "EXTRA1",
    MavDataStream.EXTRA2: "EXTRA2",
    MavDataStream.EXTRA3: "EXTRA3",
}
"""Stream → how the parameter with its rate ends: MAV1_EXTRA1 for the first port."""

_ALL_KINDS: frozenset[int] = frozenset(
    {
        0, 1, 2, 22, 24, 26, 27, 29, 30, 31, 32, 33, 35, 36, 42, 46, 49, 62, 65, 74, 83, 85, 87, 100, 105, 108, 116,
        124, 125, 127, 128, 129, 132, 133, 136, 137, 143, 147, 148, 152, 162, 163, 164, 165, 168, 173, 178, 180, 191,
        192, 193, 194, 225, 226, 235, 241, 242, 244, 245, 246, 259, 260, 262, 264, 269, 271, 277, 280, 281, 285, 286,
        295, 301, 373, 376, 435, 437, 9005, 10008, 11030,
    }
)  # fmt: skip

KNOWN_MESSAGES: dict[Kind, frozenset[int]] = {
    "copter": _ALL_KINDS,
    "plane": _ALL_KINDS | {m.Deepstall.ID, m.AoaSsa.ID},
    "rover": _ALL_KINDS | {m.RcChannelsScaled.ID, m.WaterDepth.ID},
    "sub": _ALL_KINDS,
}
"""Kind → what can be asked for by id; the rest is DENIED as a stream and FAILED as a single message."""
