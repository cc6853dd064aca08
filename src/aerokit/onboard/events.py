"""Events of a component (https://mavlink.io/en/services/events.html), PING and TIMESYNC."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavSeverity

if TYPE_CHECKING:
    from aerokit.onboard.host import ComponentHost
    from aerokit.protocols.servers.host import ComponentIds

MAX_STORED_EVENTS = 64
SEQUENCE_INTERVAL_S = 5.0
MAX_ARGUMENT_BYTES = 40
_UNAVAILABLE = 0  # MAV_EVENT_ERROR_REASON_UNAVAILABLE


def check_severity(severity: int) -> None:
    if not MavSeverity.EMERGENCY <= severity <= MavSeverity.DEBUG:
        raise InvalidArgument(f"severity = {severity} is not allowed: it must be 0 (EMERGENCY) to 7 (DEBUG)")


class EventSender:
    """Sends EVENT messages, and repeats any of the last 64 events on request."""

    def __init__(self, host: ComponentHost) -> None:
        self._host = host
        self._sequence = -1  # number of the last event; -1 before the first event
        self._sent: deque[m.Event] = deque(maxlen=MAX_STORED_EVENTS)
        host.on(m.RequestEvent, self._on_request)

    def send(self, event_id: int, arguments: bytes, severity: int) -> None:
        if not 0 <= event_id <= 0xFFFFFFFF:
            raise InvalidArgument(f"event_id = {event_id} is not allowed: it must be 0 to 4294967295")
        if len(arguments) > MAX_ARGUMENT_BYTES:
            raise InvalidArgument(
                f"the arguments of the event have {len(arguments)} bytes; at most {MAX_ARGUMENT_BYTES} fit into EVENT"
            )
        check_severity(severity)
        is_first = self._sequence < 0
        self._sequence = (self._sequence + 1) & 0xFFFF
        levels = severity << 4 | severity  # four bits for logs and four bits for other programs
        event = m.Event(
            destination_component=0,  # all components
            destination_system=0,
            id=event_id,
            event_time_boot_ms=self._host.time_boot_ms,
            sequence=self._sequence,
            log_levels=levels,
            arguments=bytes(arguments).ljust(MAX_ARGUMENT_BYTES, b"\0"),
        )
        self._sent.append(event)
        self._host.send(event)
        if is_first:
            self._host.call_later(SEQUENCE_INTERVAL_S, self._send_sequence)

    def _send_sequence(self) -> None:
        # Receivers notice lost events by the sequence number.
        self._host.send(m.CurrentEventSequence(self._sequence, flags=0))
        self._host.call_later(SEQUENCE_INTERVAL_S, self._send_sequence)

    def _on_request(self, request: m.RequestEvent, sender: ComponentIds) -> None:
        # Sequence numbers have 16 bits and wrap around, so `last_sequence` may be below `first_sequence`.
        count = ((request.last_sequence - request.first_sequence) & 0xFFFF) + 1
        stored = [event for event in self._sent if (event.sequence - request.first_sequence) & 0xFFFF < count]
        for event in stored:
            self._host.send(event, sender)
        if not stored:
            oldest = self._sent[0].sequence if self._sent else 0
            error = m.ResponseEventError(*sender, request.first_sequence, oldest, reason=_UNAVAILABLE)
            self._host.send(error, sender)


def answer_pings(host: ComponentHost) -> None:
    def on_ping(ping: m.Ping, sender: ComponentIds) -> None:
        if ping.target_system == 0 and ping.target_component == 0:  # A PING with a target is an answer.
            host.send(m.Ping(ping.time_usec, ping.seq, *sender), sender)

    def on_timesync(message: m.Timesync, sender: ComponentIds) -> None:
        if message.tc1 == 0:  # A TIMESYNC with another value is an answer.
            own_time_ns = int(host.now * 1e9)
            host.send(m.Timesync(own_time_ns, message.ts1, *sender), sender)

    host.on(m.Ping, on_ping)
    host.on(m.Timesync, on_timesync)
