"""Computes statistics of a flight, for its summary and for comparisons."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.logs.flights.failsafes import failsafe_parameters, failsafes
from aerokit.logs.flights.falls import falls
from aerokit.logs.flights.flight import TangentPlane, battery_name
from aerokit.logs.report.formatting import clock_text, distance_text, duration_text, number_text
from aerokit.logs.report.silences import silence_sentences

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.logs.flights.falls import Fall
    from aerokit.logs.flights.flight import FlightLog, TimeSeries

# Shorter steps do not add to the length of the track, because they are noise of a stationary vehicle.
_MIN_STEP_M = 1.0
_MAX_LISTED = 5
# A hovering multicopter needs 20 to 60 % throttle, so 90 % in a descent is unusual.
_HIGH_THROTTLE_PERCENT, _HIGH_ATTITUDE_ERROR_DEG = 90.0, 20.0
# If the throttle or current in a descent is below this share of its value before the descent, the motors have less
# power than a controlled descent needs.
_LOW_POWER_SHARE = 0.5
_STOPPED_MOTORS_ADVICE = ", so look at what stopped the motors: ESCs, their supply, a command"
# If the pulse of an output is _MOTOR_RAISED_US longer in flight than before arming, the output drives a motor. If the
# motors' pulses in a descent differ by _UNEQUAL_US, the autopilot tried to lift one side.
_MOTOR_RAISED_US, _UNEQUAL_US = 200.0, 300.0
_BEFORE_FALL_S = 5.0


class FlightStatistics(Snapshot):
    """Statistics of the armed time, or of the whole log if the vehicle was never armed. None means unknown."""

    armed_s: float | None
    distance_m: float | None
    """Length of the track over ground."""
    max_height_m: float | None
    """Maximum height above home."""
    max_distance_m: float | None
    """Maximum horizontal distance from home."""
    max_speed_m_s: float | None
    """Maximum ground speed."""
    max_climb_m_s: float | None
    max_descent_m_s: float | None
    max_tilt_deg: float | None
    """Maximum absolute roll or pitch angle."""
    end_distance_m: float | None
    """Horizontal distance from home at the end."""
    start_voltage_v: float | None
    """Voltage of the first battery at the start. All battery values are those of the first battery."""
    end_voltage_v: float | None
    min_voltage_v: float | None
    start_remaining_percent: float | None
    end_remaining_percent: float | None
    max_current_a: float | None
    min_satellites: float | None
    max_hdop: float | None
    max_vibration_m_s2: float | None
    clips: float | None
    """Number of times that an accelerometer reached its limit."""
    max_estimator_ratio: float | None
    """Maximum innovation test ratio. Above 1, the estimator rejects a measurement."""
    lost_percent: float | None
    """Percentage of lost messages, as an average over time. A silence counts as 100 %."""


class Statistic(Snapshot):
    """How a field of `FlightStatistics` is compared, and the warning about a value that is out of its normal range."""

    label: str
    decimals: int
    warning: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf


STATISTICS = {
    "armed_s": Statistic("armed, s", 0),
    "distance_m": Statistic("distance flown, m", 0),
    "max_height_m": Statistic("max height above home, m", 1),
    "max_distance_m": Statistic("max distance from home, m", 0),
    "max_speed_m_s": Statistic("max speed, m/s", 1),
    "max_climb_m_s": Statistic("max climb rate, m/s", 1),
    "max_descent_m_s": Statistic("max descent rate, m/s", 1),
    "max_tilt_deg": Statistic("max tilt, °", 0),
    "end_distance_m": Statistic("distance from home at the end, m", 1),
    "start_voltage_v": Statistic("battery at start, V", 2),
    "end_voltage_v": Statistic("battery at end, V", 2),
    "min_voltage_v": Statistic("battery minimum, V", 2),
    "start_remaining_percent": Statistic("battery at start, %", 0),
    "end_remaining_percent": Statistic("battery at end, %", 0),
    "max_current_a": Statistic("max current, A", 1),
    "min_satellites": Statistic("min satellites", 0, "{:.0f} satellites at minimum", minimum=6),
    "max_hdop": Statistic("max HDOP", 2),
    "max_vibration_m_s2": Statistic(
        "max vibration, m/s²", 1, "vibration up to {:.0f} m/s² (normal: below 30)", maximum=30
    ),
    "clips": Statistic("accelerometer clippings", 0, "{:.0f} accelerometer clippings", maximum=0),
    "max_estimator_ratio": Statistic(
        "max estimator ratio", 2, "the estimator rejected measurements (ratio {:.2f}, above 1)", maximum=1
    ),
    "lost_percent": Statistic("messages lost, %", 2, "{:.0f} % of the messages lost", maximum=2),
}


def statistics_of(flight: FlightLog) -> FlightStatistics:
    spans = _ArmedSpans(flight)
    north_east = metres_from_home(flight)
    track_rows = list(spans.rows(flight.track))
    home_distances = [math.hypot(*north_east[row]) for row in track_rows] if north_east else []
    speeds = [
        math.hypot(flight.velocity["north_m_s"][row], flight.velocity["east_m_s"][row])
        for row in spans.rows(flight.velocity)
    ]
    sink_rates = spans.known_values(flight.velocity, "down_m_s")
    tilts = [abs(angle) for name in ("roll_deg", "pitch_deg") for angle in spans.known_values(flight.attitude, name)]
    voltages, remaining, currents = (
        spans.known_values_of_first(flight.batteries, name) for name in ("voltage_v", "remaining_percent", "current_a")
    )
    satellites, hdops = (spans.known_values_of_first(flight.gps, name) for name in ("satellites", "hdop"))
    vibrations = [level for axis in "xyz" for level in spans.known_values(flight.vibration, f"{axis}_m_s2")]
    clips = spans.known_values(flight.vibration, "clips")
    estimator_ratios = [ratio for name in flight.estimator for ratio in spans.known_values(flight.estimator, name)]
    return FlightStatistics(
        armed_s=sum(end - begin for begin, end in flight.armed) if flight.armed else None,
        distance_m=_path_length(north_east, track_rows) if north_east else None,
        max_height_m=_max_or_none(spans.known_values(flight.track, "altitude_relative_m")),
        max_distance_m=_max_or_none(home_distances),
        max_speed_m_s=_max_or_none(speeds),
        max_climb_m_s=_max_or_none([-sink_rate for sink_rate in sink_rates]),
        max_descent_m_s=_max_or_none(sink_rates),
        max_tilt_deg=_max_or_none(tilts),
        end_distance_m=home_distances[-1] if home_distances and not math.isnan(home_distances[-1]) else None,
        start_voltage_v=voltages[0] if voltages else None,
        end_voltage_v=voltages[-1] if voltages else None,
        min_voltage_v=min(voltages, default=None),
        start_remaining_percent=remaining[0] if remaining else None,
        end_remaining_percent=remaining[-1] if remaining else None,
        max_current_a=_max_or_none(currents),
        min_satellites=min(satellites, default=None),
        max_hdop=_max_or_none(hdops),
        max_vibration_m_s2=_max_or_none(vibrations),
        clips=sum(max(later - earlier, 0.0) for earlier, later in pairwise(clips)) if clips else None,
        max_estimator_ratio=_max_or_none(estimator_ratios),
        lost_percent=spans.mean(flight.link, "lost_percent"),
    )


def metres_from_home(flight: FlightLog) -> list[tuple[float, float]]:
    """Return metres north and east of home for each row of the track; empty if home or the track is unknown."""
    if flight.home is None or not len(flight.track):
        return []
    plane = TangentPlane(flight.home.latitude_deg, flight.home.longitude_deg)
    latitudes, longitudes = flight.track["latitude_deg"], flight.track["longitude_deg"]
    return [plane.metres(*place) for place in zip(latitudes, longitudes, strict=True)]


def time_in_modes(flight: FlightLog) -> dict[str, float]:
    """Return the armed seconds in each mode, in the order of first use."""
    seconds_by_mode: dict[str, float] = {}
    for change, end in flight.mode_spans():
        # If the vehicle was never armed, the whole log counts.
        for armed_from, armed_to in flight.armed or [(0.0, flight.duration_s)]:
            seconds = min(end, armed_to) - max(change.time_s, armed_from)
            if seconds > 0:
                seconds_by_mode[change.name] = seconds_by_mode.get(change.name, 0.0) + seconds
    return seconds_by_mode


class _ArmedSpans:
    """Selects the rows of time series logged while the vehicle was armed, or all rows if it was never armed."""

    def __init__(self, flight: FlightLog) -> None:
        self._spans = flight.armed or [(-math.inf, math.inf)]

    def rows(self, series: TimeSeries) -> Iterator[int]:
        for begin, end in self._spans:
            yield from range(bisect_left(series.times, begin), bisect_right(series.times, end))

    def known_values(self, series: TimeSeries, name: str) -> list[float]:
        times, values = series.times, series[name]
        known: list[float] = []
        for begin, end in self._spans:
            part = values[bisect_left(times, begin) : bisect_right(times, end)]
            known += [value for value in part if math.isfinite(value)]
        return known

    def known_values_of_first(self, by_number: dict[int, TimeSeries], name: str) -> list[float]:
        return self.known_values(by_number[min(by_number)], name) if by_number else []

    def mean(self, series: TimeSeries, name: str) -> float | None:
        """Return the time-weighted average of a column in the spans."""
        times, values = series.times, series[name]
        total, weight = 0.0, 0.0
        for begin, end in self._spans:
            for row in range(bisect_left(times, begin), bisect_right(times, end)):
                # The last value of the column counts for 1 s.
                until_s = times[row + 1] if row + 1 < len(times) else times[row] + 1.0
                seconds = min(until_s, end) - times[row]
                if math.isfinite(values[row]):
                    total += values[row] * seconds
                    weight += seconds
        return total / weight if weight else None


def _max_or_none(values: list[float]) -> float | None:
    return max((value for value in values if math.isfinite(value)), default=None)


def _path_length(north_east: list[tuple[float, float]], rows: list[int]) -> float:
    length_m = 0.0
    counted: tuple[float, float] | None = None  # the end of the last step that `length_m` includes
    previous_row = None
    for row in rows:
        if previous_row != row - 1:  # A gap in `rows`: the way between the two points is unknown.
            counted = None
        previous_row = row
        point = north_east[row]
        if math.isnan(math.hypot(*point)):
            continue
        if counted is None:
            counted = point
            continue
        step = math.dist(point, counted)
        if step >= _MIN_STEP_M:
            length_m += step
            counted = point
    return length_m


def findings(flight: FlightLog) -> list[str]:
    """Return sentences about each fall and hard landing."""
    sentences = []
    for fall in falls(flight):
        sentences.append(f"{fall_text(fall)}.")
        if measured := fall_measurements(flight, fall):
            sentences.append(f"Measured in the descent: {'; '.join(measured)}.")
    return sentences


def fall_measurements(flight: FlightLog, fall: Fall) -> list[str]:
    """Describe what was measured in the descent, with advice if a value is unusual."""
    begin_s = fall.begins_s
    end_s = fall.time_s - 0.2  # excludes the impact
    angles = ("roll_deg", "pitch_deg")
    texts = []
    currents = _currents(flight, begin_s, end_s)
    throttle = _descent_values(flight.air, "throttle_percent", begin_s, end_s)
    if throttle is not None:
        advice = ", so look at motors, propellers and battery" if throttle.maximum >= _HIGH_THROTTLE_PERCENT else ""
        is_current_low = any(current.is_low for current in currents.values())
        if throttle.is_low and not is_current_low:  # A low current gets this advice in its own text.
            advice = _STOPPED_MOTORS_ADVICE
        texts.append(f"throttle {throttle.text('%')}{advice}")
    tilt = _max_or_none([abs(angle) for name in angles for angle in flight.attitude.between(name, begin_s, end_s)])
    if tilt is not None:
        texts.append(f"tilt up to {tilt:.0f}°")
    errors = [abs(error) for name in angles for error in _attitude_errors(flight, name, begin_s, end_s)]
    max_error = _max_or_none(errors)
    if max_error is not None:
        advice = ", so look at the attitude charts" if max_error >= _HIGH_ATTITUDE_ERROR_DEG else ""
        texts.append(f"attitude up to {max_error:.0f}° off its set-point{advice}")
    motors = _motor_outputs(flight, begin_s, end_s)
    if motors:
        texts.append(motors)
    for name, current in currents.items():
        advice = _STOPPED_MOTORS_ADVICE if current.is_low else ""
        texts.append(f"{name} {current.text('A')}{advice}")
    return texts


def _currents(flight: FlightLog, begin_s: float, end_s: float) -> dict[str, _DescentValues]:
    """Return each battery's current during a descent. The keys are labels, such as "battery 1 current"."""
    currents = {}
    for index, battery in sorted(flight.batteries.items()):
        current = _descent_values(battery, "current_a", begin_s, end_s)
        if current is not None:
            name = battery_name(index) if len(flight.batteries) > 1 else "battery"
            currents[f"{name} current"] = current
    return currents


