"""What every request to a vehicle has in common, without IO and without a clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Generic, TypedDict, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message

__all__ = [
    "PATIENCE_S",
    "EarlyAnswers",
    "Exchange",
    "OnProgress",
    "Progress",
    "RoundTrip",
    "Transfer",
    "TransferOptions",
    "ranges",
]

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


GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4

DEVIATIONS = 4.0

SPARE_S = 0.03
"""What the vehicle's main loop and the resolution of clocks add, however steady the answers come."""

BACKOFF = 1.5

MOST_BACKOFFS = 30


class RoundTrip:
    """Smoothed round-trip time of one vehicle, shared by its transfers.

    Only answers to requests that were sent once count: of one sent again nobody knows which was answered.
    """

    def __init__(
        self, initial_s: float | None = None, *, shortest_s: float = 0.05, longest_s: float = 2.0
    ) -> None:
        self.smoothed_s: float | None = None
        """Seconds; None before the first measurement."""
        self.fastest_s: float | None = None
        """Seconds of the fastest one so far; nothing can be an answer sooner."""
        self._deviation_s = 0.0
        self._shortest_s, self._longest_s = shortest_s, longest_s
        if initial_s is not None:
            self.measured(initial_s)

    def measured(self, seconds: float) -> None:
        """An answer came so many seconds after its only request."""
        self.fastest_s = seconds if self.fastest_s is None else min(self.fastest_s, seconds)
        if self.smoothed_s is None:
            self.smoothed_s, self._deviation_s = seconds, seconds / 2
            return
        self._deviation_s += DEVIATION_GAIN * (abs(seconds - self.smoothed_s) - self._deviation_s)
        self.smoothed_s += GAIN * (seconds - self.smoothed_s)

    def timeout_s(self, attempt: int = 1) -> float:
        """Seconds to wait for the answer to the ``attempt``-th sending (from 1) before sending again.

        The second attempt waits as long as the first, since radios lose single frames; later ones wait longer, as for
        a link that is choked or gone.
        """
        if self.smoothed_s is None:
            first = min(1.0, self._longest_s)
        else:
            first = self.smoothed_s + max(DEVIATIONS * self._deviation_s, SPARE_S)
        patient = max(first, self._shortest_s) * BACKOFF ** min(max(0, attempt - 2), MOST_BACKOFFS)
        return min(patient, max(self._longest_s, first))


PATIENCE_S = 10.0
"""How long a transfer goes on asking while nothing comes, unless the caller says otherwise."""


class Progress(Snapshot):
    """How far a transfer is: ``done`` of ``total`` (None: not known yet) parameters, items or bytes."""

    done: int
    total: int | None
    elapsed_s: float

    @property
    def fraction(self) -> float | None:
        """0 to 1; None while the total is not known."""
        if self.total is None:
            return None
        return self.done / self.total if self.total else 1.0

    @property
    def rate(self) -> float:
        """Parameters, items or bytes per second since the start; 0 before any time has passed."""
        return self.done / self.elapsed_s if self.elapsed_s > 0 else 0.0


_MOST_RANGES = 10


def ranges(numbers: Iterable[int]) -> str:
    """Numbers as text: ``3, 7–12``; of many ranges the first ten, and how many more there are."""
    found: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if found and number == found[-1][1] + 1:
            found[-1] = (found[-1][0], number)
        else:
            found.append((number, number))
    text = ", ".join(str(low) if low == high else f"{low}–{high}" for low, high in found[:_MOST_RANGES])
    more = len(found) - _MOST_RANGES
    return f"{text} and {more} more ranges" if more > 0 else text


OnProgress = Callable[[Progress], None]


class TransferOptions(TypedDict, total=False):
    """What transfers hand on to their base."""

    round_trip: RoundTrip | None
    patience_s: float
    on_progress: OnProgress | None


class Transfer(Exchange[ResultT]):
    """An exchange of many messages with one component. It ends when all is there, or when nothing has come for
    ``patience_s`` seconds; what did come sets that clock back, so that a long transfer over a bad radio ends well.
    """

    # from start() on
    _started_at: float
    _moved_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__()
        if not patience_s > 0:
            raise InvalidArgument(f"patience_s = {patience_s!r} is not allowed: above 0")
        self.target_system: int = target_system
        self.target_component: int = target_component
        self.round_trip: RoundTrip = RoundTrip() if round_trip is None else round_trip
        self._patience_s = patience_s
        self._on_progress = on_progress

    def _begin(self, now: float) -> None:
        """Time starts to count."""
        self._started_at = self._moved_at = now

    def _move(self, now: float, done: int, total: int | None) -> None:
        """Something new has come: tell the caller, and be patient again."""
        self._moved_at = now
        if self._on_progress is not None:
            self._on_progress(Progress(done, total, now - self._started_at))

    def _is_out_of_patience(self, now: float) -> bool:
        return now >= self._moved_at + self._patience_s  # as the deadline is computed, to the last bit

    def _is_from_target(self, message: Message) -> bool:
        """Whether the component we talk to sent it; other components of the same vehicle do not count."""
        frame = message.received_frame
        return frame is None or (
            frame.system_id == self.target_system and frame.component_id == self.target_component
        )


SOONEST = 0.5
"""An answer takes at least this part of the fastest round trip so far."""

EARLY_ONES = 2
"""Early after more sendings than that, it is the vehicle that has become faster: one that was busy at first would be
asked, and not be believed, until nobody has patience any more."""


class EarlyAnswers:
    """What is too early for an answer to the last sending is a late or repeated one to something before."""

    def __init__(self, round_trip: RoundTrip) -> None:
        self._round_trip = round_trip
        self._sendings: dict[str, set[float]] = {}

    def is_one(self, name: str, sent_at: float, now: float, *, attempts: int) -> bool:
        """Whether what comes now can be no answer to what was asked about this name, the ``attempts``-th time."""
        elapsed_s = now - sent_at
        if elapsed_s >= SOONEST * (self._round_trip.fastest_s or 0.0):
            return False
        if attempts == 1:
            self._round_trip.measured(elapsed_s)  # perhaps this vehicle is so fast: believe it next time
        sendings = self._sendings.setdefault(name, set())
        sendings.add(sent_at)
        return len(sendings) <= EARLY_ONES
