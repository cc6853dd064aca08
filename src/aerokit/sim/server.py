"""Simulated vehicles on links, in real time or faster, inside the running event loop."""

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
from aerokit.sim.channel import Channel, SharedHearing, datagrams
from aerokit.sim.vehicle import TICK_S, SimulatedVehicle
from aerokit.transport import Link, MemoryLink, Peer, TcpListen, create_link, memory_link_pair

_SHORTEST_WAIT_S = 0.001
"""Of the loop's time, for many vehicles or when they run faster than it: several ticks are then done in one go."""
_MANY = 10
_WAIT_OF_MANY_S = TICK_S
"""Simulated, for more than `_MANY` unless they are on virtual time: what falls into it goes out together."""
_INSTANT_S = 1e-8
"""What is due so soon on virtual time happens before anybody answers, as it does by a timer."""
_TURNS = 1
_LONGEST_LEAP_S = 0.5
"""Simulated; what the loop was late beyond that does not pass for the vehicles, unless they are to keep real time."""


class SimulatorServer:
    """Vehicles that live as long as an ``async with`` block; every vehicle is on every link.

    ``vehicles_on`` says for each link, in the order of the links, which vehicles are on it instead.

    It runs on the loop's own clock by timers alone: no task, no thread. ``speedup`` 10 makes ten simulated
    seconds of a real one. What the loop missed because something blocked it is caught up in real time. Otherwise all
    but half a simulated second of it is left out: a client that had no chance to speak is not taken for a silent one.
    Leaving the block closes the links.

    What a vehicle raises, by a mistake of its own or of somebody's callback, ends the block at once: the links
    are closed, the task that runs the block is cancelled, and the block raises it.

    Raises LinkOpenError when a link cannot be opened; nothing is left behind then.
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
            raise InvalidArgument(f"speedup = {speedup!r} must be above 0")
        self.vehicles: tuple[SimulatedVehicle] | tuple[SimulatedVehicle, ...] = (
            (vehicles,) if isinstance(vehicles, SimulatedVehicle) else tuple(vehicles)
        )
        self._links = (links,) if isinstance(links, Link) else tuple(links)
        self.vehicles_on: (
            list[tuple[SimulatedVehicle] | tuple[SimulatedVehicle, ...]] | list[Sequence[SimulatedVehicle]]
        ) = [self.vehicles] * len(self._links) if vehicles_on is None else list(vehicles_on)
        if len(self.vehicles_on) != len(self._links):
            raise InvalidArgument(f"vehicles_on is for {len(self.vehicles_on)} links of {len(self._links)}")
        self._speedup = speedup
        self._dues = [0.0] * len(self.vehicles)  # when each vehicle has something to do
        self._numbers = {id(vehicle): number for number, vehicle in enumerate(self.vehicles)}
        self._shortest_wait_s = _SHORTEST_WAIT_S if speedup != 1.0 or len(self.vehicles) > _MANY else 0.0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._jump: Callable[[float], bool] | None = None  # of a loop on virtual time
        self._started_at = 0.0
        self._now_at_start = max((vehicle.now for vehicle in self.vehicles), default=0.0)
        self._ports: list[_Port] = []
        self._timer: asyncio.TimerHandle | None = None
        self._timer_due = self._timer_at = 0.0
        self._exit = AsyncExitStack()
        self._owner: asyncio.Task[Any] | None = None  # runs the block; a fixture's may have ended before
        self._cancels_owner = False
        self.on_datagram: Callable[[float, bytes, bool], object] | None = None
        """Called with all that comes in and goes out: the simulated second, the bytes, whether a vehicle sent them."""
        self.failure: Exception | None = None
        """What a vehicle raised; nothing has happened since."""

    @property
    def addresses(self) -> tuple[str, ...]:
        """The addresses of its links, as they are once they are open."""
        return tuple(link.address for link in self._links)

    @property
    def now(self) -> float:
        """Simulated seconds."""
        if self._loop is None:
            return self._now_at_start
        return self._now_at_start + (self._loop.time() - self._started_at) * self._speedup

    async def __aenter__(self) -> Self:
        if self._loop is not None:
            raise BusyError("this SimulatorServer was started before")
        self._loop, self._owner = asyncio.get_running_loop(), asyncio.current_task()
        self._jump = getattr(self._loop, "jump", None)
        if self._jump is None and len(self.vehicles) > _MANY:
            self._shortest_wait_s = max(_SHORTEST_WAIT_S, _WAIT_OF_MANY_S / self._speedup)
        self._started_at = self._loop.time()
        try:
            async with AsyncExitStack() as opening:
                await self._open_links(opening)
                self._run(self.now)
                self._exit = opening.pop_all()
        except BaseException as error:
            self._end(error)
            raise
        return self

    async def _open_links(self, opening: AsyncExitStack) -> None:
        connected: set[int] = set()
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
        """Raise what a vehicle raised in the place of what it caused."""
        self._stop()
        owner, self._owner = self._owner, None
        if self._cancels_owner and owner is not None and owner is asyncio.current_task():
            _take_cancellation_back(owner)
        if self.failure is not None and self.failure is not error:
            raise self.failure from self.failure.__cause__

    def wake(self) -> None:
        """Let everything happen that is due; call it after a fault or a value was changed by hand.

        Raises what a vehicle raises, now or before.
        """
        if self.failure is not None:
            raise self.failure
        if self._loop is None:
            return
        self._leave_out_lateness()
        try:
            self._dues = [vehicle.next_due for vehicle in self.vehicles]
            self._run(self.now)
        except Exception as error:
            self._fail(error)
            raise

    def _on_timer(self) -> None:
        self._leave_out_lateness()
        self._timer = None
        try:
            self._run_on(max(self.now, self._timer_due))  # a timer may fire a hair early
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Whoever waits for a vehicle is told at once; on the loop's own stack nobody would hear of it."""
        self.failure = error
        self._stop()
        for link in self._links:
            link.close()
        owner = self._owner
        if owner is not None and not owner.done() and owner is not asyncio.current_task():
            self._cancels_owner = owner.cancel()

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop = None
        self._ports.clear()

    def _run(self, now: float) -> None:
        self._step(now)
        self._flush()
        self._schedule()

    def _run_on(self, now: float) -> None:
        """The same, and on virtual time also what comes next, as long as nothing else happens in between."""
        self._step(now)
        while not self._flush():
            if (due := self._leap()) is None:
                self._schedule()
                return
            self._step(due)
        loop = self._loop
        if self._jump is None or loop is None or self._when(min(self._dues)) < loop.time() + _INSTANT_S:
            self._schedule()
        else:  # after those who hear what was sent: they may have nothing to say to it
            loop.call_soon(self._go_on, _TURNS)

    def _go_on(self, turns: int) -> None:
        """On virtual time, in place of a timer; who was woken by what was sent gets so many turns before."""
        loop = self._loop
        if loop is None:
            return
        try:
            if (due := self._leap()) is not None:
                self._run_on(due)
            elif turns and self._timer is None:
                loop.call_soon(self._go_on, turns - 1)
            else:
                self._schedule()
        except Exception as error:
            self._fail(error)

    def _leap(self) -> float | None:
        """On virtual time: go to what is due next, unless something else comes before; when that is."""
        due = min(self._dues)
        if self._jump is None or due == math.inf or not self._jump(self._when(due)):
            return None
        return max(self.now, due)

    def _step(self, now: float) -> None:
        dues = self._dues
        for number, due in enumerate(dues):
            if due <= now:
                vehicle = self.vehicles[number]
                vehicle.step(now)
                dues[number] = vehicle.next_due

    def hear(self, data: bytes, peer: Peer, port: _Port) -> None:
        """Bytes came in on a link."""
        if self._loop is None:
            return
        self._leave_out_lateness()
        now = self.now
        if self.on_datagram is not None:
            self.on_datagram(now, data, False)
        try:
            for vehicle, channel in zip(port.vehicles, port.channels, strict=True):
                vehicle.receive(data, max(now, vehicle.now), peer, channel)
                self._dues[self._numbers[id(vehicle)]] = vehicle.next_due
            port.hearing.forget()
            self._flush()
            self._schedule()
        except Exception as error:
            self._fail(error)

    def _flush(self) -> bool:
        """Send what is to be sent; whether there was something."""
        has_sent = False
        for port in self._ports:
            for datagram in port.take_datagrams(together=self._jump is None):
                has_sent = True
                port.link.write(datagram)
                if self.on_datagram is not None:
                    self.on_datagram(self.now, datagram, True)
            port.hang_up()
        return has_sent

    def _schedule(self) -> None:
        loop = self._loop
        due = min(self._dues, default=math.inf)
        if loop is None or due == math.inf:
            return
        if self._timer is not None:
            if self._timer_due == due:
                return
            self._timer.cancel()
        when = self._when(due)
        if self._shortest_wait_s:
            when = max(when, loop.time() + self._shortest_wait_s)
        self._timer_due, self._timer_at = due, when
        self._timer = loop.call_at(when, self._on_timer)

    def _leave_out_lateness(self) -> None:
        """The timer should have come before now; in real time nothing is left out."""
        if self._loop is None or self._timer is None or self._speedup == 1.0:
            return
        late = self._loop.time() - self._timer_at - _LONGEST_LEAP_S / self._speedup
        if late > 0:
            self._started_at += late
            self._timer_at += late

    def _when(self, due: float) -> float:
        """By the loop's clock."""
        return self._started_at + (due - self._now_at_start) / self._speedup


