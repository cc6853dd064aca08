"""Two links between a program and a vehicle, of which the one in use falls silent when an order was given."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial

from order_air import Air, Crossing, Diary, Silence, Weather
from stream_splitter import Splitter

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.mavlink.messages import Heartbeat
from aerokit.sim import SimulatedVehicle, SimulatorServer
from aerokit.transport import Link, SeveralLinks, memory_link_pair


@dataclass(frozen=True)
class TwoLinks:
    """What becomes of the link in use; ``is_copied``: both carry one stream, so that answers come over both."""

    silence: Silence
    is_copied: bool = False


class Airs:
    """As :class:`order_air.Air`, of two links; the weather is that of both."""

    def __init__(self, airs: list[Air], two: TwoLinks) -> None:
        self.airs, self._two = airs, two
        self._diary = airs[0].diary
        self.connection: aerokit.Connection | None = None

    @property
    def weather(self) -> Weather:
        return self.airs[0].weather

    @weather.setter
    def weather(self, weather: Weather) -> None:
        for air in self.airs:
            air.weather = weather

    def begin(self) -> None:
        """The order is given now, and the link in use falls silent."""
        assert self.connection is not None
        assert self.connection.links is not None
        (used,) = [index for index, each in enumerate(self.connection.links.value) if each.used_for]
        self.airs[used].silence = self._two.silence
        for air in self.airs:
            air.begin()

    @property
    def sent(self) -> list[Crossing]:
        return self._diary.sent

    @property
    def heartbeats(self) -> list[Crossing]:
        return self._diary.heartbeats

    def believe(self, heartbeat: Heartbeat) -> None:
        """The program takes what has just come."""
        self._diary.heard[-1].is_believed = True


class _Unbelieved(Diary):
    """Of two links it is not said which is taken: the connection says so."""

    def cross(self, into: list[Crossing], *about: object, **more: object) -> Crossing:
        crossing = super().cross(into, *about, **more)  # type: ignore[arg-type]
        crossing.is_believed = into is not self.heard
        return crossing


@asynccontextmanager
async def over_two(
    vehicle: SimulatedVehicle, two: TwoLinks
) -> AsyncIterator[tuple[Airs, aerokit.Connection]]:
    """A connection over two links, to be flown with, and what crosses them."""
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
    """A connection over both."""
    together = SeveralLinks([partial(_itself, air) for air in airs.airs])
    async with open_connection(together) as connection:
        airs.connection = connection
        connection.bus.attach(Heartbeat, airs.believe)
        yield connection


def unused_airs(near: Sequence[Link], two: TwoLinks) -> Airs:
    """Through the air over these links; nothing is open yet."""
    diary = _Unbelieved()
    return Airs([Air(each, diary=diary) for each in near], two)


def _itself(link: Link) -> Link:
    return link
