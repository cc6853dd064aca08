"""A scripted flight controller with a mission, and a program's vehicle connected to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from flight_controller import FlightController
from flight_controller_services import Item

from aerokit.dronekit.commands import Command, CommandSequence
from aerokit.dronekit.vehicle import Vehicle, connect

__all__ = [
    "FIRST",
    "HOME",
    "LIMIT_S",
    "SECOND",
    "THIRD",
    "Pair",
    "connected",
    "kept",
    "transfers",
    "waypoint",
]

HOME = Item(16, -35.363261, 149.16523, 584.0, 0)
FIRST, SECOND, THIRD = (Item(16, -35.5 - n / 8, 149.25, 20.0 + n) for n in range(3))
LIMIT_S = 100.0

Pair = tuple[FlightController, CommandSequence]


def waypoint(latitude: float = -35.5, frame: int = 3, command: int = 16, **fields: Any) -> Command:
    """A command 30 m up, with some fields otherwise."""
    cmd = Command(0, 0, 0, frame, command, 0, 0, 0, 0, 0, 0, latitude, 149.25, 30)
    for name, value in fields.items():
        setattr(cmd, name, value)
    return cmd


@contextmanager
def connected(
    *items: Item, capabilities: int | None = None, **options: Any
) -> Iterator[tuple[FlightController, Vehicle]]:
    """A vehicle that holds these items, home included."""
    with FlightController(heartbeat_s=0.02, **options) as controller:
        if capabilities is not None:
            controller.capabilities = capabilities
        controller.missions.items = list(items)
        controller.missions.has_home = controller.autopilot == 3
        with connect(controller.address, rate=None) as vehicle:
            yield controller, vehicle


def kept(controller: FlightController) -> list[tuple[int, float, float]]:
    """Return the stored mission: command, latitude, altitude."""
    return [(item.command, item.x, item.z) for item in controller.missions.items]


def transfers(controller: FlightController, since: int) -> list[str]:
    """The messages that began or ended a transfer."""
    names = ("MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_WRITE_PARTIAL_LIST", "MISSION_REQUEST_LIST")
    return [frame.name for frame in controller.received(*names, since=since)]
