"""An event loop on a thread of its own, and blocking calls into it that Ctrl-C can end."""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import contextvars
import functools
import os
import threading
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

import anyio

from aerokit.errors import BusyError, ConnectionClosed, LinkOpenError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from contextlib import AbstractAsyncContextManager

__all__ = ["Held", "LoopThread"]

P = ParamSpec("P")
T = TypeVar("T")

WAKE_S = 0.2
"""On Windows, Ctrl-C is noticed only between waits."""
INTERRUPTED_CALL_ENDS_S = 2.0
CLOSE_S = 5.0
"""The longest that closing waits; every single step of it is bounded by itself."""


class LoopThread:
    """One asyncio loop on one thread. The thread does not keep the interpreter alive; at its exit it is closed.

    What runs there sees the context variables of the loop, not those of its caller.

    Raises:
        LinkOpenError: the system has no thread, or no file descriptors, for it.
    """

    def __init__(self) -> None:
        self._calls = _Calls()
        started: concurrent.futures.Future[asyncio.AbstractEventLoop] = concurrent.futures.Future()
        # In a context of its own: sniffio keeps there which library is running, and the caller's may be another one.
        self._thread = threading.Thread(
            target=contextvars.Context().run,
            args=(_run, self._calls, started),
            name="aerokit loop",
            daemon=True,
        )
        self._is_closed = False
        self._process = os.getpid()
        self._lock = threading.Lock()  # nothing waits while it is held: the loop's thread takes it, too
        try:
            self._thread.start()
            self._loop = started.result()
        except (OSError, RuntimeError) as error:
            raise _not_started(error) from error
        except BaseException:  # Ctrl-C: nobody will close it
            started.add_done_callback(self._calls.end_of)
            raise
        atexit.register(self.close)

    def run(self, function: Callable[P, Awaitable[T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Await ``function(*args, **kwargs)`` on the loop and return its result or raise its exception, as it is.

        Ctrl-C cancels it there, waits until it has cleaned up, and goes on as KeyboardInterrupt.

        Raises:
            BusyError: called on the loop's own thread, which would wait for itself.
            ConnectionClosed: the loop was closed, before or meanwhile.
        """
        return self._run(INTERRUPTED_CALL_ENDS_S, function, *args, **kwargs)

    def run_to_its_end(self, function: Callable[P, Awaitable[T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """As :meth:`run`, for what leaves something undone when it is cut short, and is bounded by itself.

        Ctrl-C waits for it, and goes on as KeyboardInterrupt afterwards; a second one does not wait.
        """
        return self._run(None, function, *args, **kwargs)

    def _run(
        self,
        patience_s: float | None,
        function: Callable[P, Awaitable[T]],
        /,  # the function may have arguments of these names
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """``patience_s``: how long to wait for the end of an interrupted call; None: as long as it takes."""
        ended = threading.Event()

        async def call() -> T:
            try:
                return await function(*args, **kwargs)
            finally:
                ended.set()

        future = self._start(call)
        try:
            self.wait_for(future)
        except BaseException:
            future.cancel()
            while not ended.wait(WAKE_S if patience_s is None else patience_s):
                if patience_s is not None or not self._thread.is_alive():
                    break
            raise
        try:
            return future.result()
        except concurrent.futures.CancelledError:
            raise ConnectionClosed("the connection was closed while this call waited") from None

    def call(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that does not wait on the loop's thread; else as :meth:`run`."""

        async def call() -> T:
            return function(*args, **kwargs)

        return self.run(call)

    def call_soon(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Have a function that does not wait called on the loop, after those asked for before; from any thread.

        Nobody waits for it or hears what it raises: it must not raise.

        Raises:
            ConnectionClosed: the loop was closed.
        """
        with self._lock:
            self._check()
            self._soon(functools.partial(function, *args, **kwargs))

    def hold_open(self, context: AbstractAsyncContextManager[T]) -> Held[T]:
        """Enter an asynchronous context manager on the loop; it is left, in the same task, when it is closed."""
        return Held(self, context)

    def close(self) -> None:
        """End whatever still runs on the loop, the loop and the thread; idempotent, and bounded in time."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            if self._process == os.getpid():
                with contextlib.suppress(RuntimeError):  # it has stopped by itself
                    self._soon(self._calls.end)
        atexit.unregister(self.close)
        if not self.is_current:
            self._thread.join(CLOSE_S)

    @property
    def is_current(self) -> bool:
        """Whether the caller is on the loop's thread."""
        return threading.current_thread() is self._thread

    def wait_for(self, *futures: concurrent.futures.Future[Any]) -> None:
        """Wait until one of them is done, open to Ctrl-C on every system; ConnectionClosed when the loop ends first."""
        while not concurrent.futures.wait(futures, WAKE_S, concurrent.futures.FIRST_COMPLETED).done:
            if not self._thread.is_alive() and not any(future.done() for future in futures):
                raise ConnectionClosed("the connection was closed while this call waited")

    def _start(self, function: Callable[[], Awaitable[T]]) -> concurrent.futures.Future[T]:
        if self.is_current:
            raise BusyError(
                "a blocking call on the loop's own thread would wait for itself: predicates and callbacks run there;"
                " call it from another thread"
            )
        future: concurrent.futures.Future[T] = concurrent.futures.Future()
        with self._lock:
            self._check()
            self._soon(self._calls.begin, function, future)
        return future

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        self._loop.call_soon_threadsafe(function, *args, context=self._calls.context)

    def _check(self) -> None:
        if self._is_closed:
            raise ConnectionClosed("the connection was closed")
        if self._process != os.getpid():
            raise ConnectionClosed(
                "the connection belongs to the process that opened it, and not to its children"
            )


class Held(Generic[T]):
    """An asynchronous context manager that is open on a :class:`LoopThread`, in a task of its own."""

    def __init__(self, loop: LoopThread, context: AbstractAsyncContextManager[T]) -> None:
        self._loop, self._context = loop, context
        self._opened: concurrent.futures.Future[T] = concurrent.futures.Future()
        self._leave = asyncio.Event()
        self._task = loop._start(self._live)
        self.value = self._wait_until_open()
        """What the context manager gave."""

    def close(self) -> None:
        """Leave the context manager and wait until that is done; idempotent."""
        if self._loop.is_current:
            self._leave.set()
        elif not self._task.done():
            with contextlib.suppress(ConnectionClosed):
                self._loop.call(self._leave.set)
                concurrent.futures.wait([self._task], CLOSE_S)

    async def _live(self) -> None:
        async with self._context as value:
            self._opened.set_result(value)
            await self._leave.wait()

    def _wait_until_open(self) -> T:
        try:
            self._loop.wait_for(self._opened, self._task)
        except BaseException:
            self._task.cancel()
            raise
        if not self._opened.done():
            self._task.result()  # raises what entering it raised
        return self._opened.result()


class _Calls:
    """What runs on the loop for other threads, until the end."""

    def __init__(self) -> None:
        self.context = contextvars.Context()
        self._end: asyncio.Event | None = None
        self._tasks: dict[asyncio.Task[None], _Call[Any]] = {}

    def begin(self, function: Callable[[], Awaitable[T]], future: concurrent.futures.Future[T]) -> None:
        """Await it in a task; the future is told what comes of it, and cancels it."""
        call = _Call(function, future)
        task = asyncio.get_running_loop().create_task(call.live())
        self._tasks[task] = call
        task.add_done_callback(self._tasks.pop)

    def end(self) -> None:
        """Begin the end."""
        if self._end is not None:
            self._end.set()

    def end_of(self, started: concurrent.futures.Future[asyncio.AbstractEventLoop]) -> None:
        """End what was just started, if it was."""
        if started.exception() is None:
            started.result().call_soon_threadsafe(self.end)

    async def live(self, started: Callable[[asyncio.AbstractEventLoop], None]) -> None:
        """Wait for the end, and then for that of everything that was begun."""
        self.context, self._end = contextvars.copy_context(), asyncio.Event()
        started(asyncio.get_running_loop())
        await self._end.wait()
        while self._tasks:
            for call in self._tasks.values():
                call.cancel()
            await asyncio.wait(tuple(self._tasks))


class _Call(Generic[T]):
    """A coroutine function that is awaited on the loop, for a future on another thread."""

    def __init__(self, function: Callable[[], Awaitable[T]], future: concurrent.futures.Future[T]) -> None:
        self._function, self._future = function, future
        self._scope: anyio.CancelScope | None = None
        self._is_cancelled = False

    def cancel(self) -> None:
        """Cancel it; idempotent."""
        self._is_cancelled = True
        if self._scope is not None:
            self._scope.cancel()

    async def live(self) -> None:
        loop, future = asyncio.get_running_loop(), self._future

        def cancel_with(ended: concurrent.futures.Future[T]) -> None:
            if ended.cancelled():
                with contextlib.suppress(RuntimeError):  # the loop is closed
                    loop.call_soon_threadsafe(self.cancel)

        future.add_done_callback(cancel_with)
        with anyio.CancelScope() as self._scope:  # here: outside tasks anyio does not know what is running
            if self._is_cancelled:
                self._scope.cancel()
            try:
                result = await self._function()
            except asyncio.CancelledError:
                future.cancel()
                raise
            except BaseException as error:  # sys.exit() too: it is the caller's, and not the loop's
                _tell(future.set_exception, error)
            else:
                _tell(future.set_result, result)


def _tell(setter: Callable[[T], None], value: T) -> None:
    with contextlib.suppress(concurrent.futures.InvalidStateError):  # it was cancelled just then
        setter(value)


def _run(calls: _Calls, started: concurrent.futures.Future[asyncio.AbstractEventLoop]) -> None:
    """What the thread does."""
    try:
        anyio.run(calls.live, started.set_result)
    except BaseException as error:
        if started.done():
            raise
        started.set_exception(error)


def _not_started(error: Exception) -> LinkOpenError:
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    failed = LinkOpenError(f"the event loop's thread cannot start: {reason}")
    failed.errno = error.errno if isinstance(error, OSError) else None
    return failed
