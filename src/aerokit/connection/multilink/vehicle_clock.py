"""``VehicleClock`` and ``HardwareId``: evidence that two links lead to the same vehicle.

The time in a TIMESYNC answer counts from boot on ArduPilot and PX4. The times of two vehicles with the same system id
therefore differ by more than the round-trip time.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from aerokit.mavlink.messages import AutopilotVersion

MAX_SAMPLES = 20
MIN_TOLERANCE_S = 0.1
MAX_SPEED_ERROR = 0.02  # Simulations do not keep their nominal speed exactly.
MAX_DRIFT_S = 0.5  # Without this limit, any clock would match after a long enough silence.
# A measured clock rate of 1 ± this value counts as 1. Otherwise the error of the rate would add up to a large error of
# the clock during a long silence.
REAL_TIME_TOLERANCE = 0.05
MIN_SPAN_S = 1.0
MAX_SPEED = 200.0  # maximum speed of a simulation, relative to real time
MAX_PAUSE_S = 10.0  # A simulation that was paused for longer counts as rebooted.
SPEED_MAX_AGE_S = 5.0  # A clock rate measured before a pause or reboot remains valid for this time.


class VehicleClock:
    """Estimates the clock of one vehicle from samples.

    In each sample, the vehicle's clock showed ``vehicle_s`` when ours showed ``at``, in seconds.
    """

    def __init__(self) -> None:
        # (our time, the vehicle's time) in seconds.
        self._samples: deque[tuple[float, float]] = deque(maxlen=MAX_SAMPLES)
        self.is_steady: bool = True
        """True if the last sample was as expected from the rate; False after a pause or reboot."""
        # Clock rate before the last pause or reboot, and our time of the first sample after it.
        self._previous_rate: tuple[float, float] | None = None

    def add(self, at: float, vehicle_s: float, round_trip_s: float) -> bool:
        """Add a sample from the link in use. Return False if the vehicle rebooted."""
        continues = not self._samples or self._continues(at, vehicle_s, round_trip_s)
        is_unexpected = self._fits(at, vehicle_s, round_trip_s) is False  # None: the rate is not known yet
        self.is_steady = continues and not is_unexpected
        if not self.is_steady:
            if (rate := self._measured_rate) is not None:
                self._previous_rate = rate, at
            self._samples.clear()  # A rate that is measured across a pause or reboot would be wrong.
        self._samples.append((at, vehicle_s))
        return continues

    def matches(self, at: float, vehicle_s: float, round_trip_s: float) -> bool | None:
        """Return True if a sample from another link agrees with this clock. None means that this is unknown."""
        fits = self._fits(at, vehicle_s, round_trip_s)
        # Until the rate is measured, a mismatch proves nothing, because a simulation may run at any rate.
        if self._measured_rate is None and not fits:
            return None
        return fits

    def _fits(self, at: float, vehicle_s: float, round_trip_s: float) -> bool | None:
        """Return True if a sample agrees with the last one. None while the rate is unknown."""
        rate = self._rate
        if rate is None:
            return None
        last_at, last_vehicle_s = self._samples[-1]
        tolerance = self._tolerance_s(at, round_trip_s, rate)
        return abs(last_vehicle_s + rate * (at - last_at) - vehicle_s) <= tolerance

    def _continues(self, at: float, vehicle_s: float, round_trip_s: float) -> bool:
        """Return False if the vehicle's clock went back, ran too fast or stood still for too long."""
        last_at, last_vehicle_s = self._samples[-1]
        advance_s = vehicle_s - last_vehicle_s
        rate = self._measured_rate
        if rate is None:
            # The rate of the vehicle's clock is not measured yet. In a simulation, it may be up to MAX_SPEED.
            max_advance_s = MAX_SPEED * (at - last_at + MIN_TOLERANCE_S + round_trip_s)
            return -MIN_TOLERANCE_S - round_trip_s <= advance_s <= max_advance_s
        tolerance_s = self._tolerance_s(at, round_trip_s, rate)
        expected_s = rate * (at - last_at)
        min_advance_s = max(0.0, expected_s - MAX_PAUSE_S * max(1.0, rate))
        return min_advance_s - tolerance_s <= advance_s <= expected_s + tolerance_s

    def _tolerance_s(self, at: float, round_trip_s: float, rate: float) -> float:
        last_at, _ = self._samples[-1]
        drift_s = min(MAX_SPEED_ERROR * abs(at - last_at), MAX_DRIFT_S)
        return (MIN_TOLERANCE_S + round_trip_s / 2 + drift_s) * max(1.0, rate)

    @property
    def _rate(self) -> float | None:
        """Rate of the clock, measured now or before a pause or reboot. None if it is unknown."""
        if self._measured_rate is not None:
            return self._measured_rate
        if self._previous_rate is None:
            return None
        rate, interrupted_at = self._previous_rate
        last_at, _ = self._samples[-1]
        return rate if last_at - interrupted_at <= SPEED_MAX_AGE_S else None

    @property
    def _measured_rate(self) -> float | None:
        """Seconds of the vehicle's clock per second of ours. None if the samples span too short a time."""
        if not self._samples:
            return None
        (first_at, first_vehicle_s), (last_at, last_vehicle_s) = self._samples[0], self._samples[-1]
        if last_at - first_at < MIN_SPAN_S:
            return None
        rate = (last_vehicle_s - first_vehicle_s) / (last_at - first_at)
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
