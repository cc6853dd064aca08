"""Mission mode (AUTO.MISSION) of a simulated PX4.

Simulated: take-off, waypoints with hold time, acceptance radius and heading, loitering, delays, landing, return,
speed, jumps. Other commands are skipped. Not simulated: regions of interest, circles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavSeverity, MavType, MissionState
from aerokit.mavlink.messages import MissionItemReached
from aerokit.missions import MissionItem
from aerokit.sim.motion import Ned
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.modes import HOLD, LAND, MISSION, RTL, TAKEOFF

TAKE_OFFS = (Cmd.NAV_TAKEOFF, Cmd.NAV_VTOL_TAKEOFF)
LANDINGS = (Cmd.NAV_LAND, Cmd.NAV_VTOL_LAND)
_WITH_PLACE = (
    Cmd.NAV_WAYPOINT,
    Cmd.NAV_LOITER_UNLIM,
    Cmd.NAV_LOITER_TIME,
    Cmd.NAV_LOITER_TO_ALT,
    *TAKE_OFFS,
    *LANDINGS,
)
# Commands that PX4 stores, but that make a mission invalid.
_STORED_ONLY = (Cmd.CONDITION_DELAY, Cmd.CONDITION_DISTANCE, Cmd.NAV_FENCE_RETURN_POINT)
_VTOL = (Cmd.NAV_VTOL_TAKEOFF, Cmd.NAV_VTOL_LAND)
_MAX_FIRST_DISTANCE_M = 10_000.0


def rejection(px4: Px4Host, items: Sequence[MissionItem]) -> str | None:
    """Return the text with which PX4 rejects a mission, or None."""
    if px4.VEHICLE_TYPE == MavType.QUADROTOR and any(item.command in _VTOL for item in items):
        return "Mission contains VTOL items but vehicle is not a VTOL"
    has_place = False
    _, _, home_down = px4.home
    for number, item in enumerate(items, start=1):
        if item.command in _STORED_ONLY:
            return f"item {number}: unsupported cmd: {item.command:d}"
        if item.command == Cmd.NAV_LAND and number == 1 and px4.is_landed:
            return "starts with landing"
        if item.command in TAKE_OFFS:
            _, _, down = px4.place_of(item)
            if down >= home_down:
                return "Takeoff altitude below home altitude!"
            if has_place:
                return "takeoff not first waypoint item"
        has_place = has_place or item.command in _WITH_PLACE
    # PX4 also checks the glide slope of a landing, which is not simulated.
    return _missing_landing(px4, items) or _landing_problem(items)


def _missing_landing(px4: Px4Host, items: Sequence[MissionItem]) -> str | None:
    if "MIS_TKO_LAND_REQ" not in px4.parameters or not items:  # A multicopter has no MIS_TKO_LAND_REQ.
        return None
    takes_off = any(item.command in TAKE_OFFS for item in items)
    lands = any(item.command in LANDINGS for item in items)
    # The default of planes is 2: a landing is required.
    required = round(px4.parameters["MIS_TKO_LAND_REQ"])
    if required == 1 and not takes_off:
        return "Takeoff waypoint required."
    if required == 2 and not lands:
        return "Landing waypoint/pattern required."
    if required == 3 and not (takes_off and lands):
        return "Takeoff or Landing item missing."
    if required == 4 and takes_off and not lands:
        return "Add Landing item or remove Takeoff."
    if required == 4 and lands and not takes_off:
        return "Add Takeoff item or remove Landing."
    return None


def _landing_problem(items: Sequence[MissionItem]) -> str | None:
    """Return PX4's text if DO_LAND_START, landings and RETURN_TO_LAUNCH follow each other in an invalid sequence."""
    # Indices of DO_LAND_START (`land_start`) and of the item before the landing (`approach`); -1 without such an item.
    land_start = approach = -1
    for index, item in enumerate(items):
        if item.command == Cmd.DO_LAND_START:
            if land_start >= 0:
                return "more than one land start."
            land_start = index
        elif item.command in LANDINGS:
            if index == 0:
                return "starts with land waypoint."
            approach = index - 1
        elif item.command == Cmd.NAV_RETURN_TO_LAUNCH and land_start >= 0:
            return "land start item before RTL item not possible."
    # A landing must follow DO_LAND_START.
    return "invalid land start." if land_start > approach else None


