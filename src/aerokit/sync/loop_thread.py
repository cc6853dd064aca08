"""An event loop on a thread of its own, and blocking calls into it that Ctrl-C can interrupt."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import contextvars
import functools
import os
import threading
import time
import weakref
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

import anyio

from aerokit.connection.heartbeats import ActivityMonitor
from aerokit.connection.tasks import Cancellation
from aerokit.errors import AerokitError, BusyError, ConnectionClosed, LinkOpenError
from aerokit.sync.thread_future import ThreadFuture

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

P = ParamSpec("P")
T = TypeVar("T")

SIGNAL_CHECK_INTERVAL_S = 0.2  # Maximum length of a wait, because Windows raises KeyboardInterrupt only between waits.
INTERRUPTED_CALL_TIMEOUT_S = 2.0
CLOSE_TIMEOUT_S = 5.0
CLOSED_DURING_CALL = "the connection was closed while this call waited"


class LoopThread:
    """An asyncio event loop on a daemon thread. The loop is closed at interpreter exit.

    The loop and its thread do not refer to this object, so that it can be garbage collected while they run; see
    :meth:`when_dropped`. Functions run with the loop's context variables rather than the caller's.

    Raises:
        LinkOpenError: the system is out of threads or file descriptors.
    """

    def __init__(self) -> None:
        self.activity: ActivityMonitor = ActivityMonitor(time.monotonic)
        """Monitor of the program's calls, which show that the program does not hang."""
        self._calls = _Calls()
        started: ThreadFuture[asyncio.AbstractEventLoop] = ThreadFuture()
        # The caller's context may name another async library, which sniffio would then report in the thread. The thread
        # therefore starts with an empty context.
        self._thread = threading.Thread(
            target=contextvars.Context().run, args=(_run_loop, self._calls, started), name="aerokit loop", daemon=True
        )
        self._is_closed = False
        self._finalizer: weakref.finalize[Any, Any] | None = None
        self._lock = threading.Lock()  # The loop's thread also acquires it, so it must not be held during a wait.
        try:
            self._thread.start()
            while not started.wait(SIGNAL_CHECK_INTERVAL_S):
                pass
            self._loop = started.result()
            atexit.register(self._calls.finish, self._thread)
        except (OSError, RuntimeError) as error:
            self._abort()
            # Ctrl-C during Thread.start() becomes a RuntimeError, because start() waits with a Condition (see
            # ThreadFuture).
            if isinstance(error.__context__, KeyboardInterrupt):
                raise error.__context__ from None
            raise _start_error(error) from error
        except BaseException:
            self._abort()
            raise

    def run(self, function: Callable[P, Awaitable[T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Await ``function(*args, **kwargs)`` on the loop; return its result or raise its exception.

        Ctrl-C cancels the function, waits at most `INTERRUPTED_CALL_TIMEOUT_S` for its clean-up, and raises
        KeyboardInterrupt. Raises BusyError on the loop's own thread, where the call would be a deadlock, and
        ConnectionClosed if the loop was closed before or during the call.
        """
        return self._run_call(function, args, kwargs)

    def run_shielded(self, function: Callable[P, Awaitable[T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Like :meth:`run`, but after Ctrl-C wait without limit for the end of the function.

        Ctrl-C still cancels the function, which must itself shield its clean-up. A second Ctrl-C ends the wait.
        """
        return self._run_call(function, args, kwargs, is_shielded=True, must_start=True)

    def run_exit(self, function: Callable[P, Awaitable[T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Like :meth:`run`, but start the function even if Ctrl-C came first. Used for the exit of a block.

        Ctrl-C then cancels the function after its start.
        """
        return self._run_call(function, args, kwargs, must_start=True)

    def _run_call(
        self,
        function: Callable[..., Awaitable[T]],
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        *,
        is_shielded: bool = False,
        must_start: bool = False,
    ) -> T:
        """Run a function. After Ctrl-C, cancel it and wait until it has ended, for a limited time.

        With ``is_shielded``, this wait has no limit. With ``must_start``, the function is started even if Ctrl-C came
        first.
        """
        call: _Call[T] | None = None
        try:
            call = _Call(functools.partial(function, *args, **kwargs))
            self.activity.pending_calls.add(call)
            self._start(call)
            self.wait_for(call)
        except BaseException as error:
            if must_start and isinstance(error, KeyboardInterrupt):
                # Clean-up must run even if Ctrl-C came before the call was started. A second start has no effect.
                call = call or _Call(functools.partial(function, *args, **kwargs))
                with contextlib.suppress(AerokitError):
                    self._start(call)
            if call is not None:
                self._cancel(call)  # The function must itself shield its clean-up from this cancellation.
                wait_s = SIGNAL_CHECK_INTERVAL_S if is_shielded else INTERRUPTED_CALL_TIMEOUT_S
                while call.is_scheduled and not call.wait(wait_s):
                    must_wait_on = is_shielded and self._thread.is_alive()
                    if not must_wait_on:
                        break
                # An error of the clean-up function must not be lost, so it becomes the cause of the raised exception.
                failure = call.pop_exception() if is_shielded else None
                if failure is not None:
                    raise error from failure
            raise
        finally:
            self.activity.pending_calls.discard(call)
            self.activity.feed()
        assert call is not None
        return call.result()

    def call(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Like :meth:`run`, but for a synchronous function."""

        async def call() -> T:
            return function(*args, **kwargs)

        return self.run(call)

    def enter(self, context: AbstractAsyncContextManager[T]) -> T:
        """Enter a context manager on the loop. The caller must exit it with :meth:`run_shielded`."""
        is_entered = False

        async def enter_and_record() -> T:
            nonlocal is_entered
            value = await context.__aenter__()
            is_entered = True
            return value

        try:
            return self.run_shielded(enter_and_record)
        except BaseException as error:
            # Ctrl-C arrived after the context manager was entered, so the caller will not exit it.
            if is_entered:
                self.run_shielded(context.__aexit__, type(error), error, error.__traceback__)
            raise

    def enter_sync(self, context: AbstractContextManager[T]) -> T:
        """Like :meth:`enter`, for a synchronous context manager."""
        return self.enter(_AsyncContext(context))

    def feed(self) -> None:
        """Record that the program is running. A call on the loop's own thread has no effect."""
        if not self.is_current:
            self.activity.feed()

    def call_soon(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Schedule a synchronous function on the loop from any thread. It must not raise.

        Functions run in the order of these calls. Raises ConnectionClosed if the loop was closed.
        """
        self.feed()
        with self._lock:
            self._check_open()
            self._schedule(functools.partial(function, *args, **kwargs))

    def open_context(self, context: AbstractAsyncContextManager[T]) -> OpenContext[T]:
        """Enter an asynchronous context manager on the loop. `OpenContext.close` exits it in the same task."""
        return OpenContext(self, context)

    def close(self) -> None:
        """Cancel all calls, and end the loop and its thread. Waits at most five seconds."""
        with self._lock:
            if self._is_closed:
                return
            self._calls.end_soon()
            self._is_closed = True  # Set last: if Ctrl-C interrupts the line above, close() can be called again.
        if self._finalizer is not None:
            self._finalizer.detach()
        atexit.unregister(self._calls.finish)
        if not self.is_current:
            self._thread.join(CLOSE_TIMEOUT_S)

    def when_dropped(self, function: Callable[[], object]) -> None:
        """When this object is garbage-collected, call ``function`` on the loop, and end the loop.

        The function must not refer to this object, directly or indirectly. It is not called after :meth:`close` or at
        interpreter exit.
        """
        self._finalizer = weakref.finalize(self, self._calls.end_soon, function)
        self._finalizer.atexit = False

    @property
    def is_current(self) -> bool:
        """True if the caller runs on the loop's thread."""
        return threading.current_thread() is self._thread

    def wait_for(self, future: ThreadFuture[Any]) -> None:
        """Wait for a future. Ctrl-C interrupts the wait on every system.

        Raises ConnectionClosed if the loop ends first.
        """
        self.check_may_wait()
        while not future.wait(SIGNAL_CHECK_INTERVAL_S):
            if not self._thread.is_alive() and not future.is_done:
                raise ConnectionClosed(CLOSED_DURING_CALL)

    def check_may_wait(self) -> None:
        """Raise BusyError on the loop's own thread, where a wait for the loop would be a deadlock."""
        if self.is_current:
            raise BusyError(
                "a blocking call on the event loop's own thread would be a deadlock; predicates and callbacks run"
                " there: make the call on another thread"
            )

    def _start(self, call: _Call[Any]) -> None:
        self.check_may_wait()
        with self._lock:
            self._check_open()
            call.is_scheduled = True
            self._schedule(self._calls.begin, call)

    def _cancel(self, call: _Call[Any]) -> None:
        if call.is_scheduled:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                self._schedule(call.cancel)

    def _abort(self) -> None:
        self._calls.is_aborted = True
        self._calls.end_soon()

    def _schedule(self, function: Callable[..., object], *args: Any) -> None:
        self._loop.call_soon_threadsafe(function, *args, context=self._calls.context)

    def _check_open(self) -> None:
        if self._is_closed:
            raise ConnectionClosed("the connection was closed")
        if not self._calls.is_of_this_process:
            raise ConnectionClosed("the connection belongs to the parent process; open one in this process")


class OpenContext(Generic[T]):
    """An asynchronous context manager that is open on a :class:`LoopThread`, in a task of its own."""

    def __init__(self, loop: LoopThread, context: AbstractAsyncContextManager[T]) -> None:
        self._loop = loop
        self._task = _ContextTask(context)
        self._call = _Call(self._task.run)
        opened = self._task.opened
        try:
            loop._start(self._call)
            loop.wait_for(opened)
            if not opened.has_result:  # __aenter__ has failed.
                loop.wait_for(self._call)
                self._call.result()  # raises the exception of __aenter__
        except BaseException:
            loop._cancel(self._call)
            raise
        self.value = opened.result()

    def close(self) -> None:
        """Exit the context manager, and wait for it at most CLOSE_TIMEOUT_S."""
        if self._loop.is_current:  # The loop's own thread must not wait for the loop.
            self._task.close_requested.set()
        elif not self._call.is_done:
            with contextlib.suppress(ConnectionClosed):
                self._loop.call(self._task.close_requested.set)
                self._call.wait(CLOSE_TIMEOUT_S)


class _ContextTask(Generic[T]):
    """Enters a context manager, sets ``opened``, and exits the context manager once ``close_requested`` is set."""

    def __init__(self, context: AbstractAsyncContextManager[T]) -> None:
        self._context = context
        self.opened: ThreadFuture[T] = ThreadFuture()
        self.close_requested = asyncio.Event()

    async def run(self) -> None:
        try:
            async with self._context as value:
                self.opened.set_result(value)
                await self.close_requested.wait()
        finally:
            self.opened.finish()


class _AsyncContext(AbstractAsyncContextManager[T]):
    """Wraps a synchronous context manager, so that it can be used as an asynchronous one."""

    def __init__(self, context: AbstractContextManager[T]) -> None:
        self._context = context

    async def __aenter__(self) -> T:
        return self._context.__enter__()

    async def __aexit__(self, *exc: Any) -> bool | None:
        return self._context.__exit__(*exc)


class _Calls:
    """Runs the calls of other threads on the loop. Has no reference to the LoopThread."""

    def __init__(self) -> None:
        self.context = contextvars.Context()
        self.is_aborted = False  # True if LoopThread.__init__ failed
        self._end = asyncio.Event()
        self._tasks: dict[asyncio.Task[None], _Call[Any]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._process = os.getpid()

    @property
    def is_of_this_process(self) -> bool:
        """False in a forked child, where the loop's thread does not exist."""
        return self._process == os.getpid()

    def begin(self, call: _Call[Any]) -> None:
        """Run a call in a new task. A second start has no effect."""
        if call.has_started:
            return
        call.has_started = True
        task = asyncio.get_running_loop().create_task(call.run())
        self._tasks[task] = call
        # `run` does not finish a call whose task was cancelled. Without this callback, its caller would wait forever.
        # A second `finish` has no effect.
        task.add_done_callback(lambda task: self._tasks.pop(task).finish())

    def end_soon(self, function: Callable[[], object] | None = None) -> None:
        """Call a function on the loop, then end the loop.

        May be called from any thread and more than once. Never blocks.
        """
        if self._loop is not None and self.is_of_this_process:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                self._loop.call_soon_threadsafe(self._end_after, function, context=self.context)

    def finish(self, thread: threading.Thread) -> None:
        """End the loop and wait for its thread, at interpreter exit."""
        self.end_soon()
        thread.join(CLOSE_TIMEOUT_S)

    async def run(self, started: ThreadFuture[asyncio.AbstractEventLoop]) -> None:
        """Keep the loop running until `end_soon`, then cancel all calls."""
        self.context = contextvars.copy_context()
        self._loop = asyncio.get_running_loop()
        started.set_result(self._loop)
        if not self.is_aborted:
            await self._end.wait()
        while self._tasks:
            for call in self._tasks.values():
                call.cancel()
            await asyncio.wait(tuple(self._tasks))

    def _end_after(self, function: Callable[[], object] | None) -> None:
        try:
            if function is not None:
                function()
        finally:
            self._end.set()


class _Call(ThreadFuture[T]):
    """A coroutine function that runs on the loop for another thread."""

    def __init__(self, function: Callable[[], Awaitable[T]]) -> None:
        super().__init__()
        self._function = function
        self._cancellation = Cancellation()
        self.is_scheduled = False  # True once its start was scheduled on the loop
        self.has_started = False

    def cancel(self) -> None:
        self._cancellation.cancel()

    def result(self) -> T:
        if self._error is None and not self.has_result:
            raise ConnectionClosed(CLOSED_DURING_CALL)
        return super().result()

    async def run(self) -> None:
        with self._cancellation:
            try:
                self.set_result(await self._function())
            except asyncio.CancelledError:
                raise
            except BaseException as error:  # Even SystemExit must be raised in the caller's thread, not in the loop's.
                self.set_exception(error)


def _run_loop(calls: _Calls, started: ThreadFuture[asyncio.AbstractEventLoop]) -> None:
    """Run the loop. An error before the loop starts is stored in ``started``."""
    try:
        anyio.run(calls.run, started)
    except BaseException as error:
        if started.is_done:
            raise
        started.set_exception(error)
    finally:
        atexit.unregister(calls.finish)


def _start_error(error: Exception) -> LinkOpenError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    link_error = LinkOpenError(f"the event loop's thread cannot start: {reason}")
    link_error.errno = error.errno if isinstance(error, OSError) else None
    return link_error
