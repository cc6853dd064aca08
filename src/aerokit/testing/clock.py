"""An asyncio event loop on virtual time: its clock jumps to the next timer instead of sleeping.

```python
async def fly() -> None:
    await asyncio.sleep(3600)          # returns at once; loop.time() has advanced by an hour

run_virtual(fly())
```

With anyio's pytest plugin, a test module runs on virtual time if it or its ``conftest.py`` has this fixture:

```python
@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND

@pytest.mark.anyio
async def test_an_hour_of_silence() -> None:
    await anyio.sleep(3600)
```

Rules:

- ``time()`` starts at 0.0. It advances only when no callback is ready and no socket has data.
- Real sockets are polled before every jump, but a jump does not wait for them. Use
  `aerokit.transport.memory_link_pair` in tests on virtual time.
- The clock stands still during ``run_in_executor`` (``asyncio.to_thread``, name resolution). Other threads may wake
  the loop by ``call_soon_threadsafe``, but do not stop the clock.
- If nothing can happen any more, the loop raises `DeadlockError`, which names the waiting tasks. If real sockets or
  other threads could still wake the loop, it first waits for `DEADLOCK_TIMEOUT_S` of real time.
"""

from __future__ import annotations

import asyncio
import math
import selectors
import threading
from collections.abc import Callable, Coroutine, Mapping
from heapq import heappop
from types import CoroutineType
from typing import Any, TypeVar

import anyio

T = TypeVar("T")

# The selector is polled at least once in this many steps. A step is one iteration of the loop or one run of an event
# source.
_POLL_EVERY = 64
# If there are more timers than this, and more than half are cancelled, the cancelled timers are discarded.
_MANY_TIMERS = 100

DEADLOCK_TIMEOUT_S = 10.0
"""Real seconds without an event from sockets, executor calls and other threads after which the loop is deadlocked."""


