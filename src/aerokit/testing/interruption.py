"""`Interruption`: interrupts the main thread from another thread, as Ctrl-C would."""

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

_RETRY_INTERVAL_S = 0.001
_CONTEXT_FILES = ("interruption.py", "served.py")


class Interruption:
    """Raises KeyboardInterrupt in the main thread, but only within a block of `allowed`.

    Python may run the signal handler while the block is being entered or left, when no code would catch the exception.
    The handler then raises nothing, and the signal is sent again while the block lasts. No signal arrives after the
    block.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_allowed = False  # True within the block of `allowed`
        self._is_sent = False  # True once a signal was sent to the main thread
        self._is_delivered = False  # True once KeyboardInterrupt was raised
        self._previous_handler: Any = signal.default_int_handler

    @contextlib.contextmanager
    def allowed(self) -> Iterator[None]:
        """Allow interruptions in this block. This has an effect only on the main thread."""
        if threading.current_thread() is not threading.main_thread() or not _is_sigint_available():
            yield
            return
        self._previous_handler = signal.signal(signal.SIGINT, self._on_signal)
        self._is_allowed = True
        try:
            yield
        finally:
            with self._lock:  # `_send_signal` must not send after this block has ended.
                self._is_allowed = False
            if signal.getsignal(signal.SIGINT) == self._on_signal:
                # signal.signal() first runs `_on_signal` for a pending signal, so the previous handler never gets it.
                signal.signal(signal.SIGINT, self._previous_handler)

    @contextlib.contextmanager
    def on_error(self) -> Iterator[None]:
        """Interrupt the main thread if an exception leaves this block on another thread."""
        try:
            yield
        except Exception:
            # `_on_signal` ignores a signal that arrives in context-manager code, so the signal is sent again.
            while self._send_signal():
                time.sleep(_RETRY_INTERVAL_S)
            raise

    def _send_signal(self) -> bool:
        """Interrupt the main thread if this is allowed and still needed. Return True if a signal was sent."""
        with self._lock:
            is_needed = self._is_allowed and not self._is_delivered
            if is_needed:
                self._is_sent = True
                _interrupt_main()
        return is_needed

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._is_sent:  # This is not our signal: the user has pressed Ctrl-C.
            if callable(self._previous_handler):  # signal.SIG_IGN is not callable
                self._previous_handler(number, frame)
        elif self._is_allowed and not self._is_delivered and not _is_in_context_code(frame):
            self._is_delivered = True
            raise KeyboardInterrupt


def _is_sigint_available() -> bool:
    """Return True if an Interruption may replace the handler of SIGINT."""
    # SIG_IGN may be replaced, too, because shells set it for the background jobs of a script.
    handler = signal.getsignal(signal.SIGINT)
    is_of_interruption = isinstance(getattr(handler, "__self__", None), Interruption)
    return is_of_interruption or handler in (signal.default_int_handler, signal.SIG_IGN)


def _is_in_context_code(frame: FrameType | None) -> bool:
    """Return True if the frame is code that enters or leaves a `with` block."""
    name = "" if frame is None else frame.f_code.co_filename
    return name == contextlib.__file__ or (name.endswith(_CONTEXT_FILES) and "aerokit" in name)


def _interrupt_main() -> None:
    ident = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and ident is not None:
        signal.pthread_kill(ident, signal.SIGINT)  # Unlike interrupt_main, a real signal ends a sleep.
    else:
        _thread.interrupt_main()
