"""A hub between a program and a vehicle, with disturbances on either side."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import Literal

from disturbed_link import Disturbances, DisturbedLink, Silence, TrafficEntry, TrafficLog
from disturbed_link_pair import DisturbedLinkPair, TwoLinks, joined, unopened_paths
from stream_splitter import Splitter

import aerokit
from aerokit.connection.routes import ROUTE_TIMEOUT_S
from aerokit.errors import LinkLost
from aerokit.hub import Endpoint, Hub
from aerokit.hub.running_endpoint import RunningEndpoint
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedVehicle, SimulatorServer
from aerokit.transport import Link, memory_link_pair

Side = Literal["vehicle", "program"]
Ways = Literal["one", "vehicle twice", "program twice", "program copied"]
FULL = 1 << 20
"""Number of unsent bytes that exceeds the queue limit of every link of a hub."""


NEVER = Silence(0.0, 0.0)


@dataclass(frozen=True)
class ThroughHub:
    """Disturbances of the hub. Times are (begin, end), in seconds since the order was given.

    ``side`` is the disturbed side of the hub. Its endpoint accepts no data during ``jam`` and is closed during
    ``away``. ``ways`` selects the paths through the hub:

    - "one": one endpoint on each side.
    - "vehicle twice": the vehicle is reachable over two endpoints. The first one fails during ``silence``.
    - "program twice": the program has two links to the hub. The selected one fails during ``silence``.
    - "program copied": a router copies the program's traffic to two endpoints.
    """

    side: Side
    ways: Ways = "one"
    jam: tuple[float, float] | None = None
    away: tuple[float, float] | None = None
    silence: Silence = NEVER

    @property
    def quiet_until(self) -> float:
        """Time at which the program and the vehicle can reach each other again."""
        ends = [pair[1] for pair in (self.jam, self.away) if pair is not None]
        rerouted = min(self.silence.end_s, self.silence.begin_s + ROUTE_TIMEOUT_S + 1.0)
        return max([0.0, *ends, rerouted if "twice" in self.ways else 0.0])


@dataclass
class HubSideLink(DisturbedLink):
    """The hub's end of a link."""

    jam: tuple[float, float] | None = None
    away: tuple[float, float] | None = None
    disturbances: Disturbances = field(default_factory=lambda: Disturbances(latency_s=0.0))

    def begin(self) -> None:
        super().begin()
        if self.away is not None:
            loop, (begin, end) = asyncio.get_running_loop(), self.away
            loop.call_later(begin, self._endpoint.link_interrupted, LinkLost("the cable was unplugged"))
            loop.call_later(end, self._endpoint.link_restored, end - begin)

    @property
    def unsent_bytes(self) -> int:
        return FULL if self._is_now(self.jam) else 0

    @property
    def _endpoint(self) -> RunningEndpoint:
        assert isinstance(self._receiver, RunningEndpoint)
        return self._receiver

    def _is_now(self, when: tuple[float, float] | None) -> bool:
        since = asyncio.get_running_loop().time() - self.began_at
        return when is not None and when[0] <= since < when[1]

    def _is_out(self, *, is_up: bool) -> bool:
        return self._is_now(self.away) or super()._is_out(is_up=is_up)

    def _arrive(self, raw: bytes, message: Message) -> None:
        if not self._is_now(self.away):
            super()._arrive(raw, message)


class DisturbedHubPath:
    """A disturbed path through a hub.

    ``sent`` and ``heartbeats`` are the traffic of the program, ``at_vehicle`` the traffic between hub and vehicle over
    all endpoints.
    """

    def __init__(self, near: DisturbedLink | DisturbedLinkPair, through: ThroughHub) -> None:
        self.near, self._through = near, through
        self.at_vehicle = TrafficLog()
        self.vehicles_ends: list[HubSideLink] = []
        self.programs_ends: list[HubSideLink] = []
        self._disturbances = Disturbances()

    @property
    def disturbances(self) -> Disturbances:
        return self._disturbances

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances) -> None:
        self._disturbances = disturbances
        if self._through.side == "program":
            self.near.disturbances = disturbances
            return
        for vehicle_end in self.vehicles_ends:
            vehicle_end.disturbances = disturbances

    def begin(self) -> None:
        """Start the disturbances; call it when the order is given."""
        ends = self.vehicles_ends if self._through.side == "vehicle" else self.programs_ends
        ends[0].jam, ends[0].away = self._through.jam, self._through.away
        if self._through.ways == "vehicle twice":
            self.vehicles_ends[0].silence = self._through.silence
        for end in (self.near, *self.vehicles_ends, *self.programs_ends):
            end.begin()

    def end(self) -> None:
        """Mark messages of the program as lost if they never reached the vehicle."""
        arrived = {message.raw for message in self.at_vehicle.sent if not message.is_lost}
        for message in self.sent:
            message.is_lost |= message.raw not in arrived

    @property
    def sent(self) -> list[TrafficEntry]:
        return self.near.sent

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        return self.near.heartbeats


@asynccontextmanager
async def through_hub(
    vehicle: SimulatedVehicle, through: ThroughHub
) -> AsyncIterator[tuple[DisturbedHubPath, Link | aerokit.Connection]]:
    """Open a path from the program to simulated vehicles through a hub, with a record of the traffic."""
    async with AsyncExitStack() as stack:
        near, fars = await _programs_side(stack, through)
        path = DisturbedHubPath(near, through)
        path.programs_ends = [HubSideLink(far_end) for far_end in fars]
        path.vehicles_ends = await _vehicles_side(stack, vehicle, through, path.at_vehicle)
        ends = {"vehicle": path.vehicles_ends, "program": path.programs_ends}
        named = [
            Endpoint(end, name=f"{name} {number}")
            for name, those in ends.items()
            for number, end in enumerate(those, 1)
        ]
        await stack.enter_async_context(Hub(named))
        yield path, near if isinstance(near, DisturbedLink) else await stack.enter_async_context(joined(near))
        path.end()


async def _programs_side(
    stack: AsyncExitStack, through: ThroughHub
) -> tuple[DisturbedLink | DisturbedLinkPair, list[Link]]:
    """Create the links between the program and the hub."""
    pairs = [memory_link_pair() for _ in range(1 if through.ways in ("one", "vehicle twice") else 2)]
    fars: list[Link] = [far for _, far in pairs]
    if through.ways == "program copied":
        splitter = Splitter([near for near, _ in pairs])
        await splitter.open(stack)
        return DisturbedLink(splitter.port), fars
    if through.ways == "program twice":
        return unopened_paths([near for near, _ in pairs], TwoLinks(through.silence)), fars
    return DisturbedLink(pairs[0][0]), fars


async def _vehicles_side(
    stack: AsyncExitStack, vehicle: SimulatedVehicle, through: ThroughHub, traffic_log: TrafficLog
) -> list[HubSideLink]:
    """Create the links between the hub and the vehicles."""
    pairs = [memory_link_pair() for _ in range(2 if through.ways == "vehicle twice" else 1)]
    ports: list[Link] = [far for _, far in pairs]
    if len(pairs) > 1:
        splitter = Splitter([far for _, far in pairs])
        await splitter.open(stack)
        ports = [splitter.port]
    await stack.enter_async_context(SimulatorServer(vehicle, ports))
    return [HubSideLink(near, traffic_log=traffic_log) for near, _ in pairs]
