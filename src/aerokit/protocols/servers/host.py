"""``ServerHost``: the component for which a protocol server works."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from aerokit.mavlink.message import Message

# The port on which a message was received and to which its answer goes; only the host knows its type.
Channel = Any
Handler = Callable[[Any, Channel], None]


class ServerHost(Protocol):
    """Component for which protocol servers work: delivers messages, sends messages, and calls back at a time.

    Handlers get the messages that are addressed to the component, and their channel. A message that is sent with a
    channel goes there; with None it goes to all.
    """

    @property
    def now(self) -> float:
        """Seconds; never decreases."""
        ...

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the component started."""
        ...

    def on(self, message_class: type[Message], handler: Handler) -> None: ...

    def send(self, message: Message, channel: Channel = None) -> None: ...

    def send_text(self, severity: int, text: str) -> None: ...

    def call_at(self, when: float, action: Callable[[], None]) -> None: ...

    def call_later(self, delay: float, action: Callable[[], None]) -> None: ...


def sender_of(message: Message) -> tuple[int, int]:
    """Return system and component id of the sender; zeros if the message was not received."""
    frame = message.received_frame
    return (0, 0) if frame is None else (frame.system_id, frame.component_id)
