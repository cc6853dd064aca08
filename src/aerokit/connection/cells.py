"""``StateCell``: the latest value of one telemetry item, with its age and source, and ways to wait for it."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Generic, NoReturn, Protocol, TypeVar

from aerokit._internal.arguments import checked
from aerokit._internal.values import Snapshot
from aerokit.connection.bus import copy_exception
from aerokit.errors import OperationTimeout, StaleValueError, ValueUnknownError

__all__ = ["Changes", "Feed", "Source", "StateCell"]

T = TypeVar("T")

logger: logging.Logger = logging.getLogger("aerokit")

_MAX_LISTED_VALUES = 3  # number of distinct values that a time-out error lists


class Feed(Protocol):
    """Decodes messages into cells on demand, by calling :meth:`StateCell.set`."""

    @property
    def pending(self) -> object:
        """Truthy if at least one received message is not decoded yet."""

    def catch_up(self) -> None:
        """Decode the pending messages now."""

    def watchers_changed(self) -> None:
        """Called when a waiter, observer or iterator was added to one of the cells or removed from it."""


class Source(Snapshot):
    """Origin of a value: system id, component id and message name."""

    system_id: int
    component_id: int
    message: str


class StateCell(Generic[T]):
    """The latest value of one telemetry item: read it, check its age, wait for it, iterate over its changes.

    Reading never sends anything. ``clock`` returns seconds (event loop time); ``waits_for`` names the source messages
    in error texts. A cell belongs to one event loop and its thread. Other threads may read it (they never get a
    half-written value or an age that is too small), but must not wait or write.
    """

    __slots__ = (
        "_arrivals",
        "_changes",
        "_clock",
        "_close_error",
        "_explain_timeout",
        "_feeds",
        "_iterator_count",
        "_known",
        "_latest",
        "_listeners",
        "_source",
        "_stamp",
        "_updated_at",
        "name",
        "waits_for",
    )

    def __init__(
        self,
        name: str,
        clock: Callable[[], float],
        waits_for: str,
        *,
        stamp: Callable[[], float] | None = None,
    ) -> None:
        self.name: str = name
        """Name of the value, for error texts."""
        self._clock = clock
        self._stamp = clock if stamp is None else stamp  # returns the receive time for a value that is set now
        self.waits_for: str = waits_for
        """Names of the messages that carry the value."""
        # Returns why no values arrive, for time-out errors; "" if unknown.
        self._explain_timeout: Callable[[], str] = lambda: ""
        self._known = False  # False before the first value and after `forget`; `_latest` then has no meaning
        self._latest: T | None = None
        self._source: Source | None = None
        self._updated_at = -math.inf
        self._arrivals = 0  # number of values set so far
        self._changes = 0  # number of values that differed from the value before
        # Waiters and observers. Changes replace the tuple, because a called listener may add or remove listeners.
        self._listeners: tuple[_Listener[T], ...] = ()
        self._iterator_count = 0
        self._feeds: tuple[Feed, ...] = ()  # decode pending messages before the cell is read
        self._close_error: BaseException | None = None  # set when no more values will arrive

    # ------------------------------------------------------------------------------ reading

    @property
    def value(self) -> T:
        """The latest value, of any age. Raises :class:`ValueUnknownError` before the first value."""
        self._catch_up()
        if not self._known:
            raise ValueUnknownError(f"{self.name} is not known yet: no {self.waits_for} has been received")
        return self._latest  # type: ignore[return-value]

    @property
    def latest(self) -> T | None:
        """The latest value, of any age; None before the first value."""
        for feed in self._feeds:  # inlined `_catch_up`, to save the call
            if feed.pending:
                feed.catch_up()
        return self._latest if self._known else None

    @property
    def is_known(self) -> bool:
        """True once a value has been received."""
        self._catch_up()
        return self._known

    @property
    def updated_at(self) -> float:
        """Time of the latest value, in seconds of the cell's clock; −inf before the first value."""
        self._catch_up()
        return self._updated_at

    @property
    def age(self) -> float:
        """Seconds since the latest value was received; inf before the first value."""
        self._catch_up()
        return self._clock() - self._updated_at

    @property
    def source(self) -> Source | None:
        """Sender and message of the latest value; None before the first value."""
        self._catch_up()
        return self._source

    @checked
    def fresh(self, within: float) -> T:
        """Return the latest value if it is at most ``within`` seconds old.

        Raises:
            StaleValueError: the value is older.
            ValueUnknownError: no value has been received.
        """
        # The age is read first: if the loop's thread sets a new value in between, the age is too large, not too small.
        age = self.age
        value = self.value
        if age > within:
            raise StaleValueError(
                f"{self.name} is {age:.1f} s old, the limit is {within:g} s: no {self.waits_for} since"
            )
        return value

    # ------------------------------------------------------------------------------ waiting

    @checked
    async def wait_until(
        self,
        predicate: Callable[[T], object],
        *,
        held_for: float = 0.0,
        timeout: float | None = None,
        description: str = "",
    ) -> T:
        """Wait until ``predicate(value)`` has been true for ``held_for`` seconds, and return the value.

        The predicate is checked for the current value, however old, and for every value received. A condition that is
        true for only one message is therefore not missed. A value is taken as unchanged until the next one is received,
        so the vehicle's silence counts towards ``held_for``. Time before this call does not count. Call :meth:`fresh`
        afterwards if the value must be recent. Exceptions of the predicate are raised here.

        Raises:
            OperationTimeout: the condition was not met within ``timeout`` seconds; the error names ``description`` and
                the last values.
            ConnectionClosed, LinkLost: the connection ended.
        """
        self._raise_if_closed()
        waiter = _Waiter(self, predicate, held_for)
        self._add(waiter)
        if self._known:
            waiter.receive(self._latest)  # type: ignore[arg-type]
        return await waiter.wait(timeout, description)

    def changes(self) -> Changes[T]:
        """Iterate over the current value, if there is one, and then over each change of the value.

        A reader that is slower than the changes skips to the latest value. The loop can be left at any time.
        """
        return Changes(self, every_arrival=False)

    def updates(self) -> Changes[T]:
        """Like :meth:`changes`, but yield each received value, even if it equals the value before."""
        return Changes(self, every_arrival=True)

    @checked
    def observe(self, callback: Callable[[T | None, T], None], *, every_arrival: bool = False) -> Callable[[], None]:
        """Call ``callback(previous, value)`` on every change; return a function that removes the callback.

        With ``every_arrival``, call it for every received value. The callback runs inside :meth:`set` and must return
        quickly; its exceptions are logged.
        """
        observer = _Observer(self, callback, every_arrival)
        self._add(observer)
        return observer.close

    # ------------------------------------------------------------------------------ writing

    def set(self, value: T, source: Source) -> None:
        """Store a new value and wake the waiters."""
        if not self._known or (value is not self._latest and value != self._latest):
            self._changes += 1
        self._latest = value
        self._known = True
        self._source = source
        self._updated_at = self._stamp()
        self._arrivals += 1
        for listener in self._listeners:
            listener.receive(value)

    def _add_age(self, seconds: float) -> None:
        self._catch_up()
        self._updated_at -= seconds  # The clock stood still while the computer slept.

    def forget(self) -> None:
        """Make the value unknown again, e.g. after a reboot. Waiters keep waiting."""
        # `_latest` keeps its value: another thread may have just read `_known` as True, and reads `_latest` next.
        self._known = False
        self._source = None
        self._updated_at = -math.inf
        for listener in self._listeners:
            listener.forget()

    def _feed_from(self, *feeds: Feed) -> None:
        self._feeds = feeds

    @property
    def _is_watched(self) -> bool:
        return bool(self._iterator_count or self._listeners)

    def close(self, error: BaseException) -> None:
        """Raise ``error`` in current and later waiters, because no more values will arrive. Reading still works."""
        if self._close_error is None:
            self._close_error = error
            for listener in self._listeners:
                listener.fail(copy_exception(error))

    def _raise_if_closed(self) -> None:
        if self._close_error is not None:
            raise copy_exception(self._close_error)

    def _catch_up(self) -> None:
        for feed in self._feeds:
            if feed.pending:
                feed.catch_up()

    def _add(self, listener: _Listener[T]) -> None:
        self._catch_up()
        self._listeners += (listener,)
        self._notify_feeds()

    def _remove(self, listener: _Listener[T]) -> None:
        self._listeners = tuple(other for other in self._listeners if other is not listener)
        self._notify_feeds()

    def _add_iterator(self) -> None:
        self._catch_up()
        self._iterator_count += 1
        self._notify_feeds()

    def _remove_iterator(self) -> None:
        self._iterator_count -= 1
        self._notify_feeds()

    def _notify_feeds(self) -> None:
        for feed in self._feeds:
            feed.watchers_changed()

    def _describe(self) -> str:
        if not self.is_known:
            return f"{self.name} is not known yet: no {self.waits_for} has been received"
        return f"{self.name} is {self._latest!r}, {self.age:.1f} s old"

    def __repr__(self) -> str:
        return f"<StateCell {self._describe()}>"

    if not TYPE_CHECKING:  # Type checkers do not see these methods, and therefore report their use as an error.

        def __getattr__(self, name: str) -> NoReturn:
            """Raise an error that suggests ``.value``, e.g. for ``vehicle.position.latitude_deg``."""
            if not name.startswith("_") and hasattr(self.latest, name):
                raise AttributeError(f"{self.name} is a StateCell: did you mean .value.{name}?")
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

        def __getitem__(self, key: object) -> NoReturn:
            """Raise an error that suggests ``.value[…]``. Iteration over a cell also calls this method."""
            hint = ", or camera_at(number) for a camera" if self.name == "cameras" else ""
            raise TypeError(f"{self.name} is a StateCell, not its value: use {self.name}.value[…]{hint}")

    def __bool__(self) -> NoReturn:
        """Raise TypeError, because ``if vehicle.armed:`` would always be true."""
        raise TypeError(f"a StateCell has no truth value: use {self.name}.value or {self.name}.latest")


