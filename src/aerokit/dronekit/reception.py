"""Streamed messages as attributes: a frame is kept, and made a message of when the attribute is read or listened to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

__all__ = ["Latest", "Stream"]

MessageT = TypeVar("MessageT", bound=Message)


class Latest(Generic[MessageT]):
    """An attribute of a class that is the latest message of a kind, or None before the first.

    What is assigned is the message, or its frame: then the message is made by the first who reads it, on any thread.
    """

    def __init__(self, message_type: type[MessageT]) -> None:
        self.message_type = message_type

    def __set_name__(self, owner: type, name: str) -> None:
        self.key, self._made = f"{name} held", f"{name} made"  # no program's own attributes are called so

    @overload
    def __get__(self, instance: None, owner: type) -> Latest[MessageT]: ...

    @overload
    def __get__(self, instance: object, owner: type) -> MessageT | None: ...

    def __get__(self, instance: object | None, owner: type) -> Latest[MessageT] | MessageT | None:
        if instance is None:
            return self
        store = instance.__dict__
        held: Any = store.get(self.key)
        if held.__class__ is not Frame:
            return held  # type: ignore[no-any-return]  # a message, or None
        made: MessageT | None = store.get(self._made)
        if made is None or made.received_frame is not held:
            made = store[self._made] = self.message_type.decode_body(held.body, held)
        return made

    def __set__(self, instance: object, value: MessageT | Frame | None) -> None:
        instance.__dict__[self.key] = value


class Stream:
    """One kind of message of a vehicle: keeps the latest frame; its handlers run while someone listens.

    ``names`` are those that the handlers tell of; until each has been told once, they run in any case.
    """

    __slots__ = (
        "__weakref__",
        "_component_id",
        "_decode",
        "_handlers",
        "_key",
        "_names",
        "_others",
        "_store",
        "is_heard",
    )

    def __init__(self, owner: object, attribute: Latest[Any], names: tuple[str, ...]) -> None:
        self._store, self._key = owner.__dict__, attribute.key
        self._decode: Callable[[bytes, Frame], Any] = attribute.message_type.decode_body
        self._names = names
        self._others: Mapping[str, object] = {}
        self._handlers: list[Callable[[Any], None]] = []
        self._component_id = 0
        self.is_heard = True
        """Whether the handlers run."""

    def add(self, handler: Callable[[Any], None]) -> None:
        """Have a handler called with the messages, after those added before."""
        self._handlers.append(handler)

    def heed_also(self, listeners: Mapping[str, object]) -> None:
        """Run the handlers while there are any of these, too."""
        self._others = listeners

    def begin(self, component_id: int) -> None:
        """Only messages of this component count."""
        self._component_id = component_id

    def take(self, frame: Frame) -> None:
        """Take a frame of the vehicle's system (loop thread)."""
        if frame.component_id != self._component_id:
            return
        if not self.is_heard:
            self._store[self._key] = frame
            return
        message = self._decode(frame.body, frame)
        self._store[self._key] = message
        for handler in self._handlers:
            handler(message)

    def review(self, ready: set[str], listened: Mapping[str, object]) -> None:
        """Who listens, or what has been told, has changed."""
        self.is_heard = (
            bool(self._others)
            or "*" in listened
            or any(name in listened or name not in ready for name in self._names)
        )
