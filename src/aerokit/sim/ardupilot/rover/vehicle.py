"""`SimulatedRover`: an ArduRover 4.7 car without sockets, threads or a clock of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, MavType, RoverMode
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.parameter_tables import Kind
from aerokit.sim.ardupilot.radio import LevelJoystick
from aerokit.sim.ardupilot.rover.failsafes import RoverArming, RoverFailsafes, RoverFence
from aerokit.sim.ardupilot.rover.host import RoverHost
from aerokit.sim.ardupilot.rover.modes import ROVER_MODES, RoverAuto, RoverGuided
from aerokit.sim.ardupilot.targets import RoverTargets
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler
from aerokit.sim.ground_motion import GroundLimits, GroundMotion
from aerokit.sim.motion import Motion, Wind

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
    ARMING: ClassVar[type[Arming]] = RoverArming
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
