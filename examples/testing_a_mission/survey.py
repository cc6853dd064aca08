"""The program under test: fly around a field and return. Asynchronous, blocking, and for DroneKit.

python survey.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import sys
import time
from typing import TYPE_CHECKING, Any

import aerokit
from aerokit.missions import Mission, return_to_launch, take_off, waypoint

if TYPE_CHECKING:
    from aerokit import Position, sync

ALTITUDE_M = 10.0
SIDE_M = 20.0
MIN_BATTERY_PERCENT = 40.0


class BatteryTooLow(Exception):
    """The battery has too little charge for the survey."""


def corners(home: Position) -> list[Position]:
    """Return the corners of the field."""
    return [
        home.offset(north_m=SIDE_M),
        home.offset(north_m=SIDE_M, east_m=SIDE_M),
        home.offset(east_m=SIDE_M),
    ]


def plan(home: Position) -> Mission:
    """Return the mission: take off, visit each corner, return."""
    return Mission([
        take_off(home, altitude_relative_m=ALTITUDE_M),
        *(waypoint(place, altitude_relative_m=ALTITUDE_M) for place in corners(home)),
        return_to_launch(),
    ])  # fmt: skip


async def survey(vehicle: aerokit.Vehicle) -> None:
    """Survey the field. Raises BatteryTooLow before arming."""
    await vehicle.wait_ready()
    check_battery(vehicle.batteries.value[0].remaining_percent)
    await vehicle.mission.upload(plan(vehicle.position.value))
    await vehicle.arm()
    await vehicle.mission.start()
    await vehicle.mission.wait_finished(timeout=300)


def survey_blocking(vehicle: sync.Vehicle) -> None:
    """Survey the field without ``async``."""
    vehicle.wait_ready()
    check_battery(vehicle.batteries.value[0].remaining_percent)
    vehicle.mission.upload(plan(vehicle.position.value))
    vehicle.arm()
    vehicle.mission.start()
    vehicle.mission.wait_finished(timeout=300)


def hop_classic(address: str) -> None:
    """Fly up and down with DroneKit's API."""
    from dronekit import VehicleMode, connect

    vehicle: Any = connect(address, wait_ready=True)
    wait_for(lambda: vehicle.is_armable)
    vehicle.mode = VehicleMode("GUIDED")
    wait_for(lambda: vehicle.mode.name == "GUIDED")
    vehicle.armed = True
    wait_for(lambda: vehicle.armed)
    vehicle.simple_takeoff(ALTITUDE_M)
    wait_for(lambda: vehicle.location.global_relative_frame.alt > 0.95 * ALTITUDE_M)
    vehicle.mode = VehicleMode("LAND")
    wait_for(lambda: not vehicle.armed)
    vehicle.close()


def check_battery(percent: float | None) -> None:
    """Raise BatteryTooLow if the charge is known and too low."""
    if percent is not None and percent < MIN_BATTERY_PERCENT:
        raise BatteryTooLow(f"{percent:g} % is less than {MIN_BATTERY_PERCENT:g} %")


def wait_for(condition: Any) -> None:
    """Poll, as DroneKit programs do."""
    while not condition():
        time.sleep(0.02)


async def main(address: str) -> None:
    """Survey the field of the vehicle at ``address``."""
    async with aerokit.connect(address) as vehicle:
        await survey(vehicle)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
