"""A simulated vehicle in memory, a connected `Vehicle`, and a recorder of its messages, on virtual time."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import anyio

import aerokit
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.errors import LinkLost
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.testing.clock import VirtualClockLoop
from aerokit.transport.link import Link, Peer, Receiver

M = TypeVar("M", bound=Message)

SETPOINTS = (m.SetPositionTargetLocalNed, m.SetPositionTargetGlobalInt, m.SetAttitudeTarget)


class Wire(Link):
    """The program's end of a link. ``sent`` has the messages sent, as (loop time, message)."""

    def __init__(self, link: Link) -> None:
        self.address = link.address
        self.sent: list[tuple[float, Message]] = []
        self._link = link
        self._framer = Framer()
        self._receiver: Receiver | None = None

    async def open(self, receiver: Receiver) -> None:
        self._receiver = receiver
        await self._link.open(receiver)

    def write(self, data: bytes, peer: Peer = None) -> None:
        now = asyncio.get_running_loop().time()
        self.sent += [(now, STANDARD.decode(frame)) for frame in self._framer.receive(data, now)]
        self._link.write(data, peer)

    def close(self) -> None:
        self._link.close()

    async def wait_closed(self) -> None:
        await self._link.wait_closed()

    def lose(self) -> None:
        """Lose the link, as when the cable is unplugged."""
        assert self._receiver is not None
        self._link.close()
        self._receiver.link_lost(LinkLost("the cable was unplugged"))

    def deliver(self, data: bytes) -> None:
        """Deliver bytes to the program."""
        assert self._receiver is not None
        self._receiver.bytes_received(data, None)

    def clear(self) -> None:
        self.sent.clear()

    def all(self, kind: type[M]) -> list[M]:
        return [message for _, message in self.sent if isinstance(message, kind)]

    def last(self, kind: type[M]) -> M:
        return self.all(kind)[-1]

    def times(self, kind: type[Message]) -> list[float]:
        return [at for at, message in self.sent if isinstance(message, kind)]

    def commands(self, command: int) -> list[m.CommandLong | m.CommandInt]:
        return [
            message
            for _, message in self.sent
            if isinstance(message, (m.CommandLong, m.CommandInt)) and message.command == command
        ]

    def mode_orders(self) -> list[int]:
        """Custom modes requested by MAV_CMD_DO_SET_MODE, in ArduPilot's encoding."""
        return [
            int(command.param2) for command in self.commands(MavCmd.DO_SET_MODE) if isinstance(command, m.CommandLong)
        ]

    def setpoints(self) -> list[tuple[float, Message]]:
        return [(at, message) for at, message in self.sent if isinstance(message, SETPOINTS)]


@dataclass
class Flight:
    """One simulated copter, and the program's `Vehicle`."""

    copter: SimulatedCopter
    vehicle: aerokit.Vehicle
    wire: Wire

    async def take_off(self, altitude_m: float = 10.0) -> None:
        """Wait until the copter is ready, arm it, take off in GUIDED, and clear the recorder."""
        await self.vehicle.wait_ready()
        await self.vehicle.set_mode("GUIDED")
        await self.vehicle.arm()
        await self.vehicle.take_off(altitude_m)
        await anyio.sleep(3.0)
        self.wire.clear()

    def pilot_takes_over(self, mode: int = CopterMode.LOITER) -> None:
        """Change the mode by the remote control, with the throttle stick in the middle."""
        self.copter.rc[2] = 1500
        assert self.copter.set_mode(mode)


@asynccontextmanager
async def open_flight(
    copter: SimulatedCopter | None = None,
    *,
    latency_s: float = 0.0,
    others: Iterable[SimulatedVehicle] = (),
    **options: Any,
) -> AsyncIterator[Flight]:
    """Connect to a copter that is ready at power-on. ``options`` are those of `connect`."""
    copter = SimulatedCopter(boot_time_s=0.0) if copter is None else copter
    options.setdefault("system_id", copter.system_id)
    async with simulated_link([copter, *others], latency_s=latency_s) as link:
        wire = Wire(link)
        async with aerokit.connect(wire, **options) as vehicle:
            yield Flight(copter, vehicle, wire)


