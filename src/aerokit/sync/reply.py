"""``Reply``: what one thread waits for and another one gives, open to Ctrl-C at every moment."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    import concurrent.futures

T = TypeVar("T")


class Reply(Generic[T]):
    """A result or an error, given once by another thread.

    It is waited for at a plain lock. ``threading.Condition``, and with it ``Event`` and ``Future``, is Python code that
    Ctrl-C may stop anywhere: between its lines KeyboardInterrupt becomes ``RuntimeError: release unlocked lock``, or a
    lock stays taken that the other thread needs.
    """

    def __init__(self) -> None:
        self._gate = threading.Lock()
        self._gate.acquire()
        self._values: tuple[T, ...] = ()
        self._error: BaseException | None = None
        self.is_done: bool = False
        """Whether it was given, or it is certain that it never will be."""

    @property
    def has_result(self) -> bool:
        """Whether a result was given, and neither an error nor nothing."""
        return bool(self._values)

    def give(self, value: T) -> None:
        """Give the result."""
        self._values = (value,)
        self.end()

    def fail(self, error: BaseException) -> None:
        """Give an error instead."""
        self._error = error
        self.end()

    def end(self) -> None:
        """Nothing more is given; idempotent, on one thread."""
        if not self.is_done:
            self.is_done = True
            self._gate.release()

    def wait(self, timeout: float) -> bool:
        """Wait at most so many seconds; whether it is done."""
        if not self.is_done and self._gate.acquire(timeout=timeout):
            self._gate.release()  # for the next who waits
        return self.is_done

    def result(self) -> T:
        """The result, once it is done; raises the error, once; LookupError when there is neither."""
        error = self.take_error()
        if error is not None:
            raise error
        if not self._values:
            raise LookupError("nothing was given")
        return self._values[0]

    def take_error(self) -> BaseException | None:
        """The error, once."""
        error, self._error = self._error, None  # kept, it would hold its traceback, and that would hold it
        return error


def reply_of(future: concurrent.futures.Future[Any]) -> Reply[None]:
    """What is done when the future is; it never has a result."""
    reply: Reply[None] = Reply()
    future.add_done_callback(lambda _: reply.end())
    return reply
