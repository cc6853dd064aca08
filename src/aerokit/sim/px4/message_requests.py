"""Messages on request and at other rates: REQUEST_MESSAGE, SET_MESSAGE_INTERVAL and their elder siblings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.px4.telemetry import available_modes

if TYPE_CHECKING:
    from aerokit.sim.commands import Command, CommandHandler
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["message_requests"]

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
