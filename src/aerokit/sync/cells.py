"""``StateCell`` for programs without ``async``: reading is the same, waiting blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from aerokit.runtime.cells import Changes as AsyncChanges
    from aerokit.runtime.cells import Source
    from aerokit.runtime.cells import StateCell as AsyncStateCell
    from aerokit.sync.loop_thread import LoopThread

__all__ = ["Changes", "StateCell"]

T = TypeVar("T")


class StateCell(Generic[T]):
    """The latest value of one thing; as :class:`aerokit.runtime.cells.StateCell`.

    Reading takes a snapshot on the caller's thread: it neither talks to the vehicle nor waits for the loop.
    """

    __slots__ = ("_loop", "aio")

    def __init__(self, loop: LoopThread, cell: AsyncStateCell[T]) -> None:
        self._loop = loop
        self.aio = cell
        """The cell itself, for code that runs on the loop."""

    @property
    def name(self) -> str:
        """What it is the value of."""
        return self.aio.name

    @property
    def waits_for(self) -> str:
        """The messages that the value comes from."""
        return self.aio.waits_for

    @property
    def value(self) -> T:
        """The latest value, however old; :class:`aerokit.errors.ValueUnknownError` before the first."""
        return self.aio.value

    @property
    def latest(self) -> T | None:
        """The latest value, or None before the first."""
        return self.aio.latest

    @property
    def is_known(self) -> bool:
        """Whether a value has come."""
        return self.aio.is_known

    @property
    def updated_at(self) -> float:
        """When the latest value came, in seconds of the loop's clock; −inf before the first."""
        return self.aio.updated_at

    @property
    def age(self) -> float:
        """Seconds since the latest value came; inf before the first."""
        return self.aio.age

    @property
    def source(self) -> Source | None:
        """Who sent the latest value, and in which message; None before the first."""
        return self.aio.source

    def fresh(self, within: float) -> T:
        """The latest value if it is at most ``within`` seconds old; else StaleValueError or ValueUnknownError."""
        return self.aio.fresh(within)

    def wait_until(
        self,
        predicate: Callable[[T], object],
        *,
        held_for: float = 0.0,
        timeout: float | None = None,
        description: str = "",
    ) -> T:
        """Wait until ``predicate(value)`` is true, ``held_for`` seconds on end, and return the value.

        ``predicate`` runs on the loop's thread, on every value that comes. After ``timeout`` seconds
        :class:`aerokit.errors.OperationTimeout` says what was seen meanwhile.
        """
        return self._loop.run(
            self.aio.wait_until, predicate, held_for=held_for, timeout=timeout, description=description
        )

    def changes(self) -> Changes[T]:
        """Follow the values that differ from the one before, the present one first; a slow reader gets the latest."""
        return Changes(self._loop, self.aio.changes())

    def updates(self) -> Changes[T]:
        """Like :meth:`changes`, but each value that comes counts, also when it equals the one before."""
        return Changes(self._loop, self.aio.updates())

    def __repr__(self) -> str:
        return repr(self.aio)

    def __bool__(self) -> bool:
        return bool(self.aio)  # raises


class Changes(Generic[T]):
    """An endless iterator over a cell; the latest value wins. Raises the error that the connection ended with."""

    def __init__(self, loop: LoopThread, changes: AsyncChanges[T]) -> None:
        self._loop, self._changes = loop, changes

    @property
    def missed(self) -> int:
        """How many values were overwritten before this reader came to them."""
        return self._changes.missed

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        return self._loop.run(_next, self._changes)


async def _next(items: AsyncIterator[T]) -> T:
    return await items.__anext__()
