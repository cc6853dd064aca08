"""What ArduPilot does with a key for signing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.signing import ONE_MINUTE, SigningKey, timestamp_at
from aerokit.sim.signing import VehicleSigning

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["ArduPilotSigning"]

_SAVE_EVERY_S = 30.0
_SIGNING_OFF = 1


class ArduPilotSigning(VehicleSigning):
    """It says nothing when a key is taken, stores its time stamp every 30 seconds, and begins a minute behind it.

    The first port counts as secure, as USB is on a flight controller: it signs, and lets everything in; set
    ``trusts_first_port`` to False, and call `load`, for a vehicle whose only link is a radio. Bit 0 of MAV1_OPTIONS,
    MAV2_OPTIONS … turns signing off on the first, second … port from the next boot or SETUP_SIGNING on.
    """

    AHEAD: ClassVar[int] = ONE_MINUTE

    def __init__(self, vehicle: ArduPilotVehicle, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self.trusts_first_port = True
        self._ardupilot = vehicle
        vehicle.when_powered_on(self._keep_time)

    def is_for(self, link_id: int) -> bool:
        """Signing can be turned off for a port."""
        name, parameters = f"MAV{link_id + 1}_OPTIONS", self._ardupilot.parameters
        return not (name in parameters and int(parameters[name]) & _SIGNING_OFF)

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """Everything on the first port."""
        return _everything if link_id == 0 and self.trusts_first_port else None

    def may_change(self) -> bool:
        """Not while armed."""
        if self._ardupilot.is_armed:
            self._ardupilot.send_text(MavSeverity.WARNING, "ERROR: Won't setup signing when armed")
            return False
        return True

    def _keep_time(self) -> None:
        self._ardupilot.every(_SAVE_EVERY_S, self._save)
        self._ardupilot.call_later(self._ardupilot.timeline.gps_fix, self._hear_gps)

    def _hear_gps(self) -> None:
        """GPS knows the time: stamps are not before it."""
        stamp = timestamp_at(int(self._ardupilot.unix_time))
        for channel in self._ardupilot.channels:
            if channel.signing is not None:
                channel.signing.timestamp = max(channel.signing.timestamp, stamp)
        self._save()

    def _save(self) -> None:
        if self.key is not None:
            used = [each.signing.timestamp for each in self._ardupilot.channels if each.signing is not None]
            self.timestamp: int = max([self.timestamp, *used])


def _everything(_: Frame) -> bool:
    return True
