"""``ThreadFuture``: a result that one thread sets and another thread waits for."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    import concurrent.futures

T = TypeVar("T")


class ThreadFuture(Generic[T]):
    """A result or an error that another thread sets. Waiting for it is safe for Ctrl-C at every moment.

    It uses a plain lock. ``Event`` and ``Future`` use ``threading.Condition``, which is Python code that Ctrl-C can
    interrupt between any two lines: KeyboardInterrupt then becomes ``RuntimeError: release unlocked lock``, or a lock
    that the other thread needs stays acquired.
    """

    def __init__(self) -> None:
        self._gate = threading.Lock()  # held until the future is done
        self._gate.acquire()
        self._values: tuple[T, ...] = ()
        self._error: BaseException | None = None
        self.is_done: bool = False

    @property
    def has_result(self) -> bool:
        return bool(self._values)

    def set_result(self, value: T) -> None:
        self._values = (value,)
        self.finish()

    def set_exception(self, error: BaseException) -> None:
        self._error = error
        self.finish()

    def finish(self) -> None:
        """Mark the future as done. Later calls do nothing.

        All calls must be made on one thread.
        """
        if not self.is_done:
            self.is_done = True
            self._gate.release()

    def wait(self, timeout: float) -> bool:
        if not self.is_done and self._gate.acquire(timeout=max(timeout, 0.0)):  # A lock takes -1 as "no limit".
            self._gate.release()  # Let the next waiting thread continue.
        return self.is_done

    def result(self) -> T:
        """Return the result, or raise the error. An error is raised only once.

        Raises LookupError if there is no result and no error.
        """
        error = self.pop_exception()
        if error is not None:
            raise error
        if not self._values:
            raise LookupError("the future was finished without a result")
        return self._values[0]

    def pop_exception(self) -> BaseException | None:
        # Forget the error, because its traceback refers to this object, which would be a reference cycle.
        error, self._error = self._error, None
        return error


def when_done(future: concurrent.futures.Future[Any]) -> ThreadFuture[None]:
    """Return a ThreadFuture that finishes, without a result, together with ``future``."""
    done: ThreadFuture[None] = ThreadFuture()
    future.add_done_callback(lambda _: done.finish())
    return done
