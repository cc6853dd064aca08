"""``LoopWatch``: detects a blocked event loop, and bounds the age of data that is read after the pause."""

from __future__ import annotations

import asyncio
import math
import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

# After this interval, a timer checks whether the loop was blocked. Data that is read earlier, such as telemetry at 10
# Hz, postpones the check. A check counts as late after 0.2 s: this interval plus LATE_THRESHOLD_S.
CHECK_INTERVAL_S = 0.12

LATE_THRESHOLD_S = 0.08

BLOCKED_THRESHOLD_S = 0.25

# After a pause of the loop, all data that arrived meanwhile has been read once this many iterations read nothing. One
# iteration does not suffice, because some loops run timers before they read sockets.
MIN_IDLE_ITERATIONS = 3

MAX_SLEEPS = 16

# Maps each platform to its clock that includes suspended time, and to the clock of the loop. On Windows, the loop's
# clock itself includes suspended time.
CLOCKS = {
    "linux": ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC"),
    "darwin": ("CLOCK_MONOTONIC", "CLOCK_UPTIME_RAW"),
}

_CLOCKS = tuple(getattr(time, clock) for clock in CLOCKS[sys.platform]) if sys.platform in CLOCKS else None


def suspended_s() -> float:
    """Return for how many seconds since boot the computer was suspended and the loop's clock stood still."""
    if _CLOCKS is None:
        return 0.0
    total, awake = _CLOCKS
    return time.clock_gettime(total) - time.clock_gettime(awake)


def loop_clock() -> Callable[[], float]:
    loop = asyncio.get_running_loop()
    # asyncio's own loops use time.monotonic(). Calling it directly is faster.
    return time.monotonic if type(loop).time is asyncio.BaseEventLoop.time else loop.time


