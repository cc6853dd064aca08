"""`Flight`: a simulated vehicle in a test, with the program's vehicle, faults and track.

```python
async with open_flight("copter", seed=3) as flight:
    flight.faults.lose_gps(after_s=20)
    await my_mission(flight.vehicle)
flight.track.assert_landed_near(within_m=3)
```

On virtual time (`run_virtual`, or the fixtures of the pytest plugin) a flight takes a fraction of a second.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from itertools import combinations
from typing import TYPE_CHECKING, Any, TypeVar, overload

import aerokit
from aerokit.errors import InvalidArgument
from aerokit.sim.kinds import simulated
from aerokit.sim.server import SimulatorServer
from aerokit.testing.clock import run_virtual
from aerokit.testing.faults import FaultInjector
from aerokit.testing.picture import save_picture
from aerokit.testing.stage import FlightRecording, FlightScheduler
from aerokit.testing.track import min_distance_m
from aerokit.transport import memory_link_pair

if TYPE_CHECKING:
    from os import PathLike

    from aerokit.sim.vehicle import SimulatedVehicle
    from aerokit.testing.journal import Journal
    from aerokit.testing.track import Track
    from aerokit.transport import Link

T = TypeVar("T")
_BOOT_TIME_S = 1.0


class Flight:
    """A simulated vehicle in a test. Faults can be scheduled before the flight, and the track remains afterwards."""

    def __init__(self, fleet: SimulatedFleet, number: int) -> None:
        self._fleet = fleet
        self.simulated: Any = fleet._vehicles[number]
        """The simulated vehicle, such as `aerokit.sim.SimulatedCopter`: battery, parameters, motion …"""
        self.track: Track = fleet._scheduler.tracks[number]
        """True track of the vehicle."""
        self.journal: Journal = fleet._scheduler.journals[number]
        """Status texts that the vehicle sent, and messages that it received."""
        self.faults: FaultInjector = FaultInjector(self.simulated, fleet._with_scheduler)
        """Injects faults."""
        self._vehicle: aerokit.Vehicle | None = None

    @property
    def vehicle(self) -> aerokit.Vehicle:
        """The program's vehicle, which is connected. Raises RuntimeError if the flight is not open."""
        if self._vehicle is None:
            self._fleet._check_open()
            raise RuntimeError(
                "the flight was opened with connect=False and has no vehicle; connect your program to flight.link"
            )
        return self._vehicle

    @property
    def recording(self) -> FlightRecording | None:
        """Recording of the link, which all vehicles of a fleet share. None without ``record=True``."""
        return self._fleet.recording

    @property
    def link(self) -> Link:
        """The program's end of the link, for a program that connects by itself. Needs ``connect=False``."""
        return self._fleet.link

    def run(self, main: Callable[[Flight], Awaitable[T]]) -> T:
        """Open the flight, run ``main(flight)`` on virtual time and close the flight. For tests without ``async``."""
        return self._fleet.run(lambda _: main(self))


