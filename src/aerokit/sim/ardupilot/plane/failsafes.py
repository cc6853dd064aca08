"""ArduPlane's failsafes: a short and a long one of the radio, the long one of the ground station, the battery's."""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink.enums import MavCmd, MavMissionType, MavSeverity, PlaneMode
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.plane.host import PlaneHost
from aerokit.sim.local_frame import Ned

_NONE, _SHORT, _LONG, _GCS = range(4)
"""What goes on, as the texts call it."""
_SILENT_S, _COUNT_S = 1.0, 0.2
"""Without pulses for so long, and then counted for so long: the throttle failsafe."""
_SHORT_BEST_GUESS, _SHORT_FBWA, _SHORT_DISABLED, _SHORT_FBWB = 0, 2, 3, 4
_LONG_RTL, _LONG_GLIDE, _LONG_PARACHUTE, _LONG_AUTO, _LONG_AUTOLAND = range(1, 6)
_HEARTBEAT, _HEARTBEAT_OR_RSSI, _IN_AUTO = 1, 2, 3
"""FS_GCS_ENABL."""
_BATTERY_RTL, _LAND, _TERMINATE, _QLAND, _PARACHUTE, _LOITER_QLAND, _AUTOLAND_OR_RTL = range(1, 8)
_PILOTED = frozenset(
    {PlaneMode.MANUAL, PlaneMode.STABILIZE, PlaneMode.ACRO, PlaneMode.FLY_BY_WIRE_A, PlaneMode.AUTOTUNE}
    | {PlaneMode.FLY_BY_WIRE_B, PlaneMode.CRUISE, PlaneMode.TRAINING}
)
_NAVIGATING = frozenset({PlaneMode.AUTO, PlaneMode.GUIDED, PlaneMode.LOITER, PlaneMode.AUTOLAND})
_LONG_AS_PILOTED = _PILOTED | {PlaneMode.CIRCLE, PlaneMode.LOITER, PlaneMode.TAKEOFF}


