"""An event loop on a thread of its own, and blocking calls into it that Ctrl-C can end."""

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

from aerokit.connection.own_heartbeat import ProofOfLife
from aerokit.connection.tasks import Cancellation
from aerokit.errors import AerokitError, BusyError, ConnectionClosed, LinkOpenError
from aerokit.sync.reply import Reply

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

P = ParamSpec("P")
T = TypeVar("T")

WAKE_S = 0.2
"""On Windows, Ctrl-C is noticed only between waits."""
INTERRUPTED_CALL_ENDS_S = 2.0
CLOSED_MEANWHILE = "the connection was closed while this call waited"
CLOSE_S = 5.0
"""The longest that closing waits; every single step of it is bounded by itself."""


class LoopThread:
    """One asyncio loop on one thread. The thread does not keep the interpreter alive; at its exit it is closed.

    Neither the loop nor its thread refer to this object: who can reach it can use the loop, see :meth:`when_dropped`.

    What runs there sees the context variables of the loop, not those of its caller.

    Raises:
        LinkOpenError: the system has no thread, or no file descriptors, for it.
    """

    def __init__(self) -> None:
        self.proof: ProofOfLife = ProofOfLife(time.monotonic)
        """Of the program that calls."""
        self._calls = _Calls()
        started: Reply[asyncio.AbstractEventLoop] = Reply()
        # In a context of its own: sniffio keeps there which library is running, and the caller's may be another one.
        self._thread = threading.Thread(
            target=contextvars.Context().run,
            args=(_run, self._calls, started),
            name="aerokit loop",
            daemon=True,
        )
        self._is_closed = False
        self._if_dropped: weakref.finalize[Any, Any] | None = None
        self._lock = threading.Lock()  # nothing waits while it is held: the loop's thread takes it, too
        try:
            self._thread.start()
            while not started.wait(WAKE_S):
                pass
            self._loop = started.result()
            atexit.register(self._calls.finish, self._thread)
        except (OSError, RuntimeError) as error:
            self._give_up()
            # Thread.start waits at a Condition: see Reply
            if isinstance(error.__context__, KeyboardInterrupt):
                raise error.__context__ from None
            raise _not_started(error) from error
        except BaseException:
            self._give_up()
            raise

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

        Ctrl-C waits for it, and goes on as KeyboardInterrupt afterwards, its cause what it has raised; a second one
        does not wait.
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
        call: _Call[T] | None = None
        try:
            call = _Call(functools.partial(function, *args, **kwargs))
            self.proof.waiting.add(call)
            self._start(call)
            self.wait_for(call)
        except BaseException as error:
            if patience_s is None and isinstance(error, KeyboardInterrupt):  # it may not have begun
                call = call or _Call(functools.partial(function, *args, **kwargs))
                with contextlib.suppress(AerokitError):
                    self._start(call)
            if call is not None:
                self._cancel(call)
                while call.was_started and not call.wait(WAKE_S if patience_s is None else patience_s):
                    if patience_s is not None or not self._thread.is_alive():
                        break
                if patience_s is None and (failure := call.take_error()) is not None:
                    raise error from failure
            raise
        finally:
            self.proof.waiting.discard(call)
            self.proof.feed()
        assert call is not None
        return call.result()

    def call(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that does not wait on the loop's thread; else as :meth:`run`."""

        async def call() -> T:
            return function(*args, **kwargs)

        return self.run(call)

    def enter(self, context: AbstractAsyncContextManager[T]) -> T:
        """Enter a context manager for a ``with`` block of the program, which leaves it by :meth:`run_to_its_end`.

        Ctrl-C that comes when it is entered already, and before the block has begun, leaves it again.
        """
        is_entered = False

        async def enter() -> T:
            nonlocal is_entered
            value = await context.__aenter__()
            is_entered = True
            return value

        try:
            return self.run_to_its_end(enter)
        except BaseException as error:
            if is_entered:
                self.run_to_its_end(context.__aexit__, type(error), error, error.__traceback__)
            raise

    def enter_at_once(self, context: AbstractContextManager[T]) -> T:
        """As :meth:`enter`, for one that does not wait."""
        return self.enter(_Awaited(context))

    def feed(self) -> None:
        """The program has called, unless it is the loop's own thread that does."""
        if not self.is_current:
            self.proof.feed()

    def call_soon(self, function: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Have a function that does not wait called on the loop, after those asked for before; from any thread.

        Nobody waits for it or hears what it raises: it must not raise.

        Raises:
            ConnectionClosed: the loop was closed.
        """
        self.feed()
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
            self._calls.end_soon()
            self._is_closed = True  # afterwards: interrupted before, it can be closed again
        if self._if_dropped is not None:
            self._if_dropped.detach()
        atexit.unregister(self._calls.finish)
        if not self.is_current:
            self._thread.join(CLOSE_S)

    def when_dropped(self, function: Callable[[], object]) -> None:
        """Have the loop end when nobody can reach this object any more, after calling a function there.

        The function must not refer to this object, directly or through others. Not called once this was closed, nor
        at the interpreter's exit.
        """
        self._if_dropped = weakref.finalize(self, self._calls.end_soon, function)
        self._if_dropped.atexit = False

    @property
    def is_current(self) -> bool:
        """Whether the caller is on the loop's thread."""
        return threading.current_thread() is self._thread

    def wait_for(self, reply: Reply[Any]) -> None:
        """Wait until it is done, open to Ctrl-C on every system; ConnectionClosed when the loop ends first."""
        while not reply.wait(WAKE_S):
            if not self._thread.is_alive() and not reply.is_done:
                raise ConnectionClosed(CLOSED_MEANWHILE)

    def _start(self, call: _Call[Any]) -> None:
        if self.is_current:
            raise BusyError(
                "a blocking call on the loop's own thread would wait for itself: predicates and callbacks run there;"
                " call it from another thread"
            )
        with self._lock:
            self._check()
            call.was_started = True
            self._soon(self._calls.begin, call)

    def _cancel(self, call: _Call[Any]) -> None:
        if call.was_started:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._soon(call.cancel)

    def _give_up(self) -> None:
        """It was interrupted while it started: whenever it has, it ends."""
        self._calls.is_over = True
        self._calls.end_soon()

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        self._loop.call_soon_threadsafe(function, *args, context=self._calls.context)

    def _check(self) -> None:
        if self._is_closed:
            raise ConnectionClosed("the connection was closed")
        if not self._calls.is_of_this_process:
            raise ConnectionClosed(
                "the connection belongs to the process that opened it, and not to its children"
            )


class Held(Generic[T]):
    """An asynchronous context manager that is open on a :class:`LoopThread`, in a task of its own."""

    def __init__(self, loop: LoopThread, context: AbstractAsyncContextManager[T]) -> None:
        self._loop, self._block = loop, _Block(context)
        self._call = _Call(self._block.live)
        opened = self._block.opened
        try:
            loop._start(self._call)
            loop.wait_for(opened)
            if not opened.has_result:
                loop.wait_for(self._call)
                self._call.result()  # raises what entering it raised
        except BaseException:
            loop._cancel(self._call)
            raise
        self.value = opened.result()
        """What the context manager gave."""

    def close(self) -> None:
        """Leave the context manager and wait until that is done; idempotent."""
        if self._loop.is_current:
            self._block.leave.set()
        elif not self._call.is_done:
            with contextlib.suppress(ConnectionClosed):
                self._loop.call(self._block.leave.set)
                self._call.wait(CLOSE_S)


class _Block(Generic[T]):
    """What the loop has of a :class:`Held`."""

    def __init__(self, context: AbstractAsyncContextManager[T]) -> None:
        self._context = context
        self.opened: Reply[T] = Reply()
        self.leave = asyncio.Event()

    async def live(self) -> None:
        """Enter the context manager, and leave it when that is asked for."""
        try:
            async with self._context as value:
                self.opened.give(value)
                await self.leave.wait()
        finally:
            self.opened.end()


class _Awaited(AbstractAsyncContextManager[T]):
    """A context manager that does not wait."""

    def __init__(self, context: AbstractContextManager[T]) -> None:
        self._context = context

    async def __aenter__(self) -> T:
        return self._context.__enter__()

    async def __aexit__(self, *exc: Any) -> bool | None:
        return self._context.__exit__(*exc)


class _Calls:
    """What runs on the loop for other threads, until the end."""

    def __init__(self) -> None:
        self.context = contextvars.Context()
        self.is_over = False
        """Nobody has taken the loop that was started."""
        self._end = asyncio.Event()
        self._tasks: dict[asyncio.Task[None], _Call[Any]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._process = os.getpid()

    @property
    def is_of_this_process(self) -> bool:
        """Whether the loop's thread lives in this process, and not in the one it was forked from."""
        return self._process == os.getpid()

    def begin(self, call: _Call[Any]) -> None:
        """Await it in a task; asked for twice, once."""
        if call.has_begun:
            return
        call.has_begun = True
        task = asyncio.get_running_loop().create_task(call.live())
        self._tasks[task] = call
        task.add_done_callback(self._end_of)

    def end(self) -> None:
        """Begin the end."""
        self._end.set()

    def end_soon(self, function: Callable[[], object] | None = None) -> None:
        """Begin the end, after calling a function on the loop; from any thread, never blocks, idempotent."""
        if self._loop is not None and self.is_of_this_process:
            with contextlib.suppress(RuntimeError):  # it has stopped by itself
                self._loop.call_soon_threadsafe(self._end_after, function, context=self.context)

    def finish(self, thread: threading.Thread) -> None:
        """Begin the end and wait for that of the thread, at the interpreter's exit."""
        self.end_soon()
        thread.join(CLOSE_S)

    async def live(self, started: Reply[asyncio.AbstractEventLoop]) -> None:
        """Wait for the end, and then for that of everything that was begun."""
        self.context = contextvars.copy_context()
        self._loop = asyncio.get_running_loop()
        started.give(self._loop)
        if not self.is_over:
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
            self.end()

    def _end_of(self, task: asyncio.Task[None]) -> None:
        self._tasks.pop(task).end()  # it has ended by itself, unless it was cancelled before its first step


class _Call(Reply[T]):
    """A coroutine function that is awaited on the loop for another thread."""

    def __init__(self, function: Callable[[], Awaitable[T]]) -> None:
        super().__init__()
        self._function = function
        self._cancellation = Cancellation()
        self.was_started = False
        """Whether the loop was asked to run it."""
        self.has_begun = False
        """Whether the loop runs it, or has."""

    def cancel(self) -> None:
        """Cancel it (loop thread); idempotent."""
        self._cancellation.cancel()

    def result(self) -> T:
        """As of any reply; ConnectionClosed when it was cancelled."""
        if self._error is None and not self.has_result:
            raise ConnectionClosed(CLOSED_MEANWHILE)
        return super().result()

    async def live(self) -> None:
        """Run it; never raises but when cancelled."""
        with self._cancellation:
            try:
                self.give(await self._function())
            except asyncio.CancelledError:
                raise
            except BaseException as error:  # sys.exit() too: it is the caller's, and not the loop's
                self.fail(error)


def _run(calls: _Calls, started: Reply[asyncio.AbstractEventLoop]) -> None:
    """What the thread does."""
    try:
        anyio.run(calls.live, started)
    except BaseException as error:
        if started.is_done:
            raise
        started.fail(error)
    finally:
        atexit.unregister(calls.finish)


def _not_started(error: Exception) -> LinkOpenError:
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    failed = LinkOpenError(f"the event loop's thread cannot start: {reason}")
    failed.errno = error.errno if isinstance(error, OSError) else None
    return failed
