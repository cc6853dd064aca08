"""Detects the falls and hard landings of a flight by heights, sink rates and status texts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.logs.flights.failsafes import CRASH_KINDS, evidence_in_texts

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.logs.flights.flight import FlightLog

# Only descents faster than _MIN_SINK_M_S can be falls, because autopilots land at 0.5 to 2 m/s, and descend at 1.5 m/s
# by default (ArduPilot WP_SPD_DN, PX4 MPC_Z_VEL_MAX_DN). A descent ends when the sink rate is below _STOPPED_M_S.
_MIN_SINK_M_S, _STOPPED_M_S = 3.0, 1.0
_MIN_HEIGHT_M = 2.0
# With a higher sink rate, an impact is a fall, not a hard landing. Free fall reaches this speed after two metres.
_FALL_SINK_M_S = 6.0
# An impact on the ground stops a vehicle within _IMPACT_S. Motors need longer to stop a fast descent. If the interval
# between two velocities is longer than _MAX_INTERVAL_S, nothing is known about the end of the descent.
_IMPACT_S, _MAX_INTERVAL_S = 0.6, 3.5
_SAME_HEIGHT_M = 1.5
_DISARM_TIMEOUT_S = 30.0
# Disarming and status texts may explain a descent if they are at most _REASON_BEFORE_S before its start. Status texts
# may also explain it if they are at most _TEXT_AFTER_S after its end.
_REASON_BEFORE_S, _TEXT_AFTER_S = 3.0, 5.0
# Disarming less than this before the end of a descent may be a consequence of the impact, not the cause.
_IMPACT_DISARM_S = 0.3
_NEAR_HOME_HEIGHT_M = 3.0  # above this height, an armed vehicle that keeps its height may be hovering


class Fall(Snapshot):
    """A fall or a hard landing: a descent at 3 m/s or more, until the ground or the log's end; see docs/report.md."""

    time_s: float
    """Time of the impact, or of the last entry if the log ends before it."""
    begins_s: float
    """Start of the descent."""
    height_m: float
    """Height that the vehicle lost."""
    sink_m_s: float
    """Sink rate at the end of the descent."""
    is_hard_landing: bool
    """True for a hard landing: the sink rate was below 6 m/s, and there are no ``reasons``."""
    has_impact: bool
    """False if the log ends during the descent."""
    reasons: tuple[str, ...]
    """Evidence of a fall: disarming in the air, and status texts about a crash, a motor failure or a termination."""

    @property
    def title(self) -> str:
        return "Hard landing" if self.is_hard_landing else "Fall"


def falls(flight: FlightLog) -> list[Fall]:
    """Return the falls and hard landings of a flight, the oldest first. The log must have heights and sink rates.

    In each of them, the vehicle sank 2 m or more, at 3 m/s or more, and came to a stop within 0.6 s; if the log has few
    velocities, within 1.5 times the interval between two of them. In addition, one of these is true:

    - It was disarmed within 30 s after the stop, and its logged height changed by at most 1.5 m until then.
    - It was at most 3 m above home, and its logged height changed by at most 1.5 m in the next 30 s.
    - The log has evidence of a fall: see `Fall.reasons`.

    If the log ends during a descent, the descent is a fall or hard landing if there is such evidence, or if the vehicle
    would have reached home's height within 2 s.
    """
    if not flight.armed:
        return []
    candidates = [_fall(flight, descent) for descent in _descents(flight)]
    return [fall for fall in candidates if fall is not None]


class _Descent(NamedTuple):
    begin_s: float
    end_s: float
    sink_m_s: float  # the highest sink rate near the end
    has_impact: bool  # False if the log ends during the descent


