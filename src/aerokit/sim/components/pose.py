"""Where the vehicle that carries a device truly is, and how it lies in the air."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from aerokit.errors import InvalidArgument
from aerokit.sim.local_frame import true_place

if TYPE_CHECKING:
    from aerokit.sim.local_frame import GlobalPoint
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["Pose", "pose_of"]


class Pose(NamedTuple):
    """Angles in radians."""

    place: GlobalPoint
    height_m: float
    """Above home."""
    roll: float
    pitch: float
    yaw: float


def pose_of(vehicle: SimulatedVehicle) -> Pose | None:
    """None of a vehicle that is nowhere, such as a recording."""
    try:
        place = true_place(vehicle)
    except InvalidArgument:
        return None
    motion = vehicle.motion  # type: ignore[attr-defined]
    height = getattr(vehicle, "altitude_m", -motion.down)
    return Pose(place, height, motion.roll, motion.pitch, motion.yaw)
