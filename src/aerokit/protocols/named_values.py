"""Base classes of the parameter protocols: lists with gaps, requests by name, and the rules for valid answers.

See https://mavlink.io/en/services/parameter.html and https://mavlink.io/en/services/parameter_ext.html.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.protocols.exchange import StaleAnswerFilter, Transfer, format_ranges
from aerokit.protocols.request_window import DEFAULT_SIZE, RequestWindow

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

ValueT = TypeVar("ValueT")
ResultT = TypeVar("ResultT")

# The stream of a list has stopped if nothing arrives for this many times its longest pause so far.
TIMEOUT_PAUSES = 4
# A list gets at least this many seconds to start. An earlier second request would restart the list.
MIN_START_TIMEOUT_S = 0.3
# Maximum number of times that old values are requested again because the number of parameters has changed.
MAX_REFRESHES = 3
# Index in a request that selects the parameter by its name.
BY_NAME = -1
# Name and index of the probe: a request for index 0, which every component with parameters answers.
PROBE, PROBE_INDEX = "", 0
# A name without an answer counts as unknown once the probability that all its answers were lost is below this value.
MAX_LOSS_PROBABILITY = 1e-4
# After MIN_EQUAL_ANSWERS with the same unexpected value, this value is the result of the write. The value from before
# the write needs MIN_UNCHANGED_ANSWERS, because the vehicle may have sent some answers before the write arrived.
MIN_EQUAL_ANSWERS, MIN_UNCHANGED_ANSWERS = 2, 8


class ValueList(Transfer[ResultT], Generic[ResultT, ValueT]):
    """Download of a list: requests the list once, then missing indices as soon as a gap appears."""

    list_request_name: ClassVar[str]
    noun: ClassVar[str]
    window_size: ClassVar[int] = DEFAULT_SIZE

    def __init__(self, target_system: int, target_component: int, **options: Unpack[TransferOptions]) -> None:
        super().__init__(target_system, target_component, **options)
        self._window: RequestWindow[int] = RequestWindow(self.round_trip, size=self.window_size)
        self._received: dict[int, ValueT] = {}  # the values by index
        self._reported_counts: dict[int, int] = {}  # by index: the number of values that the message reported
        self._count: int | None = None
        self._next_index = 0  # next index that is expected in the stream
        self._is_streaming = False
        self._stream_deadline: float | None = None  # when the stream counts as stopped if no message arrives
        self._last_at = 0.0  # time of the stream's last message
        self._pause_s = 0.0  # longest pause of the stream; ParameterList lets it decay
        self._attempts = 0  # number of requests for the list
        self._refreshes = 0  # number of times that old values were requested again

    def expire(self, now: float) -> None:
        if self.deadline is None or now < self.deadline:
            return
        if self._is_idle(now):
            self._fail(ParameterTimeout(self._timeout_text(), missing=self._missing()))
            return
        if self._stream_deadline is not None and now >= self._stream_deadline:  # The stream has stopped.
            self._on_stream_stopped(now)
        self._proceed(now)

    @abstractmethod
    def _list_request(self) -> Message: ...

    @abstractmethod
    def _read_request(self, index: int) -> Message: ...

    @abstractmethod
    def _on_stream_stopped(self, now: float) -> None:
        """Called when the stream has not started, or has stopped before its end."""

    @abstractmethod
    def _finish_or_request_missing(self) -> None: ...

    def _send_list_request(self, now: float) -> None:
        self._attempts += 1
        self._is_streaming = True
        self._outbox.append(self._list_request())
        self._stream_deadline = now + max(self.round_trip.timeout_s(self._attempts), MIN_START_TIMEOUT_S)

    def _store(self, index: int, value: ValueT, reported_count: int, now: float) -> None:
        is_new = index not in self._received
        self._received[index] = value
        self._reported_counts[index] = reported_count
        if is_new:
            count = self._count or 0
            self._report_progress(now, min(len(self._received), count), count)

    def _proceed(self, now: float) -> None:
        self._finish_or_request_missing()
        if self.done:
            return
        for index in self._window.take_due(now):
            self._outbox.append(self._read_request(index))
        self._wait_until(self._window.deadline, self._stream_deadline)

    def _drop_stale(self, count: int) -> tuple[int, ...]:
        """Drop the values that were reported with another count, and return their indices.

        After `MAX_REFRESHES` such calls, the values are kept, and the result is empty.
        """
        stale = tuple(index for index in range(count) if self._reported_counts[index] != count)
        if not stale or self._refreshes >= MAX_REFRESHES:
            return ()
        self._refreshes += 1
        for index in stale:
            del self._received[index]
        return stale

    def _missing(self) -> tuple[int, ...]:
        return tuple(index for index in range(self._count or 0) if index not in self._received)

    def _timeout_text(self) -> str:
        if self._count is None:
            return f"{self.list_request_name} was not answered, sent {self._attempts} times"
        missing = self._missing()
        return (
            f"{len(missing)} of {self._count} {self.noun} were not received: nothing new for"
            f" {self._idle_timeout_s:g} s, missing {format_ranges(missing)}"
        )


class NamedRequests(Transfer[dict[str, "ValueT | ParameterRejected | ParameterTimeout"]], Generic[ValueT]):
    """Request the values of some names, several at a time. The result has one answer for each name, in the same order.

    After ``idle_timeout_s`` seconds without progress, the missing answers become ParameterTimeout errors.
    """

    window_size: ClassVar[int]  # initial limit of requests in flight
    max_window_size: ClassVar[int | None] = None  # the highest limit; None uses the default of `RequestWindow`
    _may_probe = False  # True to detect unknown names by a probe. No request is then sent as two copies.

    def __init__(
        self, target_system: int, target_component: int, names: Iterable[str], **options: Unpack[TransferOptions]
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._names = tuple(dict.fromkeys(names))
        self._window: RequestWindow[str] = RequestWindow(
            self.round_trip,
            size=self.window_size,
            max_size=self.max_window_size,
            duplicate_last=not self._may_probe,
        )
        self._results: dict[str, ValueT | ParameterRejected | ParameterTimeout] = {}
        self._sent_at: dict[str, float] = {}
        self._stale_answers = StaleAnswerFilter(self.round_trip)

    def _begin(self, now: float) -> None:
        for name in self._names:
            self._window.request(name)
        self._proceed(now)

    def receive(self, message: Message, now: float) -> None:
        """Process a message. Only those from the target component count."""
        if not self.done and self._is_from_target(message):
            self._on_message(message, now)
            self._proceed(now)

    def expire(self, now: float) -> None:
        if self.deadline is None or now < self.deadline:
            return
        if self._is_idle(now):
            for name in self._names:
                if name not in self._results:
                    self._results[name] = ParameterTimeout(self._timeout_text(name), missing=(name,))
        self._proceed(now)

    @abstractmethod
    def _request(self, name: str) -> list[Message]: ...

    @abstractmethod
    def _on_message(self, message: Message, now: float) -> None: ...

    def _timeout_text(self, name: str) -> str:
        return f"{name} was not answered, requested {self._window.attempts(name)} times"

    def _process_overdue(self, now: float) -> None: ...

    def _send_probe_if_wanted(self, now: float) -> None: ...

    def _set_result(self, name: str, answer: ValueT | ParameterRejected | ParameterTimeout, now: float) -> None:
        self._window.discard(name)
        self._results[name] = answer
        self._report_progress(now, len(self._results), len(self._names))

    def _proceed(self, now: float) -> None:
        if len(self._results) < len(self._names):
            self._process_overdue(now)  # This call may set the last results.
        if len(self._results) == len(self._names):
            self._finish({name: self._results[name] for name in self._names})
            return
        for name in self._window.take_due(now):
            self._outbox += self._request(name)
            self._sent_at[name] = now
        self._send_probe_if_wanted(now)
        self._wait_until(self._window.deadline)


class NamedReads(NamedRequests[ValueT]):
    """Read some values by name, and detect unknown names by a probe, a request that is always answered.

    If the component answers the probe but repeatedly ignores a name, the result for the name is a ParameterRejected.
    """

    unknown_text: ClassVar[str]  # for example "the vehicle has no parameter"
    _is_probe_wanted = False  # True if the next requests must include the probe
    _probes_sent = 0
    _probes_answered = 0

    @abstractmethod
    def _read_request(self, name: str, index: int) -> Message: ...

    def _request(self, name: str) -> list[Message]:
        if name == PROBE:
            self._probes_sent += 1
            return [self._read_request(name, PROBE_INDEX)]
        return [self._read_request(name, BY_NAME)]

    def _overdue(self, now: float) -> list[str]:
        return [name for name in self._window.overdue(now) if name != PROBE]

    def _send_probe_if_wanted(self, now: float) -> None:
        if self._is_probe_wanted and PROBE not in self._window:
            self._window.record_sent(PROBE, now)
            self._outbox += self._request(PROBE)
            self._sent_at[PROBE] = now
        self._is_probe_wanted = False

    def _is_probe_answer(self, index: int, now: float) -> bool:
        if index != PROBE_INDEX or not self._window.attempts(PROBE):
            return False
        # After a pause of the link, the answers to earlier probes arrive together. They must not all count, because
        # every name without an answer would be rejected at once. With `may_measure=False`, the first of them does not
        # shorten the expected round trip.
        return not self._stale_answers.is_stale(PROBE, self._sent_at[PROBE], now, may_measure=False)

    def _count_probe_answer(self) -> None:
        # There cannot be more answers than requests, so further answers are duplicates.
        self._probes_answered = min(self._probes_answered + 1, self._probes_sent)

    def _reject_if_requested_often(self, names: Iterable[str], now: float) -> None:
        """Reject the names that were requested so often that their answers cannot all have been lost."""
        for name in names:
            if self._loss_probability(self._window.attempts(name)) < MAX_LOSS_PROBABILITY:
                text = f"{self.unknown_text} {name}: it answers requests for other names, but not for this one"
                self._set_result(name, ParameterRejected(text, name=name), now)

    def _loss_probability(self, attempts: int) -> float:
        if not self._probes_answered:
            return 1.0
        lost = self._probes_sent - self._probes_answered
        # Laplace's rule of succession: factor i is the probability of a further loss after `lost + i` losses in
        # `sent + i` requests.
        return math.prod((lost + 1 + i) / (self._probes_sent + 2 + i) for i in range(attempts))


class RepeatedAnswers(Generic[ValueT]):
    """Counts consecutive answers to a write with the same value. After enough of them, the write ends."""

    def __init__(self, is_same: Callable[[ValueT, ValueT], bool]) -> None:
        self._is_same = is_same
        self._answers: list[ValueT] = []

    def __len__(self) -> int:
        return len(self._answers)

    def ends_with(self, answer: ValueT) -> bool:
        return bool(self._answers) and self._is_same(self._answers[-1], answer)

    def add(self, answer: ValueT) -> None:
        if not self.ends_with(answer):
            self._answers.clear()
        self._answers.append(answer)

    def are_conclusive(self, *, is_unchanged: bool) -> bool:
        """Return True if the answers suffice to end the write.

        ``is_unchanged`` is True if the answers have the value from before the write.
        """
        needed = MIN_UNCHANGED_ANSWERS if is_unchanged else MIN_EQUAL_ANSWERS
        return len(self._answers) >= needed
