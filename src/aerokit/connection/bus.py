"""Who wants which message: the bus decodes a frame once, when someone wants it, and never otherwise."""

from __future__ import annotations

import asyncio
import copy
import logging
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import anyio

from aerokit._internal.arguments import checked
from aerokit.errors import BusyError, InvalidArgument, OperationTimeout, SubscriptionOverflow
from aerokit.events import Event
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame

    Ender = Callable[[Exception], object]

__all__ = ["Bus", "Detach", "Ending", "Overflow", "Sink", "Subscription", "once", "raisable"]

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


ErrorT = TypeVar("ErrorT", bound=BaseException)


def raisable(error: ErrorT) -> ErrorT:
    """A copy of a kept error, to be raised once.

    One object raised again and again would gather the tracebacks of all who got it, keep their frames alive and pass
    the context of one task to the next. ``__cause__`` says why, as in the original.
    """
    try:
        fresh = copy.copy(error)
    except Exception:  # its constructor wants more than its args tell
        return error.with_traceback(None)
    fresh.__cause__, fresh.__suppress_context__ = error.__cause__, error.__suppress_context__
    return fresh


class Ending:
    """Whether something has ended, by what, and who is told when it does."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        """What has ended it; None: it goes on."""
        self._enders: list[Ender] = []

    def raise_if_ended(self) -> None:
        """Raise what has ended it, if it has ended."""
        if self.error is not None:
            raise raisable(self.error)

    def on_end(self, ender: Ender) -> Detach:
        """Have ``ender(error)`` called at the end; at once if it has ended already."""
        if self.error is not None:
            ender(self.error)
            return _nothing
        self._enders.append(ender)

        def detach() -> None:
            if ender in self._enders:
                self._enders.remove(ender)

        return detach

    def tell(self, error: Exception) -> None:
        """Tell everybody that it has ended by this error."""
        enders, self._enders = self._enders, []
        for ender in enders:
            try:
                ender(error)
            except Exception:
                logger.exception("a mistake at the end of a connection; the others are told all the same")


def _nothing() -> None:
    pass


ItemT = TypeVar("ItemT")

Overflow = Literal["drop_oldest", "drop_newest", "error"]
"""What happens to an item that finds the queue full: the oldest goes, it goes itself, or the reader gets an error."""


class Subscription(Generic[ItemT]):
    """Items as they come, for one reader: registered on entry of its ``with``, gone at its exit.

    ``capacity=1`` with ``drop_oldest``, the default, is "always the latest": a reader slower than the stream never
    sees an old value, and ``missed`` counts what it did not see. When the connection ends, what is queued can still
    be read; then reading raises the reason.
    """

    def __init__(
        self,
        attach: Callable[[Sink], Sequence[Detach]],
        *,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> None:
        if capacity < 1:
            raise InvalidArgument(f"capacity = {capacity} is not allowed: at least 1")
        if overflow not in ("drop_oldest", "drop_newest", "error"):
            raise InvalidArgument(
                f"overflow = {overflow!r} is not allowed: 'drop_oldest', 'drop_newest' or 'error'"
            )
        self._explain_timeout: Callable[[], str] = str
        """Says, for the text of a time-out, what keeps items from coming; empty when nothing is known."""
        self.missed: int = 0
        """How many items were dropped because the reader was slow."""
        self._attach = attach
        self._detach: list[Detach] = []
        self._capacity, self._overflow = capacity, overflow
        self._queue: deque[ItemT] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._error: Exception | None = None
        self._closed = False

    def __enter__(self) -> Self:
        if self._closed or self._detach:
            raise BusyError("a subscription is entered once; make a new one")
        self._detach = list(self._attach(self._push))
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> ItemT:
        while not self._queue:
            if self._error is not None:
                raise raisable(self._error)
            if self._closed:
                raise StopAsyncIteration
            await self._wait()
        return self._queue.popleft()

    @checked
    async def get(self, timeout: float | None = None) -> ItemT:
        """Return the next item.

        Raises:
            OperationTimeout: none came within ``timeout`` seconds.
            ConnectionClosed, LinkLost: the connection ended.
            InvalidArgument: it is read outside its ``with``.
        """
        with anyio.move_on_after(timeout):
            try:
                return await self.__anext__()
            except StopAsyncIteration:
                raise InvalidArgument("this subscription is closed: read it inside its `with`") from None
        why = self._explain_timeout()
        raise OperationTimeout(
            f"nothing came on this subscription within {timeout:g} s{f'; {why}' if why else ''}"
        )

    def get_nowait(self) -> ItemT | None:
        """Return the next item if there is one."""
        return self._queue.popleft() if self._queue else None

    def close(self, error: Exception | None = None) -> None:
        """Take no more items; a waiting reader gets ``error``, or the end of the iteration without one."""
        for detach in self._detach:
            detach()
        self._detach = []
        self._error = self._error or error
        self._closed = True
        self._wake()

    def _push(self, item: ItemT) -> None:
        if self._closed:  # in the middle of a delivery that had begun
            return
        if len(self._queue) < self._capacity:
            self._queue.append(item)
        else:
            self._overflowed(item)
        self._wake()

    def _overflowed(self, item: ItemT) -> None:
        self.missed += 1
        if self._overflow == "drop_oldest":
            self._queue.popleft()
            self._queue.append(item)
        elif self._overflow == "error":
            self.close(
                SubscriptionOverflow(f"{self._capacity} items were waiting and were not read fast enough")
            )

    async def _wait(self) -> None:
        if self._waiter is not None:
            raise InvalidArgument("a subscription has one reader; open a second one for a second reader")
        self._waiter = asyncio.get_running_loop().create_future()
        try:
            await self._waiter
        finally:
            self._waiter = None

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
