"""`Interruption`: ends what the main thread does, from another thread, as Ctrl-C would."""

from __future__ import annotations

import _thread
import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import FrameType

_AGAIN_S = 0.001
_AT_THE_EDGE = ("interruption.py", "served.py")


class Interruption:
    """Interrupts the main thread at most while it is in `allowed`; KeyboardInterrupt comes out of that block.

    Python may handle a signal much later than it was sent, and anywhere: also while a block is being entered or left,
    where nobody would catch it. A signal that comes there is sent again, and none is left when the block is.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_allowed = self._is_sent = self._is_told = False
        self._before: Any = signal.default_int_handler

    @contextlib.contextmanager
    def allowed(self) -> Iterator[None]:
        """May be interrupted in this block, if it is the main thread that runs it, and Ctrl-C is not taken."""
        if threading.current_thread() is not threading.main_thread() or not _is_free():
            yield
            return
        self._before = signal.signal(signal.SIGINT, self._on_signal)
        self._is_allowed = True
        try:
            yield
        finally:
            with self._lock:  # not between the look and the interruption
                self._is_allowed = False
            if signal.getsignal(signal.SIGINT) == self._on_signal:
                signal.signal(
                    signal.SIGINT, self._before
                )  # handles what was sent, before it changes anything

    @contextlib.contextmanager
    def at_an_error(self) -> Iterator[None]:
        """On the other thread: an exception in this block interrupts the main thread, and goes on."""
        try:
            yield
        except Exception:
            while self._interrupts():
                time.sleep(_AGAIN_S)
            raise

    def _interrupts(self) -> bool:
        with self._lock:
            is_wanted = self._is_allowed and not self._is_told
            if is_wanted:
                self._is_sent = True
                _interrupt_main()
        return is_wanted

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._is_sent:
            if callable(self._before):  # SIG_IGN is not
                self._before(number, frame)
        elif self._is_allowed and not self._is_told and not _is_at_the_edge(frame):
            self._is_told = True
            raise KeyboardInterrupt


def _is_free() -> bool:
    """Whether nobody but another of these has taken Ctrl-C; ignored, as by the jobs of a script, it is free."""
    handler = signal.getsignal(signal.SIGINT)
    return handler in (signal.default_int_handler, signal.SIG_IGN) or isinstance(
        getattr(handler, "__self__", None), Interruption
    )


def _is_at_the_edge(frame: FrameType | None) -> bool:
    """Whether a block is being entered or left."""
    name = "" if frame is None else frame.f_code.co_filename
    return name == contextlib.__file__ or (name.endswith(_AT_THE_EDGE) and "aerokit" in name)


def _interrupt_main() -> None:
    ident = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and ident is not None:
        signal.pthread_kill(ident, signal.SIGINT)  # wakes it from a sleep, too
    else:
        _thread.interrupt_main()
