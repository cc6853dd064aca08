"""Base classes of all protocol exchanges with a vehicle. They use no sockets, tasks or clocks (sans-I/O)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Generic, TypedDict, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message

__all__ = [
    "IDLE_TIMEOUT_S",
    "Exchange",
    "MessageStream",
    "OnProgress",
    "RoundTrip",
    "StaleAnswerFilter",
    "Transfer",
    "TransferOptions",
    "TransferProgress",
    "format_ranges",
    "is_addressed_to",
]

ResultT = TypeVar("ResultT")


class Exchange(ABC, Generic[ResultT]):
    """One request to one vehicle, with retries and a result.

    A driver calls ``start`` once, ``receive`` for every message of the classes in ``expects`` from the target, and
    ``expire`` at ``deadline``. After each call it sends what ``take_outbox`` returns, until ``done`` is True.
    Times are seconds on any monotonic clock.
    """

    expects: tuple[type[Message], ...] = ()
    """The message classes to pass to ``receive``."""

    def __init__(self) -> None:
        self.deadline: float | None = None
        self._outbox: list[Message] = []
        self._result: ResultT | None = None
        self._error: Exception | None = None
        self.done: bool = False

    @abstractmethod
    def start(self, now: float) -> None:
        """Queue the first message and set the deadline."""

    @abstractmethod
    def receive(self, message: Message, now: float) -> None:
        """Process a message from the target. Messages that do not belong to this request are ignored."""

    @abstractmethod
    def expire(self, now: float) -> None:
        """Send again or fail. Called when the deadline has passed, unless ``done`` is True."""

    def link_changed(self, now: float) -> None:
        """Called after a switch to another link, which leads to another port of the vehicle.

        Does nothing by default, because most exchanges repeat unanswered requests anyway. Exchanges that the vehicle
        continues only over the same port override this method to restart.
        """
        return

    def vehicle_rebooted(self, now: float) -> None:
        """Called after a reboot of the vehicle, which has then forgotten the exchange. Does nothing by default."""
        return

    def message_dropped(self) -> None:
        """Called if a message of `take_outbox` was certainly not sent, because no link accepted it."""
        return

    def abort(self, error: Exception) -> None:
        """End the exchange with this error, unless it is already done."""
        self._fail(error)

    def take_outbox(self) -> list[Message]:
        """Return the messages to send now, and clear the outbox."""
        messages = self._outbox
        self._outbox = []
        return messages

    def result(self) -> ResultT:
        """Return the result, or raise the error with which the exchange ended. Call it only when ``done`` is True."""
        if self._error is not None:
            raise self._error
        if not self.done:
            raise RuntimeError("this exchange has not ended yet")
        return self._result  # type: ignore[return-value]  # set by _finish, which alone ends without an error

    def _finish(self, result: ResultT) -> None:
        if not self.done:
            self._result = result
            self.done = True
            self.deadline = None

    def _fail(self, error: Exception) -> None:
        if not self.done:
            self._error = error
            self.done = True
            self.deadline = None


# The smoothing factors of TCP for the round trip and its deviation (RFC 6298).
GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4
# A time-out is the smoothed round trip plus this many deviations, as in TCP.
DEVIATIONS = 4.0

# Seconds to wait for an answer before the first measurement, as in TCP.
INITIAL_TIMEOUT_S = 1.0

# Minimum jitter of answers, caused by the vehicle's main loop and the resolution of the clock.
JITTER_S = 0.03

# An answer that arrives sooner than this fraction of a known round trip belongs to an earlier request.
MIN_ROUND_TRIP_FRACTION = 0.5

BACKOFF = 1.5  # From the third attempt on, each attempt waits longer than the previous one by this factor.
MAX_BACKOFFS = 30  # Maximum exponent of BACKOFF, because a higher power could overflow.


class RoundTrip:
    """Smoothed round-trip time to one vehicle, shared by its transfers.

    Only answers to requests that were sent once are measured (Karn's algorithm), because an answer after a retry may
    belong to either transmission. ``link_s`` returns the link's latest round-trip time as TIMESYNC measures it, or
    None. An answer that arrives in much less than this time is not measured, because it must belong to an earlier
    request.
    """

    def __init__(
        self,
        initial_s: float | None = None,
        *,
        min_s: float = 0.05,
        max_s: float = 2.0,
        link_s: Callable[[], float | None] = lambda: None,
    ) -> None:
        self.smoothed_s: float | None = None
        """Smoothed round-trip time in seconds; None before the first measurement."""
        self.fastest_s: float | None = None
        """The shortest round-trip time so far, in seconds."""
        self._deviation_s = 0.0
        self._min_s, self._max_s = min_s, max_s
        self.link_s = link_s
        if initial_s is not None:
            self.add_sample(initial_s)

    def add_sample(self, seconds: float) -> None:
        """Record the time from a request that was sent once to its answer."""
        if seconds < MIN_ROUND_TRIP_FRACTION * (self.link_s() or 0.0):
            return
        self.fastest_s = seconds if self.fastest_s is None else min(self.fastest_s, seconds)
        if self.smoothed_s is None:
            self.smoothed_s = seconds
            self._deviation_s = seconds / 2
            return
        self._deviation_s += DEVIATION_GAIN * (abs(seconds - self.smoothed_s) - self._deviation_s)
        self.smoothed_s += GAIN * (seconds - self.smoothed_s)

    def timeout_s(self, attempt: int = 1) -> float:
        """Return the seconds to wait for an answer to transmission number ``attempt`` (from 1) before the next retry.

        The second attempt waits as long as the first, because radios lose single frames. Later attempts back off,
        because the link may be congested or down.
        """
        if self.smoothed_s is None:
            first_timeout_s = min(INITIAL_TIMEOUT_S, self._max_s)
        else:
            first_timeout_s = self.smoothed_s + max(DEVIATIONS * self._deviation_s, JITTER_S)
        backoffs = min(max(0, attempt - 2), MAX_BACKOFFS)
        backed_off_s = max(first_timeout_s, self._min_s) * BACKOFF**backoffs
        # The maximum must not be shorter than a slow link needs for a normal answer.
        return min(backed_off_s, max(self._max_s, first_timeout_s))


# A stream has ended if nothing arrives in the time of this many messages. Radios hardly ever lose so many in a row.
SILENT_MESSAGES = 10


class MessageStream:
    """Tracks the stream of messages that follows one request, and determines when the stream has ended.

    The stream has ended when nothing arrives for much longer than the interval between two messages.
    """

    def __init__(self, round_trip: RoundTrip) -> None:
        self._round_trip = round_trip
        self._interval = RoundTrip(min_s=0.001)  # the time between two messages, smoothed like a round trip
        self._has_started = False  # True once a message has followed the request
        self._last_at = 0.0  # time of the request, or of the last message after it
        self.failures: int = 0
        """Number of consecutive requests that no message followed. The owner of this object counts them."""

    @property
    def interval_s(self) -> float | None:
        """Smoothed seconds between two messages."""
        return self._interval.smoothed_s

    @property
    def due_at(self) -> float:
        """Time by which the next message must arrive. If none does, the stream has ended, or its request was lost.

        Before the first message, and while the interval between messages is unknown, only the round trip determines
        this time.
        """
        # The first failures do not lengthen the wait, because radios lose single requests.
        silence_s = self._round_trip.timeout_s(max(1, self.failures - 1))
        if self._has_started and self._interval.smoothed_s is not None:
            silence_s += max(SILENT_MESSAGES * self._interval.smoothed_s, self._interval.timeout_s())
        return self._last_at + silence_s

    def on_request(self, now: float) -> None:
        """Record that the request for the stream is sent now."""
        self._last_at = now
        self._has_started = False

    def on_message(self, now: float, messages: int) -> None:
        """Record a message. ``messages`` is the number sent since the previous message, including lost ones.

        For a repeated or delayed message, ``messages`` is 0 or less. The time before such a message is not measured.
        """
        elapsed_s = now - self._last_at
        if self._has_started and messages > 0:
            self._interval.add_sample(elapsed_s / messages)
        elif not self._has_started and self.failures == 0:  # The request was sent once, and this is its first answer.
            self._round_trip.add_sample(elapsed_s)
        self._last_at = now
        self._has_started = True
        self.failures = 0


IDLE_TIMEOUT_S = 10.0
"""Default seconds without progress after which a transfer fails."""


class TransferProgress(Snapshot):
    """Progress of a transfer: ``done`` of ``total`` parameters, items or bytes. ``total`` is None while unknown."""

    done: int
    total: int | None
    elapsed_s: float

    @property
    def fraction(self) -> float | None:
        """Progress from 0 to 1; None while the total is unknown."""
        if self.total is None:
            return None
        return self.done / self.total if self.total else 1.0

    @property
    def rate(self) -> float:
        """Parameters, items or bytes per second since the start."""
        return self.done / self.elapsed_s if self.elapsed_s > 0 else 0.0


_MAX_RANGES = 10


def is_addressed_to(message: Any, system_id: int, component_id: int) -> bool:
    """Return True if a message is addressed to this component or to all (0). Old firmware leaves the target 0."""
    return message.target_system in (0, system_id) and message.target_component in (0, component_id)


def format_ranges(numbers: Iterable[int]) -> str:
    """Format numbers as ranges: ``3, 7–12``. After ten ranges, the text only says how many more there are."""
    ranges: list[range] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1].stop:
            ranges[-1] = range(ranges[-1].start, number + 1)
        else:
            ranges.append(range(number, number + 1))
    shown = ranges[:_MAX_RANGES]
    text = ", ".join(f"{run.start}" if len(run) == 1 else f"{run.start}–{run.stop - 1}" for run in shown)
    omitted = len(ranges) - _MAX_RANGES
    return f"{text} and {omitted} more ranges" if omitted > 0 else text


OnProgress = Callable[[TransferProgress], None]


class TransferOptions(TypedDict, total=False):
    """Keyword arguments that subclasses pass on to `Transfer`."""

    round_trip: RoundTrip | None
    idle_timeout_s: float
    on_progress: OnProgress | None


class Transfer(Exchange[ResultT]):
    """An exchange of many messages with one component.

    The transfer fails after ``idle_timeout_s`` seconds without progress. It has no total limit: over a bad radio it may
    take long, but continues while new data arrives.
    """

    # start() sets these attributes.
    _started_at: float
    _progress_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        round_trip: RoundTrip | None = None,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__()
        if not idle_timeout_s > 0:
            raise InvalidArgument(f"idle_timeout_s = {idle_timeout_s!r} is not allowed: it must be above 0")
        self.target_system: int = target_system
        self.target_component: int = target_component
        self.round_trip: RoundTrip = RoundTrip() if round_trip is None else round_trip
        self._idle_timeout_s = idle_timeout_s
        self.on_progress: OnProgress | None = on_progress
        """Called with each progress report. Must not raise, because the next request is sent only after this call."""

    def start(self, now: float) -> None:
        self._started_at = now
        self._progress_at = now
        self._begin(now)

    @abstractmethod
    def _begin(self, now: float) -> None:
        """Queue the first messages and set the deadline."""

    def _report_progress(self, now: float, done: int, total: int | None) -> None:
        self._progress_at = now
        if self.on_progress is not None:
            self.on_progress(TransferProgress(done, total, now - self._started_at))

    @property
    def _idle_deadline(self) -> float:
        return self._progress_at + self._idle_timeout_s

    def _wait_until(self, *times: float | None) -> None:
        """Set the deadline to the earliest of these times, but not later than the idle time-out."""
        self.deadline: float | None = min(time for time in (*times, self._idle_deadline) if time is not None)

    def _is_idle(self, now: float) -> bool:
        return now >= self._idle_deadline

    def _is_from_target(self, message: Message) -> bool:
        frame = message.received_frame
        return frame is None or (frame.system_id == self.target_system and frame.component_id == self.target_component)


# For each name, early answers to at most this many requests are refused. Without this limit, all answers of a vehicle
# that has become faster would be refused until the idle timeout.
MAX_EARLY_ANSWERS = 2


class StaleAnswerFilter:
    """Detects answers that arrive too early for the latest request, and therefore answer an earlier one."""

    def __init__(self, round_trip: RoundTrip) -> None:
        self._round_trip = round_trip
        self._early_requests: dict[str, set[float]] = {}  # by name: send times of requests answered too early

    def is_stale(self, name: str, sent_at: float, now: float, *, may_measure: bool) -> bool:
        """Return True if ``now`` is too early for an answer to the request for ``name`` sent at ``sent_at``.

        ``may_measure`` is True if the time may be a round trip of the link. After MAX_EARLY_ANSWERS requests for a name
        were answered early, the vehicle counts as faster than before, and the result is False. The caller must also
        check the answer in other ways, because it may be meant for another station.
        """
        elapsed_s = now - sent_at
        if elapsed_s >= MIN_ROUND_TRIP_FRACTION * (self._round_trip.fastest_s or 0.0):
            return False
        if may_measure:
            # This sample lowers `fastest_s`. If the vehicle really is this fast, its next answer is then accepted.
            self._round_trip.add_sample(elapsed_s)
        early_requests = self._early_requests.setdefault(name, set())
        early_requests.add(sent_at)
        has_become_faster = len(early_requests) > MAX_EARLY_ANSWERS
        return not has_become_faster
