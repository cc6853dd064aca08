"""ArduPlane's failsafes (radio, ground station, battery) and its fence."""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink.enums import MavCmd, MavMissionType, MavSeverity, PlaneMode
from aerokit.sim.ardupilot.failsafes import ArduPilotFailsafes
from aerokit.sim.ardupilot.fence import ArduPilotFence
from aerokit.sim.ardupilot.host import RC_THROTTLE, ArduPilotMode, ConditionTimer
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.plane_modes import PlaneHost
from aerokit.sim.motion import Ned

_NONE, _SHORT, _LONG, _GCS = range(4)
# Time without pulses after which the radio is bad, and time after which a bad radio counts as lost.
_RADIO_TIMEOUT_S, _MIN_BAD_S = 1.0, 0.2
# Values of FS_SHORT_ACTN, FS_LONG_ACTN and FS_GCS_ENABL, and of the battery actions.
_SHORT_BEST_GUESS, _SHORT_FBWA, _SHORT_DISABLED, _SHORT_FBWB = 0, 2, 3, 4
_LONG_RTL, _LONG_GLIDE, _LONG_PARACHUTE, _LONG_AUTO, _LONG_AUTOLAND = range(1, 6)
_HEARTBEAT, _HEARTBEAT_OR_RSSI, _IN_AUTO = 1, 2, 3
_BATTERY_RTL, _LAND, _TERMINATE, _QLAND, _PARACHUTE, _LOITER_QLAND, _AUTOLAND_OR_RTL = range(1, 8)
_PILOTED = frozenset(
    {PlaneMode.MANUAL, PlaneMode.STABILIZE, PlaneMode.ACRO, PlaneMode.FLY_BY_WIRE_A, PlaneMode.AUTOTUNE}
    | {PlaneMode.FLY_BY_WIRE_B, PlaneMode.CRUISE, PlaneMode.TRAINING}
)
_NAVIGATING = frozenset({PlaneMode.AUTO, PlaneMode.GUIDED, PlaneMode.LOITER, PlaneMode.AUTOLAND})
_PILOTED_FOR_LONG_FAILSAFE = _PILOTED | {PlaneMode.CIRCLE, PlaneMode.LOITER, PlaneMode.TAKEOFF}
_SHORT_MODES = {_SHORT_FBWA: PlaneMode.FLY_BY_WIRE_A, _SHORT_FBWB: PlaneMode.FLY_BY_WIRE_B}
_LONG_MODES: dict[int, tuple[int, ...]] = {
    _LONG_GLIDE: (PlaneMode.FLY_BY_WIRE_A,),
    _LONG_AUTO: (PlaneMode.AUTO,),
    _LONG_AUTOLAND: (PlaneMode.AUTOLAND, PlaneMode.RTL),
    _LONG_RTL: (PlaneMode.RTL,),
}


