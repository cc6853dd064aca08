"""``MessageStream``: whether what was asked for is still being sent, when nobody says where it ends."""

from __future__ import annotations

from aerokit.protocols.exchange import RoundTrip

SILENT_MESSAGES = 10
"""So many messages in a row are hardly ever lost: the vehicle has sent all that it was asked for."""


class MessageStream:
    """Messages that follow one request. They have ended when nothing comes for much longer than between two of them."""

    def __init__(self, round_trip: RoundTrip) -> None:
        self._round_trip = round_trip
        self._interval = RoundTrip(shortest_s=0.001)
        self._heard_at: float | None = None
        self._at = 0.0
        self.fails: int = 0
        """How often in a row nothing came; counted by the owner."""

    @property
    def interval_s(self) -> float | None:
        """Seconds from one message to the next."""
        return self._interval.smoothed_s

    @property
    def due_at(self) -> float:
        """When it must have ended, or was never begun."""
        silence = self._round_trip.timeout_s(max(1, self.fails - 1))
        if self._heard_at is not None and self._interval.smoothed_s is not None:
            silence += max(SILENT_MESSAGES * self._interval.smoothed_s, self._interval.timeout_s())
        return self._at + silence

    def asked(self, now: float) -> None:
        """The request is sent now."""
        self._at, self._heard_at = now, None

    def heard(self, now: float, messages: int) -> None:
        """A message has come, so many after the one before."""
        if self._heard_at is not None and messages > 0:
            self._interval.measured((now - self._heard_at) / messages)
        elif self._heard_at is None and self.fails == 0:
            self._round_trip.measured(now - self._at)
        self._at = self._heard_at = now
        self.fails = 0
