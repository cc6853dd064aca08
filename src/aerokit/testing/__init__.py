"""For tests of programs that use aerokit. Nothing in aerokit imports this.

An event loop on virtual time (`run_virtual`), simulated vehicles with faults and true tracks (`open_flight`,
`open_fleet`, `serve_flight`), and a pytest plugin with the same as fixtures: docs/testing.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .clock import VIRTUAL_BACKEND, DeadlockError, VirtualClockLoop, run_virtual
    from .fault_verbs import FaultInjector
    from .flights import Fleet, Flight, open_fleet, open_flight
    from .served import ServedFlight, serve_flight
    from .track import Track, TrackPoint

__all__ = [
    "VIRTUAL_BACKEND",
    "DeadlockError",
    "FaultInjector",
    "Fleet",
    "Flight",
    "ServedFlight",
    "Track",
    "TrackPoint",
    "VirtualClockLoop",
    "open_fleet",
    "open_flight",
    "run_virtual",
    "serve_flight",
]

# Imported when first asked for: pytest imports this package with its plugin in every project.
_HOMES = {
    "VIRTUAL_BACKEND": "clock",
    "DeadlockError": "clock",
    "FaultInjector": "fault_verbs",
    "Fleet": "flights",
    "Flight": "flights",
    "ServedFlight": "served",
    "Track": "track",
    "TrackPoint": "track",
    "VirtualClockLoop": "clock",
    "open_fleet": "flights",
    "open_flight": "flights",
    "run_virtual": "clock",
    "serve_flight": "served",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
