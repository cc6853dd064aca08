"""Tests without waiting: an asyncio loop whose clock jumps to the next timer instead of sleeping.

```python
async def fly() -> None:
    await asyncio.sleep(3600)          # returns at once; loop.time() has moved by an hour

run_virtual(fly())
```

With anyio's pytest plugin, a test module runs on virtual time when it (or its ``conftest.py``) has the
fixture

```python
@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND

@pytest.mark.anyio
async def test_an_hour_of_silence() -> None:
    await anyio.sleep(3600)
```

The rules:

* ``time()`` starts at 0.0 and moves only when no callback is ready and no socket has anything to say.
* Real sockets are polled before every jump, but a jump does not wait for them: let tests on virtual time talk
  over `aerokit.transport.memory_link_pair`.
* While a call of ``run_in_executor`` (``asyncio.to_thread``, name resolution) is under way the clock stands
  still. Other threads may wake the loop by ``call_soon_threadsafe``, but do not stop the clock.
* When nothing can ever happen again, `DeadlockError` names the waiting tasks instead of hanging. If real
  sockets or other threads could still wake the loop, they get `PATIENCE_S` seconds of real time first.
"""

from __future__ import annotations

import asyncio
import selectors
import threading
from collections.abc import Callable, Coroutine, Mapping
from heapq import heappop
from types import CoroutineType
from typing import Any, TypeVar

import anyio

T = TypeVar("T")

PATIENCE_S = 10.0
"""Real seconds that sockets, executor calls and other threads get before the loop is called deadlocked."""


class DeadlockError(RuntimeError):
    """Nothing left to wait for: no ready callback, no timer, and nobody outside who would wake the loop."""


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """An asyncio loop on virtual time; see the module's text for its rules.

    ``patience_s`` is in real seconds, see `PATIENCE_S`.
    """

    def __init__(self, *, patience_s: float = PATIENCE_S) -> None:
        self._now = 0.0
        self._outside_calls = 0
        self._patience_s = patience_s
        self._own_sources: int | None = None  # the loop's own self-pipe, known once it is set up
        super().__init__(_JumpingSelector(self))
        self._own_sources = len(self._selector_map())
        self._clock_resolution = 1e-9  # now + (when - now) may miss a timer by a rounding error

    def time(self) -> float:
        """Virtual seconds since this loop was made."""
        return self._now

    def jump(self, when: float) -> bool:
        """Inside a callback: move the clock on to ``when``, unless something else happens until then; whether it did.

        Saves a turn of the loop to whoever would have nothing done but set a timer for ``when``.
        """
        if self._ready or self._stopping or self._outside_calls or self._debug:  # type: ignore[attr-defined]
            return False
        timers: list[asyncio.TimerHandle] = self._scheduled  # type: ignore[attr-defined]
        while timers and timers[0].cancelled():  # as the loop itself does at its next turn
            self._timer_cancelled_count -= 1  # type: ignore[attr-defined]
            heappop(timers)._scheduled = False  # type: ignore[attr-defined]
        if timers and timers[0].when() <= when + self._clock_resolution:
            return False
        if len(self._selector_map()) != self._own_sources:  # sockets are asked before every jump
            return False
        self._now = max(self._now, when)
        return True

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]
        """Runs ``func`` on a thread; the clock stands still until it has returned."""
        future = super().run_in_executor(executor, func, *args)
        self._outside_calls += 1
        future.add_done_callback(self._outside_call_done)
        return future

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        """Joins the executor's threads, in real time."""
        self._outside_calls += 1
        try:
            await super().shutdown_default_executor()
        finally:
            self._outside_calls -= 1

    def wait_for_events(self, poll: Callable[[float], list[Any]], timeout: float | None) -> list[Any]:
        """What the selector does instead of waiting ``timeout`` virtual seconds (None: for ever)."""
        events = poll(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        if self._outside_calls or (timeout is None and self._may_be_woken()):
            return self._wait_in_real_time(poll)
        if timeout is None:
            raise DeadlockError(self._deadlock("nothing left to wait for"))
        self._now += timeout
        return []

    def _outside_call_done(self, _future: asyncio.Future[Any]) -> None:
        self._outside_calls -= 1

    def _wait_in_real_time(self, poll: Callable[[float], list[Any]]) -> list[Any]:
        events = poll(self._patience_s)
        if not events:
            raise DeadlockError(
                self._deadlock(f"nothing came from outside in {self._patience_s} real seconds")
            )
        return events

    def _may_be_woken(self) -> bool:
        return len(self._selector_map()) != self._own_sources or threading.active_count() > 1

    def _selector_map(self) -> Mapping[Any, Any]:
        selector: selectors.BaseSelector = self._selector  # type: ignore[attr-defined]
        return selector.get_map()

    def _deadlock(self, reason: str) -> str:
        waiting = "".join(f"\n  - {_where(task)}" for task in asyncio.all_tasks(self))
        return f"at {self._now} virtual seconds: {reason}; waiting tasks:{waiting or ' none'}"


def run_virtual(coroutine: Coroutine[Any, Any, T]) -> T:
    """Runs a coroutine to its end on a `VirtualClockLoop`; cancels what it left, as asyncio.run does.

    TypeError for what is no coroutine, such as the function that makes it.
    """
    if not asyncio.iscoroutine(coroutine):
        raise TypeError(f"run_virtual takes a coroutine, as main() gives one, not {coroutine!r}")

    async def main() -> T:
        return await coroutine

    try:
        return anyio.run(main, backend_options={"loop_factory": VirtualClockLoop})
    finally:
        coroutine.close()


VIRTUAL_BACKEND: tuple[str, dict[str, object]] = ("asyncio", {"loop_factory": VirtualClockLoop})
"""What a fixture ``anyio_backend`` returns to run a module's tests on virtual time."""


class _JumpingSelector(selectors.DefaultSelector):
    """Asks the loop what to do instead of waiting."""

    def __init__(self, loop: VirtualClockLoop) -> None:
        super().__init__()
        self._loop: VirtualClockLoop | None = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert self._loop is not None
        return self._loop.wait_for_events(super().select, timeout)

    def close(self) -> None:
        self._loop = None
        super().close()


def _where(task: asyncio.Task[Any]) -> str:
    """A waiting task with the innermost line it stands at."""
    place = ""
    step: object = task.get_coro()
    while isinstance(step, CoroutineType):
        if step.cr_frame is not None:
            place = f" at {step.cr_frame.f_code.co_filename}:{step.cr_frame.f_lineno} in {step.__qualname__}"
        step = step.cr_await
    return task.get_name() + place