class _Port:
    """One link, the vehicles on it, and their channels there."""

    def __init__(
        self,
        server: SimulatorServer,
        link: Link,
        vehicles: Sequence[SimulatedVehicle],
        channels: Sequence[Channel],
    ) -> None:
        self._server = server
        self.link = link
        self.vehicles: Sequence[SimulatedVehicle] = vehicles
        self.channels: Sequence[Channel] = channels
        self.hearing: SharedHearing = SharedHearing()
        if len(channels) > 1:
            for channel in channels:
                channel.hearing = self.hearing

    def take_datagrams(self, *, together: bool) -> list[bytes]:
        """What is to be sent; of many vehicles ``together``, whose frames then share datagrams as behind a router."""
        speaking = [channel for channel in self.channels if channel.has_output]
        if together and len(self.channels) > _MANY:
            return datagrams(piece for channel in speaking for piece in channel.take_pieces())
        return [datagram for channel in speaking for datagram in channel.take_datagrams()]

    def hang_up(self) -> None:
        """Cut off the clients of a TCP port whose only vehicle reboots."""
        if len(self.channels) == 1 and self.channels[0].hangs_up:
            self.channels[0].hangs_up = False
            if isinstance(self.link, TcpListen):
                self.link.close_clients()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """See `Receiver`."""
        self._server.hear(data, peer, self)

    def link_lost(self, error: LinkLost) -> None:
        """The client has gone; the vehicles fly on, as vehicles do."""

    async def close(self) -> None:
        """Close the link and wait until it is gone."""
        self.link.close()
        await self.link.wait_closed()


