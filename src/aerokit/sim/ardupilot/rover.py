"""`SimulatedRover`: an ArduRover 4.7 car that uses no sockets, threads or system clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from aerokit.mavlink.enums import FenceMitigate, MavCmd, MavModeFlag, MavResult, MavSeverity, MavType, RoverMode
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes, ArmingCheck
from aerokit.sim.ardupilot.fence import REPORT_ONLY, ArduPilotFence
from aerokit.sim.ardupilot.host import RC_THROTTLE, ArduPilotMode, ArduPilotMotors, ConditionTimer
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.radio import ArduPilotJoystick, RoverJoystick
from aerokit.sim.ardupilot.rover_modes import ROVER_MODES, RoverGuided, RoverHost
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler
from aerokit.sim.motion import SimulatedWind
from aerokit.sim.vehicle_motion import GroundLimits, GroundMotion

_NEEDS_LOCATION = 1


class RoverArming(ArduPilotArming[RoverHost]):
    """ArduRover's arming checks. A position is needed only in modes that use one, or if ARMING_NEED_LOC is set."""

    def ahrs_reasons(self) -> Sequence[str]:
        return ()  # `position_reasons` includes these checks, because ArduRover runs them after the GPS checks.

    def position_reasons(self) -> Sequence[str]:
        rover = self.vehicle
        if not rover.mode.needs_position and rover.parameters["ARMING_NEED_LOC"] != _NEEDS_LOCATION:
            return ()
        reasons = super().position_reasons() or super().ahrs_reasons()
        if reasons:
            return reasons
        if rover.failsafes.has_estimator_failed:
            return ("EKF failsafe",)
        return () if rover.navigation.has_position else ("Need Position Estimate",)

    def own_reasons(self) -> list[str]:
        reasons = []
        if self.is_checked(ArmingCheck.PARAMETERS) and not self.vehicle.parameters["WP_SPEED"] > 0:
            reasons.append("WP_SPEED too low")
        if not self.vehicle.mode.can_arm:
            reasons.append("Mode not armable")
        return reasons

    def on_armed(self) -> None:
        self.vehicle.path.reset()

    def on_disarmed(self) -> None:
        # The current place becomes home if no command has set home.
        rover = self.vehicle
        if rover.navigation.home is not None and not rover.navigation.home_is_locked:
            rover.navigation.set_home(rover.motion.place, lock=False)


# Values of FS_ACTION, of FENCE_ACTION and of the battery actions.
_NONE, _RTL, _HOLD, _SMART_RTL, _SMART_RTL_OR_HOLD, _TERMINATE, _LOITER_OR_HOLD = range(7)
_MODES: dict[int, tuple[int, ...]] = {
    _RTL: (RoverMode.RTL, RoverMode.HOLD),
    _HOLD: (RoverMode.HOLD,),
    _SMART_RTL: (RoverMode.SMART_RTL, RoverMode.RTL, RoverMode.HOLD),
    _SMART_RTL_OR_HOLD: (RoverMode.SMART_RTL, RoverMode.HOLD),
    _LOITER_OR_HOLD: (RoverMode.LOITER, RoverMode.HOLD),
}
_RADIO, _GCS = "Radio", "GCS"
_RADIO_TIMEOUT_S = 0.5
# Values of FS_THR_ENABLE and FS_GCS_ENABLE, of FS_OPTIONS (bit 0), FS_EKF_ACTION and FS_CRASH_CHECK.
_CONTINUE_MISSION, _ACTIVE_IN_HOLD, _EKF_REPORT_ONLY, _HOLD_AND_DISARM = 2, 1, 2, 2
_ESTIMATOR_TIMEOUT_S, _STUCK_TIMEOUT_S, _MAX_STUCK_SPEED_M_S = 1.0, 2.0, 0.08
_DRIVES_ITSELF = frozenset(
    {RoverMode.AUTO, RoverMode.GUIDED, RoverMode.RTL, RoverMode.SMART_RTL, RoverMode.LOITER, RoverMode.CIRCLE}
)


