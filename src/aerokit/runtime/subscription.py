"""Bounded streams of messages or events, with an overflow policy and a count of what was missed."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

import anyio

from aerokit.arguments import checked
from aerokit.errors import BusyError, InvalidArgument, OperationTimeout, SubscriptionOverflow
from aerokit.runtime.endings import raisable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.runtime.bus import Detach, Sink

__all__ = ["Overflow", "Subscription"]

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
