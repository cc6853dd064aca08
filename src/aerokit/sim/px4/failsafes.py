"""Failsafes of a simulated PX4: battery, ground station, manual control, position, geofence.

https://docs.px4.io/main/en/config/safety.html. The most severe action is executed. Before RETURN or LAND the vehicle
holds for COM_FAIL_ACT_T seconds. A mode change by the user overrides the action until another failure occurs.
Simulated actions: warnings, HOLD, RETURN, LAND, disarming and flight termination. Not simulated: events with the
cause, deferred failsafes, parachutes, predicted breaches (GF_PREDICT).
"""

from __future__ import annotations

import math
from enum import IntEnum

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavBatteryChargeState, MavMissionType, MavSeverity, MavType
from aerokit.sim.channel import Channel
from aerokit.sim.missions import FenceZones
from aerokit.sim.motion import Ned
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.links import NO_STATION, OUTSIDE, TOO_FAR, TOO_HIGH, Px4TextLinks
from aerokit.sim.px4.modes import AUTO, HOLD, LAND, MISSION, MODES, OFFBOARD, ORBIT, RTL, Px4Mode

_NO_ACTION, _WARNING = 0, 1
_BATTERY_LAND, _BATTERY_RETURN = 2, 3


class Px4Fence:
    """Geofence, which is checked while GF_ACTION is not 0.

    The vehicle must be inside at least one inclusion area, if there are any, and outside all exclusion areas.
    """

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self._is_valid = True  # False if home is outside the uploaded zones, which are then ignored

    def on_uploaded(self) -> None:
        home_north, home_east, _ = self._px4.home
        self._is_valid = self._zones_allow(home_north, home_east)
        if not self._is_valid:
            self._px4.send_text(MavSeverity.CRITICAL, "Geofence invalid, doesn't contain Home position")

    @property
    def breaches(self) -> list[str]:
        """Texts that say how the vehicle breaches its geofence at present."""
        if round(self._px4.parameters["GF_ACTION"]) == _NO_ACTION:
            return []
        return self.breaches_at(self._px4.motion.place)

    def allows(self, place: Ned) -> bool:
        action = round(self._px4.parameters["GF_ACTION"])
        return action in (_NO_ACTION, _WARNING) or not self.breaches_at(place)

    def breaches_at(self, place: Ned) -> list[str]:
        """Return the texts of the breaches at a point."""
        px4 = self._px4
        north, east, down = place
        home_north, home_east, home_down = px4.home
        # The value 0 of these parameters means that there is no limit.
        max_distance, max_height = px4.parameters["GF_MAX_HOR_DIST"], px4.parameters["GF_MAX_VER_DIST"]
        breaches = []
        if 0 < max_distance < math.hypot(north - home_north, east - home_east):
            breaches.append(TOO_FAR)
        if 0 < max_height < home_down - down:
            breaches.append(TOO_HIGH)
        if self._is_valid and not self._zones_allow(north, east):
            breaches.append(OUTSIDE)
        return breaches

    def _zones_allow(self, north: float, east: float) -> bool:
        zones = FenceZones(self._px4.missions.items(MavMissionType.FENCE), self._px4.frame)
        return zones.breach_m((north, east), union=True) <= 0.0


_INTERVAL_S = 0.2