def outside_fence(px4: Px4Host, items: Sequence[MissionItem]) -> int | None:
    """Return the number of the first item outside the geofence. The first item has the number 1."""
    for number, item in enumerate(items, start=1):
        if item.command in _WITH_PLACE and not px4.failsafes.fence.allows(px4.place_of(item)):
            return number
    return None


def distance_warning(px4: Px4Host, items: Sequence[MissionItem]) -> str | None:
    first = next((item for item in items if item.command in _WITH_PLACE), None)
    distance = 0.0 if first is None else math.dist(px4.place_of(first)[:2], px4.home[:2])  # north and east
    if distance < _MAX_FIRST_DISTANCE_M:
        return None
    return f"First waypoint far away from home: {int(distance)}m. Correct mission loaded?"


_REPEATS = 10
_HEIGHT_REACHED_M = 0.8

_STAYING = (Cmd.NAV_WAYPOINT, Cmd.NAV_LOITER_TIME)
_MAX_JUMPS = 100
_ACTIVE_MODES = (MISSION, TAKEOFF, LAND)


class Px4Mission:
    """Mission mode. In flight, `update` is called at every tick."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.current: int = 0  # Index of the item that is flown now or next.
        self.reached: int = -1  # Index of the item that was reached last; -1 if there is none.
        self.is_finished: bool = False  # True after the last item was completed.
        self._needs_selection = False  # True from the end of the mission until a client selects an item.
        self.is_valid: bool = False  # True if there is a mission and it can be flown.
        self._phase = ""  # Phase of the current item: "climb", "go" or "land".
        self._arrived_at = math.nan  # time of arrival at the current item; NaN before
        self._jumps: dict[int, int] = {}  # Number of jumps that each DO_JUMP has done, by its index.
        self._state = int(MissionState.NO_MISSION)  # a MISSION_STATE
        self._repeats_left = 0  # how often MISSION_ITEM_REACHED is still repeated
        self._is_report_scheduled = False  # True while `_send_reached` is scheduled

    def start(self) -> None:
        self.is_valid = bool(self.count) and rejection(self._px4, self._px4.missions.commands) is None
        self._px4.every(1.0, self._repeat_reached)

    @property
    def count(self) -> int:
        return len(self._px4.missions.commands)

    @property
    def _item(self) -> MissionItem | None:
        return self._px4.missions.item(0, self.current)

    @property
    def mode(self) -> int:
        """``mission_mode`` of MISSION_CURRENT: 1 in modes that fly missions, 2 otherwise."""
        return 1 if self._px4.mode in _ACTIVE_MODES else 2

    @property
    def state(self) -> int:
        if not self.is_valid:
            self._state = MissionState.NO_MISSION
        elif self.is_finished:
            self._state = MissionState.COMPLETE
        elif self._px4.mode in _ACTIVE_MODES:
            self._state = MissionState.ACTIVE
        elif self.reached >= 0:
            self._state = MissionState.PAUSED
        elif self.current < 1:
            self._state = MissionState.NOT_STARTED
        return self._state  # If no condition is met, PX4 keeps the previous state.

    @property
    def wants_up(self) -> bool:
        return self._item is not None and not self.is_finished and self._phase != "land"

    def on_replaced(self, current: int) -> None:
        self.current = max(0, current)
        self.is_finished = self._needs_selection = False
        self.forget_reached()
        self._jumps.clear()
        self._validate()
        if self._px4.mode != MISSION:
            return
        if self.is_valid:
            self._begin_item()
        elif self._px4.is_armed and not self._px4.is_landed:
            self._px4.send_text(MavSeverity.CRITICAL, "No valid mission available, loitering")
            self._px4.change_mode(HOLD)

    def _validate(self) -> None:
        items = self._px4.missions.commands
        problem = rejection(self._px4, items)
        warning = distance_warning(self._px4, items)
        outside_number = outside_fence(self._px4, items)
        # An invalid mission stays stored, but is not flown.
        self.is_valid = bool(items) and problem is None and outside_number is None
        if outside_number is not None:
            self._px4.send_text(MavSeverity.CRITICAL, f"Geofence violation for waypoint {outside_number}")
        if problem is not None:
            self._px4.send_text(MavSeverity.CRITICAL, f"Mission rejected: {problem}")
        if warning is not None:
            self._px4.send_text(MavSeverity.CRITICAL, warning)

    def forget_reached(self) -> None:
        self.reached = -1
        self._repeats_left = 0

    def set_current(self, seq: int) -> None:
        self.current = seq
        self._needs_selection = False
        self._jumps.clear()
        if self._px4.mode == MISSION:
            self.is_finished = False
            self._begin_item()

    def enter(self) -> None:
        if not self.is_valid:
            return
        # In the air, PX4 flies a finished mission again only after a client has selected an item (mission_base.cpp,
        # checkMissionRestart).
        if self._needs_selection and self._px4.is_armed and not self._px4.is_landed:
            self._px4.send_text(MavSeverity.CRITICAL, "No valid mission available, loitering")
            self._px4.call_later(0.0, self._hold)
            return
        if self.current >= self.count or self._needs_selection:
            self.current = 0
            self.forget_reached()
            self._jumps.clear()
        self.is_finished = self._needs_selection = False
        if self._px4.is_armed:
            self._px4.info("Executing Mission")
        self._begin_item()

    def _begin_item(self) -> None:
        """Execute commands up to the next item with a position, and make that item the target."""
        for _ in range(_MAX_JUMPS + self.count):  # The number of steps is limited, because DO_JUMPs can form a loop.
            item = self._item
            self._arrived_at = math.nan
            if item is None:
                self._finish()
                return
            if item.command in _WITH_PLACE or item.command == Cmd.NAV_DELAY:
                self._set_target_for(item)
                return
            if item.command == Cmd.DO_JUMP:
                self.current = self._index_after_jump(item)
                continue
            self._execute(item)
            self._mark_reached()
            if not self._advance():
                return

    def _execute(self, item: MissionItem) -> None:
        px4 = self._px4
        if item.command == Cmd.DO_CHANGE_SPEED and item.param2 > 0:
            px4.flight.speed_m_s = min(item.param2, px4.flight.top_speed_m_s)
        elif item.command == Cmd.NAV_RETURN_TO_LAUNCH:
            px4.call_later(0.0, self._return)

    def _return(self) -> None:
        self._px4.change_mode(HOLD)
        # HOLD comes first, so that the mission is not resumed after the landing.
        if self._px4.change_mode(RTL):
            self._px4.info("Returning to launch")

    def _index_after_jump(self, item: MissionItem) -> int:
        """Return the index at which the mission continues after a DO_JUMP."""
        index = self.current
        jumps_done = self._jumps.get(index, 0)
        if jumps_done >= item.param2:
            self._jumps.pop(index, None)  # The next execution of this DO_JUMP counts again from 0.
            return index + 1
        self._jumps[index] = jumps_done + 1
        # PX4 stores in the item how often it has jumped, and sends the changed item to the last client.
        self._px4.missions.on_item_changed(index)
        is_target_valid = 0 <= item.param1 < self.count
        return int(item.param1) if is_target_valid else index + 1

    def _set_target_for(self, item: MissionItem) -> None:
        px4, motion = self._px4, self._px4.motion
        self._phase = "go"
        if item.command == Cmd.NAV_DELAY:
            px4.flight.stay_here()
            return
        target = self._place(item)
        north, east, down = target
        has_heading = item.command == Cmd.NAV_WAYPOINT and math.isfinite(item.param4)
        px4.flight.heading = math.radians(item.param4) if has_heading else None
        if px4.is_landed or item.command in TAKE_OFFS:  # On the ground, every item begins with a climb.
            self._climb(down if item.command in TAKE_OFFS else None)
        elif item.command in LANDINGS:
            # Fly to the landing point at the present height; `update` then descends.
            px4.flight.target = (north, east, motion.down)
        else:
            px4.flight.target = target

    def _climb(self, down: float | None) -> None:
        """Start a vertical climb to ``down``. None selects MIS_TAKEOFF_ALT above home."""
        px4, motion = self._px4, self._px4.motion
        _, _, home_down = px4.home
        if down is None:
            down = home_down - px4.parameters["MIS_TAKEOFF_ALT"]
        self._phase = "climb"
        px4.flight.target = (motion.north, motion.east, min(down, motion.down))
        if px4.is_armed:
            px4.info(f"Climb to {home_down - down:.1f} meters above home")

    def _place(self, item: MissionItem) -> Ned:
        # For PX4, latitude and longitude 0 are an ordinary position.
        north, east, down = self._px4.place_of(item)
        return (north, east, down if math.isfinite(down) else self._px4.motion.down)

    def update(self) -> None:
        item, flight = self._item, self._px4.flight
        if item is None or self.is_finished:
            flight.fly_to_target()
            return
        if self._phase == "land":
            flight.descend()
            return
        flight.fly_to_target()
        if not self._is_at_target(item):
            return
        if self._phase == "climb":
            self._phase = "go"
            flight.target = self._place(item)
            return
        if math.isnan(self._arrived_at):
            self._arrived_at = self._px4.now
        if item.command in LANDINGS:
            self._phase = "land"
            self._mark_reached()
        elif self._is_done(item):
            self._complete_item(item)

    def _complete_item(self, item: MissionItem) -> None:
        self._mark_reached()
        if item.autocontinue and self._advance():
            self._begin_item()

    def _is_at_target(self, item: MissionItem) -> bool:
        if item.command == Cmd.NAV_DELAY:
            return True
        motion, target = self._px4.motion, self._px4.flight.target
        _, _, down = target
        is_near = motion.distance_to(target) <= self._acceptance_radius_m(item)
        return is_near and abs(down - motion.down) <= self._height_tolerance_m

    def _acceptance_radius_m(self, item: MissionItem) -> float:
        has_own_radius = item.command == Cmd.NAV_WAYPOINT and item.param2 > 0
        return item.param2 if has_own_radius else self._px4.parameters["NAV_ACC_RAD"]

    @property
    def _height_tolerance_m(self) -> float:
        return _HEIGHT_REACHED_M

    def _is_done(self, item: MissionItem) -> bool:
        if item.command == Cmd.NAV_LOITER_UNLIM:
            return False
        stays = item.command in _STAYING or item.command == Cmd.NAV_DELAY
        if not stays:
            return True
        return self._px4.now - self._arrived_at >= item.param1

    def on_landed(self) -> None:
        if self._px4.mode == MISSION and self._phase == "land" and not self.is_finished:
            self._mark_reached()
            if self._advance():
                self._begin_item()
        elif self._px4.mode == LAND:
            self.is_finished = True  # land.cpp sets mission_result.finished.

    def _advance(self) -> bool:
        """Select the next item and return True. After the last item, finish the mission and return False."""
        if self.current + 1 < self.count:
            self.current += 1
            return True
        self._finish()
        return False

    def _finish(self) -> None:
        px4 = self._px4
        self.is_finished = self._needs_selection = True
        # After the last item, that item stays current. A DO_JUMP is never current (mission_base.cpp, getNonJumpItem).
        self.current = max(0, min(self.current, self.count - 1))
        while self.current > 0 and self._px4.missions.commands[self.current].command == Cmd.DO_JUMP:
            self.current -= 1
        if px4.is_landed:
            px4.info("Mission finished, landed")
            return
        px4.info("Mission finished, loitering")
        px4.flight.stay_here()
        px4.call_later(0.0, self._hold)

    def _hold(self) -> None:
        is_flying = self._px4.is_armed and not self._px4.is_landed
        if self.is_finished and is_flying and self._px4.mode == MISSION:
            self._px4.change_mode(HOLD)

    def _mark_reached(self) -> None:
        if self.reached == self.current:
            return
        self.reached = self.current
        self._repeats_left = _REPEATS
        # Of several items in the same tick, only the last is reported.
        if not self._is_report_scheduled:
            self._is_report_scheduled = True
            self._px4.call_later(0.0, self._send_reached)

    def _send_reached(self) -> None:
        self._is_report_scheduled = False
        if self.reached >= 0:
            self._px4.send(MissionItemReached(self.reached))

    def _repeat_reached(self) -> None:
        if self._repeats_left > 0 and self.reached >= 0 and self.count:
            self._repeats_left -= 1
            self._px4.send(MissionItemReached(self.reached))
