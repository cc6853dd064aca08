"""`Told`: how a state is declared: which messages tell it, by which decoder, and which of them is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, overload

from aerokit.mavlink import messages

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Autopilot
    from aerokit.mavlink.message import Message
    from aerokit.runtime.cells import StateCell

__all__ = ["MESSAGE_IDS", "By", "Told", "message_type"]

T = TypeVar("T")

MESSAGE_IDS = {row[0]: message_id for message_id, row in messages.INDEX.items()}
"""Name of a message class → message id, without importing the class."""


def message_type(class_name: str) -> type[Message]:
    """The message class of this name."""
    found: type[Message] = getattr(messages, class_name)
    return found


class By(Generic[T]):
    """One message that tells a state.

    Args:
        message: name of its class; a name, so that not all messages are imported.
        decode: gives the value, or None when the message does not know it; None: the telemetry itself does it.
        knowing: ``decode`` is given what else is known (``reading.Context``), too.
        hz: the rate that it is asked for when a program asks for nothing special.
        second_best: it counts only while no better message has told the state lately.
        instead: some autopilots send this one instead of the first.
        one_of: the field that says which one of several it speaks of; each of them counts.
    """

    def __init__(
        self,
        message: str,
        decode: Callable[..., T | None] | None,
        *,
        knowing: bool = False,
        hz: float | None = None,
        second_best: bool = False,
        instead: bool = False,
        one_of: str | None = None,
    ) -> None:
        if message not in MESSAGE_IDS:
            raise ValueError(f"{message} is no message class")
        self.message: str = message
        self.decode = decode
        self.knowing: bool = knowing
        self.hz: float | None = hz
        self.second_best: bool = second_best
        self.instead: bool = instead
        self.one_of: str | None = one_of


class _HasCells(Protocol):
    def _cell_of(self, name: str) -> StateCell[Any]:
        """The cell of this name."""
        ...


class Told(Generic[T]):
    """A state that messages tell, in a class that declares states: the declaration on the class, a cell on an object.

    Args:
        sources: what tells it, the best first.
        waits_for: what is named when nothing has come; the messages that are asked for by default.
        at_once: it is worked out when the message comes, not when somebody looks.
    """

    name: str

    def __init__(self, *sources: By[T], waits_for: str = "", at_once: bool = False) -> None:
        if not sources:
            raise ValueError("a state needs a message that tells it")
        self.sources = sources
        self.at_once: bool = at_once
        self._waits_for = waits_for

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Told[T]: ...
    @overload
    def __get__(self, instance: _HasCells, owner: type) -> StateCell[T]: ...
    def __get__(self, instance: _HasCells | None, owner: type) -> Told[T] | StateCell[T]:
        if instance is None:
            return self
        cell: StateCell[T] = instance._cell_of(self.name)
        instance.__dict__[self.name] = cell  # found there from now on
        return cell

    def asked_of(self, autopilot: Autopilot) -> list[type[Message]]:
        """The messages to ask this autopilot for when a program wants the state."""
        names = [each.message for each in self.sources[:1]] + [e.message for e in self.sources if e.instead]
        return [kind for kind in map(message_type, names) if autopilot.sends(kind)]

    def waits_for(self, autopilot: Autopilot) -> str:
        """The messages that it comes from, for error texts."""
        return self._waits_for or " or ".join(kind.NAME for kind in self.asked_of(autopilot))
