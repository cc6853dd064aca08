"""AUTO.MISSION of a simulated PX4 aeroplane: climb-out, waypoints flown over, circles, a straight approach."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd
from aerokit.sim.px4.mission import Mission
from aerokit.sim.px4.modes import HOLD

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.px4.plane import SimulatedPx4Plane

__all__ = ["PlaneMission"]

_C = MavCmd
_TAKE_OFFS = (_C.NAV_TAKEOFF, _C.NAV_VTOL_TAKEOFF)
_LANDINGS = (_C.NAV_LAND, _C.NAV_VTOL_LAND)
_CIRCLES = (_C.NAV_LOITER_UNLIM, _C.NAV_LOITER_TIME, _C.NAV_LOITER_TO_ALT)
_TURN_S = 2.0


class PlaneMission(Mission):
    """The mission mode of an aeroplane."""

    def __init__(self, plane: SimulatedPx4Plane) -> None:
        super().__init__(plane)
        self._plane = plane

    def _climb(self, down: float | None) -> None:
        super()._climb(down)
        self._plane.flight.course = self._plane.motion.yaw

    def _aim(self, item: MissionItem) -> None:
        super()._aim(item)
        flight = self._plane.flight
        radius = {_C.NAV_LOITER_UNLIM: item.param3, _C.NAV_LOITER_TIME: item.param3}.get(
            MavCmd(item.command), item.param2 if item.command == _C.NAV_LOITER_TO_ALT else 0.0
        )
        default = self._plane.parameters["NAV_LOITER_RAD"]
        flight.radius_m = radius if radius and math.isfinite(radius) else default
        if item.command in _LANDINGS:
            self._phase = "land"

    def update(self) -> None:
        """One tick: steer, and look whether the item is reached."""
        item, flight = self._item, self._plane.flight
        if item is None or self.is_finished:
            flight.circle()
        elif self._phase == "land":
            flight.descend()
        elif self._phase == "climb":
            flight.climb_out()
            if self._plane.motion.down <= flight.target[2]:
                self._leave_climb(item)
        else:
            self._go(item)

    def _leave_climb(self, item: MissionItem) -> None:
        if item.command in _TAKE_OFFS:
            self._pass(item)
        else:
            self._phase = "go"
            self._plane.flight.target = self._place(item)

    def _go(self, item: MissionItem) -> None:
        flight = self._plane.flight
        if item.command in _CIRCLES or item.command == _C.NAV_DELAY:
            flight.circle()
        else:
            flight.fly_straight()
        if not self._is_there(item):
            return
        if math.isnan(self._arrived_at):
            self._arrived_at = self._plane.now
        if self._is_done(item):
            self._pass(item)

    def _pass(self, item: MissionItem) -> None:
        self._reach()
        if item.autocontinue and self._advance():
            self._begin_item()

    def _is_there(self, item: MissionItem) -> bool:
        if item.command == _C.NAV_DELAY:
            return True
        plane, motion = self._plane, self._plane.motion
        north, east, down = plane.flight.target
        radius = max(plane.parameters["NAV_ACC_RAD"], item.param2 if item.command == _C.NAV_WAYPOINT else 0.0)
        radius = max(radius, _TURN_S * motion.airspeed_m_s)
        if item.command in _CIRCLES:
            radius += abs(plane.flight.radius_m)
        near = math.hypot(north - motion.north, east - motion.east) <= radius
        return near and abs(down - motion.down) <= plane.parameters["NAV_FW_ALT_RAD"]

    def _hold(self) -> None:
        """What the commander does when a mission has ended in the air."""
        target = self._plane.flight.target
        super()._hold()
        if self._plane.mode == HOLD:
            self._plane.flight.target = target
