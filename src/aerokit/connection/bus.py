"""``Bus``: delivers messages and events to subscribers. A frame is decoded once, and only if a subscriber needs it."""

from __future__ import annotations

import asyncio
import copy
import logging
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeVar

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

    EndCallback = Callable[[Exception], object]

__all__ = ["Bus", "Detach", "EndSignal", "Overflow", "Sink", "Subscription", "copy_exception", "once"]

logger: logging.Logger = logging.getLogger("aerokit")

Detach = Callable[[], None]
"""Function that detaches a sink. A second call does nothing."""

Sink = Callable[[Any], None]
"""Callback for one message, frame or event. The callback must return quickly and cannot await."""

EventT = TypeVar("EventT", bound=Event)

# How a sink is called. MESSAGE: sink(message). FRAME: sink(frame). LAZY: sink(frame), or sink(frame, message) if
# another sink needs the message decoded.
MESSAGE, FRAME, LAZY = range(3)
MIXED = 3  # The sinks for one message are called with different arguments.


class _Entry(NamedTuple):
    takes: int  # MESSAGE, FRAME or LAZY
    sink: Callable[..., None]


# (takes, sinks): `takes` is MESSAGE or FRAME if all sinks can be called with the same argument, otherwise MIXED. This
# is a plain tuple, because unpacking a NamedTuple for each frame would take three times as long.
_DeliveryPlan = tuple[int, tuple[Callable[..., None], ...]]

EVERY_SYSTEM = 0
_HEARTBEAT_ID = 0


