"""``Deadlines``: many of them on one timer of the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

__all__ = ["Deadlines"]

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
