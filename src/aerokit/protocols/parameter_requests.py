"""What reading and writing parameters by name have in common: many at once, one result each.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink.messages import ParamError, ParamValue
from aerokit.parameters import Parameter
from aerokit.protocols.early_answers import EarlyAnswers
from aerokit.protocols.request_window import RequestWindow
from aerokit.protocols.transfer import PATIENCE_S, OnProgress, Transfer

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.round_trip import RoundTrip

__all__ = ["Answer", "ParameterRequests", "rejection"]

Answer = Parameter | ParameterRejected | ParameterTimeout
"""What came of one request: what the vehicle says the parameter is, or why there is nothing to say."""

ERRORS = {
    1: "the vehicle has no such parameter",
    2: "the vehicle does not accept this value",
    3: "the vehicle does not permit it",
    4: "the vehicle has no such component",
    5: "it is read-only",
    6: "the vehicle has no parameters of this type",
    7: "it is of another type",
    8: "the vehicle could not read it",
}


class ParameterRequests(Transfer[dict[str, Answer]]):
    """Ask for some names, a window of them at a time; ends with one answer for each, in the order given.

    Where nothing new comes for ``patience_s`` seconds, what is missing becomes a ParameterTimeout.
    """

    expects: tuple[type[Message], ...] = (ParamValue, ParamError)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        bytewise: bool,
        window: int,
        doubles_last: bool = True,
        own_system: int = 0,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self._names = tuple(dict.fromkeys(names))
        self._bytewise, self._own_system = bytewise, own_system
        self._window: RequestWindow[str] = RequestWindow(
            self.round_trip, size=window, doubles_last=doubles_last
        )
        self._answers: dict[str, Answer] = {}
        self._sent_at: dict[str, float] = {}
        self._early = EarlyAnswers(self.round_trip)

    def start(self, now: float) -> None:
        """Ask for the first of them."""
        self._begin(now)
        for name in self._names:
            self._window.ask(name)
        self._step(now)

    def receive(self, message: Message, now: float) -> None:
        """Take one value or error; what was not asked for is ignored, as are other components."""
        if self.done or not self._is_from_target(message):
            return
        if isinstance(message, ParamValue):
            self._take(message, now)
        elif isinstance(message, ParamError) and message.target_system in (0, self._own_system):
            self._take_error(
                message, now
            )  # PX4 fills what it does not use with anything: only the name counts
        self._step(now)

    def expire(self, now: float) -> None:
        """An answer is overdue."""
        if self.deadline is None or now < self.deadline:
            return
        if self._is_out_of_patience(now):
            for name in self._names:
                if name not in self._answers:
                    self._answers[name] = ParameterTimeout(self._timeout_text(name), missing=(name,))
        self._step(now)

    @abstractmethod
    def _request(self, name: str) -> list[Message]:
        """What is to be sent for this name now."""

    @abstractmethod
    def _take(self, message: ParamValue, now: float) -> None:
        """A value has come."""

    @abstractmethod
    def _timeout_text(self, name: str) -> str:
        """What was waited for."""

    def _before_sending(self, now: float) -> None:
        """The overdue ones are about to be sent again."""

    def _after_sending(self, now: float) -> None:
        """What was due has been sent."""

    def _take_error(self, message: ParamError, now: float) -> None:
        name = message.param_id
        if name in self._names and name in self._window:
            self._window.answered(name, now)
            self._settle(name, rejection(name, message.error), now)

    def _is_too_early(self, name: str, now: float) -> bool:
        """Whether this can be no answer to what was sent last: it is a late or repeated one to something before."""
        sent_at = self._sent_at.get(name, now)
        return self._early.is_one(name, sent_at, now, attempts=self._window.attempts(name))

    def _settle(self, name: str, answer: Answer, now: float) -> None:
        self._window.forget(name)
        self._answers[name] = answer
        self._move(now, len(self._answers), len(self._names))

    def _step(self, now: float) -> None:
        if len(self._answers) < len(self._names):
            self._before_sending(now)
        if len(self._answers) == len(self._names):
            self._finish({name: self._answers[name] for name in self._names})
            return
        for name in self._window.take_due(now):
            self._outbox += self._request(name)
            self._sent_at[name] = now
        self._after_sending(now)
        times = (self._window.deadline, self._moved_at + self._patience_s)
        self.deadline: float | None = min(at for at in times if at is not None)


def rejection(name: str, code: int) -> ParameterRejected:
    """The exception that stands for a PARAM_ERROR (https://mavlink.io/en/messages/common.html#PARAM_ERROR)."""
    reason = ERRORS.get(code, f"MAV_PARAM_ERROR {code}")
    return ParameterRejected(f"{name} was refused: {reason}", name=name, code=code)
