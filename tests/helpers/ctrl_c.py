"""Sends Ctrl-C to the main thread."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable

from aerokit.sync.loop_thread import LoopThread

__all__ = ["interrupt_soon", "interrupt_when", "is_waiting_for_loop"]

POLL_INTERVAL_S = 0.01


def interrupt_soon() -> threading.Timer:
    """Interrupt the main thread after a moment."""
    timer = threading.Timer(0.1, _interrupt)
    timer.start()
    return timer


def interrupt_when(condition: Callable[[], bool]) -> threading.Thread:
    """Interrupt the main thread once ``condition()`` is true, which another thread evaluates."""

    def wait() -> None:
        while not condition():
            time.sleep(POLL_INTERVAL_S)
        _interrupt()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def is_waiting_for_loop() -> bool:
    """Return True while the main thread is in a blocking call that waits for the thread of the event loop."""
    frame = sys._current_frames().get(_main_thread_id())
    while frame is not None and frame.f_code is not LoopThread.wait_for.__code__:
        frame = frame.f_back
    return frame is not None


def _interrupt() -> None:
    signal.pthread_kill(_main_thread_id(), signal.SIGINT)


def _main_thread_id() -> int:
    ident = threading.main_thread().ident
    assert ident is not None
    return ident
