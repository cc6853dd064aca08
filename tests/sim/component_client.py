"""Client for tests of component devices: commands to any address, and the senders of the answers."""

from __future__ import annotations

from typing import TypeVar

from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.sim import AttachableComponent, SimulatedCopter, SimulatedVehicle

M = TypeVar("M", bound=Message)


class ComponentClient(Client):
    def ask(self, component: int, command: int, *params: float, system: int | None = None) -> list[int]:
        """Return the results of answers that arrive at once."""
        first = len(self.received)
        numbers = [*params, *(0.0,) * (7 - len(params))]
        system = self.vehicle.system_id if system is None else system
        self.send(m.CommandLong(system, component, command, 0, *numbers))
        return [ack.result for _, ack in self.received[first:] if isinstance(ack, m.CommandAck)]

    def request(self, component: int, kind: type[M], *params: float) -> list[M]:
        """Return the messages that REQUEST_MESSAGE brings."""
        first = len(self.received)
        self.ask(component, MavCmd.REQUEST_MESSAGE, kind.ID, *params)
        return [message for _, message in self.received[first:] if isinstance(message, kind)]

    def messages_from(self, component: int, kind: type[M], *, system: int | None = None) -> list[M]:
        wanted = (self.vehicle.system_id if system is None else system, component)
        return [message for message in self.all(kind) if source(message) == wanted]


def source(message: Message) -> tuple[int, int]:
    frame = message.received_frame
    assert frame is not None
    return (frame.system_id, frame.component_id)


def copter_with(*components: AttachableComponent, **options: object) -> tuple[SimulatedCopter, ComponentClient]:
    """Return a booted copter with these devices."""
    copter = SimulatedCopter(boot_time_s=0.0, components=components, **options)  # type: ignore[arg-type]
    return copter, settled(copter)


def settled(vehicle: SimulatedVehicle, **ids: int) -> ComponentClient:
    """Return a client three seconds after the start."""
    client = ComponentClient(vehicle, **ids)
    client.run(3.0)
    client.clear()
    return client
