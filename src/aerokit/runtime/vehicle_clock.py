"""``VehicleClock``: a system's time since boot as it is told over each link, which shows that it is one system.

The time in a TIMESYNC answer runs since boot on ArduPilot and PX4: two vehicles that were given the same system id do
not tell the same time, to within the milliseconds in which an answer comes.
"""

from __future__ import annotations

from collections import deque

__all__ = ["VehicleClock"]

SAMPLES = 20
TOLERANCE_S = 0.1
DRIFT = 0.02
"""How wrong the speed may be: a simulation is not always as fast as it says."""
MOST_DRIFT_S = 0.5
"""And what comes of it at most: else anybody's clock would be right after a silence that was long enough."""
REAL = 0.05
"""So near to 1 the speed is 1: a real vehicle's. Over a long silence an error of measuring would become seconds."""
SPAN_S = 1.0
FASTEST = 200.0
"""No simulation is faster than this."""


class VehicleClock:
    """Times are ours in seconds; ``told_s`` is the vehicle's own."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque(maxlen=SAMPLES)

    def note(self, at: float, told_s: float, round_trip_s: float) -> bool:
        """Told over the link in use; False when it does not go on: the vehicle has rebooted."""
        goes_on = not self._samples or self._goes_on(at, told_s, round_trip_s)
        if not goes_on:
            self._samples.clear()
        self._samples.append((at, told_s))
        return goes_on

    def agrees(self, at: float, told_s: float, round_trip_s: float) -> bool | None:
        """Whether it is the time that this vehicle should have by now; ``at`` is the middle of the round trip.

        None as long as its speed is not known: that of a simulation may be any.
        """
        speed = self._speed
        if speed is None:
            return None
        last_at, last = self._samples[-1]
        drift_s = min(DRIFT * abs(at - last_at), MOST_DRIFT_S)
        tolerance = (TOLERANCE_S + round_trip_s / 2 + drift_s) * max(1.0, speed)
        return abs(last + speed * (at - last_at) - told_s) <= tolerance

    def _goes_on(self, at: float, told_s: float, round_trip_s: float) -> bool:
        agrees = self.agrees(at, told_s, round_trip_s)
        if agrees is not None:
            return agrees
        last_at, last = self._samples[-1]
        most = FASTEST * (at - last_at + TOLERANCE_S + round_trip_s)
        return -TOLERANCE_S - round_trip_s <= told_s - last <= most

    @property
    def _speed(self) -> float | None:
        if not self._samples:
            return None
        (first_at, first), (last_at, last) = self._samples[0], self._samples[-1]
        if last_at - first_at < SPAN_S:
            return None
        speed = (last - first) / (last_at - first_at)
        return 1.0 if abs(speed - 1) <= REAL else speed