class RoverFailsafes(ArduPilotFailsafes[RoverHost]):
    """ArduRover's failsafes.

    FS_TIMEOUT seconds after the loss of the radio or the ground station, the rover executes FS_ACTION, armed or not.
    In HOLD, the action requires bit 0 of FS_OPTIONS. In RTL, there is no action. While the radio check is enabled, the
    text is "Radio Failsafe", even if only the ground station is lost.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (
        _TERMINATE, _HOLD, _RTL, _SMART_RTL_OR_HOLD, _SMART_RTL, _NONE,
    )  # fmt: skip

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self._lost: set[str] = set()  # links that are lost at present
        self._triggered: set[str] = set()  # lost links whose failsafe was executed
        self._lost_since = math.nan  # time since which at least one link is lost
        self._position_lost, self._stuck = ConditionTimer(), ConditionTimer()

    @property
    def is_any_active(self) -> bool:
        # On Rover, a low battery does not cause MAV_STATE_CRITICAL.
        return bool(self._triggered) or self.has_estimator_failed

    def update(self) -> None:
        self._check_radio()
        self._check_ground_station()
        self._check_estimator()
        self._check_crash()
        super().update()

    def _check_radio(self) -> None:
        rover, parameters = self.vehicle, self.vehicle.parameters
        if rover.rc.is_receiving:
            self.radio_received_at: float = rover.now
        if not parameters["FS_THR_ENABLE"]:
            self.is_radio_lost = False
            return
        is_throttle_low = rover.rc[RC_THROTTLE] < parameters["FS_THR_VALUE"]
        self.is_radio_lost: bool = is_throttle_low or rover.now - self.radio_received_at > _RADIO_TIMEOUT_S
        self._update_link(_RADIO, is_lost=self.is_radio_lost)

    def _check_ground_station(self) -> None:
        parameters = self.vehicle.parameters
        if not parameters["FS_GCS_ENABLE"] or math.isnan(self.vehicle.ground_station_seen_at):
            return
        self.is_ground_station_lost: bool = self.ground_station_silence >= parameters["FS_GCS_TIMEOUT"]
        self._update_link(_GCS, is_lost=self.is_ground_station_lost)

    def _update_link(self, name: str, *, is_lost: bool) -> None:
        """Record whether a link is lost, and start or end the failsafe that both links share."""
        rover = self.vehicle
        was_any_link_lost = bool(self._lost)
        # This method is not called for a link whose check is disabled, so such a link stays lost.
        self._lost = (self._lost | {name}) if is_lost else (self._lost - {name})
        if self._lost and not was_any_link_lost:
            self._lost_since = rover.now
        if self._triggered and not self._lost:
            self.warn(f"{name} Failsafe Cleared", MavSeverity.INFO)
        self._triggered &= self._lost  # A link that has returned can start the failsafe again.
        is_waiting = rover.now - self._lost_since <= rover.parameters["FS_TIMEOUT"]
        is_due = self._lost and not self._triggered and not is_waiting
        if not is_due or not self._may_act():
            return
        # Like the firmware, name the link that was just checked, even if only the other link is lost (failsafe.cpp,
        # failsafe_trigger).
        self._triggered = set(self._lost)
        self.warn(f"{name} Failsafe")
        rover.rc.release_overrides()
        enabled = rover.parameters["FS_THR_ENABLE" if name == _RADIO else "FS_GCS_ENABLE"]
        if rover.mode.number == RoverMode.AUTO and enabled == _CONTINUE_MISSION:
            self.warn("Failsafe - Continuing Auto Mode")
        else:
            # FS_ACTION has the same values as the battery actions, so `act_on_battery` executes it.
            self.act_on_battery(int(rover.parameters["FS_ACTION"]))

    def _may_act(self) -> bool:
        rover = self.vehicle
        if rover.mode.number == RoverMode.HOLD:
            return bool(int(rover.parameters["FS_OPTIONS"]) & _ACTIVE_IN_HOLD)
        return rover.mode.number != RoverMode.RTL

    def act_on_battery(self, action: int) -> None:
        if action == _TERMINATE:
            self.vehicle.arming.disarm()
        else:
            self.vehicle.enter_first_accepted(*_MODES.get(action, ()))

    def _check_estimator(self) -> None:
        rover = self.vehicle
        is_lost = rover.is_armed and not rover.navigation.has_position
        lost_for = self._position_lost.seconds(is_lost, rover.now)
        if not is_lost:
            if self.has_estimator_failed:
                self.has_estimator_failed = False
                self.warn("EKF failsafe cleared", MavSeverity.CRITICAL)
            return
        can_start = lost_for >= _ESTIMATOR_TIMEOUT_S and not self.has_estimator_failed
        if not can_start:
            return
        self.has_estimator_failed: bool = True
        self.warn("EKF variance", MavSeverity.CRITICAL)
        action = int(rover.parameters["FS_EKF_ACTION"])
        if action and rover.mode.needs_position:  # Modes that need no position continue.
            if action != _EKF_REPORT_ONLY:
                rover.set_mode(RoverMode.HOLD)
            self.warn("EKF failsafe", MavSeverity.CRITICAL)

    def _check_crash(self) -> None:
        rover, action = self.vehicle, int(self.vehicle.parameters["FS_CRASH_CHECK"])
        # The simulation has no obstacles: only a failed motor keeps the rover from driving.
        is_blocked = rover.is_armed and rover.mode.number in _DRIVES_ITSELF and rover.faults.motor_failed
        is_stuck = bool(action) and is_blocked and rover.motion.ground_speed_m_s < _MAX_STUCK_SPEED_M_S
        if self._stuck.seconds(is_stuck, rover.now) >= _STUCK_TIMEOUT_S:
            self._stuck.reset()
            self.warn("Crash: Going to HOLD", MavSeverity.EMERGENCY)
            rover.set_mode(RoverMode.HOLD)
            if action == _HOLD_AND_DISARM:
                rover.arming.disarm()


_HOLD_BEYOND_M = 100.0


class RoverFence(ArduPilotFence[RoverHost]):
    """ArduRover's fence, which has no altitude limits and sends no texts.

    FENCE_ACTION has the values of FS_ACTION. With any action but 0, a rover more than 100 m outside changes to HOLD.
    """

    PERIOD_S: ClassVar[float] = 0.1
    MITIGATION: ClassVar[int] = FenceMitigate.NONE

    def act(self, new_breaches: int) -> None:
        if self.action == REPORT_ONLY:
            return
        if self.beyond_m(new_breaches) > _HOLD_BEYOND_M:
            self.vehicle.set_mode(RoverMode.HOLD)
        elif self.action == _TERMINATE:
            self.vehicle.arming.disarm()
        else:
            self.caused_mode: bool = self.vehicle.enter_first_accepted(*_MODES.get(self.action, ()))


class RoverMotors(ArduPilotMotors):
    """The motor that drives the wheels."""

    ELECTRONICS_A: ClassVar[float] = 0.0
    AMPERES_AT_FULL: ClassVar[float] = 16.0

    def update(self, dt: float, *, landed: bool) -> None:
        motion = self.vehicle.motion
        self.throttle: float = max(-1.0, min(1.0, motion.speed_m_s / motion.wheels.top_speed_m_s / 2.0))
        if not self.is_armed:
            self.throttle = 0.0


_MANUAL_INPUT = frozenset({"MANU", "ACRO", "STER"})


class SimulatedRover(RoverHost):
    """ArduRover, as far as a client can observe it. `GroundMotion` is the motion model.

    Takes the arguments of `ArduPilotVehicle`. The rover has 1,235 parameters. Simulated modes: MANUAL, ACRO, STEERING
    and SIMPLE (driven by the sticks), HOLD, LOITER and CIRCLE (which only stop), AUTO, GUIDED, RTL and SMART_RTL.
    Commands to take off and land are UNSUPPORTED.

    Not simulated: boats, driving in circles, braking before a fence.
    """

    guided: RoverGuided  # pyright: ignore[reportIncompatibleVariableOverride]

    KIND: ClassVar[Kind] = "rover"
    FIRMWARE: ClassVar[str] = "ArduRover"
    MAV_TYPE: ClassVar[int] = MavType.GROUND_ROVER
    HOME_NEEDS_ORIGIN: ClassVar[bool] = False
    REPORTS_HOME: ClassVar[bool] = True
    BASE_FLAGS: ClassVar[int] = MavModeFlag.CUSTOM_MODE_ENABLED
    GUIDED_MODES: ClassVar[frozenset[str]] = frozenset({"LOIT", "CIRC", "AUTO", "RTL", "SRTL", "GUID"})
    CAPABILITIES: ClassVar[int] = 0xF1EF
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["rover"]
    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]] = ROVER_MODES
    ARMING: ClassVar[type[ArduPilotArming[Any]]] = RoverArming
    FAILSAFES: ClassVar[type[ArduPilotFailsafes[Any]]] = RoverFailsafes
    FENCE: ClassVar[type[ArduPilotFence[Any]]] = RoverFence
    MOTORS: ClassVar[type[ArduPilotMotors]] = RoverMotors
    JOYSTICK: ClassVar[type[ArduPilotJoystick]] = RoverJoystick

    def make_motion(self, wind: SimulatedWind | None) -> GroundMotion:
        """Create the motion model with limits from the parameters. Wind is reported, but does not move the rover."""
        parameters = self.parameters
        # The value 0 means that there is no limit. The motion model needs a limit, so `or` replaces the 0.
        limits = GroundLimits(
            acceleration_m_s2=parameters["ATC_ACCEL_MAX"] or 1.0,
            top_speed_m_s=self.top_speed,
            turn_rate_rad_s=math.radians(parameters["ATC_STR_RAT_MAX"] or 120.0),
            turn_radius_m=parameters["TURN_RADIUS"] or 0.9,
            sideways_m_s2=9.81 * (parameters["ATC_TURN_MAX_G"] or 0.6),
        )
        return GroundMotion(self.rng, limits, wind)

    @property
    def is_standby(self) -> bool:
        return self.mode.number == RoverMode.HOLD

    @property
    def base_mode(self) -> int:
        manual_input = MavModeFlag.MANUAL_INPUT_ENABLED if self.mode.name in _MANUAL_INPUT else 0
        return super().base_mode | manual_input

    def make_commands(self) -> dict[int, CommandHandler]:
        return {
            **super().make_commands(),
            MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: self.change_to(RoverMode.RTL),
            MavCmd.DO_FLIGHTTERMINATION: lambda _: MavResult.UNSUPPORTED,
        }
