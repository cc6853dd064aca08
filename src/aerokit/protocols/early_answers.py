"""``EarlyAnswers``: which answers come sooner after a request than any answer can."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.protocols.round_trip import RoundTrip

__all__ = ["EarlyAnswers"]

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
