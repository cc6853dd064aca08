"""Vehicles with gimbals, another ground station, and recorders."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from flight_harness import Flight, Px4Flight, open_flight

from aerokit import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedGimbal

PITCHYAW, MOUNT = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.DO_MOUNT_CONTROL
CONFIGURE, REQUEST = MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, MavCmd.REQUEST_MESSAGE
OTHER = (254, 190)
"""System and component id of another ground station."""


def copter_with_mount(**options: Any) -> SimulatedCopter:
    """Create a copter whose autopilot manages gimbal 1."""
    copter = SimulatedCopter(boot_time_s=0.0, **options)
    copter.parameters["MNT1_TYPE"] = 1.0
    return copter


@asynccontextmanager
async def mounted() -> AsyncIterator[Flight]:
    """Connect to a copter on the ground with a gimbal that the autopilot manages."""
    async with open_flight(copter_with_mount()) as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


@asynccontextmanager
async def with_gimbals(*gimbals: SimulatedGimbal, copter: SimulatedCopter | None = None) -> AsyncIterator[Flight]:
    """Connect to a copter on the ground with these gimbals, each with its manager, and discover them."""
    copter = copter or SimulatedCopter(boot_time_s=0.0, components=gimbals)
    async with open_flight(copter) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.gimbal.controllers.wait_until(lambda _: True, timeout=3)
        flight.wire.clear()
        yield flight


def other_station(flight: Flight, message: Message) -> None:
    """Send a message from the other station to the vehicle and its devices."""
    copter = flight.copter
    copter.receive(FrameEncoder(*OTHER).encode(message), copter.now)


def takes_control(flight: Flight, component: int = 154, *, secondary: bool = False) -> None:
    """Claim a gimbal for the other station."""
    pair, keep = (-2.0, -2.0), (-1.0, -1.0)
    params = (*keep, *pair) if secondary else (*pair, *keep)
    other_station(flight, m.CommandLong(1, component, CONFIGURE, 0, *params, 0, 0, 0))


def configured(flight: Flight | Px4Flight) -> list[tuple[float, ...]]:
    """Params 1 to 4 and 7 of each gimbal control command sent."""
    sent: list[Any] = flight.wire.commands(CONFIGURE)
    return [(message.param1, message.param2, message.param3, message.param4, message.param7) for message in sent]


def own_ids(flight: Flight) -> tuple[int, int]:
    connection = flight.vehicle.connection
    return connection.source_system, connection.source_component
