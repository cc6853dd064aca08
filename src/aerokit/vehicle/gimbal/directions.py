"""Which way a gimbal has to point from the vehicle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.vehicle.orders.progress import OLD_POSITION_S

if TYPE_CHECKING:
    from aerokit.position import Position
    from aerokit.vehicle.gimbal.arrival import Wanted
    from aerokit.vehicle.orders.bridge import Bridge

__all__ = ["direction_to", "straight"]

UPRIGHT_DEG = 89.0
"""Of a camera that looks straighter up or down, all turning is yaw."""
NEAR_M = 1.0
"""Nearer than this along the ground, any yaw will do."""


def straight(pitch: float, yaw: float, roll: float | None, *, from_nose: bool) -> Wanted:
    """Angles as they were ordered; of a camera that looks straight down or up, the yaw is anybody's."""
    is_upright = abs(pitch) > UPRIGHT_DEG
    turned = None if is_upright else yaw
    return (pitch, roll, None if from_nose else turned, turned if from_nose else None)


def direction_to(bridge: Bridge, target: Position) -> Wanted | None:
    """From where the vehicle is now; None while that is not known, or which of the two is higher."""
    cell = bridge.talk.telemetry.position
    here = cell.latest
    if here is None or cell.age > OLD_POSITION_S:
        return None
    pairs = (
        (target.altitude_relative_m, here.altitude_relative_m),
        (target.altitude_amsl_m, here.altitude_amsl_m),
    )
    up = next((its - own for its, own in pairs if its is not None and own is not None), None)
    if up is None:
        if target.altitude_relative_m is not None or target.altitude_amsl_m is not None:
            return None
        up = 0.0
    along = here.distance_to(target)
    pitch = math.degrees(math.atan2(up, along))
    return (
        pitch,
        None,
        here.bearing_to(target) if along > NEAR_M and abs(pitch) <= UPRIGHT_DEG else None,
        None,
    )
