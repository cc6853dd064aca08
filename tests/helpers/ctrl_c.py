"""Sends Ctrl-C to the main thread."""

from __future__ import annotations

import signal
import threading

__all__ = ["interrupt_soon"]


def interrupt_soon() -> threading.Timer:
    """Interrupt the main thread after a moment."""
    main = threading.main_thread().ident
    assert main is not None
    timer = threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT))
    timer.start()
    return timer