class Bus:
    """Delivers messages and events to the attached sinks, in the order in which they were attached.

    ``wanted`` has the number of sinks for each message id with at least one sink. It is updated in place. A framer that
    is given this mapping skips all other frames.
    """

    def __init__(self, dialect: Dialect = STANDARD) -> None:
        self.dialect = dialect
        self.must_check_frames = False
        """True if `FrameReceiver` must check each frame before it is delivered. Makes :meth:`deliver_all` stop."""
        self.wanted: dict[int, int] = {}  # message id → number of sinks
        self._sinks: dict[tuple[int, int], tuple[_Entry, ...]] = {}  # the key is (system id, message id)
        # Cache: system id → message id → plan. Small keys are found faster than a combination of both ids.
        self._plans: dict[int, dict[int, _DeliveryPlan]] = {}
        self._event_sinks: dict[type[Event], tuple[Sink, ...]] = {}

    def attach(self, message_type: type[Message], sink: Sink, *, system_id: int = EVERY_SYSTEM) -> Detach:
        """Deliver every message of this type from ``system_id`` (0: from any system) to ``sink``.

        Returns a function that detaches ``sink``.
        """
        return self._attach((system_id, message_type.ID), _Entry(MESSAGE, sink))

    def require_frames(self, *message_types: type[Message]) -> None:
        """Make the framer return frames of these types even if no sink is attached."""
        for message_type in message_types:
            self.attach(message_type, _discard)

    def attach_frames(self, message_type: type[Message], sink: Sink, *, system_id: int = EVERY_SYSTEM) -> Detach:
        """Like :meth:`attach`, but ``sink`` gets the undecoded frame."""
        return self._attach((system_id, message_type.ID), _Entry(FRAME, sink))

    def attach_lazily(
        self,
        message_type: type[Message],
        sink: Callable[..., None],
        *,
        system_id: int = EVERY_SYSTEM,
    ) -> Detach:
        """Like :meth:`attach`, but call ``sink(frame)`` with the undecoded frame.

        If another sink needs the message decoded anyway, call ``sink(frame, message)`` instead.
        """
        return self._attach((system_id, message_type.ID), _Entry(LAZY, sink))

    def create_on_first(
        self, message_ids: Iterable[int], create: Callable[[], object], *, system_id: int = EVERY_SYSTEM
    ) -> Detach:
        """Call ``create()`` when the first of these messages arrives, before the message is delivered.

        If ``create()`` raises, it is called again at the next message; otherwise it is called once. Sinks that it
        attaches get the first message too. Returns a function that cancels the call.
        """

        def on_first(frame: Frame) -> None:
            entries_before = self._entries(frame)
            create()
            detach_all()
            # The delivery of this frame uses the sinks from before `create()`, so the new sinks are called here.
            for entry in self._entries(frame):
                if entry not in entries_before:
                    try:
                        entry.sink(self.dialect.decode(frame) if entry.takes == MESSAGE else frame)
                    except Exception:
                        _report(entry.sink)

        on_first_entry = _Entry(FRAME, on_first)
        detachers = [self._attach((system_id, message_id), on_first_entry, ahead=True) for message_id in message_ids]

        def detach_all() -> None:
            for detach in detachers:
                detach()

        return detach_all

    def attach_event(self, event_type: type[EventT], sink: Callable[[EventT], None]) -> Detach:
        """Deliver every event of this class and of its subclasses to ``sink``. Returns a function that detaches it."""
        self._event_sinks[event_type] = (*self._event_sinks.get(event_type, ()), sink)
        return once(lambda: _remove_sink(self._event_sinks, event_type, sink))

    def deliver(self, frame: Frame) -> None:
        """Deliver a frame, decoded if needed. If a sink raises, the error is logged, and the other sinks are called."""
        self.deliver_all((frame,), _discard)

    def deliver_all(
        self, frames: Iterable[Frame], before_heartbeat: Callable[..., None], *context: object
    ) -> Frame | None:
        """Deliver the frames in order, like :meth:`deliver`. Stop after a frame whose sink sets `must_check_frames`.

        Returns the frame after which delivery stopped, or None. Calls ``before_heartbeat(frame, *context)`` before each
        HEARTBEAT is delivered.
        """
        plans, decode = self._plans, self.dialect.decode
        for frame in frames:
            message_id = frame.message_id
            if message_id == _HEARTBEAT_ID:
                before_heartbeat(frame, *context)
            try:
                takes, sinks = plans[frame.system_id][message_id]
            except KeyError:
                takes, sinks = self._add_plan(frame)
            if takes == MIXED:
                self._deliver_mixed(frame)
            else:
                item = frame if takes == FRAME else decode(frame)
                for sink in sinks:
                    try:
                        sink(item)
                    except Exception:
                        _report(sink)
            if self.must_check_frames:
                return frame
        return None

    def _deliver_mixed(self, frame: Frame) -> None:
        message = self.dialect.decode(frame)
        for takes, sink in self._entries(frame):
            try:
                if takes == MESSAGE:
                    sink(message)
                elif takes == FRAME:
                    sink(frame)
                else:
                    sink(frame, message)
            except Exception:
                _report(sink)

    def publish(self, event: Event) -> None:
        """Deliver an event to the sinks of its class and base classes."""
        for event_type in type(event).__mro__[:-1]:  # all classes of the event, without `object`
            for sink in self._event_sinks.get(event_type, ()):
                try:
                    sink(event)
                except Exception:
                    _report(sink)

    def _attach(self, key: tuple[int, int], entry: _Entry, *, ahead: bool = False) -> Detach:
        """Add a sink behind the others or, with ``ahead``, before them."""
        entries = self._sinks.get(key, ())
        self._sinks[key] = (entry, *entries) if ahead else (*entries, entry)
        self._plans.clear()
        _, message_id = key
        self.wanted[message_id] = self.wanted.get(message_id, 0) + 1
        return once(lambda: self._detach(key, entry))

    def _add_plan(self, frame: Frame) -> _DeliveryPlan:
        """Plan how to deliver frames with this system id and message id, and cache the plan."""
        entries = self._entries(frame)
        # A message outside the dialect has no sinks, because it cannot be decoded.
        if not entries or self.dialect.get(frame.message_id) is None:
            return FRAME, ()
        taken = {entry.takes for entry in entries}
        if MESSAGE not in taken:
            takes = FRAME  # No sink needs the message decoded, because LAZY sinks accept the frame alone.
        elif taken == {MESSAGE}:
            takes = MESSAGE
        else:
            takes = MIXED
        plan = takes, tuple(entry.sink for entry in entries)
        self._plans.setdefault(frame.system_id, {})[frame.message_id] = plan
        return plan

    def _entries(self, frame: Frame) -> tuple[_Entry, ...]:
        """Return the entries for the frame's system, followed by those for all systems."""
        system_id, message_id = frame.system_id, frame.message_id
        for_all_systems = self._sinks.get((EVERY_SYSTEM, message_id), ())
        if system_id == EVERY_SYSTEM:  # The sender's id is invalid. Only the sinks for all systems get the frame.
            return for_all_systems
        return self._sinks.get((system_id, message_id), ()) + for_all_systems

    def _detach(self, key: tuple[int, int], entry: _Entry) -> None:
        _remove_sink(self._sinks, key, entry)
        self._plans.clear()
        _, message_id = key
        self.wanted[message_id] -= 1
        if not self.wanted[message_id]:
            del self.wanted[message_id]


