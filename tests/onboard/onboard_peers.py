"""A component and its peers on a link in memory, on virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any, TypeVar

import aerokit
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavType
from aerokit.mavlink.message import Message
from aerokit.onboard import OnboardComponent
from aerokit.protocols.servers.host import ComponentIds
from aerokit.transport import memory_link_pair

MessageT = TypeVar("MessageT", bound=Message)


class Station:
    """A ground station that sends raw messages to a component and collects its answers."""

    def __init__(self, connection: Connection, target: tuple[int, int]) -> None:
        self.connection, self.target = connection, ComponentIds(*target)
        self.received: list[Message] = []

    @contextmanager
    def collecting(self, *types: type[Message]) -> Iterator[list[Any]]:
        detachments = self.connection.attach(types, self.received.append)
        try:
            yield self.received
        finally:
            for detach in detachments:
                detach()

    async def ask(self, message: Message, *answers: type[MessageT], timeout: float = 5.0) -> MessageT:
        """Send a message and return the next answer of these types."""
        with self.connection.subscribe(*answers, capacity=100) as stream:
            self.connection.send(message)
            return await stream.get(timeout)

    def command_long(self, command: int, *params: float, confirmation: int = 0) -> m.CommandLong:
        numbers = (*params, *(0.0,) * 7)[:7]
        return m.CommandLong(*self.target, command, confirmation, *numbers)

    async def command(self, command: int, *params: float, confirmation: int = 0) -> m.CommandAck:
        return await self.ask(self.command_long(command, *params, confirmation=confirmation), m.CommandAck)


@asynccontextmanager
async def payload_and_station(**arguments: Any) -> AsyncIterator[tuple[OnboardComponent, Station]]:
    """Open a component 1/191 and a ground station 255/190."""
    near, far = memory_link_pair()
    async with aerokit.component(near, **arguments) as payload, open_connection(far) as connection:
        yield payload, Station(connection, (payload.system_id, payload.component_id))


@asynccontextmanager
async def autopilot_and_client(**arguments: Any) -> AsyncIterator[tuple[OnboardComponent, aerokit.Vehicle]]:
    """Open a component that is an autopilot, and aerokit's client for it."""
    near, far = memory_link_pair()
    kind = {"component_id": 1, "type": MavType.QUADROTOR, "autopilot": MavAutopilot.GENERIC}
    async with aerokit.component(near, **{**kind, **arguments}) as node, aerokit.connect(far, rates={}) as vehicle:
        yield node, vehicle


@asynccontextmanager
async def device_and_client(component_id: int, kind: int) -> AsyncIterator[tuple[OnboardComponent, aerokit.Vehicle]]:
    """Open an autopilot and a device beside it on one link, and aerokit's client."""
    async with autopilot_and_client() as (node, vehicle):
        device = aerokit.component(connection=node.connection, component_id=component_id, type=kind)
        async with device as component:
            yield component, vehicle
