"""Window of independent requests: decides which requests to send or repeat, and when."""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from aerokit.protocols.exchange import RoundTrip

KeyT = TypeVar("KeyT", bound=Hashable)

# ArduPilot queues 20 PARAM_REQUEST_READ and drops further ones.
DEFAULT_SIZE = 20
# The window grows to at most this many times its initial size. It grows only while answers stay fast. Most of the
# requests are then in transit, so the vehicle's queue does not overflow.
MAX_GROWTH = 5
# An answer has waited in a queue if it takes longer than QUEUED_FACTOR times the fastest answer plus QUEUED_MARGIN_S.
QUEUED_FACTOR, QUEUED_MARGIN_S = 1.5, 0.02
# From attempt DUPLICATE_FROM_ATTEMPT on, each of the last FEW_LEFT requests is sent as two copies: over a bad radio, a
# transfer would otherwise wait long for their answers.
FEW_LEFT, DUPLICATE_FROM_ATTEMPT = 5, 3
# Maximum time-out of the last few requests, unless two round trips are longer. Repeating them costs little.
FEW_LEFT_TIMEOUT_S = 0.5
# Maximum time-out, even if answers have taken longer so far: the queue that delayed them may be empty by then.
MAX_TIMEOUT_S = 2.0
# Answers arrive in the order of the requests. When a request is answered, all unanswered requests that were sent at
# least this many transmissions before it count as lost (like the packet threshold of QUIC, RFC 9002).
LOSS_THRESHOLD = 3


class PendingRequest:
    """Times and numbers of a request's transmissions. The transmissions of all requests are numbered together."""

    __slots__ = (
        "attempts", "due_at", "first_at", "first_number", "last_number", "previous_sent_at", "sent_at",
        "was_duplicated",
    )  # fmt: skip

    def __init__(self, now: float, number: int) -> None:
        self.first_at: float = now
        self.sent_at: float = now
        self.previous_sent_at: float = now
        self.due_at: float = now
        self.first_number: int = number
        self.last_number: int = number
        self.was_duplicated: bool = False
        self.attempts: int = 0


class PendingRequests(Generic[KeyT]):
    """Requests without an answer, each identified by a key. They wait to be sent, or are in flight."""

    def __init__(self) -> None:
        self._waiting: dict[KeyT, None] = {}  # requests to send, in order
        self._in_flight: dict[KeyT, PendingRequest] = {}  # in the order in which they were sent
        self._requests: dict[KeyT, PendingRequest] = {}  # requests in flight, or waiting to be sent again
        self._sent_count = 0

    def __len__(self) -> int:
        return len(self._waiting) + len(self._in_flight)

    def __contains__(self, key: object) -> bool:
        return key in self._waiting or key in self._in_flight

    def request(self, key: KeyT) -> None:
        if key not in self:
            self._waiting[key] = None

    def discard(self, key: KeyT) -> None:
        self._waiting.pop(key, None)
        self._in_flight.pop(key, None)
        self._requests.pop(key, None)

    def _take_waiting(self, now: float) -> KeyT:
        """Count the first waiting request as sent, and return its key."""
        key = next(iter(self._waiting))
        del self._waiting[key]
        self._record_transmission(key, now)
        return key

    def _record_transmission(self, key: KeyT, now: float) -> PendingRequest:
        self._sent_count += 1
        request = self._requests.setdefault(key, PendingRequest(now, self._sent_count))
        request.attempts += 1
        request.last_number = self._sent_count
        request.previous_sent_at, request.sent_at = request.sent_at, now
        self._in_flight[key] = request
        return request

    def _requeue(self, keys: list[KeyT]) -> None:
        if keys:
            for key in keys:
                del self._in_flight[key]
            self._waiting = {**dict.fromkeys(keys), **self._waiting}


