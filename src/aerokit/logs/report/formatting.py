"""Formats times, durations and lengths for reports."""

from __future__ import annotations

from datetime import datetime, timezone

_A_YEAR_S = 365 * 86_400.0


def clock_text(seconds: float) -> str:
    """Format a time since the start of the log as minutes and seconds: ``3:07.5``."""
    minutes, remaining_s = divmod(round(max(seconds, 0.0), 1), 60)
    return f"{minutes:.0f}:{remaining_s:04.1f}"


def duration_text(seconds: float) -> str:
    """Format a duration: ``47 s``, ``12 min 5 s``, ``1 h 3 min``."""
    rounded = round(seconds)
    if rounded < 60:
        return f"{rounded} s"
    if rounded < 3600:
        return f"{rounded // 60} min {rounded % 60} s" if rounded % 60 else f"{rounded // 60} min"
    return f"{rounded // 3600} h {rounded % 3600 // 60} min"


def distance_text(metres: float) -> str:
    """Format a distance: ``310 m``, ``3.4 km``."""
    if metres >= 1000:
        return f"{metres / 1000:.1f} km"
    return f"{metres:.0f} m" if metres >= 10 else f"{metres:.1f} m"


def number_text(value: float) -> str:
    """Format a number, with one decimal below 100: ``5.7``, ``310``."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def date_text(unix_s: float) -> str:
    if unix_s < _A_YEAR_S:
        return "at an unknown time"
    return f"{datetime.fromtimestamp(unix_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
