"""How often a PX4 sends what on a link, which depends on the link's mode, and what it says of that when asked."""

from __future__ import annotations

import csv
import math
import pkgutil
from collections.abc import Container, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.px4.telemetry import available_modes

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.commands import Command, CommandHandler
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["LINK_MODES", "LinkRates", "message_requests"]


LINK_MODES = ("normal", "onboard", "config", "minimal")
"""What MAV_n_MODE calls Normal, Onboard, Config and Minimal."""

_FAST_IN_SIMULATION = (
    m.Attitude.ID,
    m.AttitudeQuaternion.ID,
    m.AttitudeTarget.ID,
    m.GlobalPositionInt.ID,
    m.LocalPositionNed.ID,
    m.PositionTargetLocalNed.ID,
    m.ServoOutputRaw.ID,
)
_MORE_IN_SIMULATION_HZ = {m.RcChannels.ID: 20.0, m.OpticalFlowRad.ID: 10.0, m.Statustext.ID: 20.0}
_ALWAYS_HZ = {m.Heartbeat.ID: 1.0, m.MissionCurrent.ID: 1.0, m.CurrentEventSequence.ID: 0.3}
"""On every link, and not to be changed."""

_OFF, _WHEN_IT_CHANGES = -1, 0


class LinkRates:
    """Rates of all links. A link gets the mode at its place of ``modes``, one beyond the last the last.

    "normal" is as the simulator's link for ground stations is started: some messages come at ``fast_hz``.
    """

    def __init__(self, modes: Sequence[str], built: Container[int], fast_hz: float) -> None:
        unknown = sorted(set(modes) - set(LINK_MODES))
        if unknown or not modes:
            raise ValueError(
                f"link_modes: {unknown[0] if unknown else 'empty'}; there are {', '.join(LINK_MODES)}"
            )
        self._modes, self._built, self._fast_hz = tuple(modes), built, fast_hz
        self._told: dict[Channel, dict[int, int]] = {}
        self._mode_of: dict[Channel, str] = {}

    def start(self, channel: Channel, number: int, first: float) -> None:
        """A link begins to stream at ``first``; ``number`` is its place."""
        mode = self._modes[min(number, len(self._modes) - 1)]
        self._mode_of[channel], told = mode, {}
        for message_id, rate in self._rates_at_start(mode).items():
            told[message_id] = _interval_us(rate)
            if rate and message_id in self._built and message_id != m.GpsGlobalOrigin.ID:
                channel.streams.set_interval(message_id, 1.0 / rate, first)
        self._told[channel] = told
        for message_id, rate in _ALWAYS_HZ.items():
            channel.streams.set_interval(message_id, 1.0 / rate, first)

    def _rates_at_start(self, mode: str) -> dict[int, float]:
        rates = _table()[mode]
        if mode != "normal":
            return rates
        fast = dict.fromkeys(_FAST_IN_SIMULATION, self._fast_hz)
        return {**rates, **fast, **_MORE_IN_SIMULATION_HZ}

    def interval_us(self, channel: Channel, message_id: int) -> int:
        """As MESSAGE_INTERVAL tells it: -1 is off or unknown, 0 whenever there is something new."""
        if message_id == m.Heartbeat.ID:
            return 1_000_000
        return self._told.get(channel, {}).get(message_id, _OFF)

    def set_interval_us(self, channel: Channel, message_id: int, interval_us: float, now: float) -> int:
        """The MAV_RESULT; 0 goes back to the link's own rate."""
        rates = _table()[self._mode_of[channel]]
        if message_id not in rates:
            return MavResult.FAILED
        wanted = round(interval_us) if math.isfinite(interval_us) else 0
        wanted = _interval_us(rates[message_id]) if wanted == 0 else max(_OFF, wanted)
        self._told[channel][message_id] = wanted
        if message_id in self._built:
            channel.streams.set_interval(message_id, max(0, wanted) / 1e6, now)
        return MavResult.ACCEPTED

    def requested(self, channel: Channel, message_id: int) -> None:
        """A message was asked for once: from now on it counts as one that is sent when it changes."""
        told = self._told.get(channel, {})
        if told.get(message_id) == _OFF:
            told[message_id] = _WHEN_IT_CHANGES


