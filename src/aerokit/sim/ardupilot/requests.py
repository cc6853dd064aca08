"""Requests for streams (by message id or stream group) and for single messages of a simulated ArduPilot."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavDataStream as Stream
from aerokit.mavlink.enums import MavResult
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.ardupilot.kinds import Kind, rows_of
from aerokit.sim.channel import Channel
from aerokit.sim.commands import ReceivedCommand, to_int

# Suffixes of the parameters with the stream rates. The prefix is that of the port: MAV1_EXTRA1 on the first port.
_RATE_PARAMETERS: dict[int, str] = {
    Stream.RAW_SENSORS: "RAW_SENS", Stream.EXTENDED_STATUS: "EXT_STAT", Stream.RC_CHANNELS: "RC_CHAN",
    Stream.RAW_CONTROLLER: "RAW_CTRL", Stream.POSITION: "POSITION", Stream.EXTRA1: "EXTRA1",
    Stream.EXTRA2: "EXTRA2", Stream.EXTRA3: "EXTRA3",
}  # fmt: skip

# Ids of the messages that a client can request. A request to stream another message is DENIED, and a request to send
# another message once is FAILED.
_ALL_KINDS: frozenset[int] = frozenset(
    {
        0, 1, 2, 22, 24, 26, 27, 29, 30, 31, 32, 33, 35, 36, 42, 46, 49, 62, 65, 74, 83, 85, 87, 100, 105, 108, 116,
        124, 125, 127, 128, 129, 132, 133, 136, 137, 143, 147, 148, 152, 162, 163, 164, 165, 168, 173, 178, 180, 191,
        192, 193, 194, 225, 226, 235, 241, 242, 244, 245, 246, 259, 260, 262, 264, 269, 271, 277, 280, 281, 285, 286,
        295, 301, 373, 376, 435, 437, 9005, 10008, 11030,
    }
)  # fmt: skip
_SUPPORTED_MESSAGES: dict[Kind, frozenset[int]] = {
    "copter": _ALL_KINDS,
    "plane": _ALL_KINDS | {m.Deepstall.ID, m.AoaSsa.ID},
    "rover": _ALL_KINDS | {m.RcChannelsScaled.ID, m.WaterDepth.ID},
    "sub": _ALL_KINDS,
}

# The fastest stream has 80 % of the rate of the main loop, which is 400 Hz (GCS_Common.cpp, cap_message_interval).
_MIN_INTERVAL_S, _MAX_INTERVAL_S = 0.0025 / 0.8, 60.0
_MODES_MONITOR_INTERVAL_S = 5.0
_MAX_INTERVAL_ID = 0xFFFF  # MESSAGE_INTERVAL.message_id has 16 bits.
_MIN_TERRAIN_REQUEST_INTERVAL_S = 2.0

DISPLAY_VALUES: dict[str, float] = {
    "CamTilt": 0.5, "CamPan": 0.5, "TetherTrn": 0.0, "Lights1": 0.5, "Lights2": 0.5, "PilotGain": 0.5,
    "InputHold": 0.0, "RollPitch": 0.0, "RFTarget": -0.01,
}  # fmt: skip
"""Names and values of NAMED_VALUE_FLOAT, which ArduSub sends one after the other with EXTENDED_STATUS."""


class _ChangedRate(NamedTuple):
    """A rate parameter that REQUEST_DATA_STREAM has changed until the next reboot."""

    value_after_reboot: float
    requested: int


class ArduPilotMessageRequests:
    """SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE and REQUEST_DATA_STREAM.

    Parameters of the port (MAV1_EXTRA1 …) hold the stream rates at boot. REQUEST_DATA_STREAM changes these parameters.
    Plane saves and broadcasts the new values. The other firmwares restore the old values at the next reboot.
    """

    def __init__(self, vehicle: ArduPilotHost, *, stream_groups: bool = True) -> None:
        self._vehicle = vehicle
        self._supported = _SUPPORTED_MESSAGES[vehicle.KIND]
        # Message ids by stream group. Some of the messages are sent only under certain conditions.
        self._groups: dict[int, tuple[int, ...]] = dict.fromkeys(_RATE_PARAMETERS, ())
        for stream, message_id, _ in rows_of(vehicle.KIND, "stream_groups.csv"):
            self._groups[Stream[stream]] += (int(message_id),)
        self._changed_rates: dict[str, _ChangedRate] = {}  # by parameter name
        if stream_groups:
            vehicle.on(m.RequestDataStream, self._on_group)

    def set_interval(self, command: ReceivedCommand) -> int:
        message_id, interval_us = to_int(command.param1), to_int(command.param2)
        if command.param3 != 0.0:  # The firmware supports only 0.
            return MavResult.DENIED
        if message_id not in self._supported:
            self._vehicle.info(f"No ap_message for mavlink id ({message_id})")
            return MavResult.DENIED
        if interval_us < -1:
            return MavResult.DENIED
        # SET_MESSAGE_INTERVAL: -1 and 0 turn a stream off. For HEARTBEAT, 0 selects the default of one second.
        interval = max(0, interval_us) / 1e6
        if interval_us == 0 and message_id == m.Heartbeat.ID:
            interval = 1.0
        if 0.0 < interval < _MIN_INTERVAL_S:
            self._vehicle.info(f"Requested rate for message ID {message_id} too fast. Increase SCHED_LOOP_RATE")
            return MavResult.DENIED
        self._stream(message_id, min(interval, _MAX_INTERVAL_S), command.channel, self._vehicle.now)
        return MavResult.ACCEPTED

    def get_interval(self, command: ReceivedCommand) -> int:
        return self._send_interval(to_int(command.param1), command.channel)

    def _send_interval(self, message_id: int, channel: Channel) -> int:
        is_supported = message_id in self._supported
        interval_us = round(channel.streams.interval(message_id) * 1e6)
        if interval_us == 0:
            interval_us = -1  # The message is not streamed.
        if message_id <= _MAX_INTERVAL_ID:
            self._vehicle.send(m.MessageInterval(message_id, interval_us if is_supported else 0), channel)
        return MavResult.ACCEPTED if is_supported else MavResult.FAILED

    def request_message(self, command: ReceivedCommand) -> int:
        message_id = to_int(command.param1)
        # Only MESSAGE_INTERVAL is sent before the acknowledgement.
        if message_id == m.MessageInterval.ID:
            return self._send_interval(to_int(command.param2), command.channel)
        if message_id not in self._supported:
            return MavResult.FAILED
        if message_id == m.AvailableModes.ID:
            self._send_modes(to_int(command.param2), command.channel)
        else:
            self.send_soon(message_id, command.channel)
        return MavResult.ACCEPTED

    def send_soon(self, message_id: int, channel: Channel) -> None:
        """Send a message directly after the acknowledgement of the command that is being handled."""
        # The firmware sends RC_CHANNELS_RAW only on MAVLink 1 ports.
        if message_id != m.RcChannelsRaw.ID or channel.version == 1:
            self._vehicle.call_later(0.0, partial(self._vehicle.send_built, message_id, channel))

    def _send_modes(self, index: int, channel: Channel) -> None:
        """Send AVAILABLE_MODES of the mode with this index, or of all modes for 0."""
        vehicle = self._vehicle
        modes = vehicle.available_modes()
        if index != 0:
            modes = [mode for mode in modes if mode.mode_index == index]
        for message in modes:
            vehicle.call_later(0.0, partial(vehicle.send, message, channel))
        channel.streams.set_interval(m.AvailableModesMonitor.ID, _MODES_MONITOR_INTERVAL_S, vehicle.now)

    def _on_group(self, request: m.RequestDataStream, channel: Channel) -> None:
        if request.start_stop not in (0, 1):
            return
        rate = request.req_message_rate if request.start_stop else 0
        requested = request.req_stream_id
        streams = list(self._groups) if requested == Stream.ALL else [requested]
        for stream in streams:
            if stream in self._groups:
                self._stream_group(stream, rate, channel, self._vehicle.now)
                self._store_rate(f"{self._prefix(channel)}{_RATE_PARAMETERS[stream]}", rate)
        if requested == Stream.ALL:  # The group ADSB has a rate, but no messages in the simulation.
            self._store_rate(f"{self._prefix(channel)}ADSB", rate)

    def start_channel(self, channel: Channel, first: float) -> None:
        """Start the streams that the port's parameters select. ``first`` is the time of the first messages."""
        for stream, suffix in _RATE_PARAMETERS.items():
            rate = self._vehicle.parameters.get(f"{self._prefix(channel)}{suffix}", 0.0)
            if rate > 0:
                self._stream_group(stream, rate, channel, first)

    def _prefix(self, channel: Channel) -> str:
        return f"MAV{self._vehicle.channels.index(channel) + 1}_"

    def restart(self) -> None:
        """Restore the stream rates that REQUEST_DATA_STREAM has changed."""
        parameters = self._vehicle.parameters
        for name, change in self._changed_rates.items():
            if parameters[name] == change.requested:  # False if PARAM_SET has set another value, which is kept.
                parameters[name] = change.value_after_reboot
        self._changed_rates.clear()

    def _store_rate(self, name: str, rate: int) -> None:
        vehicle, parameters = self._vehicle, self._vehicle.parameters
        if name not in parameters or parameters[name] == rate:
            return
        previous_value, previous_change = parameters[name], self._changed_rates.get(name)
        parameters[name] = rate
        if vehicle.KIND == "plane":  # Only ArduPlane saves stream rates beyond a reboot (persist_streamrates).
            vehicle.storage.parameters.send(name, UNKNOWN_INDEX, None)
        elif previous_change is None:
            self._changed_rates[name] = _ChangedRate(value_after_reboot=previous_value, requested=rate)
        else:
            self._changed_rates[name] = previous_change._replace(requested=rate)

    def _stream_group(self, stream: int, rate: float, channel: Channel, first: float) -> None:
        """Stream a group at ``rate`` Hz from the time ``first`` on. 0 stops it."""
        group_interval = max(1.0 / rate, _MIN_INTERVAL_S) if rate > 0 else 0.0
        for message_id in self._groups[stream]:
            interval = group_interval
            if message_id == m.TerrainRequest.ID and rate > 0:
                interval = max(interval, _MIN_TERRAIN_REQUEST_INTERVAL_S)
            elif message_id == m.NamedValueFloat.ID:
                # A message contains one of `DISPLAY_VALUES`, in turn. Each value is sent at the rate of the group.
                interval /= len(DISPLAY_VALUES)
            self._stream(message_id, interval, channel, first)

    def _stream(self, message_id: int, interval: float, channel: Channel, first: float) -> None:
        # The firmware sends RC_CHANNELS_RAW only in MAVLink 1, for old on-screen displays.
        if message_id != m.RcChannelsRaw.ID or channel.version == 1:
            channel.streams.set_interval(message_id, interval, first)
