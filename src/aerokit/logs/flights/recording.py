"""Derives lost messages, silences of the vehicle and the speed of a simulation from a recording."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING

from aerokit._internal.formatting import format_value
from aerokit.logs.flights.flight import Silence, TimeSeries

if TYPE_CHECKING:
    from aerokit.logs.flights.flight import FlightLog

NAN = math.nan
_MAX_SEQUENCE_GAP = 200
_ALL_LOST = (100.0, 0)  # row of the link's time series: percentage of lost messages, number of received messages
MIN_SILENCE_S = 3.0
"""Minimum seconds without a message that count as a silence. Autopilots send HEARTBEAT once a second."""

_MAX_CLOCK_DRIFT = 0.2  # If the vehicle's clock is more than 20 % faster or slower, the vehicle is simulated.
_MIN_CLOCK_COMPARISON_S = 1.0  # In a shorter recording, the delays of the link would distort the comparison.
_MAX_CLOCK_GAP_S = 10.0  # `ClockComparison` sums longer intervals between two messages separately.


class ClockComparison:
    """Compares the vehicle's time since boot with the time of the recording."""

    def __init__(self) -> None:
        self._previous: tuple[float, int] = (-math.inf, 0)
        self._recorded_s = 0.0
        self._vehicle_s = 0.0
        # Sums of the intervals in which the vehicle's clock has advanced by _MAX_CLOCK_GAP_S or more: the recording
        # computer has slept, or the vehicle is a fast simulation.
        self._long_recorded_s = 0.0
        self._long_vehicle_s = 0.0

    def compare(self, time_s: float, boot_ms: int) -> None:
        previous_s, previous_ms = self._previous
        self._previous = time_s, boot_ms
        recorded_s, vehicle_s = time_s - previous_s, (boot_ms - previous_ms) / 1e3
        # Ignore an interval if the vehicle rebooted, the recording paused, or the recording's clock was set back.
        if vehicle_s < 0 or not 0 <= recorded_s < _MAX_CLOCK_GAP_S:
            return
        if vehicle_s >= _MAX_CLOCK_GAP_S:
            self._long_recorded_s += recorded_s
            self._long_vehicle_s += vehicle_s
            return
        self._recorded_s += recorded_s
        self._vehicle_s += vehicle_s

    @property
    def speed(self) -> float:
        """Seconds by which the vehicle's clock advances in a recorded second; 1 if the log is too short to compare."""
        recorded_s, vehicle_s = self._recorded_s, self._vehicle_s
        if not self._is_comparable:  # In the log of a fast simulation, all intervals may be long.
            recorded_s, vehicle_s = recorded_s + self._long_recorded_s, vehicle_s + self._long_vehicle_s
            if min(recorded_s, vehicle_s) < _MIN_CLOCK_COMPARISON_S:
                return 1.0
        return vehicle_s / recorded_s

    @property
    def missing_s(self) -> float:
        """Seconds of the vehicle's clock that were not recorded, probably because the recording computer slept."""
        return self._long_vehicle_s - self._long_recorded_s if self._is_comparable else 0.0

    @property
    def _is_comparable(self) -> bool:
        return min(self._recorded_s, self._vehicle_s) >= _MIN_CLOCK_COMPARISON_S


