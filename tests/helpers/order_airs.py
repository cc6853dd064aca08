"""Two links between a program and a vehicle, of which the selected one fails after an order."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial

from order_air import Air, Disturbances, Silence, TrafficEntry, TrafficLog
from stream_splitter import Splitter

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.mavlink.messages import Heartbeat
from aerokit.sim import SimulatedVehicle, SimulatorServer
from aerokit.transport import Link, MultiLink, memory_link_pair


@dataclass(frozen=True)
class TwoLinks:
    """The failure of the selected link. ``is_copied``: both carry the same stream, so answers arrive over both."""

    silence: Silence
    is_copied: bool = False


class Airs:
    """Like :class:`order_air.Air` for two links with the same disturbances."""

    def __init__(self, airs: list[Air], two: TwoLinks) -> None:
        self.airs, self._two = airs, two
        self._diary = airs[0].traffic_log
        self.connection: aerokit.Connection | None = None

    @property
    def disturbances(self) -> Disturbances:
        return self.airs[0].disturbances

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances) -> None:
        for air in self.airs:
            air.disturbances = disturbances

    def begin(self) -> None:
        """Start the disturbances, as the order is given and the selected link fails."""
        assert self.connection is not None
        assert self.connection.links is not None
        (used,) = [index for index, link in enumerate(self.connection.links.value) if link.used_for]
        self.airs[used].silence = self._two.silence
        for air in self.airs:
            air.begin()

    @property
    def sent(self) -> list[TrafficEntry]:
        return self._diary.sent

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        return self._diary.heartbeats

    def believe(self, heartbeat: Heartbeat) -> None:
        """Record that the program accepted the last message."""
        self._diary.heard[-1].is_believed = True


class _SelectedLinkLog(TrafficLog):
    """The connection reports which of the links it selects."""

    def cross(self, into: list[TrafficEntry], *about: object, **more: object) -> TrafficEntry:
        crossing = super().cross(into, *about, **more)  # type: ignore[arg-type]
        crossing.is_believed = into is not self.heard
        return crossing


@asynccontextmanager
async def over_two(vehicle: SimulatedVehicle, two: TwoLinks) -> AsyncIterator[tuple[Airs, aerokit.Connection]]:
    """A connection over two links, and a record of their traffic."""
    pairs = [memory_link_pair() for _ in range(2)]
    airs = unused_airs([near for near, _ in pairs], two)
    async with AsyncExitStack() as stack:
        ports: list[Link] = [far for _, far in pairs]
        if two.is_copied:
            splitter = Splitter([far for _, far in pairs])
            await splitter.open(stack)
            ports = [splitter.port]
        await stack.enter_async_context(SimulatorServer(vehicle, ports))
        yield airs, await stack.enter_async_context(joined(airs))


@asynccontextmanager
async def joined(airs: Airs) -> AsyncIterator[aerokit.Connection]:
    """Open a connection over both links."""
    together = MultiLink([partial(_itself, air) for air in airs.airs])
    async with open_connection(together) as connection:
        airs.connection = connection
        connection.bus.attach(Heartbeat, airs.believe)
        yield connection


def unused_airs(near: Sequence[Link], two: TwoLinks) -> Airs:
    """Create the disturbed links, not opened."""
    traffic_log = _SelectedLinkLog()
    return Airs([Air(each, traffic_log=traffic_log) for each in near], two)


def _itself(link: Link) -> Link:
    return link
