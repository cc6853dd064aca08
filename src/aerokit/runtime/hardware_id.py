"""``HardwareId``: which piece of hardware an autopilot says that it is: two that tell different ones are two vehicles.

ArduPilot tells the processor's number in ``uid2`` (on Linux and in simulation the machine's id), and no ``uid``; PX4
tells both, in simulation constants and the system id. So several may tell the same, or nothing: that is no evidence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from aerokit.mavlink.messages import AutopilotVersion

__all__ = ["HardwareId"]


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
