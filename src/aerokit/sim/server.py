"""Serves simulated vehicles on links, in real time or faster, inside the running event loop."""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from types import TracebackType
from typing import Any

from typing_extensions import Self

from aerokit.errors import BusyError, InvalidArgument, LinkLost
from aerokit.sim.channel import Channel, SharedMessageReader, datagrams
from aerokit.sim.vehicle import TICK_S, SimulatedVehicle
from aerokit.transport import Link, MemoryLink, Peer, TcpListen, create_link, memory_link_pair

# With a speedup, or with more than `_BATCH_THRESHOLD` vehicles, a timer waits at least this many seconds of loop time.
# One callback then runs several ticks.
_MIN_BATCH_WAIT_S = 0.001
_BATCH_THRESHOLD = 10
# With more than `_BATCH_THRESHOLD` vehicles, the output of `_BATCH_INTERVAL_S` simulated seconds is sent together.
_BATCH_INTERVAL_S = TICK_S
# With a speedup, at most this many simulated seconds are made up for after the event loop was blocked.
_MAX_CATCH_UP_S = 0.5


class SimulatorServer:
    """Serves vehicles on links while its ``async with`` block runs. Leaving the block closes the links.

    Every vehicle is on every link, unless ``vehicles_on`` lists the vehicles of each link.

    The server uses timers of the event loop, without tasks or threads. ``speedup`` 10 simulates ten seconds per
    second. After the loop was blocked, the server simulates the missed time. With a ``speedup`` other than 1, the
    server simulates at most half a second of it and skips the rest, because the vehicles would take a longer time
    without heartbeats for a loss of the link.

    An exception in a vehicle or a callback closes the links and cancels the task that runs the block. The block then
    raises the exception.

    Raises LinkOpenError if a link cannot be opened. The other links are then closed again.
    """

    def __init__(
        self,
        vehicles: SimulatedVehicle | Iterable[SimulatedVehicle],
        links: Link | Iterable[Link],
        *,
        speedup: float = 1.0,
        vehicles_on: Sequence[Sequence[SimulatedVehicle]] | None = None,
    ) -> None:
        if not speedup > 0:
            raise InvalidArgument(f"speedup = {speedup!r} is not allowed: it must be above 0")
        self.vehicles: tuple[SimulatedVehicle, ...] = (
            (vehicles,) if isinstance(vehicles, SimulatedVehicle) else tuple(vehicles)
        )
        self._links = (links,) if isinstance(links, Link) else tuple(links)
        on_all: Sequence[Sequence[SimulatedVehicle]] = [self.vehicles] * len(self._links)
        self.vehicles_on: list[Sequence[SimulatedVehicle]] = list(on_all if vehicles_on is None else vehicles_on)
        if len(self.vehicles_on) != len(self._links):
            raise InvalidArgument(
                f"vehicles_on has {len(self.vehicles_on)} entries for {len(self._links)} links;"
                " pass one entry for each link"
            )
        self._speedup = speedup
        self._dues = [0.0] * len(self.vehicles)  # simulated time of each vehicle's next event
        # Index of each vehicle in `vehicles` and `_dues`, by `id`.
        self._numbers = {id(vehicle): number for number, vehicle in enumerate(self.vehicles)}
        runs_several_ticks_at_once = speedup != 1.0 or len(self.vehicles) > _BATCH_THRESHOLD
        self._min_wait_s = _MIN_BATCH_WAIT_S if runs_several_ticks_at_once else 0.0
        self._loop: asyncio.AbstractEventLoop | None = None  # None before the `async with` block
        # Removes the event source that replaces the timers on a `VirtualClockLoop`; None on any other loop.
        self._remove_source: Callable[[], None] | None = None
        self._started_at = 0.0  # loop time at the start
        self._now_at_start = max((vehicle.now for vehicle in self.vehicles), default=0.0)  # simulated time at the start
        self._ports: list[_Port] = []
        self._timer: asyncio.TimerHandle | None = None  # None while no event is scheduled
        self._timer_due = 0.0  # simulated time of the event that the timer is for
        self._timer_at = 0.0  # loop time at which the timer fires
        self._exit = AsyncExitStack()  # closes the links at the end of the block
        # The task that entered the `async with` block. A failing vehicle cancels this task.
        self._block_task: asyncio.Task[Any] | None = None
        self._has_cancelled_block = False  # True if `_fail` has cancelled `_block_task`
        self.on_datagram: Callable[[float, bytes, bool], object] | None = None
        """Called with every datagram: simulated time, bytes, and True if a vehicle has sent the datagram."""
        self.failure: Exception | None = None
        """Exception of a vehicle that has stopped the simulation; None if there was none."""

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses of the links. While the links are open, the addresses contain the actual port numbers."""
        return tuple(link.address for link in self._links)

    @property
    def now(self) -> float:
        """Simulated seconds."""
        if self._loop is None:
            return self._now_at_start
        return self._now_at_start + (self._loop.time() - self._started_at) * self._speedup

    async def __aenter__(self) -> Self:
        """Open the links and process the events that are already due. If either fails, close the links again."""
        if self._loop is not None:
            raise BusyError("this SimulatorServer was already started once; create a new SimulatorServer")
        self._loop = asyncio.get_running_loop()
        self._block_task = asyncio.current_task()
        add_source = getattr(self._loop, "add_event_source", None)  # None unless the loop is a `VirtualClockLoop`
        if add_source is None and len(self.vehicles) > _BATCH_THRESHOLD:
            self._min_wait_s = max(_MIN_BATCH_WAIT_S, _BATCH_INTERVAL_S / self._speedup)
        self._started_at = self._loop.time()
        try:
            async with AsyncExitStack() as opening:
                await self._open_links(opening)
                if add_source is not None:
                    self._remove_source = add_source(self._next_loop_time, self._on_due)
                self._run(self.now)
                self._exit = opening.pop_all()  # keeps the links open until `__aexit__`
        except BaseException as error:
            self._end(error)
            raise
        return self

    async def _open_links(self, opening: AsyncExitStack) -> None:
        connected: set[int] = set()  # `id` of each vehicle whose first channel is in use; filled by `_channels`
        for link, vehicles in zip(self._links, self.vehicles_on, strict=True):
            port = _Port(self, link, vehicles, _channels(vehicles, connected))
            opening.push_async_callback(port.close)
            await link.open(port)
            self._ports.append(port)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stop()
        await self._exit.aclose()
        self._end(error)

    def _end(self, error: BaseException | None) -> None:
        """Stop, and raise the failure of a vehicle, if there is one."""
        self._stop()
        task = self._block_task
        self._block_task = None
        is_in_block = task is not None and task is asyncio.current_task()
        if sys.version_info >= (3, 11) and self._has_cancelled_block and is_in_block:
            task.uncancel()
        if self.failure is not None and self.failure is not error:
            raise self.failure  # Python makes `error` the context of this exception.

    def wake(self) -> None:
        """Run all events that are due. Call this method after a change of a fault or of a value of a vehicle.

        Raises the error of a failed vehicle, even if the vehicle failed earlier.
        """
        if self.failure is not None:
            raise self.failure
        if self._loop is None:
            return
        self._skip_lateness()
        try:
            self._dues = [vehicle.next_due for vehicle in self.vehicles]
            self._run(self.now)
        except Exception as error:
            self._fail(error)
            raise

    def _on_due(self) -> None:
        self._skip_lateness()
        self._timer = None
        try:
            self._run(max(self.now, min(self._dues)))  # A timer may fire slightly early.
        except Exception as error:
            self._fail(error)

    def _next_loop_time(self) -> float:
        return self._loop_time(min(self._dues, default=math.inf))

    def _fail(self, error: Exception) -> None:
        self.failure = error
        self._stop()
        for link in self._links:
            link.close()
        task = self._block_task
        if task is None or task.done():  # The task of a pytest fixture may end before the block ends.
            return
        if task is not asyncio.current_task():  # In a callback, asyncio would only log the exception.
            self._has_cancelled_block = task.cancel()

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._remove_source is not None:
            self._remove_source()
        self._timer = self._loop = None
        self._ports.clear()

    def _run(self, now: float) -> None:
        self._step(now)
        self._flush()
        self._schedule()

    def _step(self, now: float) -> None:
        dues = self._dues
        for number, due in enumerate(dues):
            if due <= now:
                vehicle = self.vehicles[number]
                vehicle.step(now)
                dues[number] = vehicle.next_due

    def on_bytes(self, data: bytes, peer: Peer, port: _Port) -> None:
        """Pass bytes of a link to its vehicles."""
        if self._loop is None:
            return
        self._skip_lateness()
        now = self.now
        try:
            if self.on_datagram is not None:
                is_from_vehicle = False
                self.on_datagram(now, data, is_from_vehicle)
            for vehicle, channel in zip(port.vehicles, port.channels, strict=True):
                # `vehicle.now` is later than `now` if a timer fired early or another vehicle has advanced this one.
                vehicle.receive(data, max(now, vehicle.now), peer, channel)
                self._dues[self._numbers[id(vehicle)]] = vehicle.next_due
            port.reader.forget()  # All vehicles have used the decoded messages.
            self._flush()
            self._schedule()
        except Exception as error:
            self._fail(error)

    def _flush(self) -> None:
        # On the real clock, the frames of many vehicles share datagrams, so that fewer are sent. On virtual time, each
        # vehicle sends its own datagrams.
        is_real_time = self._remove_source is None
        for port in self._ports:
            for datagram in port.take_datagrams(together=is_real_time):
                port.link.write(datagram)
                if self.on_datagram is not None:
                    is_from_vehicle = True
                    self.on_datagram(self.now, datagram, is_from_vehicle)
            port.disconnect_clients()

    def _schedule(self) -> None:
        """Set the timer to the next event of all vehicles."""
        loop = self._loop
        if loop is None or self._remove_source is not None:  # An event source needs no timer.
            return
        due = min(self._dues, default=math.inf)
        if due == math.inf:
            return
        if self._timer is not None:
            if self._timer_due == due:  # The timer is already set to this time.
                return
            self._timer.cancel()
        when = self._loop_time(due)
        if self._min_wait_s:
            when = max(when, loop.time() + self._min_wait_s)
        self._timer_due = due
        self._timer_at = when
        self._timer = loop.call_at(when, self._on_due)

    def _skip_lateness(self) -> None:
        """Skip simulated time if the computer is too slow for the speedup, so that the lateness does not grow."""
        has_nothing_scheduled = self._timer is None and self._remove_source is None
        if self._loop is None or self._speedup == 1.0 or has_nothing_scheduled:
            return
        due_at = self._next_loop_time() if self._timer is None else self._timer_at
        late_s, max_late_s = self._loop.time() - due_at, _MAX_CATCH_UP_S / self._speedup
        skipped_s = late_s - max_late_s
        if skipped_s > 0:  # `now` counts from `_started_at`, so a later start skips time.
            self._started_at += skipped_s
            self._timer_at += skipped_s

    def _loop_time(self, due: float) -> float:
        return self._started_at + (due - self._now_at_start) / self._speedup


class _Port:
    """A link with its vehicles and their channels."""

    def __init__(
        self, server: SimulatorServer, link: Link, vehicles: Sequence[SimulatedVehicle], channels: Sequence[Channel]
    ) -> None:
        self._server = server
        self.link = link
        self.vehicles: Sequence[SimulatedVehicle] = vehicles
        self.channels: Sequence[Channel] = channels
        self.reader: SharedMessageReader = SharedMessageReader()
        if len(channels) > 1:
            for channel in channels:
                channel.reader = self.reader

    def take_datagrams(self, *, together: bool) -> list[bytes]:
        """Return the datagrams to send. With ``together``, several vehicles of a fleet may share a datagram."""
        outputs = [channel.take_pieces() for channel in self.channels if channel.outbox]
        is_fleet = len(self.channels) > _BATCH_THRESHOLD
        if together and is_fleet:
            outputs = [[piece for pieces in outputs for piece in pieces]]
        return [datagram for pieces in outputs for datagram in datagrams(pieces)]

    def disconnect_clients(self) -> None:
        """Disconnect the clients of a TCP port whose only vehicle reboots."""
        if len(self.channels) != 1:
            return
        (channel,) = self.channels
        if channel.closes_clients:
            channel.closes_clients = False
            if isinstance(self.link, TcpListen):
                self.link.close_clients()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self._server.on_bytes(data, peer, self)

    def link_lost(self, error: LinkLost) -> None:
        """Do nothing, because the vehicles continue to fly without a client."""

    async def close(self) -> None:
        self.link.close()
        await self.link.wait_closed()


def _channels(vehicles: Iterable[SimulatedVehicle], connected: set[int]) -> list[Channel]:
    """Return one channel of each vehicle for a link."""
    channels = []
    for vehicle in vehicles:
        is_first = id(vehicle) not in connected
        connected.add(id(vehicle))
        # A vehicle opens another channel for each further link.
        channels.append(vehicle.channels[0] if is_first else vehicle.open_channel())
    return channels


@asynccontextmanager
async def simulated_link(
    vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *, speedup: float = 1.0, latency_s: float = 0.0
) -> AsyncIterator[MemoryLink]:
    """Simulate vehicles in memory, and yield the client's end of the link. The caller opens this end.

    ``latency_s`` delays both directions, in seconds of the loop's clock.
    """
    near_end, far_end = memory_link_pair(latency_s=latency_s)
    async with SimulatorServer(vehicles, far_end, speedup=speedup):
        yield near_end


@asynccontextmanager
async def open_simulator(
    vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *addresses: str, speedup: float = 1.0
) -> AsyncIterator[SimulatorServer]:
    """Serve vehicles on addresses, such as "tcpin:0.0.0.0:5760" or "udpout:127.0.0.1:14550", for other programs.

    Raises InvalidArgument for an invalid address, LinkOpenError if an address cannot be opened.
    """
    links = [create_link(address) for address in addresses]
    async with SimulatorServer(vehicles, links, speedup=speedup) as server:
        yield server