class LoopWatch:
    """Detects pauses of the event loop by a timer that fires late.

    Data that arrives during a pause is read only afterwards, so the time of its arrival is unknown. Its receive time is
    the time at which the loop last ran before the pause. A pause shorter than ``CHECK_INTERVAL_S + LATE_THRESHOLD_S``
    may not be detected. Data may then be older than its receive time says, by at most the pause.

    ``on_blocked`` gets the maximum length of each pause that delays the timer by more than ``BLOCKED_THRESHOLD_S``.
    ``on_slept`` gets the time that the computer was suspended. ``on_caught_up`` is called when all waiting data has
    been read, and gets the seconds from the start of the pause until then.
    """

    def __init__(
        self,
        on_blocked: Callable[[float], None],
        on_slept: Callable[[float], None],
        suspended: Callable[[], float] = suspended_s,
        *,
        on_caught_up: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_blocked, self._on_slept, self._on_caught_up = on_blocked, on_slept, on_caught_up
        self._suspended = suspended
        # The largest of three readings is used, because a single reading may be too small; see `_detect_sleep`.
        self._suspended_before = max(suspended() for _ in range(3))  # seconds of suspension at the last check
        self.late_after: float = math.inf
        """Loop time until which the time of reading is the receive time. Later reads must call :meth:`arrival_time`.

        Infinite before `start` and after `close`. Minus infinity while data from a pause may still be unread.
        """
        self._ran_at = self._loop.time()  # when the loop last ran, as far as known
        self._due = self._ran_at  # when the timer should fire
        self._timer: asyncio.TimerHandle | None = None  # None before start() and after close()
        self.oldest_arrival: float = math.inf
        """Earliest possible receive time of data that is read now; infinite if the data cannot have waited."""
        # The last times at which the computer woke, with the seconds for which it was suspended.
        self._sleeps: deque[tuple[float, float]] = deque(maxlen=MAX_SLEEPS)
        # Next time at which `arrival_time` checks for a suspension. The check is slow.
        self._check_sleep_at = -math.inf
        self._has_read = False  # True if data was read since the last call of `_stop_catching_up_when_idle`
        self._idle_iterations = 0  # number of consecutive loop iterations in which nothing was read

    def start(self) -> None:
        self._set_timer(self._loop.time())

    def close(self) -> None:
        self.late_after = math.inf
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def arrival_time(self, now: float) -> float:
        """Return the receive time of data that is read now.

        This time is earlier than ``now`` if the data may have waited.
        """
        if now < self._check_sleep_at and self._is_catching_up:
            # The clocks were checked a moment ago, and data that arrived during the last pause may still be unread.
            self._has_read = True
            return self.oldest_arrival
        self._check_sleep_at = now + CHECK_INTERVAL_S / 2
        has_slept = self._detect_sleep()
        is_timer_late = now > self._due + LATE_THRESHOLD_S
        may_have_waited = self._is_catching_up or has_slept or is_timer_late
        if not may_have_waited:
            # Data that is read in time proves that the loop runs, so the timer need not fire. Postponing it costs less
            # than waking the process only for the timer.
            if self._timer is not None:  # None after close(), which must not start the timer again
                self._timer.cancel()
                self._set_timer(now)
            return now
        self._has_read = True
        return self._start_catching_up()

    def slept_since(self, at: float) -> float:
        """Return how many seconds the computer was suspended since this loop time."""
        # Check now, because the timer may notice a suspension up to 0.2 s later.
        if self._timer is not None and self._detect_sleep():
            self._start_catching_up()
        return sum(seconds for woke_at, seconds in self._sleeps if woke_at > at)

    def _tick(self) -> None:
        now = self._loop.time()
        late_s = now - self._due
        has_slept = self._detect_sleep()
        if self._timer is None:  # A sink of ComputerSlept has closed the connection.
            return
        if has_slept or late_s > LATE_THRESHOLD_S:
            self._start_catching_up()
        self._set_timer(now)
        if late_s > BLOCKED_THRESHOLD_S:
            # The pause began at the earliest when the timer was set, so this is its maximum length.
            self._on_blocked(late_s + CHECK_INTERVAL_S)

    def _detect_sleep(self) -> bool:
        """Report a suspension of the computer since the last call. Return True if there was one."""
        # `_suspended` subtracts two clock readings. Its result is too small if the process was preempted between the
        # readings. The true value never decreases, so the largest result so far is used.
        suspended_before_s = self._suspended_before
        self._suspended_before = max(suspended_before_s, self._suspended())
        slept_s = self._suspended_before - suspended_before_s
        # A small difference is no sleep: on macOS, NTP may adjust only one of the two clocks.
        if slept_s <= LATE_THRESHOLD_S:
            return False
        self._ran_at -= slept_s  # The loop's clock stood still during the sleep, in which data may have arrived.
        self._sleeps.append((self._loop.time(), slept_s))
        self._on_slept(slept_s)
        return True

    def _set_timer(self, now: float) -> None:
        self._ran_at, self._due = now, now + CHECK_INTERVAL_S
        if not self._is_catching_up:
            self.late_after = now + CHECK_INTERVAL_S / 2
        self._timer = self._loop.call_at(self._due, self._tick)

    def _start_catching_up(self) -> float:
        """Start reading the data that may have arrived during the pause. Return its earliest possible receive time."""
        if not self._is_catching_up:
            self.oldest_arrival = self._ran_at
            self.late_after = -math.inf
            self._idle_iterations = 0
            self._loop.call_soon(self._stop_catching_up_when_idle)
        return self.oldest_arrival

    @property
    def _is_catching_up(self) -> bool:
        """True while data that arrived during a pause may still be unread."""
        return self.oldest_arrival < math.inf

    def _stop_catching_up_when_idle(self) -> None:
        # Called in every loop iteration while `_is_catching_up` is true.
        self._idle_iterations = 0 if self._has_read else self._idle_iterations + 1
        self._has_read = False
        if self._timer is None:  # The connection is closed.
            return
        if self._idle_iterations < MIN_IDLE_ITERATIONS:
            self._loop.call_soon(self._stop_catching_up_when_idle)
        else:
            caught_up_after_s = self._loop.time() - self.oldest_arrival
            self.oldest_arrival = math.inf
            self.late_after = self._ran_at + CHECK_INTERVAL_S / 2
            self._on_caught_up(caught_up_after_s)  # This comes last, because it may close the watch.


IPYTHON_HINT = (
    "IPython in a terminal runs the loop only while a cell runs: type %gui asyncio before you connect,"
    " use aerokit.sync, or keep the whole flight in one cell"
)


def is_unintegrated_ipython() -> bool:
    """Return True in terminal IPython without ``%gui asyncio``."""
    # `%gui asyncio` sets `active_eventloop`. Without it, IPython has an event loop of its own, which runs only while
    # entered code runs.
    module = sys.modules.get("IPython.terminal.interactiveshell")
    shell: Any = getattr(getattr(module, "TerminalInteractiveShell", None), "_instance", None)
    if shell is None or getattr(shell, "active_eventloop", None) == "asyncio":
        return False
    helpers = sys.modules.get("IPython.core.async_helpers")
    return asyncio.get_running_loop() is getattr(helpers, "_asyncio_event_loop", None)
