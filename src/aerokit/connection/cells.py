"""``StateCell``: the latest value of one thing that a vehicle told, its age and source, and ways to wait."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Generic, NoReturn, Protocol, TypeVar

from aerokit._internal.arguments import checked
from aerokit._internal.values import Snapshot
from aerokit.connection.bus import raisable
from aerokit.errors import OperationTimeout, StaleValueError, ValueUnknownError

__all__ = ["Changes", "Feed", "Source", "StateCell"]

T = TypeVar("T")

logger: logging.Logger = logging.getLogger("aerokit")

_SEEN = 3  # how many of the last distinct values a time-out names


class Feed(Protocol):
    """What works out values only when somebody looks; it calls :meth:`StateCell.set`."""

    @property
    def pending(self) -> object:
        """Whether something has come that was not worked out yet."""

    def catch_up(self) -> None:
        """Work it out now."""

    def watchers_changed(self) -> None:
        """Somebody begins or ends to wait for values of one of the cells (their ``_is_watched``)."""


class Source(Snapshot):
    """Who said it: system id, component id and the name of the message it came in."""

    system_id: int
    component_id: int
    message: str


class StateCell(Generic[T]):
    """The latest value of one thing: read it at once, ask for its age, wait for it, follow it.

    Reading never talks to the vehicle. ``clock`` gives the time in seconds (the event loop's), ``waits_for``
    names the messages the value comes from, for error texts. A cell belongs to one event loop and its thread;
    other threads may read it (never a torn value, and never one called younger than it is), but not wait or
    write.
    """

    __slots__ = (
        "_arrivals",
        "_changes",
        "_clock",
        "_closed_by",
        "_explain_timeout",
        "_feeds",
        "_followers",
        "_known",
        "_latest",
        "_sinks",
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
        """What it is the value of."""
        self._clock = clock
        self._stamp = clock if stamp is None else stamp  # the time that a value set now came at
        self.waits_for: str = waits_for
        """The messages that the value comes from."""
        self._explain_timeout: Callable[[], str] = str
        """Says, for the text of a time-out, what keeps values from coming; empty when nothing is known."""
        self._known = False
        self._latest: T | None = None
        self._source: Source | None = None
        self._updated_at = -math.inf
        self._arrivals = 0
        self._changes = 0
        self._sinks: list[_Sink[T]] = []
        self._followers = 0
        self._feeds: tuple[Feed, ...] = ()
        self._closed_by: BaseException | None = None

    # ------------------------------------------------------------------------------ reading

    @property
    def value(self) -> T:
        """The latest value, however old; :class:`ValueUnknownError` before the first."""
        self._catch_up()
        if not self._known:
            raise ValueUnknownError(f"{self.name} is not known yet: no {self.waits_for} has been received")
        return self._latest  # type: ignore[return-value]

    @property
    def latest(self) -> T | None:
        """The latest value, or None before the first."""
        self._catch_up()
        return self._latest if self._known else None

    @property
    def is_known(self) -> bool:
        """Whether a value has come."""
        self._catch_up()
        return self._known

    @property
    def updated_at(self) -> float:
        """When the latest value came, in seconds of the cell's clock; −inf before the first."""
        self._catch_up()
        return self._updated_at

    @property
    def age(self) -> float:
        """Seconds since the latest value came; inf before the first."""
        self._catch_up()
        return self._clock() - self._updated_at

    @property
    def source(self) -> Source | None:
        """Who sent the latest value, and in which message; None before the first."""
        self._catch_up()
        return self._source

    @checked
    def fresh(self, within: float) -> T:
        """The latest value if it is at most ``within`` seconds old.

        Raises :class:`StaleValueError` when it is older, :class:`ValueUnknownError` when there is none.
        """
        age = self.age  # before the value: read from another thread, it is never younger than the value is
        value = self.value
        if age > within:
            raise StaleValueError(
                f"{self.name} is {age:.1f} s old, older than the {within:g} s asked for:"
                f" no {self.waits_for} since"
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
        """Wait until ``predicate(value)`` is true, ``held_for`` seconds on end, and return the value.

        The predicate is tried on the present value and on every value that comes, so one that lasted a single
        message is not missed; an exception of it is raised here. After ``timeout`` seconds
        :class:`OperationTimeout` says what was waited for (``description``) and what was seen meanwhile.
        """
        self._raise_if_closed()
        waiter = _Waiter(self, predicate, held_for)
        self._add(waiter)
        if self._known:
            waiter.receive(self._latest)  # type: ignore[arg-type]
        return await waiter.wait(timeout, description)

    def changes(self) -> Changes[T]:
        """Follow the values that differ from the one before; a slow reader gets the latest only.

        The present value, when there is one, comes first. Nothing is left behind when the loop is left early.
        """
        return Changes(self, every_arrival=False)

    def updates(self) -> Changes[T]:
        """Like :meth:`changes`, but each value that comes counts, also when it equals the one before."""
        return Changes(self, every_arrival=True)

    @checked
    def observe(
        self, callback: Callable[[T | None, T], None], *, every_arrival: bool = False
    ) -> Callable[[], None]:
        """Call ``callback(previous, value)`` at every change, inside :meth:`set`; returns what ends that.

        With ``every_arrival`` also when a value equals the one before.

        The callback must be quick; what it raises is logged.
        """
        observer = _Observer(self, callback, every_arrival)
        self._add(observer)
        return observer.close

    # ------------------------------------------------------------------------------ writing

    def set(self, value: T, source: Source) -> None:
        """Take ``value`` as the latest, and wake whoever waits for it."""
        if not self._known or value != self._latest:
            self._changes += 1
        self._latest = value
        self._known = True
        self._source = source
        self._updated_at = self._stamp()
        self._arrivals += 1
        if self._sinks:
            for sink in tuple(self._sinks):
                sink.receive(value)

    def _grow_older(self, seconds: float) -> None:
        """Count the time in which the clock stood still: the value is older by that."""
        self._catch_up()
        self._updated_at -= seconds

    def forget(self) -> None:
        """Make the value unknown again, as after a reboot; whoever waits goes on waiting."""
        self._known = False  # the value itself stays for a thread that has just seen that it is known
        self._source = None
        self._updated_at = -math.inf
        for sink in tuple(self._sinks):
            sink.forget()

    def _feed_from(self, *feeds: Feed) -> None:
        """Say where values come from that are worked out when somebody looks."""
        self._feeds = feeds

    @property
    def _is_watched(self) -> bool:
        """Whether somebody waits for values, observes or follows them, so that each one counts."""
        return bool(self._followers or self._sinks)

    def close(self, error: BaseException) -> None:
        """No value will come any more: whoever waits, now or later, gets ``error``. Reading still works."""
        if self._closed_by is None:
            self._closed_by = error
            for sink in tuple(self._sinks):
                sink.fail(raisable(error))

    def _raise_if_closed(self) -> None:
        if self._closed_by is not None:
            raise raisable(self._closed_by)

    def _catch_up(self) -> None:
        for feed in self._feeds:
            if feed.pending:
                feed.catch_up()

    def _add(self, sink: _Sink[T]) -> None:
        self._catch_up()
        self._sinks.append(sink)
        self._tell_feeds()

    def _remove(self, sink: _Sink[T]) -> None:
        self._sinks.remove(sink)
        self._tell_feeds()

    def _follow(self) -> None:
        self._catch_up()
        self._followers += 1
        self._tell_feeds()

    def _unfollow(self) -> None:
        self._followers -= 1
        self._tell_feeds()

    def _tell_feeds(self) -> None:
        for feed in self._feeds:
            feed.watchers_changed()

    def _describe(self) -> str:
        if not self.is_known:
            return f"{self.name} is not known yet, no {self.waits_for} has been received"
        return f"{self.name} is {self._latest!r}, {self.age:.1f} s old"

    def __repr__(self) -> str:
        return f"<StateCell {self._describe()}>"

    if not TYPE_CHECKING:  # type checkers know what a cell has

        def __getattr__(self, name: str) -> NoReturn:
            """``vehicle.position.latitude_deg``: the attribute is one of the value."""
            if not name.startswith("_") and hasattr(self.latest, name):
                raise AttributeError(f"{self.name} is a StateCell: did you mean .value.{name}?")
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __bool__(self) -> NoReturn:
        """``if vehicle.armed:`` would be true for ever."""
        raise TypeError(f"a StateCell is neither true nor false: write .value or .latest behind {self.name}")


class Changes(AsyncIterator[T]):
    """An endless asynchronous iterator over a cell; the latest value wins.

    Raises the error that the cell was closed with. It is registered at the cell only while it waits. Until it is
    dropped, each value is decoded as it comes.
    """

    def __init__(self, cell: StateCell[T], *, every_arrival: bool) -> None:
        cell._follow()
        self._cell = cell
        self._every_arrival = every_arrival
        self._read_at = self._count() - (1 if cell.is_known else 0)
        self._missed = 0

    def __del__(self) -> None:
        if hasattr(self, "_cell"):
            self._cell._unfollow()

    @property
    def missed(self) -> int:
        """How many values were overwritten before this reader came to them."""
        return self._missed

    def __aiter__(self) -> Changes[T]:
        return self

    async def __anext__(self) -> T:
        while self._count() == self._read_at or not self._cell.is_known:
            await self._next_arrival()
        count = self._count()
        self._missed += count - self._read_at - 1
        self._read_at = count
        return self._cell.value

    def _count(self) -> int:
        return self._cell._arrivals if self._every_arrival else self._cell._changes

    async def _next_arrival(self) -> None:
        self._cell._raise_if_closed()
        waiter: _Waiter[T] = _Waiter(self._cell, lambda _: True, 0.0)
        self._cell._add(waiter)
        await waiter.wait(None, "")


class _Sink(Generic[T]):
    """What a cell tells when something happens to it."""

    __slots__ = ()

    def receive(self, value: T) -> None:
        raise NotImplementedError

    def forget(self) -> None:
        """The value became unknown."""

    def fail(self, error: BaseException) -> None:
        """The cell was closed."""


class _Waiter(_Sink[T]):
    """One call of ``wait_until``: a future, and at most one timer for ``held_for``."""

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
        self._error: BaseException | None = None
        self._hold_timer: asyncio.TimerHandle | None = None
        self._seen: deque[T] = deque(maxlen=_SEEN)
        self._seen_count = 0

    async def wait(self, timeout: float | None, description: str) -> T:
        timer = (
            None if timeout is None else self._loop.call_later(timeout, self._expire, timeout, description)
        )
        try:
            value = await self._future
        finally:
            self._cell._remove(self)
            self._stop_hold()
            if timer is not None:
                timer.cancel()
        if self._error is not None:
            raise self._error
        return value  # type: ignore[return-value]

    def receive(self, value: T) -> None:
        if self._future.done():
            return
        self._note(value)
        try:
            holds = bool(self._predicate(value))
        except Exception as error:  # the predicate belongs to the one who waits, so does its error
            self.fail(error)
            return
        if not holds:
            self._stop_hold()
        elif self._held_for <= 0:
            self._future.set_result(value)
        elif self._hold_timer is None:
            self._hold_timer = self._loop.call_later(self._held_for, self._finish_hold)

    def forget(self) -> None:
        self._stop_hold()

    def fail(self, error: BaseException) -> None:
        # Not set_exception: a caller cancelled just now would leave it unread, and the loop complains.
        if not self._future.done():
            self._error = error
            self._future.set_result(None)

    def _finish_hold(self) -> None:
        if not self._future.done():
            self._future.set_result(self._cell.value)

    def _stop_hold(self) -> None:
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None

    def _expire(self, timeout: float, description: str) -> None:
        self.fail(OperationTimeout(self._timeout_text(timeout, description)))

    def _note(self, value: T) -> None:
        self._seen_count += 1
        if not self._seen or self._seen[-1] != value:
            self._seen.append(value)

    def _timeout_text(self, timeout: float, description: str) -> str:
        text = f"{description or self._cell.name}: not reached within {timeout:g} s; {self._cell._describe()}"
        if self._held_for > 0:
            text += f"; it had to hold for {self._held_for:g} s"
        if self._seen_count > 1:
            text += f"; {self._seen_count} values seen, last " + ", ".join(map(repr, self._seen))
        why = self._cell._explain_timeout()
        return f"{text}; {why}" if why else text


class _Observer(_Sink[T]):
    """A callback for every change."""

    __slots__ = ("_callback", "_cell", "_every_arrival", "_previous")

    def __init__(
        self, cell: StateCell[T], callback: Callable[[T | None, T], None], every_arrival: bool
    ) -> None:
        self._cell = cell
        self._every_arrival = every_arrival
        self._callback = callback
        self._previous = cell.latest

    def receive(self, value: T) -> None:
        previous, self._previous = self._previous, value
        if self._every_arrival or previous is None or previous != value:
            try:
                self._callback(previous, value)
            except Exception:  # what one observer does wrong must not keep the state from the others
                logger.exception("an observer of %s raised", self._cell.name)

    def forget(self) -> None:
        self._previous = None

    def close(self) -> None:
        if self in self._cell._sinks:
            self._cell._remove(self)
