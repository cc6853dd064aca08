"""What all transfers have in common: progress, patience, and a measured round trip."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeVar

from aerokit.errors import InvalidArgument
from aerokit.protocols.exchange import Exchange
from aerokit.protocols.round_trip import RoundTrip
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message

__all__ = ["PATIENCE_S", "OnProgress", "Progress", "Transfer", "ranges"]

ResultT = TypeVar("ResultT")

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
