"""What PX4 does with a key for signing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.messages import AdsbVehicle, Collision, Heartbeat
from aerokit.sim.signing import VehicleSigning

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.signing import SigningKey
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Px4Signing"]

_UNSIGNED = frozenset((Heartbeat.ID, AdsbVehicle.ID, Collision.ID))


class Px4Signing(VehicleSigning):
    """It tells when a key is taken, and lets heartbeats in without a signature; 1.16 knows no signing.

    The time stamp is stored when a key is taken, and not again.
    """

    def __init__(self, vehicle: SimulatedPx4, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self._px4 = vehicle

    def is_for(self, link_id: int) -> bool:
        """Since 1.17."""
        return not self._px4.version.startswith("1.16")

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """Heartbeats and the traffic around, on every port."""
        return _may_be_unsigned

    def may_change(self) -> bool:
        """Not while armed."""
        if not self.is_for(0):
            return False
        if self._px4.is_armed:
            self._px4.send_text(MavSeverity.CRITICAL, "MAVLink signing: rejected while armed")
            return False
        return True

    def changed(self) -> None:
        """Say so."""
        self._px4.info("MAVLink signing disabled" if self.key is None else "MAVLink signing key accepted")


def _may_be_unsigned(frame: Frame) -> bool:
    return frame.message_id in _UNSIGNED