class Changes(AsyncIterator[T]):
    """Asynchronous iterator over the values of a cell.

    When the cell is closed, the iterator raises the error with which it was closed. Until then, iteration never ends.
    While the iterator exists, every received message of the cell is decoded.
    """

    def __init__(self, cell: StateCell[T], *, every_arrival: bool) -> None:
        self._loop = asyncio.get_running_loop()  # `__del__` needs it, and may run on another thread.
        cell._add_iterator()  # From now on, every message of the cell is decoded.
        self._cell = cell
        self._every_arrival = every_arrival
        # Value of `_total()` when this iterator last returned a value. The iteration starts with the cell's current
        # value, which therefore counts as not returned.
        self._read_count = self._total() - (1 if cell.is_known else 0)
        self._missed = 0

    # If a program leaves its loop by `break`, only garbage collection shows that the iteration has ended.
    def __del__(self) -> None:
        if not hasattr(self, "_cell"):  # __init__ raised.
            return
        if asyncio._get_running_loop() is self._loop:
            self._cell._remove_iterator()
        else:  # The garbage collector may run on any thread.
            with suppress(RuntimeError):  # The event loop may be closed.
                self._loop.call_soon_threadsafe(self._cell._remove_iterator)

    @property
    def missed(self) -> int:
        """Number of values that this reader did not get, because newer values had already replaced them."""
        return self._missed

    def __aiter__(self) -> Changes[T]:
        return self

    async def __anext__(self) -> T:
        while self._total() == self._read_count or not self._cell.is_known:
            await self._next_arrival()
        total = self._total()
        self._missed += total - self._read_count - 1  # 1 for the value that is returned
        self._read_count = total
        return self._cell.value

    def _total(self) -> int:
        """Return the number of values received so far. Without ``every_arrival``, repeated values do not count."""
        return self._cell._arrivals if self._every_arrival else self._cell._changes

    async def _next_arrival(self) -> None:
        self._cell._raise_if_closed()
        waiter: _Waiter[T] = _Waiter(self._cell, lambda _: True, held_for=0.0)
        self._cell._add(waiter)
        await waiter.wait(timeout=None, description="")


