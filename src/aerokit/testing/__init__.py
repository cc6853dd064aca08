"""Tools to test programs that use aerokit. Only `aerokit.apps.cli` imports this package.

An event loop on virtual time (`run_virtual`), simulated vehicles with faults and true tracks (`open_flight`,
`open_fleet`, `serve_flight`), recordings as vehicles (`RecordedVehicle`), faulty links, and a pytest plugin with
fixtures: docs/testing.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.testing.clock import VIRTUAL_BACKEND as VIRTUAL_BACKEND
    from aerokit.testing.clock import DeadlockError as DeadlockError
    from aerokit.testing.clock import VirtualClockLoop as VirtualClockLoop
    from aerokit.testing.clock import run_virtual as run_virtual
    from aerokit.testing.fault_model import FaultModel as FaultModel
    from aerokit.testing.faults import FaultInjector as FaultInjector
    from aerokit.testing.faulty_link import FaultyLink as FaultyLink
    from aerokit.testing.flights import Flight as Flight
    from aerokit.testing.flights import SimulatedFleet as SimulatedFleet
    from aerokit.testing.flights import open_fleet as open_fleet
    from aerokit.testing.flights import open_flight as open_flight
    from aerokit.testing.journal import Journal as Journal
    from aerokit.testing.recorded import RecordedVehicle as RecordedVehicle
    from aerokit.testing.served import ServedFlight as ServedFlight
    from aerokit.testing.served import serve_flight as serve_flight
    from aerokit.testing.track import Track as Track
    from aerokit.testing.track_points import TrackPoint as TrackPoint


__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.testing.journal": ("Journal",),
        "aerokit.testing.track": ("Track",),
        "aerokit.testing.track_points": ("TrackPoint",),
        "aerokit.testing.clock": ("DeadlockError", "VIRTUAL_BACKEND", "VirtualClockLoop", "run_virtual"),
        "aerokit.testing.fault_model": ("FaultModel",),
        "aerokit.testing.faults": ("FaultInjector",),
        "aerokit.testing.faulty_link": ("FaultyLink",),
        "aerokit.testing.flights": ("SimulatedFleet", "Flight", "open_fleet", "open_flight"),
        "aerokit.testing.recorded": ("RecordedVehicle",),
        "aerokit.testing.served": ("ServedFlight", "serve_flight"),
    },
)
