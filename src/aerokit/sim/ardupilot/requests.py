"""How a client asks a simulated ArduPilot for messages: by id and interval, by stream group, or once."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavDataStream, MavResult
from aerokit.mavlink.messages import (
    AvailableModes,
    AvailableModesMonitor,
    Heartbeat,
    MessageInterval,
    NamedValueFloat,
    RcChannelsRaw,
    RequestDataStream,
    TerrainRequest,
)
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, whole

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


_SHORTEST_S, _LONGEST_S = 0.0025 / 0.8, 60.0
_LARGEST_IN_MESSAGE_INTERVAL = 1 << 16
_TERRAIN_REQUEST_S = 2.0


DISPLAY_VALUES: dict[str, float] = {
    "CamTilt": 0.5,
    "CamPan": 0.5,
    "TetherTrn": 0.0,
    "Lights1": 0.5,
    "Lights2": 0.5,
    "PilotGain": 0.5,
    "InputHold": 0.0,
    "RollPitch": 0.0,
    "RFTarget": -0.01,
}
"""What ArduSub tells a pilot's display in each round of EXTENDED_STATUS."""


class Requests:
    """SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE and REQUEST_DATA_STREAM.

    The rates of the streams are parameters of the port (MAV1_EXTRA1 and so on), read at the start; REQUEST_DATA_STREAM
    changes them. Only a plane saves and announces that, the others forget it in a reboot.
    """

    def __init__(self, vehicle: Host, *, stream_groups: bool = True) -> None:
        self._vehicle = vehicle
        self._known = KNOWN_MESSAGES[vehicle.KIND]
        self._groups = STREAM_GROUPS[vehicle.KIND]
        self._saved: dict[str, tuple[float, int]] = {}
        """Name of a rate → its saved value, and that which stands in for it until the next reboot."""
        if stream_groups:
            vehicle.on(RequestDataStream, self._on_group)

    def set_interval(self, command: Command) -> int:
        """Interval in microseconds; -1 is off, 0 the default (off, but for the heartbeat)."""
        message_id, interval_us = whole(command.param1), whole(command.param2)
        if command.param3 != 0.0:
            return MavResult.DENIED
        if message_id not in self._known:
            self._vehicle.info(f"No ap_message for mavlink id ({message_id})")
            return MavResult.DENIED
        if interval_us < -1:
            return MavResult.DENIED
        interval = max(0, interval_us) / 1e6
        if interval_us == 0 and message_id == Heartbeat.ID:
            interval = 1.0
        if 0.0 < interval < _SHORTEST_S:
            text = f"Requested rate for message ID {message_id} too fast. Increase SCHED_LOOP_RATE"
            self._vehicle.info(text)
            return MavResult.DENIED
        self._stream(message_id, min(interval, _LONGEST_S), command.channel, self._vehicle.now)
        return MavResult.ACCEPTED

    def get_interval(self, command: Command) -> int:
        """Answers MESSAGE_INTERVAL before the acknowledgement."""
        return self._send_interval(whole(command.param1), command.channel)

    def _send_interval(self, message_id: int, channel: Channel) -> int:
        known = message_id in self._known
        interval_us = round(channel.streams.interval(message_id) * 1e6) or -1
        if message_id < _LARGEST_IN_MESSAGE_INTERVAL:
            self._vehicle.send(MessageInterval(message_id, interval_us if known else 0), channel)
        return MavResult.ACCEPTED if known else MavResult.FAILED

    def request_message(self, command: Command) -> int:
        """Send a message once, right after the acknowledgement."""
        message_id = whole(command.param1)
        if message_id == MessageInterval.ID:
            return self._send_interval(whole(command.param2), command.channel)
        if message_id not in self._known:
            return MavResult.FAILED
        if message_id == AvailableModes.ID:
            self._send_modes(whole(command.param2), command.channel)
        else:
            self.send_soon(message_id, command.channel)
        return MavResult.ACCEPTED

    def send_soon(self, message_id: int, channel: Channel) -> None:
        """Send it after what is being answered now."""

        def send() -> None:
            message = self._vehicle.build(message_id)
            if message is not None and (message_id != RcChannelsRaw.ID or channel.version == 1):
                self._vehicle.send(message, channel)

        self._vehicle.call_later(0.0, send)

    def _send_modes(self, index: int, channel: Channel) -> None:
        """One mode by its index from 1, or all for 0; from then on AVAILABLE_MODES_MONITOR every 5 s."""
        vehicle = self._vehicle
        modes = vehicle.available_modes()
        wanted = modes if index == 0 else modes[index - 1 : index]
        for message in wanted:
            vehicle.call_later(0.0, lambda message=message: vehicle.send(message, channel))  # type: ignore[misc]
        channel.streams.set_interval(AvailableModesMonitor.ID, 5.0, vehicle.now)

    def _on_group(self, request: RequestDataStream, channel: Channel) -> None:
        if request.start_stop not in (0, 1):
            return
        rate = request.req_message_rate if request.start_stop else 0
        wanted = request.req_stream_id
        for stream in self._groups if wanted == MavDataStream.ALL else (wanted,):
            if stream in self._groups:
                self._stream_group(stream, rate, channel, self._vehicle.now)
                self._remember(f"{self._prefix(channel)}{RATE_PARAMETERS[stream]}", rate)
        if wanted == MavDataStream.ALL:
            self._remember(f"{self._prefix(channel)}ADSB", rate)

    def start_channel(self, channel: Channel, first: float) -> None:
        """Stream on a port what its parameters say, from the second ``first`` on."""
        parameters = self._vehicle.parameters
        for stream, ending in RATE_PARAMETERS.items():
            name = f"{self._prefix(channel)}{ending}"
            if name in parameters and parameters[name] > 0:
                self._stream_group(stream, parameters[name], channel, first)

    def _prefix(self, channel: Channel) -> str:
        return f"MAV{self._vehicle.channels.index(channel) + 1}_"

    def restart(self) -> None:
        """Go back to the rates that are saved, as a reboot does."""
        parameters = self._vehicle.parameters
        for name, (saved, present) in self._saved.items():
            if parameters[name] == present:
                parameters[name] = saved
        self._saved.clear()

    def _remember(self, name: str, rate: int) -> None:
        vehicle, parameters = self._vehicle, self._vehicle.parameters
        if name not in parameters or parameters[name] == rate:
            return
        if vehicle.KIND != "plane":
            self._saved[name] = (self._saved.get(name, (parameters[name], rate))[0], rate)
        parameters[name] = rate
        if vehicle.KIND == "plane":
            vehicle.announce_parameter(name)

    def _stream_group(self, stream: int, rate: float, channel: Channel, first: float) -> None:
        interval = max(1.0 / rate, _SHORTEST_S) if rate > 0 else 0.0
        for message_id in self._groups[stream]:
            pace = interval
            if message_id == TerrainRequest.ID and rate > 0:
                pace = max(interval, _TERRAIN_REQUEST_S)
            elif message_id == NamedValueFloat.ID:
                pace = interval / len(DISPLAY_VALUES)
            self._stream(message_id, pace, channel, first)

    def _stream(self, message_id: int, interval: float, channel: Channel, first: float) -> None:
        """RC_CHANNELS_RAW is for MAVLink 1 only, where old displays look for it."""
        if message_id != RcChannelsRaw.ID or channel.version == 1:
            channel.streams.set_interval(message_id, interval, first)
