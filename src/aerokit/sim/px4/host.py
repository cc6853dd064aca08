"""State, modes and land detector of a simulated PX4, and the interfaces of its modules.

The modules use `Px4Host` and each other's interfaces. They cannot import `Px4Vehicle`, which imports the modules.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Protocol

from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions import MissionItem
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.motion import Ned
from aerokit.sim.px4 import modes
from aerokit.sim.px4.external import Px4External
from aerokit.sim.px4.modes import Px4Mode

_LAND_DETECTOR_S = 1.0
_MODES_ENDED_BY_LANDING = frozenset({modes.TAKEOFF, modes.LAND, modes.PRECISION_LAND, modes.RTL})


class Px4SticksInterface(Protocol):
    roll: float
    pitch: float
    yaw: float
    throttle: float

    @property
    def are_fresh(self) -> bool: ...
    @property
    def are_wanted(self) -> bool: ...


class Px4ArmingInterface(Protocol):
    armed_at: float
    is_terminated: bool

    def disarm(self, by: str, *, force: bool = False) -> bool: ...
    def terminate(self) -> None: ...
    def report_changes(self) -> None: ...


class Px4FenceInterface(Protocol):
    def on_uploaded(self) -> None: ...
    def allows(self, place: Ned) -> bool: ...


class Px4FailsafesInterface(Protocol):
    @property
    def fence(self) -> Px4FenceInterface: ...
    @property
    def acts(self) -> bool: ...
    def arming_obstacles(self) -> list[str]: ...
    def can_be_overridden(self, moved: float) -> bool: ...
    def on_armed(self) -> None: ...
    def override(self) -> None: ...


class Px4FlightInterface(Protocol):
    target: Ned
    heading: float | None
    speed_m_s: float
    lifts_off: bool

    @property
    def descent_speed_m_s(self) -> float: ...
    @property
    def top_speed_m_s(self) -> float: ...
    def enter(self, mode: Px4Mode) -> None: ...
    def stay_here(self) -> None: ...
    def plan_take_off(self, down: float | None = None) -> None: ...
    def announce_take_off(self) -> None: ...
    def fly_to_target(self) -> None: ...
    def descend(self) -> None: ...


class Px4MissionInterface(Protocol):
    current: int
    is_valid: bool
    is_finished: bool

    @property
    def wants_up(self) -> bool: ...
    def enter(self) -> None: ...
    def update(self) -> None: ...
    def on_landed(self) -> None: ...
    def on_replaced(self, current: int) -> None: ...
    def forget_reached(self) -> None: ...
    def set_current(self, seq: int) -> None: ...


class Px4MissionsInterface(Protocol):
    @property
    def commands(self) -> Sequence[MissionItem]: ...
    def items(self, mission_type: int) -> Sequence[MissionItem]: ...
    def item(self, mission_type: int, seq: int) -> MissionItem | None: ...
    def on_item_changed(self, seq: int) -> None: ...


class Px4OffboardInterface(Protocol):
    @property
    def is_fresh(self) -> bool: ...
    @property
    def wants_up(self) -> bool: ...
    def fly(self) -> None: ...


class Px4Host(SimulatedAutopilot):
    """A simulated PX4 as its modules see it: its state and modes. `Px4Vehicle` adds the modules."""

    VEHICLE_TYPE: ClassVar[int]

    home: Ned
    boot_time_s: float
    sticks: Px4SticksInterface
    arming: Px4ArmingInterface
    failsafes: Px4FailsafesInterface
    flight: Px4FlightInterface
    mission: Px4MissionInterface
    missions: Px4MissionsInterface
    offboard: Px4OffboardInterface
    external: Px4External

    def _reset_state(self) -> None:
        """Set the state after a power-on: disarmed and landed, in HOLD."""
        self.is_ready: bool = False
        self.is_armed: bool = False
        self.is_landed: bool = True
        self.mode: Px4Mode = modes.HOLD
        self.intended_mode: Px4Mode = modes.HOLD
        self.is_in_failsafe: bool = False
        self.throttle: float = 0.0
        # True if a client has set home. Otherwise, arming sets home to the position of the vehicle.
        self.home_is_set_by_client: bool = False
        self.mode_after_landing: Px4Mode = modes.HOLD
        self._touchdown_at = math.nan  # NaN while the vehicle does not touch the ground
        self._landed_at = math.nan  # when the landing was detected; NaN before
        self._has_flown = False  # True after a take-off, until the vehicle is armed again

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        _, _, home_down = self.home
        return home_down - self.motion.down

    def place_of(self, item: MissionItem) -> Ned:
        """Return the position of a stored item of a mission, fence or list of rally points."""
        north, east = self.frame.to_local(round(item.x), round(item.y))
        _, _, home_down = self.home
        is_absolute = item.frame in (MavFrame.GLOBAL, MavFrame.GLOBAL_INT)
        down_at_zero_altitude = self.frame.origin.altitude_m if is_absolute else home_down
        return (north, east, down_at_zero_altitude - item.z)

    @property
    def has_position(self) -> bool:
        """True if the estimator has a global position."""
        has_global = self.external.has_gps or (self.external.has_vision and self.has_origin)
        return self.uptime >= 0.5 * self.boot_time_s and has_global

    @property
    def has_origin(self) -> bool:
        """True if the local frame has a global origin."""
        return self.external.has_gps or self.external.origin is not None

    def on_armed(self) -> None:
        """Start the mode that was entered while disarmed, and set home."""
        self.is_armed = True
        self._has_flown = False
        self._landed_at = math.nan
        if not self.home_is_set_by_client:
            self.home = self.motion.place
        self.failsafes.on_armed()
        # MISSION and TAKEOFF may have been entered while disarmed. They start when the vehicle is armed.
        if self.mode == modes.MISSION:
            self.mission.enter()
        elif self.mode == modes.TAKEOFF:
            self.flight.announce_take_off()
        self.set_ticking(True)

    def on_disarmed(self) -> None:
        self.is_armed = False
        self.throttle = 0.0
        self.is_in_failsafe = False

    def terminate(self) -> None:
        """Stop the motors until a restart."""
        self.arming.terminate()
        self.switch_to(modes.TERMINATION)

    def change_mode(self, mode: Px4Mode) -> bool:
        """Handle a mode request. Return False if an armed vehicle cannot run the mode. LAND is never refused."""
        if self.is_armed and mode != modes.LAND and not self.can_run(mode):
            return False
        if mode not in _MODES_ENDED_BY_LANDING:
            self.mode_after_landing = mode
        self.is_in_failsafe = False
        self.intended_mode = mode
        self.failsafes.override()
        # A request for the present mode restarts MISSION. In any other mode, the vehicle stays at its present position.
        if mode == self.mode == modes.MISSION:
            self.mission.enter()
        elif mode == self.mode:
            self.flight.stay_here()
        else:
            self.switch_to(mode)
        if mode == modes.TAKEOFF:
            self.flight.plan_take_off()
        return True

    def can_run(self, mode: Px4Mode) -> bool:
        """Return True if everything that the mode needs is available.

        A mode may need stick input, a valid mission, set-points or a position estimate.
        """
        traits = modes.MODES.get(mode)
        if traits is None or self.arming.is_terminated:
            return False
        if mode == modes.MISSION and not self.mission.is_valid:
            return False
        if mode == modes.OFFBOARD and not self.offboard.is_fresh:
            return False
        if traits.needs_sticks and not self.sticks.are_fresh:
            return False
        return self.has_position or not traits.needs_position

    def switch_to(self, mode: Px4Mode) -> None:
        """Change the mode, which the next heartbeat reports."""
        self.mode = mode
        self.flight.enter(mode)
        if mode == modes.RTL and self.is_armed:  # PX4 informs the other components of the vehicle about a return.
            all_components = 0
            self.send_command((self.system_id, all_components), MavCmd.NAV_RETURN_TO_LAUNCH)

    def leave_ground(self) -> None:
        self.is_landed = False
        self._has_flown = True
        self._touchdown_at = math.nan
        self.info("Takeoff detected")

    def on_sticks_moved(self, distance: float) -> None:
        """Switch to POSITION if the sticks moved far enough and the present mode can be overridden."""
        if self.is_armed and not self.is_landed and self.failsafes.can_be_overridden(distance):
            self.info("Pilot took over using sticks")
            self.change_mode(modes.POSITION)

    def _has_touched_down(self) -> bool:
        return self.motion.is_on_ground

    def _detect_landing(self) -> None:
        is_lifting_off = self.is_armed and self.flight.lifts_off
        can_land = self._has_touched_down() and not is_lifting_off and not self.arming.is_terminated
        if not can_land:
            self._touchdown_at = math.nan
        elif math.isnan(self._touchdown_at):
            self._touchdown_at = self.now
        elif self.now - self._touchdown_at >= _LAND_DETECTOR_S or not self.is_armed:
            self.is_landed = True
            self._landed_at = self.now
            self.motion.settle()
            self.info("Landing detected")
            self.mission.on_landed()

    def _auto_disarm(self) -> None:
        stays_on_ground = self.is_landed and not self.flight.lifts_off
        if not self.is_armed or not stays_on_ground:
            return
        if self._has_flown:
            if 0 < self.parameters["COM_DISARM_LAND"] <= self.now - self._landed_at:
                self.arming.disarm("landing")
        elif 0 < self.parameters["COM_DISARM_PRFLT"] <= self.now - self.arming.armed_at:
            self.arming.disarm("auto preflight disarming")