class _Listener(Generic[T]):
    """Gets the values of a cell."""

    __slots__ = ()

    def receive(self, value: T) -> None:
        raise NotImplementedError

    def forget(self) -> None: ...

    def fail(self, error: BaseException) -> None: ...


class _Waiter(_Listener[T]):
    """One call of ``wait_until``: a future for the result, and a timer that measures ``held_for``."""

    __slots__ = (
        "_cell",
        "_error",
        "_future",
        "_held_for",
        "_hold_timer",
        "_loop",
        "_predicate",
        "_seen",
        "_seen_count",
    )

    def __init__(self, cell: StateCell[T], predicate: Callable[[T], object], held_for: float) -> None:
        self._cell = cell
        self._predicate = predicate
        self._held_for = held_for
        self._loop = asyncio.get_running_loop()
        self._future: asyncio.Future[T | None] = self._loop.create_future()
        self._error: BaseException | None = None  # raised by `wait` instead of returning a value
        self._hold_timer: asyncio.TimerHandle | None = None  # runs while the predicate is true for the last value
        # The last values without consecutive repetitions, for the time-out error.
        self._seen: deque[T] = deque(maxlen=_MAX_LISTED_VALUES)
        self._seen_count = 0  # number of values received, with repetitions

    async def wait(self, timeout: float | None, description: str) -> T:
        """Return the value that met the condition. Raises OperationTimeout."""
        timer = None if timeout is None else self._loop.call_later(timeout, self._expire, timeout, description)
        try:
            value = await self._future
        finally:
            self._cell._remove(self)
            self._stop_hold_timer()
            if timer is not None:
                timer.cancel()
        if self._error is not None:
            raise self._error
        return value  # type: ignore[return-value]

    def receive(self, value: T) -> None:
        if self._future.done():
            return
        self._record(value)
        try:
            is_met = bool(self._predicate(value))
        except Exception as error:  # An error of the predicate belongs to the caller of `wait_until`.
            self.fail(error)
            return
        if not is_met:
            self._stop_hold_timer()
        elif self._held_for <= 0:
            self._future.set_result(value)
        elif self._hold_timer is None:
            self._hold_timer = self._loop.call_later(self._held_for, self._on_held_long_enough)

    def forget(self) -> None:
        self._stop_hold_timer()

    def fail(self, error: BaseException) -> None:
        # set_exception() is not used, because asyncio logs an exception that a cancelled caller never retrieves.
        if not self._future.done():
            self._error = error
            self._future.set_result(None)

    def _on_held_long_enough(self) -> None:
        if not self._future.done():
            self._future.set_result(self._cell.value)

    def _stop_hold_timer(self) -> None:
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None

    def _expire(self, timeout: float, description: str) -> None:
        self.fail(OperationTimeout(self._timeout_text(timeout, description)))

    def _record(self, value: T) -> None:
        self._seen_count += 1
        if not self._seen or self._seen[-1] != value:
            self._seen.append(value)

    def _timeout_text(self, timeout: float, description: str) -> str:
        text = f"{description or self._cell.name}: not reached within {timeout:g} s; {self._cell._describe()}"
        if self._held_for > 0:
            text += f"; the condition had to be true for {self._held_for:g} s without a break"
        if self._seen_count > 1:
            text += f"; {self._seen_count} values seen, last " + ", ".join(map(repr, self._seen))
        reason = self._cell._explain_timeout()
        return f"{text}; {reason}" if reason else text


class _Observer(_Listener[T]):
    """A callback registered by ``observe``."""

    __slots__ = ("_callback", "_cell", "_every_arrival", "_previous")

    def __init__(self, cell: StateCell[T], callback: Callable[[T | None, T], None], every_arrival: bool) -> None:
        self._cell = cell
        self._every_arrival = every_arrival
        self._callback = callback
        self._previous = cell.latest  # None if no value is known

    def receive(self, value: T) -> None:
        previous, self._previous = self._previous, value
        if self._every_arrival or previous is None or previous != value:
            try:
                self._callback(previous, value)
            except Exception:  # The other observers must get the value although this one is faulty.
                logger.exception("an observer of %s raised an exception", self._cell.name)

    def forget(self) -> None:
        self._previous = None

    def close(self) -> None:
        if self in self._cell._listeners:
            self._cell._remove(self)