@asynccontextmanager
async def in_the_air(altitude_m: float = 10.0, **options: Any) -> AsyncIterator[Flight]:
    """Like `open_flight`, with the copter hovering in GUIDED."""
    async with open_flight(**options) as flight:
        await flight.take_off(altitude_m)
        yield flight


def now() -> float:
    return asyncio.get_running_loop().time()


def block_loop(seconds: float) -> None:
    """Block the event loop, as time.sleep does in a program: the clock advances, but the loop does not run."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualClockLoop)
    loop._now += seconds


def suspend_computer(vehicle: aerokit.Vehicle, seconds: float) -> None:
    """Suspend the computer: other clocks advance, but the loop's clock stands still, and no data arrives."""
    watch = vehicle.connection._receiver._loop_watch
    suspended_s = watch._suspended_before + seconds
    watch._suspended = lambda: suspended_s


class HeldHeartbeats:
    """Holds back what reports the mode, as the socket does while the event loop is blocked, and loses what is newer."""

    def __init__(self, wire: Wire) -> None:
        assert wire._receiver is not None
        self._receiver, self._framer = wire._receiver, Framer()
        self._held: list[bytes] = []
        self._is_holding = True
        wire._link._receiver = self  # type: ignore[attr-defined]

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        for frame in self._framer.receive(data, 0.0):
            if not self._is_holding or frame.message_id not in (m.Heartbeat.ID, m.CurrentMode.ID):
                self._receiver.bytes_received(frame.raw, peer)
            elif frame.message_id == m.Heartbeat.ID:
                self._held.append(frame.raw)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._receiver, name)

    def stop(self) -> None:
        """Let the HEARTBEATs pass again."""
        self._is_holding = False

    def release_first_after(self, blocked_s: float) -> None:
        """Block the event loop; then the first HEARTBEAT is read, and later ones arrive again."""
        block_loop(blocked_s)
        self._is_holding = False
        self._receiver.bytes_received(self._held[0], None)


def speed_of(copter: SimulatedCopter | SimulatedPx4) -> float:
    motion = copter.motion
    return math.hypot(motion.velocity_north, motion.velocity_east, motion.velocity_down)


def make_parts(vehicle: aerokit.Vehicle) -> None:
    """Create the components that are created on first use and kept, so that leak checks do not count them."""
    for name in ("parameters", "gimbal", "mission", "rtk", "calibrate"):
        getattr(vehicle, name)


def attached_sinks(connection: Connection) -> int:
    """Count the callbacks of a connection: for messages, for events, and for its end."""
    bus = connection.bus
    tables = (*bus._sinks.values(), *bus._event_sinks.values())
    return sum(len(sinks) for sinks in tables) + len(connection._end_signal._callbacks)


def waiting_on_cells(vehicle: aerokit.Vehicle) -> int:
    """Count the waiters and observers of a vehicle's state cells."""
    return sum(len(cell._listeners) for cell in (*vehicle.telemetry.cells.values(), vehicle.link_quality))


@dataclass
class Px4Flight:
    """One simulated PX4, and the program's `Vehicle`."""

    px4: SimulatedPx4
    vehicle: aerokit.Vehicle
    wire: Wire

    async def take_off(self, altitude_m: float = 10.0) -> None:
        """Wait until the vehicle is ready, arm it, take off, wait for LOITER, and clear the recorder."""
        await self.vehicle.wait_ready()
        await self.vehicle.arm()
        await self.vehicle.take_off(altitude_m)
        await anyio.sleep(3.0)
        self.wire.clear()


@asynccontextmanager
async def open_px4(
    px4: SimulatedPx4 | None = None, *, latency_s: float = 0.0, **options: Any
) -> AsyncIterator[Px4Flight]:
    """Connect to a PX4 that is soon ready. ``options`` are those of `connect`."""
    px4 = SimulatedPx4(boot_time_s=1.0) if px4 is None else px4
    async with simulated_link(px4, latency_s=latency_s) as link:
        wire = Wire(link)
        async with aerokit.connect(wire, **options) as vehicle:
            yield Px4Flight(px4, vehicle, wire)
