"""MAV_CMD_DO_SET_ROI and its siblings: what the gimbal looks at, or a copter that has none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["RegionOfInterest"]


class RegionOfInterest:
    """Accepted with or without a gimbal, which alone follows another vehicle (…_SYSID), as far as it is heard."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle

    @property
    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler."""
        return {
            MavCmd.DO_SET_ROI: self._look_at,
            MavCmd.DO_SET_ROI_LOCATION: self._look_at,
            MavCmd.DO_SET_ROI_NONE: self._look_ahead,
            MavCmd.DO_SET_ROI_SYSID: self._follow,
        }

    def _look_at(self, command: Command) -> int:
        """No latitude, no longitude and no altitude means nothing any more."""
        point = self._vehicle.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        nowhere = command.place() == (0, 0) and command.z == 0
        self._vehicle.look_at(None if nowhere else point)
        return MavResult.ACCEPTED

    def _follow(self, command: Command) -> int:
        self._vehicle.gimbal.follow(whole(command.param1))
        return MavResult.ACCEPTED

    def _look_ahead(self, _: Command) -> int:
        self._vehicle.look_at(None)
        return MavResult.ACCEPTED