def _remove_sink(table: dict[Any, tuple[Any, ...]], key: object, sink: object) -> None:
    # The tuple is replaced, not changed, because a delivery in progress still uses the old one.
    remaining = list(table[key])
    remaining.remove(sink)
    table[key] = tuple(remaining)
    if not remaining:
        del table[key]


def once(action: Callable[[], None]) -> Detach:
    """Return a function that calls ``action`` the first time it is called, and does nothing afterwards."""
    pending = [action]

    def detach() -> None:
        if pending:
            pending.pop()()  # The action is removed before it is called, because it may call detach() itself.

    return detach


def _discard(item: object) -> None:
    pass


def _report(sink: Callable[..., None]) -> None:
    logger.exception("subscriber %r raised an exception; the message was delivered to the others", sink)


ErrorT = TypeVar("ErrorT", bound=BaseException)


def copy_exception(error: ErrorT) -> ErrorT:
    """Return a copy of a stored exception, to be raised once; the exception itself if it cannot be copied.

    Raising one object repeatedly would collect the tracebacks of all tasks, keep their frames alive and pass the
    context of one task to the next. The copy keeps ``__cause__``.
    """
    try:
        fresh = copy.copy(error)
    except Exception:  # The constructor of this exception takes other arguments than `args`, so it cannot be copied.
        return error.with_traceback(None)
    fresh.__cause__, fresh.__suppress_context__ = error.__cause__, error.__suppress_context__
    return fresh


