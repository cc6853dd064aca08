"""Which messages tell what a program reads: the name of a state cell → the messages to ask for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from aerokit.mavlink import messages

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message

__all__ = ["FEEDS", "MESSAGE_IDS", "message_type"]

MESSAGE_IDS: Mapping[str, int] = {row[0]: message_id for message_id, row in messages.INDEX.items()}
"""Name of a message class → message id, without importing the class."""

FEEDS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("mode", "armed", "system_status"), ("Heartbeat",)),
    **dict.fromkeys(("landed_state", "vtol_state"), ("ExtendedSysState",)),
    **dict.fromkeys(("position", "velocity", "heading_deg"), ("GlobalPositionInt",)),
    **dict.fromkeys(("ground_speed_m_s", "air_speed_m_s", "climb_m_s", "throttle_percent"), ("VfrHud",)),
    **dict.fromkeys(("version", "capabilities"), ("AutopilotVersion",)),
    "attitude": ("Attitude",),
    "local_position": ("LocalPositionNed",),
    "gps": ("GpsRawInt",),
    "batteries": ("BatteryStatus",),
    "estimator": ("EkfStatusReport", "EstimatorStatus"),
    "sensors": ("SysStatus",),
    "home": ("HomePosition",),
    "origin": ("GpsGlobalOrigin",),
    "rc_channels": ("RcChannels",),
    "servo_outputs": ("ServoOutputRaw",),
    "wind": ("Wind", "WindCov"),
    "range_finders": ("DistanceSensor",),
    "vibration": ("Vibration",),
    "system_time": ("SystemTime",),
    "mission_current": ("MissionCurrent",),
    "mission_reached": ("MissionItemReached",),
    "status_text": ("Statustext",),
}
"""Name of a cell → names of the message classes; where there are several, each autopilot has its own."""


def message_type(class_name: str) -> type[Message]:
    """The message class of this name."""
    found: type[Message] = getattr(messages, class_name)
    return found
