"""The summary of a flight in words, and numbers as people read them."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import TYPE_CHECKING

from aerokit.flights.failsafes import failsafes
from aerokit.report.figures import time_in_modes

if TYPE_CHECKING:
    from aerokit.flights.flight import Flight
    from aerokit.report.figures import Figures

__all__ = ["clock", "date", "length", "number", "span", "summary"]

_A_YEAR_S = 365 * 86_400.0


def summary(flight: Flight, found: Figures) -> list[str]:
    """Sentences, the most important first."""
    told = [_what(flight, found), _modes(flight), _battery(found), _failsafes(flight), _quality(found)]
    return [sentence for sentence in told if sentence] + [
        f"{note[:1].upper()}{note[1:]}." for note in flight.notes
    ]


def _what(flight: Flight, found: Figures) -> str:
    if found.armed_s is None:
        return f"It was never armed: {span(flight.duration_s)} on the ground."
    parts = [f"{span(found.armed_s)} armed"]
    if found.way_m is not None:
        parts.append(f"{length(found.way_m)} flown")
    if found.highest_m is not None:
        parts.append(f"highest {number(found.highest_m)} m above home")
    if found.farthest_m is not None:
        parts.append(f"farthest {length(found.farthest_m)} from home")
    if found.fastest_m_s is not None:
        parts.append(f"fastest {number(found.fastest_m_s)} m/s")
    if found.ended_m is not None:
        parts.append(f"ended {length(found.ended_m)} from home")
    return ", ".join(parts) + "."


def _modes(flight: Flight) -> str:
    modes = time_in_modes(flight)
    return (
        ("Flown in " if flight.armed else "In ")
        + ", ".join(f"{name} ({span(seconds)})" for name, seconds in modes.items())
        + "."
        if modes
        else ""
    )


def _battery(found: Figures) -> str:
    if found.voltage_before_v is None or found.voltage_after_v is None:
        return ""
    told = f"Battery {found.voltage_before_v:.1f} → {found.voltage_after_v:.1f} V"
    if found.remaining_before_percent is not None and found.remaining_after_percent is not None:
        told += f", {found.remaining_before_percent:.0f} → {found.remaining_after_percent:.0f} %"
    if found.voltage_least_v is not None:
        told += f", least {found.voltage_least_v:.1f} V"
    return told + "."


def _failsafes(flight: Flight) -> str:
    found = failsafes(flight)
    acted = [each for each in found if each.acted]
    doubts = [each for each in found if not each.acted]
    told = f"{len(acted) or 'No'} failsafe{'' if len(acted) == 1 else 's'}"
    if acted:
        told += ": " + "; ".join(f"{each.title} at {clock(each.time_s)} ({each.reaction})" for each in acted)
    if doubts:
        told += f". {len(doubts)} warning{'' if len(doubts) == 1 else 's'} without a known consequence: "
        told += "; ".join(f"{each.title} at {clock(each.time_s)}" for each in doubts)
    return told + "."


def _quality(found: Figures) -> str:
    doubts = []
    if found.vibration_most_m_s2 is not None and found.vibration_most_m_s2 > 30:
        doubts.append(f"vibration up to {found.vibration_most_m_s2:.0f} m/s² (below 30 is well)")
    if found.clips:
        doubts.append(f"an accelerometer reached its limit {found.clips:.0f} times")
    if found.estimator_most is not None and found.estimator_most > 1:
        doubts.append(
            f"the estimator did not believe a measurement (ratio {found.estimator_most:.2f}, above 1)"
        )
    if found.satellites_least is not None and found.satellites_least < 6:
        doubts.append(f"{found.satellites_least:.0f} satellites at the least")
    if found.lost_percent is not None and found.lost_percent > 2:
        doubts.append(f"{found.lost_percent:.0f} % of the messages lost")
    return "To look at: " + "; ".join(doubts) + "." if doubts else ""


def clock(seconds: float) -> str:
    """Minutes and seconds since the log began: ``3:07.5``."""
    minutes, rest = divmod(round(max(seconds, 0.0), 1), 60)
    return f"{minutes:.0f}:{rest:04.1f}"


def span(seconds: float) -> str:
    """``47 s``, ``12 min 5 s``, ``1 h 3 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s" if whole % 60 else f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def length(metres: float) -> str:
    """``310 m``, ``3.4 km``."""
    if metres >= 1000:
        return f"{metres / 1000:.1f} km"
    return f"{metres:.0f} m" if metres >= 10 else f"{metres:.1f} m"


def number(value: float) -> str:
    """Three digits or so."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def date(unix_s: float) -> str:
    """UTC; what is known where no clock told it."""
    if unix_s < _A_YEAR_S:
        return "at an unknown time"
    return f"{datetime.fromtimestamp(unix_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
