"""`Interruption`: ends what the main thread does, from another thread, as Ctrl-C would."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Interruption"]


class Interruption:
    """Interrupts the main thread at most while it is in `allowed`; KeyboardInterrupt comes out of that block."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_allowed = False

    @contextmanager
    def allowed(self) -> Iterator[None]:
        """May be interrupted in this block, if it is the main thread that runs it, and Ctrl-C is not taken."""
        is_main = threading.current_thread() is threading.main_thread()
        self._is_allowed = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        try:
            yield
        finally:
            with self._lock:  # not between the look and the interruption
                self._is_allowed = False

    @contextmanager
    def at_an_error(self) -> Iterator[None]:
        """On the other thread: an exception in this block interrupts the main thread, and goes on."""
        try:
            yield
        except Exception:
            with self._lock:
                if self._is_allowed:
                    _interrupt_main()
            raise


def _interrupt_main() -> None:
    ident = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and ident is not None:
        signal.pthread_kill(ident, signal.SIGINT)  # wakes it from a sleep, too
    else:
        _thread.interrupt_main()
