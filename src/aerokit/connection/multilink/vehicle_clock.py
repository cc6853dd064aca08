"""``VehicleClock`` and ``HardwareId``: evidence that two links lead to the same vehicle.

The time in a TIMESYNC answer counts from boot on ArduPilot and PX4. The times of two vehicles with the same system id
therefore differ by more than the round-trip time.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from aerokit.mavlink.messages import AutopilotVersion

MAX_SAMPLES = 20
MIN_TOLERANCE_S = 0.1
MAX_SPEED_ERROR = 0.02  # Simulations do not keep their nominal speed exactly.
MAX_DRIFT_S = 0.5  # The tolerance grows during a silence. Without this limit, every clock would match in the end.
# A measured clock rate of 1 ± this value counts as 1. During a long silence, a small error of the measured rate would
# add up to a large error of the clock.
REAL_TIME_TOLERANCE = 0.05
MIN_SPAN_S = 1.0
MAX_SPEED = 200.0  # maximum speed of a simulation, relative to real time
MAX_PAUSE_S = 10.0  # A simulation that was paused for longer counts as rebooted.
SPEED_MAX_AGE_S = 5.0  # A clock rate measured before a pause or reboot remains valid for this time.


class ClockSample(NamedTuple):
    """One reading of a vehicle's clock, in seconds. It showed ``vehicle_s`` when ours showed ``at``."""

    at: float
    vehicle_s: float
    round_trip_s: float
    """Time between request and answer. ``at``, which is in the middle, may be wrong by half of it."""


class VehicleClock:
    """Estimates the clock of one vehicle from samples: its rate relative to our clock, and its reboots."""

    def __init__(self) -> None:
        self._samples: deque[ClockSample] = deque(maxlen=MAX_SAMPLES)
        self.was_paused: bool = False
        """True if the last sample showed a pause of a simulation, or a change of its speed."""
        self._rate_before: float | None = None  # clock rate before the last pause or reboot
        self._interrupted_at = -math.inf  # time of the first sample after that pause or reboot

    def add(self, sample: ClockSample) -> bool:
        """Add a sample from the link in use. Return False if the vehicle rebooted."""
        continues = not self._samples or self._continues(sample)
        is_unexpected = self._fits(sample) is False  # `_fits` returns None while the rate is unknown.
        self.was_paused = continues and is_unexpected
        if is_unexpected or not continues:
            if (rate := self._measured_rate) is not None:
                self._rate_before, self._interrupted_at = rate, sample.at
            self._samples.clear()  # A rate that is measured across a pause or reboot would be wrong.
        self._samples.append(sample)
        return continues

    def matches(self, sample: ClockSample) -> bool | None:
        """Return True if a sample from another link agrees with this clock. None means that this is unknown."""
        fits = self._fits(sample)
        # Until the rate is measured, a mismatch is no evidence, because a simulation may run at any rate.
        if self._measured_rate is None and not fits:
            return None
        return fits

    def _fits(self, sample: ClockSample) -> bool | None:
        """Return True if a sample agrees with the last one. None while the rate is unknown."""
        rate = self._rate
        if rate is None:
            return None
        last = self._samples[-1]
        expected_s = last.vehicle_s + rate * (sample.at - last.at)
        return abs(expected_s - sample.vehicle_s) <= self._tolerance_s(sample, rate)

    def _continues(self, sample: ClockSample) -> bool:
        """Return False if the vehicle's clock went back, ran too fast or stood still for too long."""
        last = self._samples[-1]
        elapsed_s = sample.at - last.at
        advance_s = sample.vehicle_s - last.vehicle_s
        rate = self._measured_rate
        if rate is None:
            # In a simulation, the clock may run at any rate up to MAX_SPEED.
            tolerance_s = MIN_TOLERANCE_S + sample.round_trip_s
            return -tolerance_s <= advance_s <= MAX_SPEED * (elapsed_s + tolerance_s)
        tolerance_s = self._tolerance_s(sample, rate)
        expected_s = rate * elapsed_s
        min_advance_s = max(0.0, expected_s - MAX_PAUSE_S * max(1.0, rate))
        return min_advance_s - tolerance_s <= advance_s <= expected_s + tolerance_s

    def _tolerance_s(self, sample: ClockSample, rate: float) -> float:
        drift_s = min(MAX_SPEED_ERROR * abs(sample.at - self._samples[-1].at), MAX_DRIFT_S)
        return (MIN_TOLERANCE_S + sample.round_trip_s / 2 + drift_s) * max(1.0, rate)

    @property
    def _rate(self) -> float | None:
        """Rate of the clock, measured now or before a pause or reboot. None if it is unknown."""
        if self._measured_rate is not None:
            return self._measured_rate
        is_recent = bool(self._samples) and self._samples[-1].at - self._interrupted_at <= SPEED_MAX_AGE_S
        return self._rate_before if is_recent else None

    @property
    def _measured_rate(self) -> float | None:
        """Seconds of the vehicle's clock per second of ours. None if the samples span too short a time."""
        if not self._samples:
            return None
        first, last = self._samples[0], self._samples[-1]
        if last.at - first.at < MIN_SPAN_S:
            return None
        rate = (last.vehicle_s - first.vehicle_s) / (last.at - first.at)
        return 1.0 if abs(rate - 1) <= REAL_TIME_TOLERANCE else rate


class HardwareId(NamedTuple):
    """Hardware id from AUTOPILOT_VERSION. If all fields are zero, the vehicle has no hardware id.

    ArduPilot sends the processor's serial number as ``uid2`` (on Linux and in simulation the machine id), and no
    ``uid``. PX4 sends both; in simulation ``uid2`` is a constant and ``uid`` the system id. Different ids therefore
    prove that there are two vehicles, but equal ids do not prove that there is only one.
    https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION
    """

    uid2: bytes
    """18 bytes; not present in MAVLink 1."""
    uid: int

    @classmethod
    def from_message(cls, message: AutopilotVersion) -> HardwareId:
        return cls(bytes(message.uid2), message.uid)

    @property
    def has_value(self) -> bool:
        return bool(self.uid or any(self.uid2))

    def contradicts(self, other: HardwareId) -> bool:
        if any(self.uid2) and any(other.uid2):
            return self.uid2 != other.uid2
        return bool(self.uid and other.uid) and self.uid != other.uid

    def confirms(self, other: HardwareId) -> bool:
        """Return True if ``uid2`` or ``uid`` is equal, and the ids do not contradict each other."""
        is_same = (any(self.uid2) and self.uid2 == other.uid2) or (bool(self.uid) and self.uid == other.uid)
        return is_same and not self.contradicts(other)
