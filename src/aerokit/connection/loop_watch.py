"""``LoopWatch``: notices when the event loop is kept from running, and how old what is read then may be."""

from __future__ import annotations

import asyncio
import math
import sys
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

PERIOD_S = 0.1
"""How often it is looked, by a timer or by what is read."""

LATE_AFTER_S = 0.1

BLOCKED_AFTER_S = 0.25

QUIET_TURNS = 3
"""So many turns of the loop in which nothing was read: what had waited has been read. Loops differ in what they do
first in a turn, timers or sockets."""

CLOCKS = {
    "linux": ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC"),
    "darwin": ("CLOCK_MONOTONIC", "CLOCK_UPTIME_RAW"),
}
"""System → a clock that goes on while the computer sleeps, and the loop's. That of Windows goes on."""


def asleep_s() -> float:
    """Seconds that the computer has slept since it was started, during which the loop's clock stood still."""
    clocks = CLOCKS.get(sys.platform)
    if clocks is None:
        return 0.0
    all_of_it, awake = (time.clock_gettime(getattr(time, each)) for each in clocks)
    return all_of_it - awake


class LoopWatch:
    """A timer that is always under way. When it comes late, the program, or the system, kept the loop from running.
    What is read in time puts it off: each time that it wakes a sleeping process costs as much as a few messages.

    What is read afterwards may have waited since the loop last ran: nobody knows better, so that is when it came, until
    all that had waited has been read. A pause of less than ``PERIOD_S + LATE_AFTER_S`` is not noticed; what is read is
    called younger than it is by so much at most. ``on_blocked`` is told the length of pauses above
    ``BLOCKED_AFTER_S``; ``on_slept`` for how long the computer has slept, which the loop's clock does not show.
    """

    def __init__(
        self,
        on_blocked: Callable[[float], None],
        on_slept: Callable[[float], None],
        asleep: Callable[[], float] = asleep_s,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_blocked, self._on_slept = on_blocked, on_slept
        self._asleep, self._slept_before = asleep, max(asleep() for _ in range(3))
        self.late_after: float = math.inf
        """What is read at a later time than this came at :meth:`arrival`, else when it was read."""
        self._ran_at = self._due = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None
        self._oldest: float | None = None  # while there may be something that has waited
        self._has_read = False
        self._quiet_turns = 0

    def start(self) -> None:
        """Watch, until :meth:`close`."""
        self._set_timer(self._loop.time())

    def close(self) -> None:
        """Watch no more."""
        self.late_after = math.inf
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    @property
    def oldest_arrival(self) -> float:
        """When what is read now may have arrived at the earliest; infinite while nothing can have waited."""
        return math.inf if self._oldest is None else self._oldest

    def arrival(self, now: float) -> float:
        """When what is read came: now, or, if it may have waited, the earliest time at which it may have come."""
        has_slept = self._has_slept()
        if self._oldest is None and not has_slept and now <= self._due + LATE_AFTER_S:
            if self._timer is not None:
                self._timer.cancel()
            self._set_timer(now)
            return now
        self._has_read = True
        return self._fall_behind()

    def _tick(self) -> None:
        now = self._loop.time()
        late = now - self._due
        if self._has_slept() or late > LATE_AFTER_S:
            self._fall_behind()
        self._set_timer(now)
        if late > BLOCKED_AFTER_S:
            self._on_blocked(late + PERIOD_S)

    def _has_slept(self) -> bool:
        # A process that is interrupted between the two clocks reads less than the truth, which never shrinks.
        before, self._slept_before = self._slept_before, max(self._slept_before, self._asleep())
        slept_s = self._slept_before - before
        if slept_s <= LATE_AFTER_S:
            return False
        self._ran_at -= slept_s
        self._on_slept(slept_s)
        return True

    def _set_timer(self, now: float) -> None:
        self._ran_at, self._due = now, now + PERIOD_S
        if self._oldest is None:
            self.late_after = now + PERIOD_S / 2
        self._timer = self._loop.call_at(self._due, self._tick)

    def _fall_behind(self) -> float:
        if self._oldest is None:
            self._oldest, self.late_after, self._quiet_turns = self._ran_at, -math.inf, 0
            self._loop.call_soon(self._look)
        return self._oldest

    def _look(self) -> None:
        """Once a turn, until everything that had waited has been read."""
        self._quiet_turns = 0 if self._has_read else self._quiet_turns + 1
        self._has_read = False
        if self._timer is None:
            return
        if self._quiet_turns < QUIET_TURNS:
            self._loop.call_soon(self._look)
        else:
            self._oldest = None
            self.late_after = self._ran_at + PERIOD_S / 2


TERMINAL_IPYTHON = (
    "IPython in a terminal runs the loop only while a cell runs: type %gui asyncio before you connect,"
    " use aerokit.sync, or keep the whole flight in one cell"
)
"""What is wrong, and what to do."""


def stands_still_between_inputs() -> bool:
    """Whether the running loop is that of IPython in a terminal, and ``%gui asyncio`` was not typed."""
    module = sys.modules.get("IPython.terminal.interactiveshell")
    shell: Any = getattr(getattr(module, "TerminalInteractiveShell", None), "_instance", None)
    if shell is None or getattr(shell, "active_eventloop", None) == "asyncio":
        return False
    helpers = sys.modules.get("IPython.core.async_helpers")
    return asyncio.get_running_loop() is getattr(helpers, "_asyncio_event_loop", None)
