"""``Background``: tasks that live beside a block of the program and end with it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine
    from typing import Any

__all__ = ["Background", "to_its_end"]


class Background:
    """The tasks of one ``async with`` block. A mistake in one of them goes to ``on_mistake``, not to the block.

    No task group: the program's block would run inside its cancel scope. What the program does there to its own task
    (cancelling it, ``asyncio.timeout``, ``asyncio.TaskGroup``) meets a scope that is being cancelled when the block
    ends, and what comes of the two depends on the versions of Python and anyio: exceptions were swallowed and
    exchanged. And the other way round, a scope of the program that is cancelled does not reach these tasks before the
    block has ended: the heartbeat goes on while the program, shielded, lands its vehicle.
    """

    def __init__(self, on_mistake: Callable[[Exception], None]) -> None:
        self._on_mistake = on_mistake
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_over = False

    def __len__(self) -> int:
        return len(self._tasks)

    def start(self, function: Callable[[], Awaitable[None]], name: str | None = None) -> None:
        """Run it in a task of its own; nothing happens after :meth:`cancel`."""
        if not self._is_over:
            task = asyncio.get_running_loop().create_task(self._guarded(function), name=name)
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def cancel(self) -> None:
        """Have all of them end, and start no more. Never blocks; idempotent."""
        self._is_over = True
        for task in tuple(self._tasks):
            task.cancel()

    async def aclose(self) -> None:
        """Cancel them and wait until they are gone, also when the caller is being cancelled: it takes no time."""
        self.cancel()
        cancelled: asyncio.CancelledError | None = None
        with anyio.CancelScope(shield=True):
            while self._tasks:
                try:
                    await asyncio.wait(tuple(self._tasks))
                except asyncio.CancelledError as error:
                    cancelled = error
        if cancelled is not None:
            raise cancelled

    async def _guarded(self, function: Callable[[], Awaitable[None]]) -> None:
        try:
            await function()
        except Exception as error:
            self._on_mistake(error)


async def to_its_end(work: Coroutine[Any, Any, None]) -> None:
    """Await what must not be cut short, also when the caller is being cancelled, in whatever way and however often.

    anyio's shield holds off the scopes of anyio, not ``task.cancel()`` or ``asyncio.timeout``. The work must be bounded
    in time. A cancellation that came meanwhile is raised afterwards; what the work raised is its cause then.
    """
    task = asyncio.get_running_loop().create_task(work)
    cancelled: asyncio.CancelledError | None = None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.wait((task,))
            except asyncio.CancelledError as error:
                cancelled = error
    if cancelled is not None:
        raise cancelled from task.exception()
    await task
