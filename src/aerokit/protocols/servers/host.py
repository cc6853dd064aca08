"""``ServerHost``: interface to the component that a protocol server belongs to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from aerokit.mavlink.message import Message

# Where a message came from, and where its answer is sent. Only the host knows the type.
Channel = Any
Handler = Callable[[Any, Channel], None]


class ComponentIds(NamedTuple):
    """System id and component id of a MAVLink component; zeros if there is none."""

    system: int = 0
    component: int = 0


class ServerHost(Protocol):
    """Interface to the component, which delivers messages, sends messages, and schedules calls.

    A handler gets each message that is addressed to the component, and the channel on which it arrived. A message is
    sent to one channel, or to all if the channel is None.
    """

    @property
    def now(self) -> float:
        """Time in seconds, which never decreases."""
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


def sender_of(message: Message) -> ComponentIds:
    """Return the ids of the sender. They are 0 if the message was not received."""
    frame = message.received_frame
    return ComponentIds() if frame is None else ComponentIds(frame.system_id, frame.component_id)
