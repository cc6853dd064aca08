"""Rally points: where a simulated ArduPilot returns to instead of home."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavMissionType

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["best_return_place"]


def best_return_place(
    vehicle: ArduPilotVehicle, home: Ned, *, is_allowed: Callable[[Ned], bool] = lambda _: True
) -> Ned:
    """The nearest rally point that is allowed, with its own height; home when there is none or it is to be preferred.

    Rally points farther than RALLY_LIMIT_KM are none (0 means that there is no limit). With RALLY_INCL_HOME home is one
    of the places.
    """
    here = (vehicle.motion.north, vehicle.motion.east)
    parameters = vehicle.parameters
    places = [place for place in _rally_points(vehicle) if is_allowed(place)]
    if not places:
        return home
    nearest = min(places, key=lambda place: math.dist(place[:2], here))
    distance, limit = math.dist(nearest[:2], here), parameters["RALLY_LIMIT_KM"] * 1000.0
    if limit > 0 and distance > limit:
        return home
    if parameters["RALLY_INCL_HOME"] and distance >= math.dist(home[:2], here):
        return home
    return nearest


def _rally_points(vehicle: ArduPilotVehicle) -> list[Ned]:
    points = (
        vehicle.point(int(item.x), int(item.y), item.z, item.frame)
        for item in vehicle.missions.items(MavMissionType.RALLY)
    )
    return [point for point in points if point is not None]
