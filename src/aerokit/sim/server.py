"""Simulated vehicles on links, in real time or faster, inside the running event loop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from types import TracebackType
from typing import TYPE_CHECKING

from aerokit.errors import BusyError, LinkLost, LocalProtocolError
from aerokit.links import Link, MemoryLink, Peer, create_link, memory_link_pair
from aerokit.sim.vehicle import SimulatedVehicle

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.sim.channel import Channel

__all__ = ["SimulatorServer", "open_simulator", "simulated_link"]

_SHORTEST_WAIT_S = 0.001
"""Of the loop's time, for many vehicles or when they run faster than it: several ticks are then done in one go."""
_MANY = 10
_LONGEST_LATENESS_S = 0.25
"""Of the loop's time; faster than real time, what it was late beyond that does not pass for the vehicles."""


class SimulatorServer:
    """Vehicles that live as long as an ``async with`` block; every vehicle is on every link.

    ``vehicles_on`` says for each link, in the order of the links, which vehicles are on it instead.

    It runs on the loop's own clock by timers alone: no task, no thread. ``speedup`` 10 makes ten simulated
    seconds of a real one. What the loop missed because something blocked it is caught up in real time. Faster, all
    but a quarter of a second of it is left out: a client that had no chance to speak is not taken for a silent one.
    Leaving the block closes the links.

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
            raise LocalProtocolError(f"speedup = {speedup!r} must be above 0")
        self.vehicles = (vehicles,) if isinstance(vehicles, SimulatedVehicle) else tuple(vehicles)
        self._links = (links,) if isinstance(links, Link) else tuple(links)
        self.vehicles_on = [self.vehicles] * len(self._links) if vehicles_on is None else list(vehicles_on)
        if len(self.vehicles_on) != len(self._links):
            raise LocalProtocolError(
                f"vehicles_on is for {len(self.vehicles_on)} links of {len(self._links)}"
            )
        self._speedup = speedup
        self._dues = [0.0] * len(self.vehicles)  # when each vehicle has something to do
        self._numbers = {id(vehicle): number for number, vehicle in enumerate(self.vehicles)}
        self._shortest_wait_s = _SHORTEST_WAIT_S if speedup != 1.0 or len(self.vehicles) > _MANY else 0.0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._started_at = 0.0
        self._now_at_start = max((vehicle.now for vehicle in self.vehicles), default=0.0)
        self._ports: list[_Port] = []
        self._timer: asyncio.TimerHandle | None = None
        self._timer_due = self._timer_at = 0.0
        self._exit = AsyncExitStack()

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
        self._loop = asyncio.get_running_loop()
        self._started_at = self._loop.time()
        async with AsyncExitStack() as opening:
            connected: set[int] = set()
            for link, vehicles in zip(self._links, self.vehicles_on, strict=True):
                port = _Port(self, link, vehicles, _channels(vehicles, connected))
                opening.push_async_callback(port.close)
                await link.open(port)
                self._ports.append(port)
            self._exit = opening.pop_all()
        self._run(self.now)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        self._loop = None
        self._ports.clear()
        await self._exit.aclose()

    # -------------------------------------------------------------------------------------- running

    def wake(self) -> None:
        """Let everything happen that is due; call it after a fault or a value was changed by hand."""
        if self._loop is not None:
            self._leave_out_lateness()
            self._dues = [vehicle.next_due for vehicle in self.vehicles]
            self._run(self.now)

    def _on_timer(self) -> None:
        self._leave_out_lateness()
        self._timer = None
        self._run(max(self.now, self._timer_due))  # a timer may fire a hair early

    def _run(self, now: float) -> None:
        self._step(now)
        self._flush()
        self._schedule()

    def _step(self, now: float) -> None:
        for number, due in enumerate(self._dues):
            if due <= now:
                vehicle = self.vehicles[number]
                vehicle.step(now)
                self._dues[number] = vehicle.next_due

    def hear(self, data: bytes, peer: Peer, port: _Port) -> None:
        """Bytes came in on a link."""
        if self._loop is None:
            return
        self._leave_out_lateness()
        now = self.now
        for vehicle, channel in zip(port.vehicles, port.channels, strict=True):
            vehicle.receive(data, max(now, vehicle.now), peer, channel)
            self._dues[self._numbers[id(vehicle)]] = vehicle.next_due
        self._flush()
        self._schedule()

    def _flush(self) -> None:
        for port in self._ports:
            for channel in port.channels:
                if channel.has_output:
                    for datagram in channel.take_datagrams():
                        port.link.write(datagram)

    def _schedule(self) -> None:
        loop = self._loop
        due = min(self._dues, default=float("inf"))
        if loop is None or due == float("inf"):
            return
        if self._timer is not None:
            if self._timer_due == due:
                return
            self._timer.cancel()
        when = self._started_at + (due - self._now_at_start) / self._speedup
        if self._shortest_wait_s:
            when = max(when, loop.time() + self._shortest_wait_s)
        self._timer_due, self._timer_at = due, when
        self._timer = loop.call_at(when, self._on_timer)

    def _leave_out_lateness(self) -> None:
        """The timer should have come before now; in real time nothing is left out."""
        if self._loop is None or self._timer is None or self._speedup == 1.0:
            return
        late = self._loop.time() - self._timer_at - _LONGEST_LATENESS_S
        if late > 0:
            self._started_at += late
            self._timer_at += late


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
        self.vehicles, self.channels = vehicles, channels

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """See `Receiver`."""
        self._server.hear(data, peer, self)

    def link_lost(self, error: LinkLost) -> None:
        """The client has gone; the vehicles fly on, as vehicles do."""

    async def close(self) -> None:
        """Close the link and wait until it is gone."""
        self.link.close()
        await self.link.wait_closed()


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

    Raises LocalProtocolError for a wrong address, LinkOpenError for one that cannot be opened.
    """
    links = [create_link(address) for address in addresses]
    async with SimulatorServer(vehicles, links, speedup=speedup) as server:
        yield server
