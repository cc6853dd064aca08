"""Missions near a simulated vehicle, and recorders of their transfers."""

from __future__ import annotations

from typing import Any

from flight_harness import Flight, Px4Flight, Wire

from aerokit import Position
from aerokit import messages as m
from aerokit._internal import geo
from aerokit.missions import Mission, MissionItem
from aerokit.missions.navigation import take_off, waypoint
from aerokit.sim import HOME as SIMULATED_HOME

PLAN_MESSAGES = (
    m.MissionCount,
    m.MissionItemInt,
    m.MissionItem,
    m.MissionWritePartialList,
    m.MissionRequestList,
    m.MissionRequestInt,
    m.MissionClearAll,
    m.FileTransferProtocol,
)
HOME = Position(*SIMULATED_HOME[:2])


def near_home(north_m: float, east_m: float = 0.0, home: Position = HOME) -> tuple[float, float]:
    return geo.offset(home.latitude_deg, home.longitude_deg, north_m, east_m)


def long_mission(count: int) -> Mission:
    return Mission([waypoint(*near_home(i % 7, i), altitude_relative_m=20) for i in range(count)])


def short_mission(flight: Flight | Px4Flight, *ends: MissionItem) -> Mission:
    """Take-off, two places to the north, landing."""
    home = flight.vehicle.home.value.position
    items = [take_off(*near_home(0, home=home), altitude_relative_m=4)]
    items += [waypoint(*near_home(6 * i, home=home), altitude_relative_m=4) for i in (1, 2)]
    return Mission([*items, *ends])


def changed(mission: Mission, *indices: int) -> Mission:
    """Return the mission with other altitudes of these items."""
    items = [item.replace(z=33.0) if i in indices else item for i, item in enumerate(mission)]
    return Mission(items)


def sent_for_plans(wire: Wire) -> list[Any]:
    return [message for _, message in wire.sent if isinstance(message, PLAN_MESSAGES)]
