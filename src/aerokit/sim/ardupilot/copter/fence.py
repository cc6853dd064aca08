"""What an ArduCopter does outside its fence."""

from __future__ import annotations

from typing import ClassVar

from aerokit.mavlink.enums import CopterMode, FenceMitigate, MavSeverity
from aerokit.sim.ardupilot.fence import REPORT_ONLY, Fence
from aerokit.sim.ardupilot.mode import VehicleMode

__all__ = ["CopterFence"]

_GIVE_UP_M = 100.0
_ACTIONS: dict[int, tuple[int, ...]] = {
    1: (CopterMode.RTL, CopterMode.LAND),
    2: (CopterMode.LAND,),
    3: (CopterMode.SMART_RTL, CopterMode.RTL, CopterMode.LAND),
    4: (CopterMode.BRAKE, CopterMode.LAND),
    5: (CopterMode.SMART_RTL, CopterMode.LAND),
}


class CopterFence(Fence):
    """FENCE_ACTION: nothing (0), RTL (1), LAND (2), SMART_RTL (3, 5), BRAKE (4); LAND if that fails or far out."""

    PERIOD_S: ClassVar[float] = 0.1
    WATCHES_DISARMED: ClassVar[bool] = True
    MITIGATION: ClassVar[int] = FenceMitigate.NONE

    def act(self, new: int) -> None:
        """On the ground the motors stop; in the air FENCE_ACTION follows."""
        vehicle = self._vehicle
        action = int(vehicle.parameters["FENCE_ACTION"])
        if vehicle.is_landed:
            if action != REPORT_ONLY:
                vehicle.arming.disarm()
            return
        self.tell("breached", new)
        if action == REPORT_ONLY:
            return
        modes = (CopterMode.LAND,) if self.beyond_m(new) > _GIVE_UP_M else _ACTIONS.get(action, _ACTIONS[1])
        self.caused_mode: bool = any(vehicle.set_mode(mode) for mode in modes)

    def cleared(self) -> None:
        """It says so in the air."""
        if not self._vehicle.is_landed:
            self._vehicle.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: VehicleMode) -> tuple[int, str] | None:
        """Only in the air."""
        if not self.forbids_modes() or not self._vehicle.is_armed or self._vehicle.is_landed:
            return None
        return MavSeverity.WARNING, f"Mode change to {mode.name} failed: in fence recovery"

    def mode_changed(self) -> None:
        """Ten seconds for the pilot, unless the fence only reports."""
        super().mode_changed()
        if self._vehicle.parameters["FENCE_ACTION"] != REPORT_ONLY:
            self.recover_by_hand()
