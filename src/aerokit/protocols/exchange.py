"""What every request to a vehicle has in common, without IO and without a clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message

__all__ = ["Exchange"]

ResultT = TypeVar("ResultT")


class Exchange(ABC, Generic[ResultT]):
    """One request to one vehicle with its retries and its end.

    A driver calls ``start`` once, ``receive`` for every message of ``expects`` that the target sends, ``expire`` when
    ``deadline`` has come, and sends what ``take_outbox`` gives after each of them, until ``done``.
    Times are seconds on any steady clock, as long as it is always the same one.
    """

    expects: tuple[type[Message], ...] = ()
    """The message classes that ``receive`` wants to see."""

    def __init__(self) -> None:
        self.deadline: float | None = None
        self._outbox: list[Message] = []
        self._result: ResultT | None = None
        self._error: Exception | None = None
        self.done: bool = False

    @abstractmethod
    def start(self, now: float) -> None:
        """Put the first message into the outbox and set the deadline."""

    @abstractmethod
    def receive(self, message: Message, now: float) -> None:
        """Take one message of the target; what does not belong to this request is ignored."""

    @abstractmethod
    def expire(self, now: float) -> None:
        """The deadline has come: send again or give up. Not called once it is ``done``."""

    def link_changed(self, now: float) -> None:
        """The vehicle is spoken to over another link from now on, by another port of it.

        Most exchanges send again what got no answer. One whose state the vehicle keeps for the port begins anew.
        """
        return

    def abort(self, error: Exception) -> None:
        """End at once with this error, unless the end was there before."""
        self._fail(error)

    def take_outbox(self) -> list[Message]:
        """What has to be sent now; the second call gives nothing."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def result(self) -> ResultT:
        """What came of it; raises the error it ended with. Only once ``done``."""
        if self._error is not None:
            raise self._error
        if not self.done:
            raise RuntimeError("this exchange has not ended yet")
        return self._result  # type: ignore[return-value]  # set by _finish, which alone ends without an error

    def _finish(self, result: ResultT) -> None:
        if not self.done:
            self._result, self.done, self.deadline = result, True, None

    def _fail(self, error: Exception) -> None:
        if not self.done:
            self._error = error
            self.done = True
            self.deadline = None
