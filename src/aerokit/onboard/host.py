"""``ComponentHost``: receives and sends messages for one component on a connection; its events, PING and TIMESYNC."""

from __future__ import annotations

import logging
from collections import deque
from typing import TYPE_CHECKING, Any

from aerokit.connection.copies import CopyFilter
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavSeverity
from aerokit.protocols.servers.host import sender_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.protocols.servers.host import ComponentIds, Handler

logger: logging.Logger = logging.getLogger("aerokit")

CHUNK_SIZE = 50
"""Maximum number of characters in one STATUSTEXT message."""
MAX_TEXT_SIZE = 254
"""Maximum number of characters of a status text; longer texts are cut."""
MAX_COMMAND_AGE_S = 5.0
"""Maximum age in seconds of a command that is executed. Senders give up earlier."""
MAX_RECENT_ORDERS = 256
_COMMAND_MESSAGE_IDS = (m.CommandLong.ID, m.CommandInt.ID)
# Commands and other messages that change something. If they are older than `MAX_COMMAND_AGE_S`, they are ignored.
# Copies are ignored, too.
_ORDER_MESSAGE_IDS = frozenset(
    message_type.ID
    for message_type in (
        m.CommandLong, m.CommandInt, m.CommandCancel, m.ParamSet, m.ParamExtSet, m.MissionSetCurrent, m.MissionClearAll,
        m.GimbalManagerSetAttitude, m.GimbalManagerSetPitchyaw, m.GimbalManagerSetManualControl,
        m.GimbalDeviceSetAttitude,
    )
)  # fmt: skip


