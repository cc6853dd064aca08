"""``Delays``: how long to wait before a link is tried again. Without IO."""

from __future__ import annotations

__all__ = ["FIRST_DELAY_S", "LONGEST_DELAY_S", "Delays"]

FIRST_DELAY_S = 0.2
"""Before the first further attempt."""
LONGEST_DELAY_S = 5.0
"""Before each of many."""


class Delays:
    """Twice as long each time: 0.2 s, 0.4 s, … 5 s."""

    def __init__(self, first_s: float = FIRST_DELAY_S, longest_s: float = LONGEST_DELAY_S) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s

    def take(self) -> float:
        """Seconds to wait now."""
        delay_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return delay_s

    def begin_anew(self) -> None:
        """It was there again: the next one is the first."""
        self._next_s = self._first_s
