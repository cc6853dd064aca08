"""What an ArduPlane does outside its fence, and where it returns to."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavCmd, MavMissionType, MavSeverity, PlaneMode
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.rally import best_return_place

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.mode import VehicleMode
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane

__all__ = ["PlaneFence"]

_RTL, _GUIDED, _GUIDED_THROTTLE, _AUTOLAND = 1, 6, 7, 8
"""FENCE_ACTION."""
_RETURNS = frozenset({_RTL, _GUIDED, _GUIDED_THROTTLE, _AUTOLAND})


class PlaneFence(Fence):
    """FENCE_ACTION: nothing (0), RTL (1), GUIDED to the return point (6, 7), AUTOLAND or RTL (8).

    While it returns it minds no other breach. When the fence is switched off on the way to the return point, it goes
    back into the mode before.
    """

    CIRCLE_BACKUP_M: ClassVar[float] = 100.0
    WATCHES_DISARMED: ClassVar[bool] = True

    def __init__(self, plane: SimulatedPlane) -> None:
        super().__init__(plane)
        self._plane = plane
        self._mode_before: int | None = None

    def update(self) -> None:
        """Look where the aeroplane is and act on a new breach."""
        super().update()
        if not self.enabled and self.caused_mode and self._mode_before is not None:
            if self._plane.mode.number == PlaneMode.GUIDED and self._action in _RETURNS:
                self._plane.set_mode(self._mode_before)
            self.caused_mode = False

    def act(self, new: int) -> None:
        """Say it and turn back."""
        plane = self._plane
        if self.caused_mode:
            return
        self.tell("breached", new)
        before = plane.mode.number
        if self._action == _RTL:
            self._turn_back(before, PlaneMode.RTL)
        elif self._action == _AUTOLAND and before != PlaneMode.AUTOLAND:
            self._turn_back(before, PlaneMode.AUTOLAND, PlaneMode.RTL)
        elif self._action in (_GUIDED, _GUIDED_THROTTLE):
            self._turn_back(before, PlaneMode.GUIDED)
            plane.guided.go_to(self.return_place())

    def return_place(self) -> Ned:
        """Where GUIDED circles: the fence's return point or home, half-way between the heights or at FENCE_RET_ALT."""
        plane, parameters = self._plane, self._plane.parameters
        home = plane.navigation.home or (0.0, 0.0, plane.wing.ground_down)
        if parameters["FENCE_RET_RALLY"]:
            return best_return_place(plane, (home[0], home[1], home[2] - parameters["RTL_ALTITUDE"]))
        lowest = parameters["FENCE_ALT_MIN"] + parameters["FENCE_MARGIN"]
        highest = parameters["FENCE_ALT_MAX"] - parameters["FENCE_MARGIN"]
        height = parameters["FENCE_RET_ALT"]
        if height <= 0:
            height = parameters["RTL_ALTITUDE"] if lowest >= highest else (lowest + highest) / 2.0
        north, east = self._return_point() or home[:2]
        return (north, east, home[2] - height)

    def cleared(self) -> None:
        """It says so unless it is returning."""
        if self._plane.is_armed and not self.caused_mode:
            self._plane.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: VehicleMode) -> tuple[int, str] | None:
        """FENCE_OPTIONS does so by default."""
        if not self.forbids_modes() or not self._plane.is_armed:
            return None
        return MavSeverity.NOTICE, f"Mode change to {mode.name} denied, in fence recovery"

    def mode_changed(self) -> None:
        """Ten seconds for the pilot."""
        super().mode_changed()
        self.recover_by_hand()

    @property
    def _action(self) -> int:
        return int(self._plane.parameters["FENCE_ACTION"])

    def _turn_back(self, before: int, *modes: int) -> None:
        self.caused_mode: bool = any(self._plane.set_mode(mode) for mode in modes)
        self._mode_before = before

    def _return_point(self) -> tuple[float, float] | None:
        items = self._plane.missions.items(MavMissionType.FENCE)
        for item in items:
            if item.command == MavCmd.NAV_FENCE_RETURN_POINT:
                return self._plane.frame.to_local(int(item.x), int(item.y))
        return None