class FailsafeAction(IntEnum):
    """Failsafe actions, from the mildest to the most severe."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETURN = 3
    LAND = 4
    DISARM = 5
    TERMINATE = 6


Action = FailsafeAction
_LINK_ACTIONS = {1: Action.HOLD, 2: Action.RETURN, 3: Action.LAND, 5: Action.TERMINATE, 6: Action.DISARM}
_FENCE_ACTIONS = {1: Action.WARN, 2: Action.HOLD, 3: Action.RETURN, 4: Action.TERMINATE, 5: Action.LAND}
_MODES: dict[FailsafeAction, Px4Mode] = {Action.HOLD: HOLD, Action.RETURN: RTL, Action.LAND: LAND}
# After this time without a position, PX4 leaves a mode that needs a position (measured with PX4 1.17, SIH).
_POSITION_TIMEOUT_S = 5.0
_BATTERY_TEXTS = {
    MavBatteryChargeState.LOW: (MavSeverity.CRITICAL, "Low battery"),
    MavBatteryChargeState.CRITICAL: (MavSeverity.CRITICAL, "Critical battery"),
    MavBatteryChargeState.EMERGENCY: (MavSeverity.EMERGENCY, "Emergency battery level"),
}


class Px4Failsafes:
    """Checks for failures five times a second and executes failsafe actions."""

    def __init__(self, px4: Px4Host, text_links: Px4TextLinks) -> None:
        self._px4, self._text_links = px4, text_links
        self.fence: Px4Fence = Px4Fence(px4)
        self.action: FailsafeAction = Action.NONE  # The action that is being executed.
        self.battery_state: MavBatteryChargeState = MavBatteryChargeState.OK
        """MAV_BATTERY_CHARGE_STATE, which never improves while the vehicle is armed."""
        self.has_station: bool = False  # True while heartbeats of a ground station are received.
        self._station_at = -math.inf  # time of the last heartbeat of a ground station
        self._had_manual_control = False  # True once sticks were received since arming
        self._position_at = -math.inf  # Time at which the estimator had a position last.
        self._battery_at_arming = MavBatteryChargeState.OK
        self._reported_battery_level = MavBatteryChargeState.OK
        self._breaches: list[str] = []  # texts of the present breaches of the fence
        # Actions by cause. A cause that has ended stays in this dictionary while its action lasts.
        self._active: dict[str, FailsafeAction] = {}
        self._failing: frozenset[str] = frozenset()  # The causes that exist at present.
        self._holds_until = -math.inf  # end of the delay in which the vehicle holds instead of returning or landing
        self._is_overridden = False  # True after the user has changed the mode during a failsafe.
        px4.on(m.Heartbeat, self._on_heartbeat)

    def start(self) -> None:
        self._px4.every(_INTERVAL_S, self.check)

    @property
    def acts(self) -> bool:
        return self.action > Action.WARN

    def _on_heartbeat(self, beat: m.Heartbeat, channel: Channel) -> None:
        if beat.type != MavType.GCS:
            return
        self._text_links.on_station_heartbeat(channel)
        if not self.has_station and math.isfinite(self._station_at):
            self._px4.info("GCS connection regained")
        self.has_station = True
        self._station_at = self._px4.now

    def _watch_station(self) -> None:
        timeout = self._px4.parameters["COM_DL_LOSS_T"]
        if self.has_station and self._px4.now - self._station_at > timeout:
            self.has_station = False
            self._px4.info("Connection to ground station lost")
            if round(self._px4.parameters["NAV_DLL_ACT"]):
                self._px4.send_text(MavSeverity.WARNING, NO_STATION)

    def _watch_battery(self) -> None:
        state = self._battery_level()
        self.battery_state = max(state, self.battery_state) if self._px4.is_armed else state
        if self.battery_state > self._reported_battery_level and self._px4.is_armed:
            self._px4.send_text(*_BATTERY_TEXTS[self.battery_state])
        self._reported_battery_level = self.battery_state

    def _battery_level(self) -> MavBatteryChargeState:
        limits, share = self._px4.parameters, self._px4.battery.percent / 100.0
        if share < limits["BAT_EMERGEN_THR"]:
            return MavBatteryChargeState.EMERGENCY
        if share < limits["BAT_CRIT_THR"]:
            return MavBatteryChargeState.CRITICAL
        return MavBatteryChargeState.LOW if share < limits["BAT_LOW_THR"] else MavBatteryChargeState.OK

    def _battery_action(self) -> FailsafeAction:
        state, action = self.battery_state, round(self._px4.parameters["COM_LOW_BAT_ACT"])
        if state == MavBatteryChargeState.OK:
            return Action.NONE
        is_unchanged_since_arming = state <= self._battery_at_arming  # PX4 then only warns.
        has_action = action in (_BATTERY_LAND, _BATTERY_RETURN)
        if state == MavBatteryChargeState.LOW or is_unchanged_since_arming or not has_action:
            return Action.WARN
        must_land = action == _BATTERY_LAND or state == MavBatteryChargeState.EMERGENCY
        return Action.LAND if must_land else Action.RETURN

    def arming_obstacles(self) -> list[str]:
        """Return the texts of the failures that prevent arming."""
        reasons = list(self.fence.breaches)
        level = self._battery_level()
        if level >= MavBatteryChargeState.CRITICAL:
            _, text = _BATTERY_TEXTS[level]
            reasons.append(text)
        if round(self._px4.parameters["NAV_DLL_ACT"]) and not self.has_station:
            reasons.append(NO_STATION)
        return reasons

    def on_armed(self) -> None:
        # A failure that exists at arming does not trigger a failsafe.
        self._had_manual_control = self._px4.sticks.are_fresh
        self._position_at = self._px4.now
        level = self._battery_level()
        self.battery_state = level
        self._battery_at_arming = level
        self._reported_battery_level = level
        self._reset()

    def _reset(self) -> None:
        self.action = Action.NONE
        self._is_overridden = False
        self._holds_until = -math.inf
        self._active = {}
        self._failing = frozenset()
        self._breaches = []

    def _active_failures(self) -> dict[str, FailsafeAction]:
        actions = {
            "battery": self._battery_action(),
            "station": self._station_action(),
            "sticks": self._sticks_action(),
            "position": self._position_action(),
            "fence": self._fence_action(),
        }
        return {cause: action for cause, action in actions.items() if action != Action.NONE}

    def _station_action(self) -> FailsafeAction:
        if self.has_station or self._px4.intended_mode == LAND or self._is_excepted("COM_DLL_EXCEPT"):
            return Action.NONE
        return _LINK_ACTIONS.get(round(self._px4.parameters["NAV_DLL_ACT"]), Action.NONE)

    def _sticks_action(self) -> FailsafeAction:
        sticks = self._px4.sticks
        self._had_manual_control = self._had_manual_control or sticks.are_fresh
        is_lost = self._had_manual_control and not sticks.are_fresh
        if not is_lost or not sticks.are_wanted or self._is_excepted("COM_RCL_EXCEPT"):
            return Action.NONE
        return _LINK_ACTIONS.get(round(self._px4.parameters["NAV_RCL_ACT"]), Action.NONE)

    def _position_action(self) -> FailsafeAction:
        px4 = self._px4
        if px4.has_position:
            self._position_at = px4.now
        is_lost = px4.now - self._position_at > _POSITION_TIMEOUT_S
        if not is_lost:
            return Action.NONE
        return Action.LAND if MODES[px4.intended_mode].needs_position else Action.NONE

    def can_be_overridden(self, moved: float) -> bool:
        """Return True if moving a stick by ``moved`` ends the current mode. The whole range of a stick is 2."""
        parameters, mode = self._px4.parameters, self._px4.mode
        mode_bit = 0  # Bit of COM_RC_OVERRIDE that allows an override in the present mode.
        main_mode, _ = mode
        if main_mode == AUTO or mode == ORBIT:
            mode_bit = 1
        elif mode == OFFBOARD:
            mode_bit = 2
        is_allowed = bool(round(parameters["COM_RC_OVERRIDE"]) & mode_bit)
        return is_allowed and moved * 100 >= parameters["COM_RC_STICK_OV"]  # The parameter is in percent.

    def _is_excepted(self, parameter: str) -> bool:
        """Return True if the parameter excludes the intended mode from the failsafe."""
        mode = self._px4.intended_mode
        main_mode, _ = mode
        mode_bit = 0
        if mode == MISSION:
            mode_bit = 1
        elif mode == OFFBOARD:
            mode_bit = 4
        elif main_mode == AUTO:
            mode_bit = 2
        return bool(round(self._px4.parameters[parameter]) & mode_bit)

    def _fence_action(self) -> FailsafeAction:
        breaches = self.fence.breaches
        for text in breaches:
            if text not in self._breaches:
                self._px4.send_text(MavSeverity.CRITICAL, text)
        self._breaches = breaches
        if not breaches:
            return Action.NONE
        return _FENCE_ACTIONS.get(round(self._px4.parameters["GF_ACTION"]), Action.WARN)  # Other values only warn.

    def check(self) -> None:
        if self._px4.arming.is_terminated:
            return
        self._watch_station()
        self._watch_battery()
        if not self._px4.is_armed:
            self._px4.arming.report_changes()
            self._reset()
            return
        self._update_active_failures(self._active_failures())
        self._execute(self._choose_action())

    def _update_active_failures(self, failing: dict[str, FailsafeAction]) -> None:
        """Update the active failures. ``failing`` maps the present failures to their actions."""
        for cause, action in failing.items():
            # A new failure ends an override by the user.
            if cause not in self._active and action >= Action.HOLD:
                self._is_overridden = False
            # A new failure, or a more severe action for an old one, starts the delay COM_FAIL_ACT_T.
            is_worse = action > self._active.get(cause, Action.WARN)
            has_delay_ended = self._holds_until < self._px4.now
            if is_worse and self.action <= Action.HOLD and has_delay_ended:
                self._holds_until = self._px4.now + self._px4.parameters["COM_FAIL_ACT_T"]
        # If the action is at least HOLD, a failure that has ended stays active until the user changes the mode.
        still_acting = {cause: action for cause, action in self._active.items() if action >= Action.HOLD}
        self._active = {**still_acting, **failing}
        self._failing = frozenset(failing)

    def _choose_action(self) -> FailsafeAction:
        """Return the action to execute because of the worst failure."""
        worst = max(self._active.values(), default=Action.NONE)
        can_hold = self._px4.has_position
        if worst in (Action.HOLD, Action.RETURN) and not can_hold:
            worst = Action.LAND
        intended = self._px4.intended_mode
        if self._is_overridden and worst < Action.DISARM:  # The user cannot override disarming and termination.
            return min(worst, Action.WARN)
        is_returning_already = intended in (LAND, RTL)
        if worst == Action.RETURN and is_returning_already:
            return Action.WARN
        is_delay_running = self.action <= Action.HOLD and self._px4.now < self._holds_until
        if worst in (Action.RETURN, Action.LAND) and is_delay_running and can_hold:
            return Action.HOLD
        return worst

    def _execute(self, action: FailsafeAction) -> None:
        if action == self.action:
            return
        px4, previous = self._px4, self.action
        self.action = action
        px4.is_in_failsafe = action > Action.WARN
        is_escalation = action > max(previous, Action.WARN)
        if is_escalation and action < Action.TERMINATE:  # `terminate` sends its own texts.
            self._report(action)
        if action == Action.DISARM:
            px4.arming.disarm("failsafe", force=True)
        elif action == Action.TERMINATE:
            px4.arming.terminate()
        elif action in _MODES:
            px4.switch_to(_MODES[action])
        elif previous > Action.WARN:  # The failsafe has ended.
            px4.switch_to(px4.intended_mode)

    def _report(self, action: FailsafeAction) -> None:
        text = "Failsafe activated"
        is_delay = action == Action.HOLD and max(self._active.values()) > Action.HOLD
        if is_delay:
            text += f": entering Hold for {self._holds_until - self._px4.now:.0f} seconds"
        self._px4.send_text(MavSeverity.CRITICAL, text)

    def override(self) -> None:
        """Handle a mode change by the user."""
        self._active = {cause: action for cause, action in self._active.items() if cause in self._failing}
        if self.action > Action.WARN:
            self._is_overridden = bool(self._active)
            self.action = Action.WARN
            self._holds_until = -math.inf
