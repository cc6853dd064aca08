"""`ServedFlight`: a simulated vehicle on a socket, for blocking programs, classic DroneKit and other processes."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.sim.kinds import simulated, wait_longer
from aerokit.sim.server import SimulatorServer, open_simulator
from aerokit.testing.faults import FaultInjector
from aerokit.testing.interruption import Interruption
from aerokit.testing.stage import FlightRecording, Stagehand

if TYPE_CHECKING:
    from anyio.from_thread import BlockingPortal

    from aerokit.sim.journal import Journal
    from aerokit.sim.track import Track

SPEEDUP = 10.0
"""Simulated seconds in a real one, unless a test says otherwise."""


class ServedFlight:
    """One simulated vehicle that a thread of its own serves, faster than real time. Seconds are simulated ones."""

    def __init__(
        self,
        portal: BlockingPortal,
        server: SimulatorServer,
        hand: Stagehand,
        vehicle: Any,
        interruption: Interruption,
        recording: FlightRecording | None = None,
    ) -> None:
        self.address: str = server.addresses[0].replace("tcpin:", "tcp:")
        """Where programs connect to, such as "tcp:127.0.0.1:5760"."""
        self.simulated: Any = vehicle
        """The simulated vehicle; it lives on another thread: read it, change it by the verbs of ``faults``."""
        self.track: Track = hand.tracks[0]
        """Where it truly was."""
        self.journal: Journal = hand.journals[0]
        """What it said, and the orders that it heard."""
        self.faults: FaultInjector = FaultInjector(vehicle, lambda plan: portal.call(self._on_stage, plan))
        """What goes wrong with it."""
        self.recording: FlightRecording | None = recording
        """All that goes over its link, with ``record=True`` only."""
        self._portal, self._server, self._hand, self._interruption = portal, server, hand, interruption
        self._is_told = False
        hand.follow(lambda: portal.call(self._catch_up))

    @contextmanager
    def failing_at_once(self) -> Iterator[None]:
        """Raise what the simulated vehicle raises, as soon as it does, in the place of what it causes.

        Its link is closed, which ends calls that wait for the vehicle; and the main thread is interrupted, as by
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
            self._is_told = True
            raise failure from failure.__cause__

    @contextmanager
    def _telling_once(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not self._is_told or error is not self._server.failure:
                raise

    def _catch_up(self) -> None:
        if self._server.failure is None:
            self._server.wake()
        self._hand.record()

    def _on_stage(self, plan: Callable[[Stagehand], None]) -> None:
        self._catch_up()
        plan(self._hand)
        self._server.wake()


@contextmanager
def serve_flight(kind: str = "copter", **options: Any) -> Iterator[ServedFlight]:
    """Serve a vehicle of a kind while the block runs; ``options`` are those of the vehicle, and of `hosted_flight`.

    A mistake inside the simulated vehicle ends the block at once, as `ServedFlight.failing_at_once` does.
    """
    with hosted_flight(kind, **options) as flight, flight.failing_at_once():
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
    """Serve a vehicle of a kind on an address while the block runs; ``options`` are those of the vehicle.

    It waits ``speedup`` times as long for what the program sends by its own clock, unless ``parameters`` says
    otherwise: see `aerokit.sim.patience.wait_longer`.
    Raises InvalidArgument for a wrong kind or address, LinkOpenError for one that cannot be opened, and at the
    end what the vehicle raised, if nobody was told of it.
    """
    from anyio.from_thread import start_blocking_portal

    options.setdefault("boot_time_s", 1.0)
    vehicle: Any = simulated(kind, **options)
    wait_longer([vehicle], speedup, leave=options.get("parameters") or ())
    hand, interruption = Stagehand([vehicle]), Interruption()
    recording = FlightRecording() if record else None

    @asynccontextmanager
    async def serve() -> AsyncIterator[SimulatorServer]:
        with interruption.at_an_error():
            async with open_simulator([hand, vehicle], address, speedup=speedup) as server:
                if recording is not None:
                    recording.follow(server)
                yield server

    with start_blocking_portal() as portal:
        serving = portal.wrap_async_context_manager(serve())
        flight = ServedFlight(portal, serving.__enter__(), hand, vehicle, interruption, recording)
        try:
            yield flight
        finally:
            portal.call(hand.record)
            hand.follow(None)
            with flight._telling_once():
                serving.__exit__(None, None, None)
