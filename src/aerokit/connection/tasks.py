"""Background tasks of an ``async with`` block, shielded work, and deadlines."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Awaitable, Coroutine
    from types import TracebackType
    from typing import Any

    from typing_extensions import Self


class BackgroundTasks:
    """Tasks that end with an ``async with`` block. Their exceptions go to ``on_error``, not to the block.

    This is not a task group, because the program's block would then run inside the group's cancel scope. There,
    ``task.cancel()``, ``asyncio.timeout`` and ``asyncio.TaskGroup`` behave differently in each version of Python and
    anyio; in some versions, exceptions are lost or exchanged.

    The tasks continue when the program cancels a scope of its own. Heartbeats are therefore sent while shielded code
    lands the vehicle.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._on_error = on_error
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_cancelled = False

    def __len__(self) -> int:
        return len(self._tasks)

    def start(self, function: Callable[[], Awaitable[None]], name: str | None = None) -> asyncio.Task[None] | None:
        """Run ``function()`` in a new task, and return the task. After :meth:`cancel`, only return None.

        A task that is cancelled before its first step never calls the function.
        """
        if self._is_cancelled:
            return None
        task = asyncio.get_running_loop().create_task(self._guarded(function), name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def cancel(self) -> None:
        """Cancel all tasks and start no more. Never blocks; idempotent."""
        self._is_cancelled = True
        for task in tuple(self._tasks):
            task.cancel()

    async def aclose(self) -> None:
        """Cancel all tasks and wait for their end, even if the caller is being cancelled.

        None of these tasks may call it, because the task would wait for its own end.
        """
        self.cancel()  # Afterwards, `start` starts no tasks.
        cancelled: asyncio.CancelledError | None = None  # a cancellation of the caller, to be raised at the end
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
            self._on_error(error)


async def run_shielded(work: Coroutine[Any, Any, object]) -> None:
    """Await ``work`` to its end, even if the caller is cancelled.

    The cancellation is raised afterwards. If the work has failed, its exception is the cause. The work must be bounded
    in time.
    """
    task = asyncio.get_running_loop().create_task(work)
    cancelled: asyncio.CancelledError | None = None  # a cancellation of the caller, to be raised at the end
    # A shield of anyio alone would let `task.cancel()` and `asyncio.timeout` through.
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.wait((task,))
            except asyncio.CancelledError as error:
                cancelled = error
    if cancelled is not None:
        raise cancelled from task.exception()
    await task


class Cancellation:
    """Cancel scope that can be cancelled before it is entered, and from callbacks of the loop. Enter it once.

    A plain ``anyio.CancelScope`` cannot be created in a callback if sniffio is installed (a dependency of trio, openai
    and others). anyio then detects the running library only in tasks.
    """

    def __init__(self) -> None:
        self._scope: anyio.CancelScope | None = None  # None before `__aenter__`
        self._is_cancelled = False

    def cancel(self) -> None:
        self._is_cancelled = True
        if self._scope is not None:
            self._scope.cancel()

    def __enter__(self) -> Self:
        self._scope = anyio.CancelScope()
        self._scope.__enter__()
        if self._is_cancelled:
            self._scope.cancel()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        assert self._scope is not None
        return bool(self._scope.__exit__(exc_type, exc, traceback))


Callback = Callable[[], None]


class Deadlines:
    """Calls each callback at its deadline, unless the deadline is cancelled before.

    Most deadlines of requests are cancelled soon, when the answer arrives. One timer serves all deadlines, because a
    loop timer for each would cost more than sending the request. Cancelling a deadline does not reschedule the timer.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._deadlines: dict[Callback, float] = {}  # loop time at which each callback is called
        self._timer: asyncio.TimerHandle | None = None  # None while there is no deadline
        self._timer_at = 0.0  # Stored here, because uvloop's TimerHandle does not return a time in the past.

    def set(self, callback: Callback, at: float) -> None:
        """Call ``callback`` at the loop time ``at``, in seconds. Replaces an earlier deadline of the callback."""
        self._deadlines[callback] = at
        self._schedule(at)

    def cancel(self, callback: Callback) -> None:
        self._deadlines.pop(callback, None)

    def close(self) -> None:
        self._deadlines.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _fire(self, timer_at: float) -> None:
        self._timer = None
        try:
            # The clock is not read, because a loop may fire a timer slightly early.
            for callback in [callback for callback, at in self._deadlines.items() if at <= timer_at]:
                # Another callback of this list may have cancelled this one, or set it to a later time.
                if self._deadlines.get(callback, math.inf) <= timer_at:
                    del self._deadlines[callback]
                    callback()
        finally:  # If a callback raises, the loop logs the exception, and the others are called by the next timer.
            if self._deadlines:
                self._schedule(min(self._deadlines.values()))

    def _schedule(self, at: float) -> None:
        if self._timer is not None and self._timer_at <= at:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(at, self._fire, at)
        self._timer_at = at