class _DescentValues(Snapshot):
    """Values of a measurement in a descent. ``before`` is the median shortly before the descent, or NaN."""

    minimum: float
    median: float
    maximum: float
    before: float

    @property
    def is_low(self) -> bool:
        return self.median < _LOW_POWER_SHARE * self.before

    def text(self, unit: str) -> str:
        low, high = f"{self.minimum:.0f}", f"{self.maximum:.0f}"
        values = f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
        return values if math.isnan(self.before) else f"{values} (before: {self.before:.0f} {unit})"


def _descent_values(series: TimeSeries, name: str, begin_s: float, end_s: float) -> _DescentValues | None:
    values = series.between(name, begin_s, end_s)
    if not values:
        return None
    values_before = series.between(name, begin_s - _BEFORE_FALL_S, begin_s)
    before = median(values_before) if values_before else math.nan
    return _DescentValues(minimum=min(values), median=median(values), maximum=max(values), before=before)


def _motors_in_descent(flight: FlightLog, begin_s: float, end_s: float) -> dict[str, _DescentValues]:
    """Return the pulses of the motors in a descent, by output number."""
    armings = [armed_at for armed_at, _ in flight.armed if armed_at < begin_s]
    motors: dict[str, _DescentValues] = {}
    if not armings:
        return motors
    for name in flight.outputs:
        idle_us = flight.outputs.at(name, armings[-1] - 0.1)  # just before arming
        pulses = _descent_values(flight.outputs, name, begin_s, end_s)
        # An output counts as a motor if arming and flying raised its pulse.
        if pulses is not None and pulses.before - idle_us >= _MOTOR_RAISED_US:
            _, number, _ = name.split("_")  # such as "output_3_us"
            motors[number] = pulses
    return motors


