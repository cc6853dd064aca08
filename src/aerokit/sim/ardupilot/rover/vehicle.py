"""`SimulatedRover`: an ArduRover 4.7 car without sockets, threads or a clock of its own.

Beside it what it checks before arming and what it does by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from aerokit.mavlink.enums import (
    FenceMitigate,
    MavCmd,
    MavModeFlag,
    MavResult,
    MavSeverity,
    MavType,
    RoverMode,
)
from aerokit.sim.ardupilot.arming import Arming, Check
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import REPORT_ONLY, Fence
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.level import RoverTargets
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.radio import LevelJoystick
from aerokit.sim.ardupilot.rover.host import RoverHost
from aerokit.sim.ardupilot.rover.modes import ROVER_MODES, RoverAuto, RoverGuided
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler
from aerokit.sim.ground_motion import GroundLimits, GroundMotion
from aerokit.sim.motion import Motion, Wind

_NEEDS_LOCATION = 1


class RoverArming(Arming):
    """A position only in the modes that drive by it, or always with ARMING_NEED_LOC."""

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self._rover = rover

    def ahrs_reasons(self) -> Sequence[str]:
        """Comes after GPS, and only where a position is needed."""
        return ()

    def position_reasons(self) -> Sequence[str]:
        """GPS, then estimator and its position."""
        rover = self._rover
        if not rover.mode.needs_position and rover.parameters["ARMING_NEED_LOC"] != _NEEDS_LOCATION:
            return ()
        if reasons := super().position_reasons() or super().ahrs_reasons():
            return reasons
        if rover.failsafes.estimator:
            return ("EKF failsafe",)
        return () if rover.navigation.has_position else ("Need Position Estimate",)

    def own_reasons(self) -> list[str]:
        reasons = []
        if self.is_checked(Check.PARAMETERS) and not self._rover.parameters["WP_SPEED"] > 0:
            reasons.append("WP_SPEED too low")
        return reasons + ([] if self._rover.mode.can_arm else ["Mode not armable"])

    def arm(self, *, force: bool = False) -> bool:
        done = super().arm(force=force)
        if done:
            self._rover.path.begin()
        return done

    def disarm(self, *, force: bool = True) -> bool:
        """At any time; where it is disarmed is home, unless somebody has set it."""
        rover, was_armed = self._rover, self._rover.is_armed
        if not super().disarm(force=True):
            return False
        if was_armed and rover.navigation.home is not None and not rover.navigation.home_is_locked:
            rover.navigation.set_home(rover.motion.place, lock=False)
        return True


_NONE, _RTL, _HOLD, _SMART_RTL, _SMART_RTL_OR_HOLD, _TERMINATE, _LOITER_OR_HOLD = range(7)
"""FS_ACTION, FENCE_ACTION and the actions of the battery."""
_MODES: dict[int, tuple[int, ...]] = {
    _RTL: (RoverMode.RTL, RoverMode.HOLD),
    _HOLD: (RoverMode.HOLD,),
    _SMART_RTL: (RoverMode.SMART_RTL, RoverMode.RTL, RoverMode.HOLD),
    _SMART_RTL_OR_HOLD: (RoverMode.SMART_RTL, RoverMode.HOLD),
    _LOITER_OR_HOLD: (RoverMode.LOITER, RoverMode.HOLD),
}
_RADIO, _GCS = "Radio", "GCS"
_SILENT_S = 0.5
_CONTINUE_MISSION = 2
_ACTIVE_IN_HOLD = 1
_REPORT_ONLY, _HOLD_ON_ESTIMATOR = 2, 1
_ESTIMATOR_PATIENCE_S, _STUCK_S, _STUCK_M_S = 1.0, 2.0, 0.08
_HOLD_AND_DISARM = 2
_DRIVES_ITSELF = frozenset(
    {RoverMode.AUTO, RoverMode.GUIDED, RoverMode.RTL, RoverMode.SMART_RTL, RoverMode.LOITER, RoverMode.CIRCLE}
)


def modes_of_action(action: int) -> tuple[int, ...]:
    """The modes that an action tries, one after the other; none for those that change no mode."""
    return _MODES.get(action, ())


class RoverFailsafes(Failsafes):
    """FS_ACTION follows FS_TIMEOUT after radio or ground station are lost, armed or not, but not in RTL and HOLD.

    Both are one failsafe with one name: which of the two looks first after the time is up gives it, so that a lost
    ground station is told as "Radio Failsafe" while the radio is watched too.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (
        _TERMINATE, _HOLD, _RTL, _SMART_RTL_OR_HOLD, _SMART_RTL, _NONE,
    )  # fmt: skip

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self._rover = rover
        self._lost: set[str] = set()
        self._triggered: set[str] = set()
        self._lost_since = math.nan
        self._bad_since = self._stuck_since = math.nan

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state; a low battery alone is none."""
        return bool(self._triggered) or self.estimator

    def watch(self) -> None:
        """Everything, in the order of the firmware."""
        self._watch_radio()
        self._watch_ground_station()
        self._watch_estimator()
        self._watch_wheels()
        super().watch()

    def _watch_radio(self) -> None:
        rover, parameters = self._rover, self._rover.parameters
        if rover.rc.is_heard:
            self.radio_heard_at: float = rover.now
        if not parameters["FS_THR_ENABLE"]:
            self.radio = False
            return
        low = rover.rc[2] < parameters["FS_THR_VALUE"]
        self.radio: bool = low or rover.now - self.radio_heard_at > _SILENT_S
        self._trigger(_RADIO, self.radio)

    def _watch_ground_station(self) -> None:
        parameters = self._rover.parameters
        if not parameters["FS_GCS_ENABLE"] or math.isnan(self.ground_station_seen_at):
            return
        self.ground_station: bool = self.ground_station_silence >= parameters["FS_GCS_TIMEOUT"]
        self._trigger(_GCS, self.ground_station)

    def _trigger(self, name: str, lost: bool) -> None:
        rover, was_any = self._rover, bool(self._lost)
        self._lost = self._lost | {name} if lost else self._lost - {name}
        if self._lost and not was_any:
            self._lost_since = rover.now
        if self._triggered and not self._lost:
            self.say(f"{name} Failsafe Cleared", MavSeverity.INFO)
        self._triggered &= self._lost
        patient = rover.now - self._lost_since <= rover.parameters["FS_TIMEOUT"]
        if self._triggered or not self._lost or patient or not self._may_act():
            return
        self._triggered = set(self._lost)
        self.say(f"{name} Failsafe")
        rover.rc.release_overrides()
        enabled = rover.parameters["FS_THR_ENABLE" if name == _RADIO else "FS_GCS_ENABLE"]
        if rover.mode.number == RoverMode.AUTO and enabled == _CONTINUE_MISSION:
            self.say("Failsafe - Continuing Auto Mode")
        else:
            self._act(int(rover.parameters["FS_ACTION"]))

    def _may_act(self) -> bool:
        rover = self._rover
        if rover.mode.number == RoverMode.HOLD:
            return bool(int(rover.parameters["FS_OPTIONS"]) & _ACTIVE_IN_HOLD)
        return rover.mode.number != RoverMode.RTL

    def _act(self, action: int) -> None:
        if action == _TERMINATE:
            self._rover.arming.disarm()
        else:
            self.change_to(*modes_of_action(action))

    def act_on_battery(self, action: int) -> None:
        self._act(action)

    def _watch_estimator(self) -> None:
        rover = self._rover
        if not rover.is_armed or rover.navigation.has_position:
            self._bad_since = math.nan
            if self.estimator:
                self.estimator = False
                self.say("EKF failsafe cleared", MavSeverity.CRITICAL)
            return
        if math.isnan(self._bad_since):
            self._bad_since = rover.now
        if self.estimator or rover.now - self._bad_since < _ESTIMATOR_PATIENCE_S:
            return
        self.estimator: bool = True
        self.say("EKF variance", MavSeverity.CRITICAL)
        action = int(rover.parameters["FS_EKF_ACTION"])
        if action and rover.mode.needs_position:
            if action != _REPORT_ONLY:
                rover.set_mode(RoverMode.HOLD)
            self.say("EKF failsafe", MavSeverity.CRITICAL)

    def _watch_wheels(self) -> None:
        """FS_CRASH_CHECK: it wants to go somewhere and does not move."""
        rover, action = self._rover, int(self._rover.parameters["FS_CRASH_CHECK"])
        tries = rover.is_armed and rover.mode.number in _DRIVES_ITSELF and rover.faults.motor_failed
        if not action or not tries or rover.motion.ground_speed_m_s >= _STUCK_M_S:
            self._stuck_since = math.nan
        elif math.isnan(self._stuck_since):
            self._stuck_since = rover.now
        elif rover.now - self._stuck_since >= _STUCK_S:
            self._stuck_since = math.nan
            self.say("Crash: Going to HOLD", MavSeverity.EMERGENCY)
            rover.set_mode(RoverMode.HOLD)
            if action == _HOLD_AND_DISARM:
                rover.arming.disarm()


_GIVE_UP_M = 100.0


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
        super().mode_changed()
        self.recover_by_hand()


_GUIDED_MODES = frozenset({"LOIT", "CIRC", "AUTO", "RTL", "SRTL", "GUID"})
_MANUAL_INPUT = frozenset({"MANU", "ACRO", "STER"})
_AMPERES_AT_FULL = 16.0


class _Motors(Motors):
    """One motor that drives the wheels."""

    @property
    def current_a(self) -> float:
        return abs(self.throttle) * _AMPERES_AT_FULL

    def update(self, now: float, dt: float, motion: Motion, *, landed: bool) -> None:
        assert isinstance(motion, GroundMotion)
        self.throttle = max(-1.0, min(1.0, motion.speed_m_s / motion.wheels.top_speed_m_s / 2.0))
        if not self.is_armed:
            self.throttle = 0.0


class SimulatedRover(RoverHost):
    """Speaks and behaves as ArduRover does where a client can see it; drives as `GroundMotion` does.

    Its arguments are those of `ArduPilotVehicle`. It has 1,235 parameters. Simulated: MANUAL, ACRO, STEERING and
    SIMPLE by the sticks, HOLD, LOITER and CIRCLE (standing), AUTO, GUIDED, RTL and SMART_RTL. Take-off and landing
    are unknown commands.

    Not simulated yet: boats, driving in circles, slowing down before a fence.
    """

    KIND: ClassVar[Kind] = "rover"
    FIRMWARE: ClassVar[str] = "ArduRover"
    MAV_TYPE: ClassVar[int] = MavType.GROUND_ROVER
    HOME_NEEDS_ORIGIN: ClassVar[bool] = False
    TELLS_HOME: ClassVar[bool] = True
    CAPABILITIES: ClassVar[int] = 0xF1EF
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["rover"]
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = ROVER_MODES
    FAILSAFES: ClassVar[type[Failsafes]] = RoverFailsafes
    FENCE: ClassVar[type[Fence]] = RoverFence

    def make_motion(self, wind: Wind | None) -> GroundMotion:
        """Limits as the parameters have them now; wind is only told, it moves nothing."""
        parameters = self.parameters
        limits = GroundLimits(
            acceleration_m_s2=parameters["ATC_ACCEL_MAX"] or 1.0,
            top_speed_m_s=self.top_speed,
            turn_rate_rad_s=math.radians(parameters["ATC_STR_RAT_MAX"] or 120.0),
            turn_radius_m=parameters["TURN_RADIUS"] or 0.9,
            sideways_m_s2=9.81 * (parameters["ATC_TURN_MAX_G"] or 0.6),
        )
        return GroundMotion(self.rng, limits, wind)

    def make_motors(self) -> Motors:
        return _Motors()

    def make_arming(self) -> Arming:
        return RoverArming(self)

    def hear_setpoints(self) -> None:
        RoverTargets(self, self.guided)

    def make_joystick(self) -> LevelJoystick:
        return LevelJoystick(self)

    @property
    def is_landed(self) -> bool:
        """What STANDBY in the heartbeat means here: HOLD."""
        return self.mode.number == RoverMode.HOLD

    @is_landed.setter
    def is_landed(self, _: bool) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """It is always on the ground."""

    @property
    def guided(self) -> RoverGuided:
        return self.mode_of(RoverGuided)

    @property
    def auto(self) -> RoverAuto:
        return self.mode_of(RoverAuto)

    @property
    def base_mode(self) -> int:
        """Sticks in the modes that have them, guided in those that drive by themselves."""
        base, name = int(MavModeFlag.CUSTOM_MODE_ENABLED), self.mode.name
        if name in _MANUAL_INPUT:
            base |= MavModeFlag.MANUAL_INPUT_ENABLED
        if name in _GUIDED_MODES:
            base |= MavModeFlag.GUIDED_ENABLED
        return base | MavModeFlag.SAFETY_ARMED if self.motors.is_armed else base

    @property
    def is_at_rest(self) -> bool:
        return abs(self.motion.speed_m_s) < 0.01

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        return "Flight mode change failed"

    def own_commands(self) -> dict[int, CommandHandler]:
        """Of the commands that stand for a mode only the way home is known; there is nothing to terminate."""
        return {
            MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: self.change_to(RoverMode.RTL),
            MavCmd.DO_FLIGHTTERMINATION: lambda _: MavResult.UNSUPPORTED,
        }
