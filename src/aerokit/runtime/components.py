"""What kind of component a HEARTBEAT comes from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavAutopilot, MavType
from aerokit.runtime.events import ComponentFound, VehicleFound

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Heartbeat

__all__ = ["found_by", "is_autopilot"]

NO_AUTOPILOTS = frozenset(
    (
        MavType.GCS,
        MavType.ONBOARD_CONTROLLER,
        MavType.GIMBAL,
        MavType.ADSB,
        MavType.CAMERA,
        MavType.CHARGING_STATION,
        MavType.FLARM,
        MavType.SERVO,
        MavType.ODID,
        MavType.BATTERY,
        MavType.PARACHUTE,
        MavType.LOG,
        MavType.OSD,
        MavType.IMU,
        MavType.GPS,
        MavType.WINCH,
        MavType.ILLUMINATOR,
        MavType.GRIPPER,
    )
)
"""Types of other components: onboard controller, gimbal, ADS-B, camera, servo, battery, … (MAV_TYPE)."""


def is_autopilot(heartbeat: Heartbeat) -> bool:
    """Whether it comes from an autopilot: not from a ground station, a gimbal, a camera or an ADS-B receiver.

    Some of those call their autopilot GENERIC instead of INVALID, so their type counts too.
    """
    return heartbeat.autopilot != MavAutopilot.INVALID and heartbeat.type not in NO_AUTOPILOTS


def found_by(
    heartbeat: Heartbeat, at: float, system_id: int, component_id: int
) -> VehicleFound | ComponentFound:
    """What a first heartbeat tells."""
    if is_autopilot(heartbeat):
        return VehicleFound(at, system_id, component_id, heartbeat.type, heartbeat.autopilot)
    return ComponentFound(at, system_id, component_id, heartbeat.type)