def _motor_outputs(flight: FlightLog, begin_s: float, end_s: float) -> str:
    motors = _motors_in_descent(flight, begin_s, end_s)
    if not motors:
        return ""
    lowest = min(motors, key=lambda output: motors[output].median)
    highest = max(motors, key=lambda output: motors[output].median)
    low_us, high_us = motors[lowest].median, motors[highest].median
    text = _DescentValues(
        minimum=min(pulses.minimum for pulses in motors.values()),
        median=median(pulses.median for pulses in motors.values()),
        maximum=max(pulses.maximum for pulses in motors.values()),
        before=median(pulses.before for pulses in motors.values()),
    ).text("µs")
    if high_us - low_us < _UNEQUAL_US:
        return f"motor outputs {text}"
    return (
        f"unequal motor outputs {text}: output {highest} at {high_us:.0f} µs, output {lowest} at {low_us:.0f} µs, so"
        f" look at the motor of output {highest}"
    )


def _attitude_errors(flight: FlightLog, name: str, begin_s: float, end_s: float) -> Iterator[float]:
    """Yield set-point minus measured angle, in degrees, for each set-point in a time span."""
    times, values = flight.attitude_target.times, flight.attitude_target[name]
    for row in range(bisect_left(times, begin_s), bisect_right(times, end_s)):
        error = math.remainder(values[row] - flight.attitude.at(name, times[row]), 360)
        if not math.isnan(error):
            yield error