def _take_cancellation_back(task: asyncio.Task[Any]) -> None:
    if sys.version_info >= (3, 11):
        task.uncancel()


def _channels(vehicles: Iterable[SimulatedVehicle], connected: set[int]) -> list[Channel]:
    """A channel of each vehicle: its first one on the first of its links, a new one on every other."""
    channels = []
    for vehicle in vehicles:
        is_first = id(vehicle) not in connected
        connected.add(id(vehicle))
        channels.append(vehicle.channels[0] if is_first else vehicle.open_channel())
    return channels


@asynccontextmanager
async def simulated_link(
    vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *, speedup: float = 1.0, latency_s: float = 0.0
) -> AsyncIterator[MemoryLink]:
    """Vehicles in memory: gives the client's end of the link, to be opened by the caller.

    ``latency_s`` seconds, by the loop's clock, pass between sending and receiving in both directions.
    """
    near, far = memory_link_pair(latency_s=latency_s)
    async with SimulatorServer(vehicles, far, speedup=speedup):
        yield near


@asynccontextmanager
async def open_simulator(
    vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *addresses: str, speedup: float = 1.0
) -> AsyncIterator[SimulatorServer]:
    """Serve vehicles on addresses ("tcpin:0.0.0.0:5760", "udpout:127.0.0.1:14550") for other programs.

    Raises InvalidArgument for a wrong address, LinkOpenError for one that cannot be opened.
    """
    links = [create_link(address) for address in addresses]
    async with SimulatorServer(vehicles, links, speedup=speedup) as server:
        yield server