def _descents(flight: FlightLog) -> Iterator[_Descent]:
    """Yield the fast descents that end abruptly, and the one during which the log ends."""
    begin_s = -math.inf  # the last time at which the vehicle sank slowly, or not at all
    last_fast_s = -math.inf  # the last time at which it sank fast
    previous_s = -math.inf
    sink_m_s = 0.0  # the highest sink rate shortly before the end of the descent
    for time_s, down_m_s in zip(flight.velocity.times, flight.velocity["down_m_s"], strict=True):
        if math.isnan(down_m_s):
            continue
        if down_m_s >= _MIN_SINK_M_S:
            is_recent = time_s - last_fast_s <= _IMPACT_S
            sink_m_s = max(sink_m_s, down_m_s) if is_recent else down_m_s
            last_fast_s = time_s
        elif down_m_s < _STOPPED_M_S:
            # If the log has few velocities, even a sudden stop seems to take longer.
            max_stop_s = max(_IMPACT_S, 1.5 * min(time_s - previous_s, _MAX_INTERVAL_S))
            was_fast = last_fast_s > begin_s
            if was_fast and time_s - last_fast_s <= max_stop_s:
                yield _Descent(begin_s, time_s, sink_m_s, has_impact=True)
            begin_s, sink_m_s = time_s, 0.0
        previous_s = time_s
    is_fast_at_end = last_fast_s == previous_s and last_fast_s > begin_s
    if is_fast_at_end:
        yield _Descent(begin_s, last_fast_s, sink_m_s, has_impact=False)


def _fall(flight: FlightLog, descent: _Descent) -> Fall | None:
    """Return the fall or hard landing in which a descent ends; None if the vehicle may have continued to fly."""
    begin_s, end_s, sink_m_s, has_impact = descent
    begin_height_m = flight.track.at("altitude_relative_m", begin_s)
    end_height_m = flight.track.at("altitude_relative_m", end_s)
    lost_height_m = begin_height_m - end_height_m
    if not lost_height_m >= _MIN_HEIGHT_M:  # `not >=` is also true if a height is NaN
        return None
    reasons = _reasons(flight, begin_s, end_s)
    # A log that ends during the descent lacks the impact, which must then be less than two seconds away.
    hits_ground_soon = end_height_m < 2 * sink_m_s
    is_on_ground = _stays_at_height(flight, end_s, end_height_m) if has_impact else hits_ground_soon
    if not (is_on_ground or reasons):  # A logged reason, such as disarming in the air, proves a fall at any height.
        return None
    return Fall(
        time_s=end_s,
        begins_s=begin_s,
        height_m=lost_height_m,
        sink_m_s=sink_m_s,
        is_hard_landing=sink_m_s < _FALL_SINK_M_S and not reasons,
        has_impact=has_impact,
        reasons=tuple(reasons),
    )


def _stays_at_height(flight: FlightLog, time_s: float, height_m: float) -> bool:
    """Return True if the vehicle stays at about ``height_m`` until it is disarmed, or near home for 30 s."""
    disarmed_s = next((end for begin, end in flight.armed if begin <= time_s < end), time_s)
    until_s = min(disarmed_s, time_s + _DISARM_TIMEOUT_S)
    was_disarmed = disarmed_s <= until_s and disarmed_s < flight.duration_s  # an armed span also ends with the log
    if not was_disarmed and height_m > _NEAR_HOME_HEIGHT_M:
        return False  # The vehicle may be hovering.
    heights = flight.track.between("altitude_relative_m", time_s + _IMPACT_S, until_s)
    return all(abs(height - height_m) <= _SAME_HEIGHT_M for height in heights)


def _reasons(flight: FlightLog, begin_s: float, end_s: float) -> list[str]:
    earliest_s = begin_s - _REASON_BEFORE_S
    reasons = [
        "disarmed in the air"
        for armed_s, disarmed_s in flight.armed
        if armed_s < begin_s and earliest_s <= disarmed_s <= end_s - _IMPACT_DISARM_S
    ]
    texts = [text for text in flight.texts if earliest_s <= text.time_s <= end_s + _TEXT_AFTER_S]
    crash_texts = dict.fromkeys(item.text for item in evidence_in_texts(texts) if item.kind in CRASH_KINDS)
    return reasons + list(crash_texts)[:3]  # three texts are enough
