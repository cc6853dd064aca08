"""`ServedFlight`: a simulated vehicle on a socket, for blocking programs, classic DroneKit and other processes."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.sim.kinds import simulated
from aerokit.sim.patience import wait_longer
from aerokit.sim.server import SimulatorServer, open_simulator
from aerokit.testing.fault_verbs import FaultInjector
from aerokit.testing.stage import Stagehand

if TYPE_CHECKING:
    from anyio.from_thread import BlockingPortal

__all__ = ["SPEEDUP", "ServedFlight", "serve_flight"]

SPEEDUP = 10.0
"""Simulated seconds in a real one, unless a test says otherwise."""


class ServedFlight:
    """One simulated vehicle that a thread of its own serves, faster than real time. Seconds are simulated ones."""

    def __init__(
        self, portal: BlockingPortal, server: SimulatorServer, hand: Stagehand, vehicle: Any
    ) -> None:
        self.address = server.addresses[0].replace("tcpin:", "tcp:")
        """Where programs connect to, such as "tcp:127.0.0.1:5760"."""
        self.simulated: Any = vehicle
        """The simulated vehicle; it lives on another thread: read it, change it by the verbs of ``faults``."""
        self.track = hand.tracks[0]
        """Where it truly was."""
        self.faults = FaultInjector(vehicle, self._schedule)
        """What goes wrong with it."""
        self._portal, self._server, self._hand = portal, server, hand
        hand.follow(lambda: portal.call(self._catch_up))

    def _schedule(self, action: Callable[[], None], after_s: float) -> None:
        self._portal.call(self._do, action, after_s)

    def _catch_up(self) -> None:
        self._server.wake()
        self._hand.record()

    def _do(self, action: Callable[[], None], after_s: float) -> None:
        self._server.wake()
        self._hand.do(action, after_s=after_s)
        self._server.wake()


@contextmanager
def serve_flight(
    kind: str = "copter", *, address: str = "tcpin:127.0.0.1:0", speedup: float = SPEEDUP, **options: Any
) -> Iterator[ServedFlight]:
    """Serve a vehicle of a kind on an address while the block runs; ``options`` are those of the vehicle.

    It waits ``speedup`` times as long for what the program sends by its own clock, unless ``parameters`` says
    otherwise: see `aerokit.sim.patience.wait_longer`.
    Raises LocalProtocolError for a wrong kind or address, LinkOpenError for one that cannot be opened.
    """
    from anyio.from_thread import start_blocking_portal

    options.setdefault("boot_time_s", 1.0)
    vehicle: Any = simulated(kind, **options)
    wait_longer([vehicle], speedup, leave=options.get("parameters") or ())
    hand = Stagehand([vehicle])

    @asynccontextmanager
    async def serve() -> AsyncIterator[SimulatorServer]:
        async with open_simulator([hand, vehicle], address, speedup=speedup) as server:
            yield server

    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serve()) as server:
        try:
            yield ServedFlight(portal, server, hand, vehicle)
        finally:
            portal.call(hand.record)
            hand.follow(None)