class DeadlockError(RuntimeError):
    """Raised if nothing can happen any more: there is no callback, timer, socket or thread that could wake the loop."""


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """An asyncio event loop on virtual time. See the rules in the documentation of this module.

    ``deadlock_timeout_s`` is in real seconds, see `DEADLOCK_TIMEOUT_S`.
    """

    def __init__(self, *, deadlock_timeout_s: float = DEADLOCK_TIMEOUT_S) -> None:
        self._now = 0.0
        self._executor_calls = 0  # number of calls that executor threads are running
        self._iterations = 0  # number of steps since the last poll, see `_POLL_EVERY`
        self._deadlock_timeout_s = deadlock_timeout_s
        self._event_sources: list[
            tuple[Callable[[], float], asyncio.Handle]
        ] = []  # `next_due` and `run` of each source
        super().__init__(_JumpingSelector(self))
        selector: selectors.BaseSelector = self._selector  # type: ignore[attr-defined]
        self._registered: Mapping[Any, Any] = selector.get_map()
        self._own_registered_count = len(self._registered)  # The loop itself has registered its self-pipe.
        # After a wait of `when - now`, rounding may leave the clock slightly before `when`. asyncio runs timers that
        # are due within this resolution.
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Return the virtual seconds since the loop was created."""
        return self._now

    def add_event_source(self, next_due: Callable[[], float], run: Callable[[], None]) -> Callable[[], None]:
        """Call ``run`` each time the clock reaches ``next_due()``. Return a function that removes the event source.

        An event source is much faster than a timer that sets itself again, because it needs no iteration of the loop.
        ``next_due`` returns seconds on this clock, or infinity for never. After each ``run``, ``next_due`` must return
        a later time. Event sources run before timers of the same instant.
        """
        source = (next_due, asyncio.Handle(run, (), self))
        self._event_sources.append(source)

        def remove() -> None:
            if source in self._event_sources:
                self._event_sources.remove(source)

        return remove

    def _run_once(self) -> None:
        """Run the callbacks that are due. If none is, first let the clock jump to the next event source or timer."""
        self._iterations += 1
        ready = self._ready  # type: ignore[attr-defined]
        timers = self._scheduled  # type: ignore[attr-defined]
        # Without sockets, the loop polls only rarely, to notice signals and other threads.
        needs_poll = self._iterations >= _POLL_EVERY or not self._can_skip_polls
        if not needs_poll and not ready:
            has_run = self._run_event_sources()
            # Without an event source or timer, only a signal or another thread can wake the loop.
            needs_poll = not has_run and self._next_timer() == math.inf
        cancelled_count = self._timer_cancelled_count  # type: ignore[attr-defined]
        has_mostly_cancelled_timers = _MANY_TIMERS < len(timers) < 2 * cancelled_count
        if needs_poll or has_mostly_cancelled_timers:  # asyncio's own iteration polls, and discards cancelled timers.
            self._iterations = 0
            super()._run_once()  # type: ignore[misc]
            return
        if not ready:
            # If a poll is due, it happens in the next iteration. Without a timer, the clock cannot jump.
            if self._iterations >= _POLL_EVERY or self._next_timer() == math.inf:
                return
            # No event source is due before the next timer, so the clock jumps to the timer.
            self._now = max(self._now, self._next_timer())
        self._schedule_sources_before_timer()
        end = self._now + self._clock_resolution
        while timers and timers[0]._when < end:
            timer = heappop(timers)
            timer._scheduled = False
            ready.append(timer)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                handle._run()

    @property
    def _can_skip_polls(self) -> bool:
        is_watched = self._executor_calls or self._stopping or self._debug  # type: ignore[attr-defined]
        return not is_watched and len(self._registered) == self._own_registered_count

    def _next_timer(self) -> float:
        """Discard cancelled timers, and return the time of the next timer; infinity without timers."""
        timers: list[Any] = self._scheduled  # type: ignore[attr-defined]
        while timers and timers[0]._cancelled:
            self._timer_cancelled_count -= 1  # type: ignore[attr-defined]
            heappop(timers)._scheduled = False
        return timers[0]._when if timers else math.inf

    def _run_event_sources(self) -> bool:
        """Run the event sources that are due before the next timer.

        Returns True if at least one has run. Stops when a callback is ready or the selector must be polled.
        """
        sources = self._event_sources
        ready = self._ready  # type: ignore[attr-defined]
        can_skip_polls = self._can_skip_polls
        has_run = False
        while sources and not ready:
            earliest_due = math.inf
            _, earliest_handle = sources[0]
            for next_due, handle in sources:
                due = next_due()
                if due < earliest_due:
                    earliest_due = due
                    earliest_handle = handle
            # Stop at the next timer. The loop runs the event sources of the same instant together with that timer.
            if earliest_due + self._clock_resolution >= self._next_timer():
                break
            self._now = max(self._now, earliest_due)
            earliest_handle._run()
            has_run = True
            self._iterations += 1
            if self._iterations >= _POLL_EVERY or not can_skip_polls:  # Real sockets must be polled before every jump.
                break
        return has_run

    def _schedule_sources_before_timer(self) -> None:
        timers = self._scheduled  # type: ignore[attr-defined]
        end = self._now + self._clock_resolution
        if timers and timers[0]._when < end:
            self._ready.extend(handle for next_due, handle in self._event_sources if next_due() < end)  # type: ignore[attr-defined]

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]
        """Run ``func`` on a thread. The clock stands still until ``func`` returns."""
        future = super().run_in_executor(executor, func, *args)
        self._executor_calls += 1
        future.add_done_callback(self._on_executor_call_done)
        return future

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        """Join the threads of the executor, in real time.

        ``timeout``, which Python 3.12 and later pass, is ignored, because it would count virtual seconds.
        """
        self._executor_calls += 1
        try:
            await super().shutdown_default_executor()
        finally:
            self._executor_calls -= 1

    def wait_for_events(self, poll: Callable[[float], list[Any]], timeout: float | None) -> list[Any]:
        """Wait for ``timeout`` virtual seconds (None: without a limit), in place of the selector."""
        events = self._wait(poll, timeout)
        self._schedule_sources_before_timer()
        return events

    def _wait(self, poll: Callable[[float], list[Any]], timeout: float | None) -> list[Any]:
        """Return the selector's events. Without events, run the event sources or advance the clock."""
        events = poll(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        if self._executor_calls:
            return self._wait_in_real_time(poll)
        if self._run_event_sources():
            return []
        if timeout is None and self._may_be_woken():
            return self._wait_in_real_time(poll)
        if self._ready:  # type: ignore[attr-defined]  # Another thread has called the loop since the poll.
            return []
        if timeout is None:
            raise self._deadlock_error("the loop has nothing left to wait for")
        self._now += timeout
        return []

    def _on_executor_call_done(self, _future: asyncio.Future[Any]) -> None:
        self._executor_calls -= 1

    def _wait_in_real_time(self, poll: Callable[[float], list[Any]]) -> list[Any]:
        events = poll(self._deadlock_timeout_s)
        if not events:
            raise self._deadlock_error(
                f"no socket or thread has woken the loop for {self._deadlock_timeout_s} real seconds"
            )
        return events

    def _may_be_woken(self) -> bool:
        return len(self._registered) != self._own_registered_count or threading.active_count() > 1

    def _deadlock_error(self, reason: str) -> DeadlockError:
        waiting = "".join(f"\n  - {_name_and_line(task)}" for task in asyncio.all_tasks(self))
        return DeadlockError(f"at {self._now} virtual seconds: {reason}; waiting tasks:{waiting or ' none'}")


def run_virtual(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine on a `VirtualClockLoop`, and cancel its remaining tasks, as asyncio.run does.

    Raises TypeError for an object that is not a coroutine, such as a coroutine function.
    """
    if not asyncio.iscoroutine(coroutine):
        raise TypeError(f"run_virtual requires a coroutine, such as main(), not {coroutine!r}")

    async def main() -> T:
        return await coroutine

    try:
        return anyio.run(main, backend_options={"loop_factory": VirtualClockLoop})
    finally:
        coroutine.close()  # This avoids a warning if the event loop could not be created and `main` never started.


VIRTUAL_BACKEND: tuple[str, dict[str, object]] = ("asyncio", {"loop_factory": VirtualClockLoop})
"""Value to return from a module's fixture ``anyio_backend``, so that its tests run on virtual time."""


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that does not wait in real time, but calls ``wait_for_events`` of the loop."""

    def __init__(self, loop: VirtualClockLoop) -> None:
        super().__init__()
        self._loop: VirtualClockLoop | None = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert self._loop is not None
        return self._loop.wait_for_events(super().select, timeout)

    def close(self) -> None:
        self._loop = None
        super().close()


def _name_and_line(task: asyncio.Task[Any]) -> str:
    line = ""
    awaited: object = task.get_coro()
    while isinstance(awaited, CoroutineType):
        frame = awaited.cr_frame
        if frame is not None:
            line = f" at {frame.f_code.co_filename}:{frame.f_lineno} in {awaited.__qualname__}"
        awaited = awaited.cr_await
    return task.get_name() + line
