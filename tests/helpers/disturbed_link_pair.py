"""Two links between a program and a vehicle. The selected one fails after an order."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial

from disturbed_link import Disturbances, DisturbedLink, Silence, TrafficEntry, TrafficLog
from stream_splitter import Splitter

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.mavlink.messages import Heartbeat
from aerokit.sim import SimulatedVehicle, SimulatorServer
from aerokit.transport import Link, MultiLink, memory_link_pair


@dataclass(frozen=True)
class TwoLinks:
    """Failure of the selected link. With ``is_copied``, both links carry the same stream, so answers arrive twice."""

    silence: Silence
    is_copied: bool = False


class DisturbedLinkPair:
    """Like :class:`disturbed_link.DisturbedLink` for two links with the same disturbances."""

    def __init__(self, paths: list[DisturbedLink], two: TwoLinks) -> None:
        self.paths, self._two = paths, two
        self._log = paths[0].traffic_log
        self.connection: aerokit.Connection | None = None

    @property
    def disturbances(self) -> Disturbances:
        return self.paths[0].disturbances

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances) -> None:
        for path in self.paths:
            path.disturbances = disturbances

    def begin(self) -> None:
        """Start the disturbances; call it when the order is given. The selected link fails."""
        assert self.connection is not None
        assert self.connection.links is not None
        (used,) = [index for index, link in enumerate(self.connection.links.value) if link.used_for]
        self.paths[used].silence = self._two.silence
        for path in self.paths:
            path.begin()

    @property
    def sent(self) -> list[TrafficEntry]:
        return self._log.sent

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        return self._log.heartbeats

    def believe(self, heartbeat: Heartbeat) -> None:
        """Record that the program accepted the last received message."""
        self._log.received[-1].is_believed = True


class _SelectedLinkLog(TrafficLog):
    """Traffic log that accepts a message only after the connection confirms it (`believe`)."""

    def cross(self, into: list[TrafficEntry], *about: object, **more: object) -> TrafficEntry:
        crossing = super().cross(into, *about, **more)  # type: ignore[arg-type]
        crossing.is_believed = into is not self.received
        return crossing


@asynccontextmanager
async def over_two(
    vehicle: SimulatedVehicle, two: TwoLinks
) -> AsyncIterator[tuple[DisturbedLinkPair, aerokit.Connection]]:
    """Open a path over two links, with a record of their traffic."""
    pairs = [memory_link_pair() for _ in range(2)]
    paths = unopened_paths([near for near, _ in pairs], two)
    async with AsyncExitStack() as stack:
        ports: list[Link] = [far for _, far in pairs]
        if two.is_copied:
            splitter = Splitter([far for _, far in pairs])
            await splitter.open(stack)
            ports = [splitter.port]
        await stack.enter_async_context(SimulatorServer(vehicle, ports))
        yield paths, await stack.enter_async_context(joined(paths))


@asynccontextmanager
async def joined(paths: DisturbedLinkPair) -> AsyncIterator[aerokit.Connection]:
    """Open a connection over both links."""
    together = MultiLink([partial(_itself, path) for path in paths.paths])
    async with open_connection(together) as connection:
        paths.connection = connection
        connection.bus.attach(Heartbeat, paths.believe)
        yield connection


def unopened_paths(near: Sequence[Link], two: TwoLinks) -> DisturbedLinkPair:
    """Create the disturbed links, not opened."""
    traffic_log = _SelectedLinkLog()
    return DisturbedLinkPair([DisturbedLink(end, traffic_log=traffic_log) for end in near], two)


def _itself(link: Link) -> Link:
    return link
