"""Flight logs as what was flown: whole flights as columns (`read_flight`), and their entries; docs/report.md."""

from __future__ import annotations

from aerokit.logs.flights.columns import Columns
from aerokit.logs.flights.failsafes import Failsafe, failsafes
from aerokit.logs.flights.flight import Flight, ModeChange, ParameterChange, Said, Sign, Waypoint
from aerokit.logs.flights.reading import read_flight

__all__ = [
    "Columns",
    "Failsafe",
    "Flight",
    "ModeChange",
    "ParameterChange",
    "Said",
    "Sign",
    "Waypoint",
    "failsafes",
    "read_flight",
]