class PlaneFailsafes(ArduPilotFailsafes[PlaneHost]):
    """Failsafes of radio, ground station and battery, which act on armed and disarmed planes.

    FS_SHORT_ACTN is executed when the radio is lost, FS_LONG_ACTN after a further FS_LONG_TIMEOUT. If the radio returns
    before FS_LONG_ACTN, the previous mode is restored. Not simulated: the weak signal of FS_GCS_ENABL 2, parachutes,
    termination.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (_TERMINATE, _PARACHUTE, _QLAND, _LAND, _BATTERY_RTL, 0)

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        # The active failsafe: none, the short or the long failsafe of the radio, or that of the ground station.
        self.state: int = _NONE
        self._short_since = math.nan  # start of the short failsafe
        self._radio_bad = ConditionTimer()
        # Numbers of the modes before and after the start of the short failsafe.
        self._mode_before = 0
        self._mode_after = 0
        self._is_long_pending = False  # True if FS_LONG_ACTN waits for the end of the initial climb

    @property
    def is_any_active(self) -> bool:
        return self.state != _NONE or self.battery_is_low

    @property
    def is_radio_healthy(self) -> bool:
        return not (self.is_radio_lost or self._is_radio_bad())

    def update(self) -> None:
        self._check_radio()
        self._check_long()
        self._check_short()
        self._resume_pending()
        super().update()

    def _is_radio_bad(self) -> bool:
        plane = self.vehicle
        checks_throttle = plane.parameters["THR_FAILSAFE"] != 0
        is_throttle_low = checks_throttle and plane.rc[RC_THROTTLE] <= plane.parameters["THR_FS_VALUE"]
        return is_throttle_low or plane.now - self.radio_received_at > _RADIO_TIMEOUT_S

    def _check_radio(self) -> None:
        plane = self.vehicle
        if plane.rc.is_receiving:
            self.radio_received_at: float = plane.now
        is_bad = self._is_radio_bad()
        bad_for = self._radio_bad.seconds(is_bad, plane.now)
        if not is_bad:
            self._set_radio_lost(is_lost=False)
        elif plane.parameters["THR_FAILSAFE"] == 1 and bad_for >= _MIN_BAD_S - 1e-6:  # tolerates rounding errors
            self._set_radio_lost(is_lost=True)

    def _set_radio_lost(self, *, is_lost: bool) -> None:
        if is_lost != self.is_radio_lost:
            self.is_radio_lost = is_lost
            self.warn(f"Throttle failsafe {'on' if is_lost else 'off'}")

    def _check_short(self) -> None:
        action = int(self.vehicle.parameters["FS_SHORT_ACTN"])
        is_needed = self.is_radio_lost and action != _SHORT_DISABLED
        is_landing = self.vehicle.mode.is_landing
        if self.state == _NONE and is_needed and not is_landing:
            self._start_short(action)
        elif self.state == _SHORT and not is_needed:
            self._end_short()

    def _start_short(self, action: int) -> None:
        plane = self.vehicle
        self.state = _SHORT
        self._short_since = plane.now
        mode = plane.mode.number
        self._mode_before = mode
        # A mode in `_NAVIGATING` continues if the action is "best guess" (events.cpp).
        if mode in _PILOTED or (mode in _NAVIGATING and action != _SHORT_BEST_GUESS):
            plane.set_mode(_SHORT_MODES.get(action, PlaneMode.CIRCLE))  # All other actions select CIRCLE.
        self._mode_after = plane.mode.number
        if self._mode_after != self._mode_before:
            self.warn(f"RC Short Failsafe: switched to {plane.mode.name}")
        else:
            self.warn("RC Short Failsafe On")

    def _end_short(self) -> None:
        plane = self.vehicle
        self.warn("Short Failsafe Cleared")
        self.state = _NONE
        if self._mode_after != self._mode_before and plane.mode.number == self._mode_after:
            plane.set_mode(self._mode_before)
            self.warn(f"Flight mode {plane.mode.name} restored", MavSeverity.INFO)

    def _check_long(self) -> None:
        if self.state in (_LONG, _GCS):
            self._check_end_of_long()
            return
        plane = self.vehicle
        if plane.mode.is_landing:
            return
        # During the short failsafe, FS_LONG_TIMEOUT counts from the start of the short failsafe.
        lost_since = self._short_since if self.state == _SHORT else self.radio_received_at
        timeout = plane.parameters["FS_LONG_TIMEOUT"]
        gcs_option = int(plane.parameters["FS_GCS_ENABL"])
        checks_gcs = gcs_option in (_HEARTBEAT, _HEARTBEAT_OR_RSSI)
        if gcs_option == _IN_AUTO:
            checks_gcs = plane.mode.number == PlaneMode.AUTO
        if self.is_radio_lost and plane.now - lost_since > timeout:
            self._start_long(_LONG)
        elif checks_gcs and self.ground_station_silence > timeout:
            self.is_ground_station_lost = True
            self._start_long(_GCS)

    def _check_end_of_long(self) -> None:
        parameters = self.vehicle.parameters
        # If the short failsafe is enabled, the firmware uses its timeout (system.cpp, check_long_failsafe).
        is_short_enabled = parameters["FS_SHORT_ACTN"] != _SHORT_DISABLED
        timeout = parameters["FS_SHORT_TIMEOUT" if is_short_enabled else "FS_LONG_TIMEOUT"]
        if self.state == _GCS and self.ground_station_silence < timeout:
            self.is_ground_station_lost: bool = False
            self._end_long("GCS Failsafe Off")
        elif self.state == _LONG and not self.is_radio_lost:
            self._end_long("RC Long Failsafe Cleared")

    def _end_long(self, text: str) -> None:
        self.state = _NONE
        self._is_long_pending = False
        self.warn(text)

    def _start_long(self, state: int) -> None:
        plane = self.vehicle
        # The ground station may hang while its overrides are active, so the firmware gives control to the radio
        # (events.cpp).
        plane.rc.release_overrides()
        self.state = state
        mode = plane.mode.number
        action = int(plane.parameters["FS_LONG_ACTN"])
        if mode in _PILOTED_FOR_LONG_FAILSAFE:
            acts_in_take_off = action in (_LONG_GLIDE, _LONG_PARACHUTE)
            if self._is_in_take_off and not acts_in_take_off:
                self._is_long_pending = True  # `FS_LONG_ACTN` is executed after the initial climb.
            else:  # Action 0 returns to launch.
                plane.enter_first_accepted(*_LONG_MODES.get(action or _LONG_RTL, ()))
        elif mode == PlaneMode.RTL:  # The plane returns already, so only actions that land change the mode.
            if action in (_LONG_AUTO, _LONG_AUTOLAND):
                plane.enter_first_accepted(*_LONG_MODES[action])
        elif mode in (PlaneMode.AUTO, PlaneMode.GUIDED) and not plane.mode.is_landing:
            plane.enter_first_accepted(*_LONG_MODES.get(action, ()))  # Action 0 changes nothing.
        self.warn(f"{'GCS' if state == _GCS else 'RC Long'} Failsafe On: {plane.mode.name}")

    @property
    def _is_in_take_off(self) -> bool:
        return self.vehicle.mode.number == PlaneMode.TAKEOFF and self.vehicle.mode.is_taking_off

    def _resume_pending(self) -> None:
        if self._is_long_pending and not self._is_in_take_off:
            self._is_long_pending = False
            # If the plane has left TAKEOFF, the pending failsafe is dropped.
            if self.vehicle.mode.number == PlaneMode.TAKEOFF:
                self._start_long(_LONG)

    def act_on_battery(self, action: int) -> None:
        is_landing = self.vehicle.mode.is_landing
        # The Q modes need lifting rotors. A plane without them executes all three actions as LAND.
        lands = action in (_LAND, _QLAND, _LOITER_QLAND)
        returns = action in (_BATTERY_RTL, _AUTOLAND_OR_RTL)
        if action == _TERMINATE:
            self.refuse_termination()
        elif not is_landing and (lands or returns):
            if lands and self._land_by_mission():  # Without a landing sequence, the plane returns.
                return
            preferred = (PlaneMode.AUTOLAND,) if action == _AUTOLAND_OR_RTL else ()
            self.vehicle.enter_first_accepted(*preferred, PlaneMode.RTL)

    def refuse_termination(self) -> None:
        text = "AFS not enabled, can't terminate the vehicle"
        if self.vehicle.parameters["AFS_ENABLE"]:
            text = "Unable to terminate, termination is not configured"
        self.warn(text, MavSeverity.INFO)

    def _land_by_mission(self) -> bool:
        """Start the mission's landing sequence. Return False if there is none or AUTO is refused."""
        plane = self.vehicle
        stored_items = plane.missions.commands.items()
        land_starts = (seq for seq, item in enumerate(stored_items) if item.command == MavCmd.DO_LAND_START)
        land_start = next(land_starts, None)
        if land_start is None:
            self.warn("Unable to start landing sequence")
            return False
        plane.mission.set_current(land_start)
        self.warn("Landing sequence start", MavSeverity.INFO)
        return plane.set_mode(PlaneMode.AUTO)