class ComponentHost:
    """Delivers messages that are addressed to one component of a connection, and sends the component's messages.

    ``accepts`` has the system ids whose messages are processed; None means all. ``knows_command`` decides whether this
    component executes a command that is addressed to all components.
    """

    def __init__(
        self, connection: Connection, system_id: int, component_id: int, accepts: Iterable[int] | None
    ) -> None:
        self.connection = connection
        self.system_id = system_id
        self.component_id = component_id
        self.knows_command: Callable[[int], bool] = lambda _: True
        self._accepts = None if accepts is None else frozenset(accepts)
        # A component with the ids of the connection uses the encoder of the connection, because all frames with the
        # same ids need a common sequence of numbers.
        has_ids_of_connection = (system_id, component_id) == (connection.source_system, connection.source_component)
        self._encoder = None if has_ids_of_connection else FrameEncoder(system_id, component_id)
        self._started_at = connection.now()
        self._detachments: list[Detach] = []
        self._copies = CopyFilter(connection, MAX_RECENT_ORDERS)
        self._text_id = 0  # id of the last status text that was sent in chunks
        self._is_closed = False

    @property
    def now(self) -> float:
        return self.connection.now()

    @property
    def time_boot_ms(self) -> int:
        return int((self.now - self._started_at) * 1000.0) & 0xFFFFFFFF

    def on(self, message_class: type[Message], handler: Handler) -> None:
        """Call ``handler(message, sender)`` for each message to this component or to all."""

        def on_message(message: Message) -> None:
            sender = sender_of(message)
            if self._is_closed or not self._is_addressed(message, sender):
                return
            if not self._is_copy(message) and not self._is_late(message):
                self._run_and_log_errors(lambda: handler(message, sender))

        self._detachments.append(self.connection.bus.attach(message_class, on_message))

    def _is_addressed(self, message: Message, sender: ComponentIds) -> bool:
        if sender == (self.system_id, self.component_id) or sender.system == 0:  # System id 0 is not a valid sender.
            return False
        if self._accepts is not None and sender.system not in self._accepts:
            return False
        # A message without target fields is for all systems and components (0).
        target_system = getattr(message, "target_system", 0)
        target_component = getattr(message, "target_component", 0)
        if target_system not in (0, self.system_id) or target_component not in (0, self.component_id):
            return False
        # An unknown command to all components is ignored without an answer, because another component may execute it.
        is_command_to_all = target_component == 0 and message.ID in _COMMAND_MESSAGE_IDS
        return not is_command_to_all or self.knows_command(message.command)  # type: ignore[attr-defined]

    def _is_copy(self, message: Message) -> bool:
        """Return True for an order whose frame has just arrived, because the link duplicates frames."""
        # A copy must not be executed again. If it was refused because its order is running, the sender would take this
        # for the answer to the order.
        frame = message.received_frame
        return frame is not None and message.ID in _ORDER_MESSAGE_IDS and self._copies.is_copy(frame)

    def _is_late(self, message: Message) -> bool:
        """Return True for an order that may have waited too long in a blocked loop."""
        frame = message.received_frame
        age_s = 0.0 if frame is None else self.now - frame.received_at
        if message.ID not in _ORDER_MESSAGE_IDS or age_s <= MAX_COMMAND_AGE_S:
            return False
        ids = (self.system_id, self.component_id)
        logger.warning("component %d/%d: %s that may be %.0f s old was not executed", *ids, message.NAME, age_s)
        return True

    def send(self, message: Message, channel: ComponentIds | None = None) -> None:
        """Send a message to the system of ``channel``; None means all systems.

        Does nothing after the end of the connection.
        """
        if self._is_closed or not self.connection.is_open:
            return
        to = None if channel is None else channel.system
        if self._encoder is None:
            self.connection.send(message, to=to)
        else:
            self.connection.send_as(self._encoder, message, to=to)

    def send_text(self, severity: int, text: str) -> None:
        printable = "".join(char if char.isprintable() else " " for char in text)
        text = printable.encode("ascii", "replace").decode()[:MAX_TEXT_SIZE]
        if len(text) <= CHUNK_SIZE:
            self.send(m.Statustext(severity, text, id=0, chunk_seq=0))  # id 0 means that the text has only one chunk.
            return
        self._text_id = self._text_id % 0xFFFF + 1  # 1 to 65535
        for number, start in enumerate(range(0, len(text), CHUNK_SIZE)):
            chunk = text[start : start + CHUNK_SIZE]
            self.send(m.Statustext(severity, chunk, id=self._text_id, chunk_seq=number))
        if len(text) % CHUNK_SIZE == 0:  # A full chunk does not end the text, so an empty chunk must follow.
            self.send(m.Statustext(severity, "", id=self._text_id, chunk_seq=len(text) // CHUNK_SIZE))

    def report_error(self, subject: str, error: BaseException) -> None:
        """Send an exception of the program's code as a status text."""
        text = f"{subject}: {error_text(error)}"
        if not isinstance(error, AerokitError):
            logger.error("component %d/%d: %s", self.system_id, self.component_id, text, exc_info=error)
        self.send_text(MavSeverity.WARNING, text)

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        def alarm() -> None:
            if not self._is_closed:
                self._run_and_log_errors(action)

        self.connection.deadlines.set(alarm, when)

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        self.call_at(self.now + delay, action)

    def stop_receiving(self) -> None:
        for detach in self._detachments:
            detach()
        self._detachments.clear()

    def close(self) -> None:
        self._is_closed = True
        self.stop_receiving()

    def _run_and_log_errors(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except AerokitError as error:
            logger.warning("component %d/%d: %s", self.system_id, self.component_id, error)
        except Exception:
            logger.exception("component %d/%d: unexpected error", self.system_id, self.component_id)


def error_text(error: BaseException) -> str:
    return str(error) or type(error).__name__


MAX_STORED_EVENTS = 64
SEQUENCE_INTERVAL_S = 5.0
MAX_ARGUMENT_BYTES = 40
_UNAVAILABLE = 0  # MAV_EVENT_ERROR_REASON_UNAVAILABLE


def check_severity(severity: int) -> None:
    if not MavSeverity.EMERGENCY <= severity <= MavSeverity.DEBUG:
        raise InvalidArgument(f"severity = {severity} is not allowed: it must be 0 (EMERGENCY) to 7 (DEBUG)")


class EventSender:
    """Sends EVENT messages, and repeats any of the last 64 events on request.

    https://mavlink.io/en/services/events.html
    """

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