class RequestWindow(PendingRequests[KeyT]):
    """Requests, each identified by a key, with a limit on the number in flight.

    The limit is ``size`` at first, and grows to ``max_size`` while answers do not become slower. A request is repeated
    when its answer is overdue (:class:`RoundTrip`), or when later requests were answered first. With
    ``duplicate_last``, when only a few requests are left, each is sent as two copies from its third attempt on.
    """

    def __init__(
        self,
        round_trip: RoundTrip,
        *,
        size: int = DEFAULT_SIZE,
        max_size: int | None = None,
        duplicate_last: bool = True,
    ) -> None:
        super().__init__()
        self._round_trip = round_trip
        self._initial_size = size
        self._max_size = MAX_GROWTH * size if max_size is None else max_size
        self._max_in_flight = size
        self._fastest_s = math.inf
        self._duplicate_last = duplicate_last
        self._answered_at = -math.inf
        self._timeouts = 0  # number of consecutive time-outs without any answer
        self._next_timeout_at = -math.inf  # earliest time to increase `_timeouts`
        # By key of a repeated request: seconds from its first transmission to its answer. See `_on_duplicate_answer`.
        self._ambiguous: dict[KeyT, float] = {}

    @property
    def deadline(self) -> float | None:
        """Time at which the next answer is overdue. None while no request is in flight."""
        return min((request.due_at for request in self._in_flight.values()), default=None)

    def attempts(self, key: KeyT) -> int:
        """Return how often an unanswered request was sent."""
        request = self._requests.get(key)
        return 0 if request is None else request.attempts

    def overdue(self, now: float) -> list[KeyT]:
        return [key for key, request in self._in_flight.items() if request.due_at <= now]

    def record_sent(self, key: KeyT, now: float) -> None:
        """Record a request that was sent although the window may be full."""
        self._waiting.pop(key, None)
        self._record_transmission(key, now)

    def on_answer(self, key: KeyT, now: float, *, loss_threshold: int = LOSS_THRESHOLD) -> list[KeyT]:
        """Record an answer. Requeue the requests that are presumed lost, and return them.

        A request is presumed lost if it was last sent at least ``loss_threshold`` transmissions before the answered
        request.
        """
        request = self._requests.pop(key, None)
        self._waiting.pop(key, None)
        self._in_flight.pop(key, None)
        self._answered_at = now
        self._timeouts = 0
        if request is None:
            self._on_duplicate_answer(key)
            return []
        if request.attempts == 1:
            self._measure(now - request.first_at)
        elif not request.was_duplicated:  # The answer may belong to any attempt; see `_on_duplicate_answer`.
            self._ambiguous[key] = now - request.first_at
        lost = []
        for key_in_flight, request_in_flight in self._in_flight.items():
            # The answer may belong to the first transmission, so requests sent after that one do not count as lost.
            if request_in_flight.last_number > request.first_number - loss_threshold:
                break  # All further requests were sent later.
            lost.append(key_in_flight)
        self._requeue(lost)
        return lost

    def take_due(self, now: float) -> list[KeyT]:
        """Return the keys to request now, and count them as sent.

        The last few keys may be in the result twice, because their requests are sent twice.
        """
        overdue = self.overdue(now)
        # If nothing was answered since an overdue request was sent, the whole link is silent.
        is_silent = any(self._in_flight[key].sent_at >= self._answered_at for key in overdue)
        if is_silent:
            self._on_timeout(now)
        self._requeue(overdue)
        due: list[KeyT] = []
        while self._waiting and len(self._in_flight) < self._max_in_flight:
            due.append(self._take_waiting(now))
        if self._duplicate_last and len(self._in_flight) <= FEW_LEFT and not self._waiting:
            duplicates = [key for key in due if self._requests[key].attempts >= DUPLICATE_FROM_ATTEMPT]
            for key in duplicates:
                self._requests[key].was_duplicated = True
            due += duplicates
        return due

    def _on_timeout(self, now: float) -> None:
        # The link may be down, so fewer requests are sent at a time, and less often.
        self._max_in_flight = self._initial_size
        if now >= self._next_timeout_at:
            self._timeouts += 1
            self._next_timeout_at = now + self._timeout_s(1)

    def _timeout_s(self, attempts: int) -> float:
        round_trip = self._round_trip
        # Each silence of the whole link lengthens the wait. The loss of single frames does not: `RoundTrip` waits as
        # long for attempt 2 as for attempt 1.
        seconds = round_trip.timeout_s(min(attempts, 2) + self._timeouts)
        if len(self) <= FEW_LEFT and round_trip.smoothed_s is not None:
            seconds = min(seconds, max(FEW_LEFT_TIMEOUT_S, 2 * round_trip.smoothed_s))
        return min(seconds, MAX_TIMEOUT_S)

    def _measure(self, seconds: float) -> None:
        # The window grows while answers stay fast. It shrinks when slower answers show that a queue builds up.
        self._round_trip.add_sample(seconds)
        self._fastest_s = min(self._fastest_s, seconds)
        if seconds <= QUEUED_FACTOR * self._fastest_s + QUEUED_MARGIN_S:
            self._max_in_flight = min(self._max_in_flight + 1, self._max_size)
        else:
            self._max_in_flight = max(self._max_in_flight - 1, self._initial_size)

    def _record_transmission(self, key: KeyT, now: float) -> PendingRequest:
        due_at = now + self._timeout_s(self.attempts(key) + 1)  # before `len(self)` includes this request
        request = super()._record_transmission(key, now)
        request.due_at = due_at
        return request

    def _on_duplicate_answer(self, key: KeyT) -> None:
        # Two answers mean a spurious retransmission: nothing was lost. The first answer therefore belongs to the first
        # transmission. Its round trip makes the time-out longer.
        seconds = self._ambiguous.pop(key, None)
        if seconds is not None:
            self._round_trip.add_sample(seconds)