class SimulatedFleet(Sequence[Flight]):
    """Simulated vehicles on one link, as a sequence of `Flight`. A fleet can be opened only once.

    The vehicles have the system ids 1, 2, 3 … and stand in a row to the east of ``home``, ``spacing_m`` metres apart.
    """

    def __init__(
        self,
        *kinds: str,
        connect: bool = True,
        latency_s: float = 0.0,
        spacing_m: float = 5.0,
        record: bool = False,
        **options: Any,
    ) -> None:
        options.setdefault("boot_time_s", _BOOT_TIME_S)
        self._vehicles = _create_vehicles(kinds, spacing_m, **options)
        self._scheduler = FlightScheduler(self._vehicles)
        self._connect = connect
        self._latency_s = latency_s
        self.recording: FlightRecording | None = FlightRecording() if record else None
        """Recording of the link; None without ``record=True``."""
        self._server: SimulatorServer | None = None  # None while the fleet is not open
        self._link: Link | None = None  # None while the fleet is not open
        self._was_opened = False
        self._flights = [Flight(self, number) for number in range(len(kinds))]

    def __len__(self) -> int:
        return len(self._flights)

    @overload
    def __getitem__(self, index: int) -> Flight: ...
    @overload
    def __getitem__(self, index: slice) -> list[Flight]: ...
    def __getitem__(self, index: int | slice) -> Flight | list[Flight]:
        return self._flights[index]

    @property
    def vehicles(self) -> list[aerokit.Vehicle]:
        """The connected `aerokit.Vehicle` of each flight."""
        return [flight.vehicle for flight in self._flights]

    @property
    def min_distance_m(self) -> float:
        """Minimum 3D distance between two vehicles during the flight, in metres. Infinite for a single vehicle."""
        closest_m, _, _ = self._closest_approach()
        return closest_m

    def assert_stayed_apart(self, distance_m: float) -> None:
        """Assert that the 3D distance between any two vehicles was never below ``distance_m``."""
        __tracebackhide__ = True
        closest_m, time_s, names = self._closest_approach()
        text = f"{names} came nearer than {distance_m:g} m: {closest_m:.1f} m at {time_s:.1f} s"
        assert closest_m >= distance_m, text

    def save(self, path: str | PathLike[str]) -> None:
        """Draw all tracks in one picture; see `aerokit.testing.picture.save_picture`."""
        save_picture([flight.track for flight in self], path)

    def _closest_approach(self) -> tuple[float, float, str]:
        """Return the minimum 3D distance between two vehicles in metres, the time, and the names of these vehicles."""
        closest = (math.inf, 0.0, "")
        for first, second in combinations(self, 2):
            distance_m, time_s = min_distance_m(first.track, second.track)
            closest = min(closest, (distance_m, time_s, f"{first.track.name} and {second.track.name}"))
        return closest

    @property
    def link(self) -> Link:
        """The program's end of the link, for a program that connects by itself. Needs ``connect=False``."""
        self._check_open()
        if self._connect:
            raise RuntimeError(
                "the flight itself uses this link; open the flight with connect=False to connect your program instead"
            )
        assert self._link is not None
        return self._link

    def run(self, main: Callable[[SimulatedFleet], Awaitable[T]]) -> T:
        """Open the fleet, run ``main(fleet)`` on virtual time and close the fleet. For tests without ``async``."""

        async def fly() -> T:
            async with self.open():
                return await main(self)

        return run_virtual(fly())

    @asynccontextmanager
    async def open(self) -> AsyncIterator[SimulatedFleet]:
        """Switch the vehicles on and connect. Tracks and journals remain after the block.

        Raises RuntimeError if the fleet was opened before.
        """
        if self._was_opened:
            raise RuntimeError("this flight or fleet was already opened, and can be opened only once; create a new one")
        self._was_opened = True
        near_end, far_end = memory_link_pair(latency_s=self._latency_s)
        async with AsyncExitStack() as stack:
            self._link = near_end
            self._server = await stack.enter_async_context(SimulatorServer([self._scheduler, *self._vehicles], far_end))
            if self.recording is not None:
                self.recording.attach(self._server)
            stack.callback(self._close)  # This runs before the server ends, so that the tracks get their last points.
            self._scheduler.refresh_with(self._refresh)
            if self._connect:
                await self._connect_all(near_end, stack)
            yield self

    async def _connect_all(self, link: Link, stack: AsyncExitStack) -> None:
        connection = await stack.enter_async_context(aerokit.open_connection(link))
        for flight in self._flights:
            flight._vehicle = await stack.enter_async_context(
                aerokit.connect(connection, system_id=flight.simulated.system_id)
            )

    def _close(self) -> None:
        try:
            self._refresh()
        finally:
            self._scheduler.refresh_with(None)
            self._server = None
            self._link = None
            for flight in self._flights:
                flight._vehicle = None

    def _refresh(self) -> None:
        if self._server is not None:
            self._server.wake()
            self._scheduler.record()

    def _check_open(self) -> None:
        if self._server is None:
            raise RuntimeError(
                "this flight is not open. The plugin opens a flight when an `async def` test begins. In a `def` test"
                " use flight.run(main), and in a fixture `async with open_flight()`"
            )

    def _with_scheduler(self, schedule: Callable[[FlightScheduler], None]) -> None:
        """Call ``schedule`` with the scheduler at the current time, and run events that are due."""
        self._refresh()
        schedule(self._scheduler)
        if self._server is not None:
            self._server.wake()


def _create_vehicles(
    kinds: Sequence[str], spacing_m: float, *, system_id: int = 1, seed: int = 0, **options: Any
) -> list[SimulatedVehicle]:
    """Create a vehicle of each kind, in a row eastwards from the home of the first."""
    vehicles: list[Any] = []
    for number, kind in enumerate(kinds):
        if vehicles:
            frame = vehicles[0].frame
            home = frame.to_global(0.0, number * spacing_m, 0.0)  # north, east, down
            options["home"] = home.latitude_e7 / 1e7, home.longitude_e7 / 1e7, frame.origin.altitude_m
        vehicles.append(simulated(kind, system_id=system_id + number, seed=seed + number, **options))
    return vehicles


@asynccontextmanager
async def open_flight(kind: str = "copter", **options: Any) -> AsyncIterator[Flight]:
    """Simulate a vehicle of a kind ("copter", "plane", "rover", "sub", "px4", "px4_plane") and connect to it.

    With ``connect=False``, the program connects to ``flight.link`` by itself. ``latency_s`` delays both directions of
    the link. ``record=True`` records the link for the report of a failed test. Other options are those of the simulated
    vehicle: ``seed``, ``home``, ``parameters``, ``battery_percent`` …

    Raises InvalidArgument for an unknown kind.
    """
    fleet = SimulatedFleet(kind, **options)
    async with fleet.open():
        yield fleet._flights[0]


def open_fleet(*kinds: str, count: int | None = None, **options: Any) -> AbstractAsyncContextManager[SimulatedFleet]:
    """Open vehicles of these kinds, or ``count`` of one kind, on one link. Options are those of `open_flight`.

    The vehicles stand in a row to the east of ``home``, ``spacing_m`` metres (by default 5) apart.
    """
    return SimulatedFleet(*expand_kinds(kinds, count), **options).open()


def expand_kinds(kinds: Sequence[str], count: int | None) -> Sequence[str]:
    """Return the kinds, or the single kind ``count`` times.

    Raises InvalidArgument for a ``count`` below 1, or with several kinds.
    """
    kinds = kinds or ("copter",)
    if count is None:
        return kinds
    if len(kinds) != 1:
        raise InvalidArgument(f"count = {count!r} is not allowed with {len(kinds)} kinds of vehicles, only with one")
    if count < 1:
        raise InvalidArgument(f"count = {count!r} is not allowed: it must be at least 1")
    return list(kinds) * count
