"""``RoundTrip``: how long an answer takes, and so when to ask again (https://www.rfc-editor.org/rfc/rfc6298)."""

from __future__ import annotations

__all__ = ["RoundTrip"]

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
