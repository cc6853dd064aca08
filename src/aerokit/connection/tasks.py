"""``Background``: tasks that live beside a block of the program and end with it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Awaitable, Coroutine
    from types import TracebackType
    from typing import Any

    from typing_extensions import Self


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


class Cancellation:
    """Entered once, by a task; cancelled at any time, before as well, from callbacks too.

    Where sniffio is installed (trio, openai and others bring it), anyio knows which library is running in tasks
    only: an ``anyio.CancelScope`` made in a callback of the loop raises.
    """

    def __init__(self) -> None:
        self._scope: anyio.CancelScope | None = None
        self._is_cancelled = False

    def cancel(self) -> None:
        """Cancel what it is around, but for what is shielded; idempotent."""
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


Alarm = Callable[[], None]


class Deadlines:
    """Calls each of its alarms at its time, unless it is taken back before.

    A request sets a deadline and takes it back a moment later, when the answer comes. A timer of the loop for each
    would cost more than sending the request; here the one timer stays where it is, and looks for later ones when it
    has come.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._due: dict[Alarm, float] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0  # uvloop's handle of a time that is past does not tell it

    def set(self, alarm: Alarm, at: float) -> None:
        """Have ``alarm`` called at ``at`` (seconds, the loop's clock), and not at the time it was set to before."""
        self._due[alarm] = at
        self._come_by(at)

    def take_back(self, alarm: Alarm) -> None:
        """Have it not called; nothing happens when it is not set."""
        self._due.pop(alarm, None)

    def close(self) -> None:
        """Call none of them any more."""
        self._due.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _ring(self, now: float) -> None:
        self._timer = None
        for alarm in [alarm for alarm, at in self._due.items() if at <= now]:
            if self._due.pop(alarm, None) is not None:
                alarm()
        if self._due:
            self._come_by(min(self._due.values()))

    def _come_by(self, at: float) -> None:
        if self._timer is not None and self._timer_at <= at:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timer_at = self._loop.call_at(at, self._ring, at), at
