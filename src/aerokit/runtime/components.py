"""What kind of component a HEARTBEAT comes from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavAutopilot, MavType

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Heartbeat

__all__ = ["is_autopilot"]

NO_AUTOPILOTS = frozenset((MavType.GCS, 18, 26, 27, *range(30, 35), *range(36, 43), 44, 48))
"""Types of other components: onboard controller, gimbal, ADS-B, camera, servo, battery, … (MAV_TYPE)."""


def is_autopilot(heartbeat: Heartbeat) -> bool:
    """Whether it comes from an autopilot: not from a ground station, a gimbal, a camera or an ADS-B receiver.

    Some of those call their autopilot GENERIC instead of INVALID, so their type counts too.
    """
    return heartbeat.autopilot != MavAutopilot.INVALID and heartbeat.type not in NO_AUTOPILOTS
