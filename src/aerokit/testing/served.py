"""`ServedFlight`: a simulated vehicle on a socket, for blocking programs, classic DroneKit and other processes."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.sim.kinds import scale_timeouts, simulated
from aerokit.sim.server import SimulatorServer, open_simulator
from aerokit.testing.faults import FaultInjector
from aerokit.testing.interruption import Interruption
from aerokit.testing.stage import FlightRecording, FlightScheduler

if TYPE_CHECKING:
    from anyio.from_thread import BlockingPortal

    from aerokit.testing.journal import Journal
    from aerokit.testing.track import Track

SPEEDUP = 10.0
"""Default number of simulated seconds per second."""


class ServedFlight:
    """A simulated vehicle that another thread serves faster than real time. All times are simulated seconds."""

    def __init__(
        self,
        portal: BlockingPortal,
        server: SimulatorServer,
        scheduler: FlightScheduler,
        vehicle: Any,
        interruption: Interruption,
        recording: FlightRecording | None = None,
    ) -> None:
        self.address: str = server.addresses[0].replace("tcpin:", "tcp:")
        """Address of the vehicle; for "tcpin:" the one to connect to, such as "tcp:127.0.0.1:5760"."""
        self.simulated: Any = vehicle
        """The simulated vehicle, which runs on another thread. Only read its attributes; use ``faults`` for changes."""
        self.track: Track = scheduler.tracks[0]
        """True track of the vehicle."""
        self.journal: Journal = scheduler.journals[0]
        """Status texts that the vehicle sent, and messages that it received."""
        self.faults: FaultInjector = FaultInjector(
            vehicle, lambda schedule: portal.call(self._with_scheduler, schedule)
        )
        """Injects faults."""
        self.recording: FlightRecording | None = recording
        """Recording of the vehicle's link; None without ``record=True``."""
        self._server = server
        self._scheduler = scheduler
        self._interruption = interruption
        self._is_raised = False  # True once `_raise_failure` has raised the exception of the vehicle
        scheduler.refresh_with(lambda: portal.call(self._refresh))

    @contextmanager
    def raising_vehicle_errors(self) -> Iterator[None]:
        """End the block with an exception of the simulated vehicle as soon as the vehicle raises it.

        The vehicle's link is closed, which ends calls that wait for the vehicle. The main thread is interrupted as by
        Ctrl-C, which ends programs that poll.
        """
        try:
            with self._interruption.allowed():
                yield
        except BaseException:
            self._raise_failure()
            raise
        self._raise_failure()

    def _raise_failure(self) -> None:
        failure = self._server.failure
        if failure is not None:
            self._is_raised = True
            # Without "from", the traceback would also show the exception that ended the block, e.g. KeyboardInterrupt.
            raise failure from failure.__cause__

    @contextmanager
    def _raising_once(self) -> Iterator[None]:
        """Suppress the vehicle's exception if `_raise_failure` raised it before."""
        try:
            yield
        except Exception as error:
            if not self._is_raised or error is not self._server.failure:
                raise

    def _refresh(self) -> None:
        if self._server.failure is None:
            self._server.wake()
        self._scheduler.record()

    def _with_scheduler(self, schedule: Callable[[FlightScheduler], None]) -> None:
        self._refresh()
        schedule(self._scheduler)
        self._server.wake()


@contextmanager
def serve_flight(kind: str = "copter", **options: Any) -> Iterator[ServedFlight]:
    """Serve a vehicle while the block runs; ``options`` are the options of `hosted_flight` and of the vehicle.
    An exception in the simulated vehicle ends the block at once, see `ServedFlight.raising_vehicle_errors`.
    """
    with hosted_flight(kind, **options) as flight, flight.raising_vehicle_errors():
        yield flight


@contextmanager
def hosted_flight(
    kind: str = "copter",
    *,
    address: str = "tcpin:127.0.0.1:0",
    speedup: float = SPEEDUP,
    record: bool = False,
    **options: Any,
) -> Iterator[ServedFlight]:
    """Serve a vehicle on an address, at ``speedup`` times real time, while the block runs.

    ``record=True`` records the link for the report of a failed test. ``options`` are those of the vehicle; its timeouts
    are scaled as by `aerokit.sim.kinds.scale_timeouts`. Raises InvalidArgument for a wrong kind or address, and
    LinkOpenError if the address cannot be opened. If the simulated vehicle has raised an exception, the end of the
    block raises it.
    """
    from anyio.from_thread import start_blocking_portal

    options.setdefault("boot_time_s", 1.0)
    vehicle: Any = simulated(kind, **options)
    scale_timeouts([vehicle], speedup, leave=options.get("parameters") or ())
    scheduler = FlightScheduler([vehicle])
    interruption = Interruption()
    recording = FlightRecording() if record else None

    @asynccontextmanager
    async def serve() -> AsyncIterator[SimulatorServer]:
        with interruption.on_error():
            async with open_simulator([scheduler, vehicle], address, speedup=speedup) as server:
                if recording is not None:
                    recording.attach(server)
                yield server

    with start_blocking_portal() as portal:
        serving = portal.wrap_async_context_manager(serve())  # runs on the thread of the portal
        flight = ServedFlight(portal, serving.__enter__(), scheduler, vehicle, interruption, recording)
        try:
            yield flight
        finally:
            portal.call(scheduler.record)  # Append the last points of the tracks before refreshing ends.
            scheduler.refresh_with(None)
            with flight._raising_once():
                serving.__exit__(None, None, None)