def _interval_us(rate_hz: float) -> int:
    return int(1e6 / rate_hz) if rate_hz else _OFF


@lru_cache(maxsize=1)
def _table() -> dict[str, dict[int, float]]:
    """Link mode → message id → Hz, 0 for what has to be asked for."""
    data = pkgutil.get_data(__name__, "stream_rates.csv")
    assert data is not None
    rows = list(csv.DictReader(data.decode().splitlines()))
    return {mode: {int(row["message_id"]): float(row[mode]) for row in rows} for mode in LINK_MODES}


_NOT_ON_REQUEST = frozenset({m.MissionCurrent.ID, m.CurrentEventSequence.ID})
_NOTHING_BUT_AN_ANSWER = frozenset({m.Heartbeat.ID})


def message_requests(px4: SimulatedPx4) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    requests = _Requests(px4)
    handlers: dict[int, CommandHandler] = {
        MavCmd.REQUEST_MESSAGE: requests.request_message,
        MavCmd.SET_MESSAGE_INTERVAL: requests.set_interval,
        MavCmd.GET_MESSAGE_INTERVAL: requests.get_interval,
    }
    for command, message_id in _ELDER.items():
        handlers[command] = lambda each, message_id=message_id: requests.send_now(message_id, each)  # type: ignore[misc]
    return handlers


_ELDER = {
    MavCmd.REQUEST_AUTOPILOT_CAPABILITIES: m.AutopilotVersion.ID,
    MavCmd.REQUEST_PROTOCOL_VERSION: m.ProtocolVersion.ID,
    MavCmd.REQUEST_STORAGE_INFORMATION: m.StorageInformation.ID,
    MavCmd.REQUEST_FLIGHT_INFORMATION: m.FlightInformation.ID,
    MavCmd.GET_HOME_POSITION: m.HomePosition.ID,
}
"""Commands that ask for one message each."""


class _Requests:
    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4

    def send_now(self, message_id: int, command: Command) -> int:
        """The message goes out before its acknowledgement; DENIED when there is none."""
        message = None if message_id in _NOT_ON_REQUEST else self._px4.build(message_id)
        self._px4.rates.requested(command.channel, message_id)
        if message is None:
            return MavResult.DENIED
        if message_id not in _NOTHING_BUT_AN_ANSWER:
            self._px4.send(message, command.channel)
        return MavResult.ACCEPTED

    def request_message(self, command: Command) -> int:
        message_id = _number(command.param1)
        if message_id == m.MessageInterval.ID:
            return self._send_interval(_number(command.param2), command)
        if message_id != m.AvailableModes.ID:
            return self.send_now(message_id, command)
        modes, index = available_modes(self._px4), _number(command.param2)
        for message in modes if index == 0 else modes[index - 1 : index]:
            self._px4.send(message, command.channel)
        return MavResult.ACCEPTED if 0 <= index <= len(modes) else MavResult.DENIED

    def set_interval(self, command: Command) -> int:
        message_id = _number(command.param1)
        return self._px4.rates.set_interval_us(command.channel, message_id, command.param2, self._px4.now)

    def get_interval(self, command: Command) -> int:
        return self._send_interval(_number(command.param1), command)

    def _send_interval(self, message_id: int, command: Command) -> int:
        interval_us = self._px4.rates.interval_us(command.channel, message_id)
        if 0 <= message_id < 1 << 16:
            self._px4.send(m.MessageInterval(message_id, interval_us), command.channel)
        return MavResult.ACCEPTED


def _number(value: float) -> int:
    return round(value) if abs(value) < 2**31 else -1