def fall_text(fall: Fall) -> str:
    """Describe a fall: ``Fall: from 28.7 m, 16.9 m/s at the ground, at 0:24.9 (descent since 0:21.3); REASON``."""
    end = "at the ground" if fall.has_impact else "when the log ends"
    text = (
        f"{fall.title}: from {fall.height_m:.1f} m, {fall.sink_m_s:.1f} m/s {end}, at {clock_text(fall.time_s)}"
        f" (descent since {clock_text(fall.begins_s)})"
    )
    return "; ".join([text, *fall.reasons])


def summary(flight: FlightLog, statistics: FlightStatistics) -> list[str]:
    sentences = [
        *findings(flight),
        *silence_sentences(flight),
        _flight_sentence(flight, statistics),
        _modes_sentence(flight),
        _battery_sentence(statistics),
        _failsafes_sentence(flight),
        _warnings_sentence(statistics),
    ]
    notes = [f"{note[:1].upper()}{note[1:]}." for note in flight.notes]
    return [sentence for sentence in sentences if sentence] + notes


def _flight_sentence(flight: FlightLog, statistics: FlightStatistics) -> str:
    if statistics.armed_s is None:
        return f"No arming was logged in {duration_text(flight.duration_s)}."
    parts = [f"{duration_text(statistics.armed_s)} armed{_until_impact(flight, statistics.armed_s)}"]
    if statistics.distance_m is not None:
        parts.append(f"{distance_text(statistics.distance_m)} flown over ground")
    if statistics.max_height_m is not None:
        parts.append(f"max height {number_text(statistics.max_height_m)} m above home")
    if statistics.max_distance_m is not None:
        parts.append(f"max distance {distance_text(statistics.max_distance_m)} from home")
    if statistics.max_speed_m_s is not None:
        parts.append(f"max ground speed {number_text(statistics.max_speed_m_s)} m/s")
    if statistics.end_distance_m is not None:
        parts.append(f"ended {distance_text(statistics.end_distance_m)} from home")
    return ", ".join(parts) + "."