class EndSignal:
    """Stores the error that ended its owner, and passes it to each callback once."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        """The error that ended the owner; None until then. The owner sets it before it calls :meth:`notify`."""
        self._callbacks: list[EndCallback] = []

    def raise_if_ended(self) -> None:
        """Raise a copy of :attr:`error` if the owner has ended."""
        if self.error is not None:
            raise copy_exception(self.error)

    def on_end(self, callback: EndCallback) -> Detach:
        """Call ``callback(error)`` when the owner ends, or immediately if the owner has already ended."""
        if self.error is not None:
            callback(self.error)
            return lambda: None
        self._callbacks.append(callback)

        def detach() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return detach

    def notify(self, error: Exception) -> None:
        """Call all registered callbacks with the error, which the owner has stored in :attr:`error`."""
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            try:
                callback(error)
            except Exception:
                logger.exception("a callback of on_end() raised an exception; the other callbacks are still called")


ItemT = TypeVar("ItemT")

Overflow = Literal["drop_oldest", "drop_newest", "error"]
"""Policy for an item that arrives at a full queue: drop the oldest item, drop the new item, or raise in the reader."""


class Subscription(Generic[ItemT]):
    """Asynchronous iterator over received items, for one reader. Active inside its ``with`` block.

    The default, ``capacity=1`` with ``drop_oldest``, always yields the latest item; ``missed`` counts the dropped
    items. With ``overflow="error"``, a reader that was too slow gets the queued items, then an error. When the
    connection ends, queued items can still be read; after that, reading raises the connection's error.
    """

    def __init__(
        self,
        attach: Callable[[Sink], Sequence[Detach]],
        *,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> None:
        if capacity < 1:
            raise InvalidArgument(f"capacity = {capacity} is not allowed: it must be at least 1")
        if overflow not in ("drop_oldest", "drop_newest", "error"):
            raise InvalidArgument(
                f"overflow = {overflow!r} is not allowed: it must be 'drop_oldest', 'drop_newest' or 'error'"
            )
        # Returns why no items arrive, for time-out errors; "" if unknown.
        self._explain_timeout: Callable[[], str] = lambda: ""
        self.missed: int = 0
        """Number of items that were dropped because the reader was too slow."""
        self._attach = attach
        self._detachers: list[Detach] = []  # functions that end the subscription; empty before the `with` block
        self._capacity, self._overflow = capacity, overflow
        self._queue: deque[ItemT] = deque()
        self._has_reader = False  # True while a task is in `_wait`; a second one is refused
        self._waiter: asyncio.Future[None] | None = None  # wakes the waiting reader; None once it was woken
        self._error: Exception | None = None  # raised in the reader once the queue is empty
        self._closed = False

    def __enter__(self) -> Self:
        if self._closed or self._detachers:
            raise BusyError("a subscription can be entered only once; create a new one")
        self._detachers = list(self._attach(self._push))
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
                raise copy_exception(self._error)
            if self._closed:
                raise StopAsyncIteration
            await self._wait()
        return self._queue.popleft()

    @checked
    async def get(self, timeout: float | None = None) -> ItemT:
        """Return the next item.

        Raises:
            OperationTimeout: no item arrived within ``timeout`` seconds.
            ConnectionClosed, LinkLost: the connection ended.
            SubscriptionOverflow: with ``overflow="error"``, the queue was full when a further item arrived.
            BusyError: another task already reads the subscription.
            InvalidArgument: the subscription is closed; read it inside its ``with`` block.
        """
        with anyio.move_on_after(timeout):
            try:
                return await self.__anext__()
            except StopAsyncIteration:
                raise InvalidArgument("the subscription is closed: read it inside its `with` block") from None
        reason = self._explain_timeout()
        suffix = f"; {reason}" if reason else ""
        raise OperationTimeout(f"the subscription received nothing within {timeout:g} s{suffix}")

    def get_nowait(self) -> ItemT | None:
        """Return the next item, or None if the queue is empty."""
        return self._queue.popleft() if self._queue else None

    def close(self, error: Exception | None = None) -> None:
        """Stop collecting items. A waiting reader raises ``error``; without an error, its iteration ends."""
        for detach in self._detachers:
            detach()
        self._detachers = []
        self._error = self._error or error
        self._closed = True
        self._wake()

    def _push(self, item: ItemT) -> None:
        if self._closed:  # Another callback for this item, called before, has closed the subscription.
            return
        if len(self._queue) < self._capacity:
            self._queue.append(item)
        else:
            self._handle_overflow(item)
        if self._waiter is not None:
            self._wake()

    def _handle_overflow(self, item: ItemT) -> None:
        self.missed += 1
        if self._overflow == "drop_oldest":
            self._queue.popleft()
            self._queue.append(item)
        elif self._overflow == "error":
            self.close(SubscriptionOverflow(f"the reader was too slow: {self._capacity} items are already queued"))

    async def _wait(self) -> None:
        if self._has_reader:
            raise BusyError("another task already reads this subscription; open a second one for another reader")
        self._has_reader, self._waiter = True, asyncio.get_running_loop().create_future()
        try:
            await self._waiter
        finally:
            self._has_reader, self._waiter = False, None

    def _wake(self) -> None:
        waiter, self._waiter = self._waiter, None
        if waiter is not None and not waiter.done():
            waiter.set_result(None)
