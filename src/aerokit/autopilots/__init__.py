"""Differences between autopilots and vehicle types: mode tables and behaviour.

``autopilot_for(heartbeat)`` returns the :class:`Autopilot` that describes a vehicle. It does no IO and has no state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.autopilots.ardupilot import (
    AntennaTracker,
    ArduCopter,
    ArduPilot,
    ArduPlane,
    ArduRover,
    ArduSub,
    Blimp,
    ardupilot_for,
)
from aerokit.autopilots.base import Autopilot, GimbalRules, ModeOrder, Purpose, Reposition, SetpointRules, TakeOff
from aerokit.autopilots.modes import Mode, ModeTable, is_armed
from aerokit.autopilots.px4 import Px4, px4_custom_mode
from aerokit.autopilots.telemetry import AutopilotVersion
from aerokit.mavlink.enums import MavAutopilot

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Heartbeat

__all__ = [
    "AntennaTracker",
    "ArduCopter",
    "ArduPilot",
    "ArduPlane",
    "ArduRover",
    "ArduSub",
    "Autopilot",
    "AutopilotVersion",
    "Blimp",
    "GimbalRules",
    "Mode",
    "ModeOrder",
    "ModeTable",
    "Purpose",
    "Px4",
    "Reposition",
    "SetpointRules",
    "TakeOff",
    "autopilot_for",
    "is_armed",
    "px4_custom_mode",
]


def autopilot_for(heartbeat: Heartbeat) -> Autopilot:
    """Return the description for the autopilot and vehicle type of a HEARTBEAT; a generic one for unknown types."""
    if heartbeat.autopilot == MavAutopilot.ARDUPILOTMEGA:
        return ardupilot_for(heartbeat.type)
    if heartbeat.autopilot == MavAutopilot.PX4:
        return Px4(heartbeat.type)
    return Autopilot(heartbeat.type)