class LinkCounter:
    """Counts the frames received and lost in each second. Gaps in the sequence numbers show the lost frames."""

    def __init__(self, flight: FlightLog) -> None:
        self._series, self._silences = flight.link, flight.silences
        self._second = 0  # the second whose frames are being counted
        self._received = 0
        self._lost = 0

    def count(self, time_s: float, sequence: int, expected: int, received: int) -> float:
        """Count received and lost frames, and return the time at which the next second starts.

        Call this with the first frame after a gap in the sequence numbers, and with the first frame of each second.

        Args:
            time_s: time of the frame.
            sequence: its sequence number.
            expected: the sequence number after that of the previous frame; negative for the first frame of the log.
            received: number of frames since the last call, including this one.
        """
        if expected < 0:
            self._second = int(time_s)
        # Losses before the first frame are unknown.
        missing = (sequence - expected) & 0xFF if expected >= 0 else 0
        if missing > _MAX_SEQUENCE_GAP:  # not a loss, but a late frame or a frame of another link
            missing = 0
        if time_s >= self._second + 1:  # this frame is the first one of a new second
            self._received += received - 1
            received = 1
            if int(time_s) - self._second > 1:
                missing = 0  # _add_row() already shows the seconds between as 100 % loss
            self._add_row(int(time_s))
        self._received += received
        self._lost += missing
        return self._second + 1

    def add_silence(self, begins_s: float, ends_s: float, paused_s: float) -> None:
        """Record a silence of the vehicle. In ``paused_s`` seconds of it, nothing at all was recorded."""
        is_recorded = ends_s - begins_s - paused_s >= MIN_SILENCE_S
        self._silences.append(Silence(begins_s, ends_s, is_recorded))

    def end(self, received: int, last_frame_s: float, ends_s: float, paused_s: float) -> None:
        """Count the last frames, and record a silence from the last frame to the end of the log."""
        self._received += received
        if ends_s - last_frame_s < MIN_SILENCE_S:
            self._add_row(self._second + 1)
            return
        self.add_silence(last_frame_s, ends_s, paused_s)
        self._add_row(int(ends_s))
        if ends_s > self._second:
            self._series.add(ends_s, *_ALL_LOST)

    def _add_row(self, second: int) -> None:
        """Add a row for the counted second, and start to count ``second``."""
        sent = self._received + self._lost
        self._series.add(self._second, 100 * self._lost / sent if sent else NAN, self._received)
        # No frames arrived after `self._second` and before `second`. The first and last of these seconds get a row.
        if second - self._second > 1:
            self._series.add(self._second + 1, *_ALL_LOST)
            self._series.add(second - 1, *_ALL_LOST)
        self._second, self._received, self._lost = second, 0, 0


def is_real_time(speed: float) -> bool:
    """Return True if the vehicle's clock is about as fast as the recording's."""
    return abs(math.log(speed)) <= _MAX_CLOCK_DRIFT


def use_simulated_time(flight: FlightLog, speed: float) -> None:
    """Convert all times to the vehicle's seconds, if the vehicle is a simulation that did not run in real time."""
    if is_real_time(speed):
        return
    recorded_s = flight.duration_s
    flight.speed = speed
    flight.notes.append(
        f"this is a simulation at {format_value(speed)} times real speed, as the vehicle's clock shows: all times and"
        f" durations in this report are simulated; the recording took {recorded_s:.0f} s"
    )
    # Speeds and turn rates are not converted, because the vehicle reports them per second of its own time.
    for series in _all_series(flight):
        for row, time_s in enumerate(series.times):
            series.times[row] = time_s * speed
    for row, received_hz in enumerate(flight.link["received_hz"]):
        flight.link["received_hz"][row] = received_hz / speed
    for row, time_s in enumerate(flight.gcs_heartbeats):
        flight.gcs_heartbeats[row] = time_s * speed
    flight.armed = [(begin * speed, end * speed) for begin, end in flight.armed]
    flight.silences = [
        item.replace(begins_s=item.begins_s * speed, ends_s=item.ends_s * speed) for item in flight.silences
    ]
    flight.modes = [item.replace(time_s=item.time_s * speed) for item in flight.modes]
    flight.texts = [item.replace(time_s=item.time_s * speed) for item in flight.texts]
    flight.parameter_changes = [item.replace(time_s=item.time_s * speed) for item in flight.parameter_changes]
    flight.failsafe_evidence = [item.replace(time_s=item.time_s * speed) for item in flight.failsafe_evidence]


def _all_series(flight: FlightLog) -> list[TimeSeries]:
    all_series: list[TimeSeries] = []
    for field in fields(flight):
        value = getattr(flight, field.name)
        values = value.values() if isinstance(value, dict) else (value,)
        all_series += [series for series in values if isinstance(series, TimeSeries)]
    return all_series
