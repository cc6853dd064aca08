"""Streams of messages or events for programs without ``async``."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.errors import ConnectionClosed

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.runtime.subscription import Subscription as AsyncSubscription
    from aerokit.sync.loop_thread import LoopThread

__all__ = ["Subscription"]

ItemT = TypeVar("ItemT")


class Subscription(Generic[ItemT]):
    """Items as they come, for one reader: registered on entry of its ``with``, gone at its exit.

    ``capacity=1`` is "always the latest"; ``missed`` counts what a slow reader did not see. When the connection ends,
    what is queued can still be read; then reading raises the reason. As
    :class:`aerokit.runtime.subscription.Subscription`.
    """

    def __init__(self, loop: LoopThread, subscription: AsyncSubscription[ItemT]) -> None:
        self._loop, self._subscription = loop, subscription

    @property
    def missed(self) -> int:
        """How many items were dropped because the reader was slow."""
        return self._subscription.missed

    def get(self, timeout: float | None = None) -> ItemT:
        """Return the next item.

        Raises:
            OperationTimeout: none came within ``timeout`` seconds.
            ConnectionClosed, LinkLost: the connection ended.
            LocalProtocolError: it is read outside its ``with``.
        """
        return self._loop.run(self._subscription.get, timeout)

    def get_nowait(self) -> ItemT | None:
        """Return the next item if there is one."""
        return self._loop.call(self._subscription.get_nowait)

    def close(self, error: Exception | None = None) -> None:
        """Take no more items; a waiting reader gets ``error``, or the end of the iteration without one."""
        self._loop.call(self._subscription.close, error)

    def __enter__(self) -> Self:
        self._loop.enter_at_once(self._subscription)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with contextlib.suppress(ConnectionClosed):  # then it has been closed already
            self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> ItemT:
        found, item = self._loop.run(self._next)
        if not found:
            raise StopIteration
        return item[0]

    async def _next(self) -> tuple[bool, tuple[ItemT, ...]]:
        """StopAsyncIteration cannot leave a coroutine."""
        try:
            return True, (await self._subscription.__anext__(),)
        except StopAsyncIteration:
            return False, ()
