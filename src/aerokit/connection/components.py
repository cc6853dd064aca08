"""What kind of component a HEARTBEAT comes from.

ArduPilot tells the processor's number in ``uid2`` (on Linux and in simulation the machine's id), and no ``uid``; PX4
tells both, in simulation constants and the system id. So several may tell the same, or nothing: that is no evidence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from aerokit.events import ComponentFound, VehicleFound
from aerokit.mavlink.enums import MavAutopilot, MavType

if TYPE_CHECKING:
    from aerokit.mavlink.messages import AutopilotVersion, Heartbeat

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


class HardwareId(NamedTuple):
    """As AUTOPILOT_VERSION has it; all zero is nothing told.

    https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION
    """

    uid2: bytes
    """18 bytes; MAVLink 1 has no room for them."""
    uid: int

    @classmethod
    def of(cls, message: AutopilotVersion) -> HardwareId:
        """What this message tells."""
        return cls(bytes(message.uid2), message.uid)

    @property
    def is_told(self) -> bool:
        """Whether it tells anything."""
        return bool(self.uid or any(self.uid2))

    def contradicts(self, other: HardwareId) -> bool:
        """Whether both tell one, by the same field, and not the same: by ``uid`` only where ``uid2`` is not told."""
        if any(self.uid2) and any(other.uid2):
            return self.uid2 != other.uid2
        return bool(self.uid and other.uid) and self.uid != other.uid

    def confirms(self, other: HardwareId) -> bool:
        """Whether both tell the same one, by ``uid2`` or by ``uid``."""
        is_same = (any(self.uid2) and self.uid2 == other.uid2) or (bool(self.uid) and self.uid == other.uid)
        return is_same and not self.contradicts(other)
