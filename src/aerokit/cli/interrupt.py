"""Ctrl-C as an event of the loop, so that a vehicle in the air can be brought down before the program ends."""

from __future__ import annotations

import asyncio
import signal
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["on_interrupt"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def on_interrupt(callback: Callable[[], None]) -> Iterator[None]:
    """While the block lasts, Ctrl-C and SIGTERM call ``callback`` on the running loop and do nothing else."""
    loop = asyncio.get_running_loop()
    before = [signal.getsignal(number) for number in SIGNALS]
    try:
        for number in SIGNALS:
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(callback))
    except ValueError:  # not on the main thread, where alone signals can be handled
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)
