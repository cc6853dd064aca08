"""For tests of programs that use aerokit. Nothing in aerokit imports this.

An event loop on virtual time (`run_virtual`), simulated vehicles with faults and true tracks (`open_flight`,
`open_fleet`, `serve_flight`), and a pytest plugin with the same as fixtures: docs/testing.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.lazy import lazy_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.sim.journal import Journal
    from aerokit.sim.track import Track, TrackPoint

    from .clock import VIRTUAL_BACKEND, DeadlockError, VirtualClockLoop, run_virtual
    from .fault_verbs import FaultInjector
    from .flights import Fleet, Flight, open_fleet, open_flight
    from .served import ServedFlight, serve_flight

__all__ = [
    "VIRTUAL_BACKEND",
    "DeadlockError",
    "FaultInjector",
    "Fleet",
    "Flight",
    "Journal",
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
    "Journal": "aerokit.sim.journal",
    "Track": "aerokit.sim.track",
    "TrackPoint": "aerokit.sim.track",
    "VIRTUAL_BACKEND": "aerokit.testing.clock",
    "DeadlockError": "aerokit.testing.clock",
    "FaultInjector": "aerokit.testing.fault_verbs",
    "Fleet": "aerokit.testing.flights",
    "Flight": "aerokit.testing.flights",
    "ServedFlight": "aerokit.testing.served",
    "VirtualClockLoop": "aerokit.testing.clock",
    "open_fleet": "aerokit.testing.flights",
    "open_flight": "aerokit.testing.flights",
    "run_virtual": "aerokit.testing.clock",
    "serve_flight": "aerokit.testing.served",
}

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
