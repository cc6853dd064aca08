"""What an ArduRover does outside its fence."""

from __future__ import annotations

from typing import ClassVar

from aerokit.mavlink.enums import FenceMitigate, RoverMode
from aerokit.sim.ardupilot.fence import REPORT_ONLY, Fence
from aerokit.sim.ardupilot.rover.failsafes import modes_of_action

__all__ = ["RoverFence"]

_GIVE_UP_M = 100.0
_TERMINATE = 5


class RoverFence(Fence):
    """FENCE_ACTION is that of FS_ACTION; HOLD when it is far out. There is no height and no text."""

    PERIOD_S: ClassVar[float] = 0.1
    WATCHES_DISARMED: ClassVar[bool] = True
    MITIGATION: ClassVar[int] = FenceMitigate.NONE

    def act(self, new: int) -> None:
        """Change the mode, or stop the motors."""
        vehicle = self._vehicle
        action = int(vehicle.parameters["FENCE_ACTION"])
        if action == REPORT_ONLY:
            return
        if self.beyond_m(new) > _GIVE_UP_M:
            vehicle.set_mode(RoverMode.HOLD)
        elif action == _TERMINATE:
            vehicle.arming.disarm()
        else:
            self.caused_mode: bool = any(vehicle.set_mode(mode) for mode in modes_of_action(action))

    def mode_changed(self) -> None:
        """Ten seconds for the pilot."""
        super().mode_changed()
        self.recover_by_hand()
