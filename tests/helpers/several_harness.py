"""A vehicle with two radios, on virtual time: links that can be cut, delayed and stalled, and copied streams."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any

from stream_splitter import Splitter

from aerokit import events
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedVehicle, SimulatorServer
from aerokit.testing import FaultModel, FaultyLink
from aerokit.transport import Link, MemoryLink, MultiLink, Peer, memory_link_pair

DEAD = FaultModel(loss=1.0)
GOOD = FaultModel()


class Radios:
    """Several faulty links to the same vehicles, each to a separate port of the autopilot."""

    def __init__(self, count: int, *, models: Sequence[FaultModel] = (), seed: int = 0) -> None:
        pairs = [memory_link_pair() for _ in range(count)]
        self.far: list[MemoryLink] = [far for _, far in pairs]
        self.links: list[FaultyLink] = [
            FaultyLink(near, models[index] if models else GOOD, seed=seed + index)
            for index, (near, _) in enumerate(pairs)
        ]

    def together(self, **options: Any) -> MultiLink:
        """Combine the links to one `MultiLink`."""
        return MultiLink([partial(_itself, link) for link in self.links], **options)

    def cut(self, index: int) -> None:
        """Lose all messages of a link in both directions, without an error."""
        self.links[index].incoming.model = self.links[index].outgoing.model = DEAD

    def mend(self, index: int) -> None:
        """End the loss of messages of a link."""
        self.links[index].incoming.model = self.links[index].outgoing.model = GOOD


def _itself(link: Link) -> Link:
    return link


class ReceivedMessages:
    """Messages received on the vehicle's side, in the order of sending, each with the index of its radio."""

    def __init__(self, radios: Radios) -> None:
        self.messages: list[tuple[int, float, Message]] = []
        self._framers = [Framer() for _ in radios.links]
        for index, link in enumerate(radios.links):
            link.link.write = partial(self._write, index, link.link.write)  # type: ignore[method-assign]

    def _write(self, index: int, write: Any, data: bytes, peer: Peer = None) -> None:
        framer = self._framers[index]
        for frame in framer.receive(data):
            self.messages.append((index, 0.0, framer.dialect.decode(frame)))
        write(data, peer)

    def of(self, *types: type[Message]) -> list[tuple[int, Message]]:
        """Return the messages of these types, each with the index of its radio."""
        return [(index, message) for index, _, message in self.messages if isinstance(message, types)]


@asynccontextmanager
async def over(
    radios: Radios,
    vehicles: SimulatedVehicle | Iterable[SimulatedVehicle],
    *,
    copied: bool = False,
    server: dict[str, Any] | None = None,
    links: dict[str, Any] | None = None,
    **options: Any,
) -> AsyncIterator[Connection]:
    """Open a connection over these radios to simulated vehicles."""
    async with AsyncExitStack() as stack:
        ports: list[Link] = list(radios.far)
        if copied:
            splitter = Splitter(radios.far)
            await splitter.open(stack)
            ports = [splitter.port]
        await stack.enter_async_context(SimulatorServer(vehicles, ports, **(server or {})))
        together = radios.together(**(links or {}))
        yield await stack.enter_async_context(open_connection(together, **options))


class EventLog:
    """Collects the events of a connection."""

    def __init__(self, connection: Connection, *types: type[events.Event]) -> None:
        self.all: list[events.Event] = []
        for kind in types or (events.LinkSelected,):
            connection.bus.attach_event(kind, self.all.append)

    @property
    def chosen(self) -> list[tuple[str, str]]:
        """Return (link, reason) of each change, without the first selection."""
        return [
            (event.link, event.reason)
            for event in self.all
            if isinstance(event, events.LinkSelected) and event.before is not None
        ]