def _until_impact(flight: FlightLog, armed_s: float) -> str:
    impact_s = next((fall.time_s for fall in falls(flight) if fall.has_impact and not fall.is_hard_landing), math.inf)
    armed_before_s = sum(max(min(end, impact_s) - begin, 0.0) for begin, end in flight.armed)
    return f" ({duration_text(armed_before_s)} until the impact)" if armed_s - armed_before_s >= 1.0 else ""


def _modes_sentence(flight: FlightLog) -> str:
    seconds_by_mode = time_in_modes(flight)
    if not seconds_by_mode:
        return ""
    # Modes that lasted less than half a second are omitted, unless all did.
    longer = {name: seconds for name, seconds in seconds_by_mode.items() if seconds >= 0.5}
    modes = [f"{name} ({duration_text(seconds)})" for name, seconds in (longer or seconds_by_mode).items()]
    return f"{'Flown in' if flight.armed else 'In'} {', '.join(modes)}."


def _battery_sentence(statistics: FlightStatistics) -> str:
    if statistics.start_voltage_v is None or statistics.end_voltage_v is None:
        return ""
    text = f"Battery {statistics.start_voltage_v:.1f} → {statistics.end_voltage_v:.1f} V"
    if statistics.start_remaining_percent is not None and statistics.end_remaining_percent is not None:
        text += f", {statistics.start_remaining_percent:.0f} → {statistics.end_remaining_percent:.0f} %"
    if statistics.min_voltage_v is not None:
        text += f", minimum {statistics.min_voltage_v:.1f} V"
    return text + "."


def _failsafes_sentence(flight: FlightLog) -> str:
    acted, warnings, warning_kinds = [], [], []
    for failsafe in failsafes(flight):
        title_and_time = f"{failsafe.title} at {clock_text(failsafe.time_s)}"
        if failsafe.acted:
            acted.append(f"{title_and_time} ({failsafe.reaction})")
        else:
            warnings.append(f"{title_and_time} ({failsafe.evidence[0].text})")
            warning_kinds.append(failsafe.kind)
    sentences = []
    if acted:
        sentences.append(f"{len(acted)} failsafe{'' if len(acted) == 1 else 's'}: {_first_few(acted)}.")
    if warnings:
        plural = "" if len(warnings) == 1 else "s"
        sentences.append(f"{len(warnings)} warning{plural} without a recorded reaction: {_first_few(warnings)}.")
    unknown = _unknown_actions(flight, warning_kinds)
    if unknown:
        sentences.append(f"The log does not contain the parameters that decide on the reaction: {', '.join(unknown)}.")
    return " ".join(sentences) or "No failsafe was reported."


def _unknown_actions(flight: FlightLog, kinds: Iterable[str]) -> list[str]:
    """Return the names of missing parameters that decide how the vehicle reacts to these kinds of failsafes."""
    unknown: list[str] = []
    for kind in dict.fromkeys(kinds):
        names = failsafe_parameters(flight, kind)
        if not any(name in flight.parameters for name in names):
            # Parameters with ACT or ENABL in their names choose the reaction.
            unknown += [name for name in names if "ACT" in name or "ENABL" in name] or names
    return unknown


def _first_few(texts: list[str]) -> str:
    more = [f"{len(texts) - _MAX_LISTED} more"] if len(texts) > _MAX_LISTED else []
    return "; ".join([*texts[:_MAX_LISTED], *more])


def _warnings_sentence(statistics: FlightStatistics) -> str:
    warnings = [
        statistic.warning.format(value)
        for name, statistic in STATISTICS.items()
        if (value := getattr(statistics, name)) is not None and not statistic.minimum <= value <= statistic.maximum
    ]
    return "Check: " + "; ".join(warnings) + "." if warnings else ""
