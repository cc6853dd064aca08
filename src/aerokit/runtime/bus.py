"""Who wants which message: the bus decodes a frame once, when someone wants it, and never otherwise."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.message import Message
from aerokit.runtime.events import Event

if TYPE_CHECKING:
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame

__all__ = ["Bus", "Detach", "Sink", "once"]

logger: logging.Logger = logging.getLogger("aerokit")

Detach = Callable[[], None]
"""Calling it ends an attachment; calling it again does nothing."""

Sink = Callable[[Any], None]
"""Takes one message, frame or event; it must be quick and must not await."""

EventT = TypeVar("EventT", bound=Event)

_Entry = tuple[int, Callable[..., None]]
"""What it takes (`MESSAGE`, `FRAME`, `BOTH`), and who takes it."""
MESSAGE, FRAME, BOTH = range(3)
_Plan = tuple[bool, tuple[_Entry, ...]]
"""Whether anyone takes the message, and all who take it or its frame."""
EVERY_SYSTEM = 0


class Bus:
    """Brings messages and events to those who asked for them, in the order in which they attached.

    ``wanted`` is the live set of message ids somebody wants: a framer that holds it builds no frame for the others.
    """

    def __init__(self, dialect: Dialect = STANDARD) -> None:
        self.dialect = dialect
        self.wanted: dict[int, int] = {}
        self._sinks: dict[tuple[int, int], tuple[_Entry, ...]] = {}
        self._plans: dict[int, _Plan] = {}  # system and message id → all sinks, when needed
        self._event_sinks: dict[type[Event], tuple[Sink, ...]] = {}

    def attach(self, message_type: type[Message], sink: Sink, *, system_id: int = EVERY_SYSTEM) -> Detach:
        """Have every ``message_type`` of ``system_id`` (0: of every system) delivered to ``sink``."""
        return self._attach((system_id, message_type.ID), (MESSAGE, sink))

    def want(self, *message_types: type[Message]) -> None:
        """Have frames of these made although nobody subscribes: who asks for this looks at them on their way here."""
        for each in message_types:
            self.attach(each, _ignore)

    def attach_frames(
        self, message_type: type[Message], sink: Sink, *, system_id: int = EVERY_SYSTEM
    ) -> Detach:
        """As :meth:`attach`, for who may never need what is in the message: ``sink`` gets the frame, not decoded."""
        return self._attach((system_id, message_type.ID), (FRAME, sink))

    def attach_lazily(
        self,
        message_type: type[Message],
        sink: Callable[..., None],
        *,
        system_id: int = EVERY_SYSTEM,
    ) -> Detach:
        """As :meth:`attach_frames`; ``sink`` gets the message as a second argument if somebody else has it decoded."""
        return self._attach((system_id, message_type.ID), (BOTH, sink))

    def attach_first(
        self, message_ids: Iterable[int], make: Callable[[], object], *, system_id: int = EVERY_SYSTEM
    ) -> Detach:
        """Call ``make()``, once, when the first of these messages comes; what it attaches to that kind gets it.

        Ahead of who attached before: none of them can have made it while the message is delivered.
        """

        def first(frame: Frame) -> None:
            before = self._plan(frame)[1]
            make()
            detach_all()
            for entry in self._plan(frame)[1]:
                if entry not in before:
                    kind, sink = entry
                    sink(self.dialect.decode(frame) if kind == MESSAGE else frame)

        attached = [self._attach((system_id, each), (FRAME, first), ahead=True) for each in message_ids]

        def detach_all() -> None:
            for detach in attached:
                detach()

        return detach_all

    def attach_event(self, event_type: type[EventT], sink: Callable[[EventT], None]) -> Detach:
        """Have every event of this class and of its subclasses delivered to ``sink``."""
        self._event_sinks[event_type] = (*self._event_sinks.get(event_type, ()), sink)
        return once(lambda: self._detach_event(event_type, sink))

    def deliver(self, frame: Frame) -> None:
        """Decode the frame if anyone wants it and hand it over; a sink that raises is logged, the others go on."""
        try:
            is_read, entries = self._plans[frame.system_id << 24 | frame.message_id]
        except KeyError:
            is_read, entries = self._plan(frame)
        if not is_read:  # nearly always: who takes frames, or both, takes the frame alone
            for _, sink in entries:
                try:
                    sink(frame)
                except Exception:
                    _report(sink)
            return
        message = self.dialect.decode(frame)
        for kind, sink in entries:
            try:
                if kind == MESSAGE:
                    sink(message)
                elif kind == FRAME:
                    sink(frame)
                else:
                    sink(frame, message)
            except Exception:
                _report(sink)

    def publish(self, event: Event) -> None:
        """Hand an event to those who want its class."""
        for event_type in type(event).__mro__[:-1]:
            for sink in self._event_sinks.get(event_type, ()):
                try:
                    sink(event)
                except Exception:
                    _report(sink)

    def _attach(self, key: tuple[int, int], entry: _Entry, *, ahead: bool = False) -> Detach:
        sinks = self._sinks.get(key, ())
        self._sinks[key] = (entry, *sinks) if ahead else (*sinks, entry)
        self._plans.clear()
        self.wanted[key[1]] = self.wanted.get(key[1], 0) + 1
        return once(lambda: self._detach(key, entry))

    def _plan(self, frame: Frame) -> _Plan:
        """Who gets such a frame: those of its system before those of every system; nobody if it cannot be decoded."""
        system_id, message_id = frame.system_id, frame.message_id
        sinks = self._sinks.get((system_id, message_id), ()) if system_id != EVERY_SYSTEM else ()
        sinks += self._sinks.get((EVERY_SYSTEM, message_id), ())
        if not sinks or self.dialect.get(message_id) is None:
            return False, ()
        plan = any(kind == MESSAGE for kind, _ in sinks), sinks
        self._plans[system_id << 24 | message_id] = plan
        return plan

    def _detach(self, key: tuple[int, int], entry: _Entry) -> None:
        _drop(self._sinks, key, entry)
        self._plans.clear()
        left = self.wanted[key[1]] - 1
        if left:
            self.wanted[key[1]] = left
        else:
            del self.wanted[key[1]]

    def _detach_event(self, event_type: type[Event], sink: Sink) -> None:
        _drop(self._event_sinks, event_type, sink)


def _drop(table: dict[Any, tuple[Any, ...]], key: object, sink: object) -> None:
    """Take one occurrence of the sink out; deliveries under way keep the tuple they began with."""
    left = list(table[key])
    left.remove(sink)
    if left:
        table[key] = tuple(left)
    else:
        del table[key]


def once(action: Callable[[], None]) -> Detach:
    """What calls ``action`` the first time it is called."""
    pending = [action]

    def detach() -> None:
        if pending:
            pending.pop()()

    return detach


def _ignore(message: object) -> None:
    pass


def _report(sink: Callable[..., None]) -> None:
    logger.exception("a subscriber (%r) raised; the message was delivered to the others", sink)
