"""``VehicleClock``: a system's time since boot as it is told over each link, which shows that it is one system.

The time in a TIMESYNC answer runs since boot on ArduPilot and PX4: two vehicles that were given the same system id do
not tell the same time, to within the milliseconds in which an answer comes.
"""

from __future__ import annotations

from collections import deque

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
MAX_PAUSE_S = 10.0
"""A simulation that stood still for longer is taken for a vehicle that has rebooted."""
SPEED_MAX_AGE_S = 5.0
"""So long after a pause or a reboot the clock is taken to run as fast as before, until it was measured anew."""


class VehicleClock:
    """Times are ours in seconds; ``told_s`` is the vehicle's own."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque(maxlen=SAMPLES)
        self.is_steady: bool = True
        """Whether what was told last is what was expected."""
        self._former_speed: tuple[float, float] | None = None  # and when it was measured

    def note(self, at: float, told_s: float, round_trip_s: float) -> bool:
        """Told over the link in use; False when it does not go on: the vehicle has rebooted.

        A clock that has stood still for a moment goes on, but later than expected.
        """
        goes_on = not self._samples or self._goes_on(at, told_s, round_trip_s)
        self.is_steady = goes_on and self._fits(at, told_s, round_trip_s) is not False
        if not self.is_steady:
            if (speed := self._measured_speed) is not None:
                self._former_speed = speed, at
            self._samples.clear()
        self._samples.append((at, told_s))
        return goes_on

    def agrees(self, at: float, told_s: float, round_trip_s: float) -> bool | None:
        """Whether it is the time that this vehicle should have by now; ``at`` is the middle of the round trip.

        None as long as its speed is not known: that of a simulation may be any. The speed from before a pause or a
        reboot confirms, and refutes nothing.
        """
        fits = self._fits(at, told_s, round_trip_s)
        return None if not fits and self._measured_speed is None else fits

    def _fits(self, at: float, told_s: float, round_trip_s: float) -> bool | None:
        speed = self._speed
        if speed is None:
            return None
        last_at, last = self._samples[-1]
        tolerance = self._tolerance_s(at, round_trip_s, speed)
        return abs(last + speed * (at - last_at) - told_s) <= tolerance

    def _goes_on(self, at: float, told_s: float, round_trip_s: float) -> bool:
        last_at, last = self._samples[-1]
        speed = self._measured_speed
        if speed is None:
            most = FASTEST * (at - last_at + TOLERANCE_S + round_trip_s)
            return -TOLERANCE_S - round_trip_s <= told_s - last <= most
        tolerance = self._tolerance_s(at, round_trip_s, speed)
        expected = speed * (at - last_at)
        least = max(0.0, expected - MAX_PAUSE_S * max(1.0, speed))
        return least - tolerance <= told_s - last <= expected + tolerance

    def _tolerance_s(self, at: float, round_trip_s: float, speed: float) -> float:
        drift_s = min(DRIFT * abs(at - self._samples[-1][0]), MOST_DRIFT_S)
        return (TOLERANCE_S + round_trip_s / 2 + drift_s) * max(1.0, speed)

    @property
    def _speed(self) -> float | None:
        if (measured := self._measured_speed) is not None or self._former_speed is None:
            return measured
        speed, measured_at = self._former_speed
        return speed if self._samples[-1][0] - measured_at <= SPEED_MAX_AGE_S else None

    @property
    def _measured_speed(self) -> float | None:
        if not self._samples:
            return None
        (first_at, first), (last_at, last) = self._samples[0], self._samples[-1]
        if last_at - first_at < SPAN_S:
            return None
        speed = (last - first) / (last_at - first_at)
        return 1.0 if abs(speed - 1) <= REAL else speed
