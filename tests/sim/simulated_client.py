"""Client for tests of simulated vehicles, in simulated time without a loop or sockets."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd, MavModeFlag
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.protocols.servers.host import ComponentIds
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle

M = TypeVar("M", bound=Message)
STEP_S = 0.05

# Default home of PX4's simulation, and of its recordings.
PX4_HOME = (47.3977432, 8.5455939, 489.4)


class Client:
    def __init__(self, vehicle: SimulatedVehicle, *, system_id: int = 255, component_id: int = 190) -> None:
        self.vehicle = vehicle
        self.target = ComponentIds(vehicle.system_id, vehicle.component_id)
        self.now = 0.0
        self.received: list[tuple[float, Message]] = []
        self.framer = Framer()
        self._encoder = FrameEncoder(system_id, component_id)
        vehicle.step(0.0)
        self._ask_for_texts()

    def send(self, message: Message) -> None:
        self.vehicle.receive(self._encoder.encode(message), self.now)
        self.listen()

    def command(self, command: int, *params: float) -> int | None:
        """Return the result; None if there is no answer at once."""
        first = len(self.received)
        numbers = [*params, *(0.0,) * (7 - len(params))]
        self.send(m.CommandLong(*self.target, command, 0, *numbers))
        return self.ack_since(first, command)

    def command_int(
        self, command: int, frame: int, *params: float, x: int = 0, y: int = 0, z: float = 0.0
    ) -> int | None:
        first = len(self.received)
        one, two, three, four = (*params, *(0.0,) * (4 - len(params)))
        self.send(m.CommandInt(*self.target, frame, command, 0, 0, one, two, three, four, x, y, z))
        return self.ack_since(first, command)

    def ack_since(self, first: int, command: int) -> int | None:
        for _, message in self.received[first:]:
            if isinstance(message, m.CommandAck) and message.command == command:
                return message.result
        return None

    def _ask_for_texts(self) -> None:
        """PX4 sends texts only to ground stations, and this client sends no heartbeats unless a test does."""
        if isinstance(self.vehicle, SimulatedPx4):
            self.vehicle.text_links.on_station_heartbeat(self.vehicle.channels[0])

    def listen(self) -> None:
        self._ask_for_texts()
        for frame in self.framer.receive(self.vehicle.take_outbox(), self.now):
            self.received.append((self.now, STANDARD.decode(frame)))

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(end, self.now + STEP_S)
            self.vehicle.step(self.now)
            self.listen()

    def run_until(self, condition: Callable[[], bool], timeout: float = 120.0) -> float:
        """Return the simulated seconds it took."""
        start = self.now
        while not condition():
            assert self.now - start < timeout, f"not within {timeout} s; texts: {self.texts}"
            self.run(STEP_S)
        return self.now - start

    def all(self, kind: type[M]) -> list[M]:
        return [message for _, message in self.received if isinstance(message, kind)]

    def last(self, kind: type[M]) -> M:
        return self.all(kind)[-1]

    @property
    def texts(self) -> list[str]:
        return [message.text for message in self.all(m.Statustext)]

    def clear(self) -> None:
        self.received.clear()


def ready_copter(kind: type[SimulatedCopter] = SimulatedCopter, **options: object) -> tuple[SimulatedCopter, Client]:
    """Return a copter that is booted, disarmed and has a position."""
    copter = kind(boot_time_s=0.0, **options)  # type: ignore[arg-type]
    client = Client(copter)
    client.run(3.0)
    client.clear()
    return copter, client


def flying_copter(
    altitude_m: float = 10.0, kind: type[SimulatedCopter] = SimulatedCopter, **options: object
) -> tuple[SimulatedCopter, Client]:
    """Return a copter that hovers in GUIDED."""
    copter, client = ready_copter(kind, **options)
    assert set_mode(client, CopterMode.GUIDED) == 0
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == 0
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m) == 0
    client.run_until(lambda: not copter.is_landed and not copter.mode.is_taking_off, 60.0)
    client.clear()
    return copter, client


def set_mode(client: Client, mode: int) -> int | None:
    return client.command(MavCmd.DO_SET_MODE, MavModeFlag.CUSTOM_MODE_ENABLED, mode)
