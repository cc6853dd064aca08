"""Ctrl-C as an event of the loop, so that a vehicle in the air can be brought down before the program ends."""

from __future__ import annotations

import asyncio
import signal
from contextlib import contextmanager
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

__all__ = ["Interruptible", "on_interrupt"]


def _signals() -> tuple[signal.Signals, ...]:
    """SIGHUP, the end of the terminal, where there is one and nobody (nohup) has switched it off."""
    hang_up: signal.Signals | None = getattr(signal, "SIGHUP", None)
    if hang_up is None or signal.getsignal(hang_up) is signal.SIG_IGN:
        return signal.SIGINT, signal.SIGTERM
    return signal.SIGINT, signal.SIGTERM, hang_up


@contextmanager
def on_interrupt(
    callback: Callable[[], None], at_once: Callable[[int], object] = lambda number: None
) -> Iterator[None]:
    """While the block lasts, Ctrl-C, SIGTERM and SIGHUP call ``callback`` on the running loop and do nothing else.

    ``at_once(number)`` is called by the signal's handler before, also while something blocks the loop.
    """
    loop = asyncio.get_running_loop()
    signals = _signals()
    before = [signal.getsignal(number) for number in signals]

    def handle(number: int, _: object) -> None:
        at_once(number)
        loop.call_soon_threadsafe(callback)

    try:
        for number in signals:
            signal.signal(number, handle)
    except ValueError:  # not on the main thread, where alone signals can be handled
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


class Interruptible:
    """Runs functions that Ctrl-C ends; each Ctrl-C ends the innermost one only."""

    def __init__(self) -> None:
        self._scopes: list[anyio.CancelScope] = []

    def interrupt(self) -> None:
        """End the innermost one that runs."""
        if self._scopes:
            self._scopes[-1].cancel()

    async def run(self, function: Callable[[], Awaitable[int]]) -> int | None:
        """What the function gives, None when it was interrupted."""
        scope = anyio.CancelScope()
        with scope:
            self._scopes.append(scope)
            try:
                return await function()
            finally:
                self._scopes.remove(scope)
        return None
