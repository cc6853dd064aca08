"""What the autopilot said last: a frame is kept, and made a message of when somebody reads it or listens to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

from aerokit.dronekit.observers import EVERY_NAME
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.observers import Listeners

__all__ = ["Latest"]

MessageT = TypeVar("MessageT", bound=Message)


class Latest(Generic[MessageT]):
    """The latest message of a kind that the autopilot sent, and who is given each of them.

    ``ready`` are the names of what was told at least once, ``listeners`` those of the vehicle.
    """

    def __init__(self, message_type: type[MessageT], ready: set[str], listeners: Listeners) -> None:
        self._decode: Callable[[bytes, Frame], MessageT] = message_type.decode_body
        self._ready = ready
        self._listeners = [listeners]
        self._names: set[str] = set()
        self._handlers: list[Callable[[MessageT], object]] = []
        self._held: Frame | MessageT | None = None
        self._made: MessageT | None = None
        self.component_id = 0
        """Of the autopilot: nobody else counts."""

    @property
    def message(self) -> MessageT | None:
        """The message, None before the first; made by the first who reads it, on any thread."""
        held = self._held
        if not isinstance(held, Frame):
            return held
        made = self._made
        if made is None or made.received_frame is not held:
            made = self._made = self._decode(held.body, held)
        return made

    def values(self, *fields: str) -> tuple[Any, ...]:
        """Fields of one message, None before the first."""
        message = self.message
        return tuple([None if message is None else getattr(message, field) for field in fields])

    def add(
        self, handler: Callable[[MessageT], object], names: tuple[str, ...], listeners: Listeners | None
    ) -> None:
        """Have a handler called, after those added before: with each message, or, with ``names``, only as long as not
        all of them were told, or somebody listens to one of them, or has any of the other ``listeners``.
        """
        self._handlers.append(handler)
        self._names.update(names)
        if listeners is not None:
            self._listeners.append(listeners)

    def take(self, frame: Frame, message: MessageT | None = None) -> None:
        """Take a frame of the vehicle's system (loop thread), and its message if that was made already."""
        if frame.component_id != self.component_id:
            return
        if self._is_wanted():
            self.receive(self._decode(frame.body, frame) if message is None else message)
        else:
            self._held = frame

    def receive(self, message: MessageT) -> None:
        """Keep it, and give it to the handlers."""
        self._held = message
        for handler in self._handlers:
            handler(message)

    def _is_wanted(self) -> bool:
        names = self._names
        if not names or not names <= self._ready:
            return True
        for each in self._listeners:
            listened = each.by_name
            if listened and (EVERY_NAME in listened or not names.isdisjoint(listened)):
                return True
        return False