class PlaneFailsafes(Failsafes):
    """FS_SHORT_ACTN after about a second without the radio, FS_LONG_ACTN after FS_LONG_TIMEOUT more; armed or not.

    A radio that comes back during the short one gives the mode back. Not simulated: the weak signal of FS_GCS_ENABL 2,
    parachutes and terminating.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (_TERMINATE, _PARACHUTE, _QLAND, _LAND, _BATTERY_RTL, 0)

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._plane = plane
        self.state: int = _NONE
        """0 nothing, 1 short and 2 long failsafe of the radio, 3 ground station."""
        self._short_since = math.nan
        self._bad_since = math.nan
        self._mode_before = self._mode_after = 0
        self._is_pending = False

    @property
    def is_any_active(self) -> bool:
        return self.state != _NONE or self.battery_is_low

    @property
    def hears_radio(self) -> bool:
        """Whether pulses come and the throttle is above THR_FS_VALUE."""
        return not (self.radio or self._is_radio_bad())

    def watch(self) -> None:
        self._watch_radio()
        self._watch_long()
        self._watch_short()
        self._resume_pending()
        super().watch()

    def _is_radio_bad(self) -> bool:
        plane = self._plane
        low = plane.parameters["THR_FAILSAFE"] != 0 and plane.rc[2] <= plane.parameters["THR_FS_VALUE"]
        return low or plane.now - self.radio_heard_at > _SILENT_S

    def _watch_radio(self) -> None:
        plane = self._plane
        if plane.rc.is_heard:
            self.radio_heard_at: float = plane.now
        if not self._is_radio_bad():
            self._bad_since = math.nan
            self._set_radio(False)
            return
        if math.isnan(self._bad_since):
            self._bad_since = plane.now
        if plane.parameters["THR_FAILSAFE"] == 1 and plane.now - self._bad_since >= _COUNT_S - 1e-6:
            self._set_radio(True)

    def _set_radio(self, lost: bool) -> None:
        if lost != self.radio:
            self.radio = lost
            self.say(f"Throttle failsafe {'on' if lost else 'off'}")

    def _watch_short(self) -> None:
        action = int(self._plane.parameters["FS_SHORT_ACTN"])
        if self.state == _NONE and self.radio and action != _SHORT_DISABLED and not self._is_landing():
            self._begin_short(action)
        elif self.state == _SHORT and (not self.radio or action == _SHORT_DISABLED):
            self._end_short()

    def _begin_short(self, action: int) -> None:
        plane = self._plane
        self.state, self._short_since = _SHORT, plane.now
        self._mode_before = plane.mode.number
        acts = self._mode_before in _PILOTED or (
            self._mode_before in _NAVIGATING and action != _SHORT_BEST_GUESS
        )
        if acts:
            modes = {_SHORT_FBWA: PlaneMode.FLY_BY_WIRE_A, _SHORT_FBWB: PlaneMode.FLY_BY_WIRE_B}
            plane.set_mode(modes.get(action, PlaneMode.CIRCLE))
        self._mode_after = plane.mode.number
        if self._mode_after != self._mode_before:
            self.say(f"RC Short Failsafe: switched to {plane.mode.name}")
        else:
            self.say("RC Short Failsafe On")

    def _end_short(self) -> None:
        plane = self._plane
        self.say("Short Failsafe Cleared")
        self.state = _NONE
        if self._mode_after != self._mode_before and plane.mode.number == self._mode_after:
            plane.set_mode(self._mode_before)
            self.say(f"Flight mode {plane.mode.name} restored", MavSeverity.INFO)

    def _watch_long(self) -> None:
        if self.state in (_LONG, _GCS):
            self._look_for_end()
            return
        plane = self._plane
        if self._is_landing():
            return
        since = self._short_since if self.state == _SHORT else self.radio_heard_at
        patience = plane.parameters["FS_LONG_TIMEOUT"]
        if self.radio and plane.now - since > patience:
            self._begin_long(_LONG)
        elif self._watches_ground_station() and self.ground_station_silence > patience:
            self.ground_station = True
            self._begin_long(_GCS)

    def _watches_ground_station(self) -> bool:
        enabled = int(self._plane.parameters["FS_GCS_ENABL"])
        in_auto = enabled == _IN_AUTO and self._plane.mode.number == PlaneMode.AUTO
        return in_auto or enabled in (_HEARTBEAT, _HEARTBEAT_OR_RSSI)

    def _look_for_end(self) -> None:
        parameters = self._plane.parameters
        name = "FS_LONG_TIMEOUT" if parameters["FS_SHORT_ACTN"] == _SHORT_DISABLED else "FS_SHORT_TIMEOUT"
        if self.state == _GCS and self.ground_station_silence < parameters[name]:
            self.ground_station: bool = False
            self._end_long("GCS Failsafe Off")
        elif self.state == _LONG and not self.radio:
            self._end_long("RC Long Failsafe Cleared")

    def _end_long(self, text: str) -> None:
        self.state, self._is_pending = _NONE, False
        self.say(text)

    def _begin_long(self, state: int) -> None:
        plane = self._plane
        plane.rc.release_overrides()
        self.state = state
        mode = plane.mode.number
        action = int(plane.parameters["FS_LONG_ACTN"])
        if mode in _LONG_AS_PILOTED:
            glides = action in (_LONG_GLIDE, _LONG_PARACHUTE)
            if mode == PlaneMode.TAKEOFF and plane.mode.is_taking_off and not glides:
                self._is_pending = True
            else:
                self._act_long(action or _LONG_RTL)
        elif mode == PlaneMode.RTL:
            if action in (_LONG_AUTO, _LONG_AUTOLAND):
                self._act_long(action)
        elif mode in (PlaneMode.AUTO, PlaneMode.GUIDED) and not self._is_landing():
            self._act_long(action)
        self.say(f"{'GCS' if state == _GCS else 'RC Long'} Failsafe On: {plane.mode.name}")

    def _act_long(self, action: int) -> None:
        plane = self._plane
        if action == _LONG_GLIDE:
            plane.set_mode(PlaneMode.FLY_BY_WIRE_A)
        elif action == _LONG_AUTO:
            plane.set_mode(PlaneMode.AUTO)
        elif action == _LONG_AUTOLAND:
            self.change_to(PlaneMode.AUTOLAND, PlaneMode.RTL)
        elif action == _LONG_RTL:
            plane.set_mode(PlaneMode.RTL)

    def _resume_pending(self) -> None:
        """What had to wait for the end of a take-off."""
        if self._is_pending and not (
            self._plane.mode.number == PlaneMode.TAKEOFF and self._plane.mode.is_taking_off
        ):
            self._is_pending = False
            if self._plane.mode.number == PlaneMode.TAKEOFF:
                self._begin_long(_LONG)

    def _is_landing(self) -> bool:
        return self._plane.mode.is_landing

    def act_on_battery(self, action: int) -> None:
        if action == _TERMINATE:
            self.refuse_termination()
        elif action in (_LAND, _QLAND, _LOITER_QLAND):
            if not self._is_landing() and not self._land_by_mission():
                self._return(action)
        elif action in (_BATTERY_RTL, _AUTOLAND_OR_RTL):
            self._return(action)

    def refuse_termination(self) -> None:
        """Say why the flight is not ended: AFS_ENABLE does not allow it, or nobody has said how (AFS_TERM_ACTION)."""
        text = "AFS not enabled, can't terminate the vehicle"
        if self._plane.parameters["AFS_ENABLE"]:
            text = "Unable to terminate, termination is not configured"
        self.say(text, MavSeverity.INFO)

    def _return(self, action: int) -> None:
        if self._is_landing():
            return
        first = (PlaneMode.AUTOLAND,) if action == _AUTOLAND_OR_RTL else ()
        self.change_to(*first, PlaneMode.RTL)

    def _land_by_mission(self) -> bool:
        """Jump to DO_LAND_START; without one it says so."""
        plane = self._plane
        starts = [
            index
            for index, item in enumerate(plane.missions.commands.items())
            if item.command == MavCmd.DO_LAND_START
        ]
        if not starts:
            self.say("Unable to start landing sequence")
            return False
        plane.mission.set_current(starts[0])
        self.say("Landing sequence start", MavSeverity.INFO)
        return plane.set_mode(PlaneMode.AUTO)


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

    def __init__(self, plane: PlaneHost) -> None:
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
        if self._plane.is_armed and not self.caused_mode:
            self._plane.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: VehicleMode) -> tuple[int, str] | None:
        if not self.forbids_modes() or not self._plane.is_armed:
            return None
        return MavSeverity.NOTICE, f"Mode change to {mode.name} denied, in fence recovery"

    def mode_changed(self) -> None:
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