# Values of FENCE_ACTION.
_RTL, _GUIDED, _GUIDED_THROTTLE, _AUTOLAND = 1, 6, 7, 8
_RETURNS = frozenset({_RTL, _GUIDED, _GUIDED_THROTTLE, _AUTOLAND})


class PlaneFence(ArduPilotFence[PlaneHost]):
    """ArduPlane's fence. Values of FENCE_ACTION: report only (0), RTL (1), fly to the return point (6, 7), land (8).

    Further breaches are ignored during a return. Disabling the fence on the way to the return point restores the
    previous mode.
    """

    CIRCLE_BACKUP_M: ClassVar[float] = 100.0

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._mode_before: int | None = None  # mode before the last return; None before the first return

    def update(self) -> None:
        super().update()
        is_disabled_in_return = self.caused_mode and not self.enabled
        if is_disabled_in_return and self._mode_before is not None:
            if self.vehicle.mode.number == PlaneMode.GUIDED and self.action in _RETURNS:
                self.vehicle.set_mode(self._mode_before)
            self.caused_mode = False

    def act(self, new_breaches: int) -> None:
        plane = self.vehicle
        if self.caused_mode:  # The plane already returns from an earlier breach.
            return
        self.report("breached", new_breaches)
        mode_before = plane.mode.number
        if self.action == _RTL:
            self._turn_back(mode_before, PlaneMode.RTL)
        elif self.action == _AUTOLAND and mode_before != PlaneMode.AUTOLAND:  # A running landing continues.
            self._turn_back(mode_before, PlaneMode.AUTOLAND, PlaneMode.RTL)
        elif self.action in (_GUIDED, _GUIDED_THROTTLE):
            self._turn_back(mode_before, PlaneMode.GUIDED)
            plane.guided.go_to(self.return_place())

    def return_place(self) -> Ned:
        """Return the place to which the plane returns after a breach."""
        plane, parameters = self.vehicle, self.vehicle.parameters
        home_north, home_east, home_down = plane.home_or_ground
        if parameters["FENCE_RET_RALLY"]:
            return best_return_place(plane, plane.home_of_rtl)
        lowest = parameters["FENCE_ALT_MIN"] + parameters["FENCE_MARGIN"]
        highest = parameters["FENCE_ALT_MAX"] - parameters["FENCE_MARGIN"]
        height = parameters["FENCE_RET_ALT"]
        if height <= 0:
            height = parameters["RTL_ALTITUDE"] if lowest >= highest else (lowest + highest) / 2.0
        points = (
            plane.frame.to_local(int(item.x), int(item.y))
            for item in plane.missions.items(MavMissionType.FENCE)
            if item.command == MavCmd.NAV_FENCE_RETURN_POINT
        )
        north, east = next(points, (home_north, home_east))  # A fence has at most one return point.
        return (north, east, home_down - height)

    def on_cleared(self) -> None:
        if self.vehicle.is_armed and not self.caused_mode:
            self.vehicle.send_text(MavSeverity.NOTICE, "Fence breach cleared")

    def refusal(self, mode: ArduPilotMode) -> tuple[int, str] | None:
        if not self.forbids_modes() or not self.vehicle.is_armed:
            return None
        return MavSeverity.NOTICE, f"Mode change to {mode.name} denied, in fence recovery"

    def _turn_back(self, mode_before: int, *modes: int) -> None:
        self.caused_mode: bool = self.vehicle.enter_first_accepted(*modes)
        self._mode_before = mode_before
