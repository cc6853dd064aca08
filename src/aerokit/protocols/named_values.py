"""What PARAM and PARAM_EXT have in common: the list with holes, requests by name, and when an answer counts.

https://mavlink.io/en/services/parameter.html

https://mavlink.io/en/services/parameter_ext.html
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.protocols.exchange import Transfer, ranges
from aerokit.protocols.request_window import WINDOW, RequestWindow

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

ValueT = TypeVar("ValueT")
ResultT = TypeVar("ResultT")

PAUSES = 4
"""The stream of a list has stopped when nothing comes for so many of its longest pauses."""
SHORTEST_START_S = 0.3
"""A list may take that long to begin; asking again would make it begin anew."""
ROUNDS = 3
"""How often indices are asked for again that were told under another count."""
BY_NAME = -1
"""The index in a request that names what it is about."""
PROBE, PROBE_INDEX = "", 0
"""The request for a value that everybody has who has any."""
DOUBT = 1e-4
"""How probable it may be that there is such a name although nothing is said of it, while others are answered."""
VERDICT, VERDICT_OF_NO_CHANGE = 2, 8
"""So many answers with another value than asked for are a verdict; more when it is the value from before, which may
also stand in a message that was under way, while what was to set it was lost."""


class ValueList(Transfer[ResultT], Generic[ResultT, ValueT]):
    """Ask for a whole list once; a hole in the stream of answers is asked for by its index at once, in a window."""

    asked_by: ClassVar[str]
    """The message that asks for the list."""
    noun: ClassVar[str]
    window_size: ClassVar[int] = WINDOW

    def __init__(self, target_system: int, target_component: int, **options: Unpack[TransferOptions]) -> None:
        super().__init__(target_system, target_component, **options)
        self._window: RequestWindow[int] = RequestWindow(self.round_trip, size=self.window_size)
        self._told: dict[int, tuple[ValueT, int]] = {}
        """Index → what was told last under it, and how many there were then."""
        self._count: int | None = None
        self._next = 0
        """The index that the stream brings next."""
        self._is_streaming = False
        self._quiet_at: float | None = None
        self._last_at = self._pause_s = 0.0
        self._attempts = self._rounds = 0

    def expire(self, now: float) -> None:
        """Something is overdue: the beginning of the list, the rest of it, or an answer."""
        if self.deadline is None or now < self.deadline:
            return
        if self._is_out_of_patience(now):
            self._fail(ParameterTimeout(self._timeout_text(), missing=self._missing()))
            return
        if self._quiet_at is not None and now >= self._quiet_at:
            self._on_quiet(now)
        self._step(now)

    @abstractmethod
    def _list_request(self) -> Message:
        """Ask for all of them."""

    @abstractmethod
    def _read_request(self, index: int) -> Message:
        """Ask for one."""

    @abstractmethod
    def _on_quiet(self, now: float) -> None:
        """The stream has not begun, or has stopped before its end."""

    @abstractmethod
    def _conclude(self) -> None:
        """End when all is there, else have asked for what is missing."""

    def _ask_for_list(self, now: float) -> None:
        self._attempts += 1
        self._is_streaming = True
        self._outbox.append(self._list_request())
        self._quiet_at = now + max(self.round_trip.timeout_s(self._attempts), SHORTEST_START_S)

    def _keep(self, index: int, value: ValueT, told_count: int, now: float) -> None:
        is_new = index not in self._told
        self._told[index] = value, told_count
        if is_new:
            count = self._count or 0
            self._move(now, min(len(self._told), count), count)

    def _step(self, now: float) -> None:
        self._conclude()
        if self.done:
            return
        for index in self._window.take_due(now):
            self._outbox.append(self._read_request(index))
        times = (self._window.deadline, self._quiet_at, self._moved_at + self._patience_s)
        self.deadline: float | None = min(at for at in times if at is not None)

    def _drop_stale(self, count: int) -> tuple[int, ...]:
        """Forget what was told under another count, a few times at most; the indices."""
        stale = tuple(index for index in range(count) if self._told[index][1] != count)
        if not stale or self._rounds >= ROUNDS:
            return ()
        self._rounds += 1
        for index in stale:
            del self._told[index]
        return stale

    def _missing(self) -> tuple[int, ...]:
        return tuple(index for index in range(self._count or 0) if index not in self._told)

    def _timeout_text(self) -> str:
        if self._count is None:
            return f"{self.asked_by} was not answered, sent {self._attempts} times"
        missing = self._missing()
        return (
            f"{len(missing)} of {self._count} {self.noun} did not come: nothing new for {self._patience_s:g} s,"
            f" missing {ranges(missing)}"
        )


class NamedRequests(Transfer[dict[str, "ValueT | ParameterRejected | ParameterTimeout"]], Generic[ValueT]):
    """Ask for some names, a window of them at a time; ends with one answer for each, in the order given.

    Where nothing new comes for ``patience_s`` seconds, what is missing becomes a ParameterTimeout.
    """

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        window: int,
        doubles_last: bool = True,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._names = tuple(dict.fromkeys(names))
        self._window: RequestWindow[str] = RequestWindow(
            self.round_trip, size=window, doubles_last=doubles_last
        )
        self._answers: dict[str, ValueT | ParameterRejected | ParameterTimeout] = {}
        self._sent_at: dict[str, float] = {}

    def start(self, now: float) -> None:
        """Ask for the first of them."""
        self._begin(now)
        for name in self._names:
            self._window.ask(name)
        self._step(now)

    def receive(self, message: Message, now: float) -> None:
        """Take an answer; what was not asked for is ignored, as are other components."""
        if not self.done and self._is_from_target(message):
            self._hear(message, now)
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
    def _hear(self, message: Message, now: float) -> None:
        """The component has said something."""

    def _timeout_text(self, name: str) -> str:
        return f"{name} was not answered, asked for {self._window.attempts(name)} times"

    def _before_sending(self, now: float) -> None:
        """The overdue ones are about to be sent again."""

    def _after_sending(self, now: float) -> None:
        """What was due has been sent."""

    def _settle(self, name: str, answer: ValueT | ParameterRejected | ParameterTimeout, now: float) -> None:
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


class NamedReads(NamedRequests[ValueT]):
    """Read some values by name. Silence about a name becomes a ParameterRejected, while the `PROBE` is answered."""

    whose: ClassVar[str]
    """Who has no such value, and what it is called: "the vehicle has no parameter"."""
    _is_probe_wanted = False
    _probes_sent = _probes_answered = 0

    @abstractmethod
    def _read_request(self, name: str, index: int) -> Message:
        """Ask for one, by its name or by its index."""

    def _request(self, name: str) -> list[Message]:
        self._probes_sent += name == PROBE
        return [self._read_request(name, PROBE_INDEX if name == PROBE else BY_NAME)]

    def _overdue(self, now: float) -> list[str]:
        return [name for name in self._window.overdue(now) if name != PROBE]

    def _after_sending(self, now: float) -> None:
        if self._is_probe_wanted and PROBE not in self._window:
            self._window.send(PROBE, now)
            self._outbox += self._request(PROBE)
        self._is_probe_wanted = False

    def _count_probe(self) -> None:
        self._probes_answered = min(self._probes_answered + 1, self._probes_sent)  # repeated ones count once

    def _give_up_unknown(self, names: Iterable[str], now: float) -> None:
        """Silence is an answer once it can hardly be loss."""
        for name in names:
            if self._probability_of_silence(self._window.attempts(name)) < DOUBT:
                text = f"{self.whose} {name}: it answers others, and not this one"
                self._settle(name, ParameterRejected(text, name=name), now)

    def _probability_of_silence(self, attempts: int) -> float:
        """How probable it is to lose all answers to so many requests, after what became of the probes (Laplace)."""
        lost = self._probes_sent - self._probes_answered
        chances = ((lost + 1 + i) / (self._probes_sent + 2 + i) for i in range(attempts))
        return math.prod(chances) if self._probes_answered else 1.0


class OtherAnswers(Generic[ValueT]):
    """Answers to one write with another value than asked for, as far as they agree."""

    def __init__(self, is_same: Callable[[ValueT, ValueT], bool]) -> None:
        self._is_same = is_same
        self._told: list[ValueT] = []

    def __len__(self) -> int:
        return len(self._told)

    def ends_with(self, told: ValueT) -> bool:
        """Whether the last one was the same."""
        return bool(self._told) and self._is_same(self._told[-1], told)

    def add(self, told: ValueT) -> None:
        """One more; another one than before makes all of those worth nothing."""
        if not self.ends_with(told):
            self._told.clear()
        self._told.append(told)

    def are_verdict(self, *, is_no_change: bool) -> bool:
        """Whether this is what the value is."""
        return len(self._told) >= (VERDICT_OF_NO_CHANGE if is_no_change else VERDICT)
