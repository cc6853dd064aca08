"""`SimulatedSub`: an ArduSub 4.7 with vectored thrusters, without sockets, threads or a clock of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Any, ClassVar

from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, MavType, SpeedType, SubMode
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.parameter_tables import Kind
from aerokit.sim.ardupilot.radio import SubJoystick
from aerokit.sim.ardupilot.requests import DISPLAY_VALUES
from aerokit.sim.ardupilot.sub.failsafes import SubArming, SubFailsafes
from aerokit.sim.ardupilot.sub.host import SubHost
from aerokit.sim.ardupilot.sub.modes import SUB_MODES, SubAuto, SubGuided
from aerokit.sim.ardupilot.targets import SubTargets
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import Command, CommandHandler
from aerokit.sim.ground_motion import UnderwaterMotion
from aerokit.sim.motion import Motion, Wind

_GUIDED_MODES = frozenset({"AUTO", "GUIDED", "CIRCLE", "POSHOLD"})
_BASE = MavModeFlag.CUSTOM_MODE_ENABLED | MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED
_HOLDING_THROTTLE, _PER_CLIMB = 0.45, 0.44
_AMPERES_AT_FULL = 26.3
_STICKS, _THROTTLE = 8, 2


class _Motors(Motors):
    """The thrusters that hold the depth, or follow the stick; 0.5 is no thrust at all."""

    def __init__(self, sub: SubHost) -> None:
        super().__init__()
        self._sub = sub

    @property
    def current_a(self) -> float:
        thrust = abs(2.0 * self.throttle - 1.0) if self._follows_stick else self.throttle
        return float(thrust**2.7) * _AMPERES_AT_FULL

    @property
    def _follows_stick(self) -> bool:
        return self._sub.mode.has_manual_throttle

    def update(self, now: float, dt: float, motion: Motion, *, landed: bool) -> None:
        wanted = _HOLDING_THROTTLE - _PER_CLIMB * motion.velocity_down
        if self._follows_stick:
            wanted = (self._sub.rc[_THROTTLE] - 1000) / 1000.0
        self.throttle = max(0.0, min(1.0, wanted)) if self.is_armed else 0.0


class SimulatedSub(SubHost):
    """Speaks and behaves as ArduSub does where a client can see it; moves as `UnderwaterMotion` does.

    Its arguments are those of `ArduPilotVehicle`; ``home`` is at the surface, so altitudes above home are negative.
    It has 1,386 parameters. Simulated: MANUAL, STABILIZE, ACRO, ALT_HOLD and POSHOLD by the sticks, GUIDED, AUTO and
    SURFACE; it can be armed without a position in the modes that need none. Take-off is an unknown command.

    Not simulated yet: CIRCLE, SURFTRAK and MOTORDETECT (they hold still), currents. Waking up after a
    reboot it is at the surface.
    """

    KIND: ClassVar[Kind] = "sub"
    FIRMWARE: ClassVar[str] = "ArduSub"
    MAV_TYPE: ClassVar[int] = MavType.SUBMARINE
    CAPABILITIES: ClassVar[int] = 0xF9E7
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["sub"]
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = SUB_MODES
    ARMING: ClassVar[type[Arming]] = SubArming
    FAILSAFES: ClassVar[type[Failsafes]] = SubFailsafes

    def make_motion(self, wind: Wind | None) -> UnderwaterMotion:
        """SIM_BUOYANCY 1 lifts it with 0.1 m/s; wind does not reach it."""
        return UnderwaterMotion(self.rng, buoyancy_m_s2=self.parameters["SIM_BUOYANCY"] / 10.0)

    def make_motors(self) -> Motors:
        return _Motors(self)

    def hear_setpoints(self) -> None:
        SubTargets(self, self.guided)

    def make_joystick(self) -> SubJoystick:
        return SubJoystick(self)

    def reset_controllers(self) -> None:
        """All sticks rest in the middle."""
        self.display_names = cycle(DISPLAY_VALUES)
        for index in range(_STICKS):
            self.rc[index] = 1500

    @property
    def first_mode(self) -> int:
        return SubMode.MANUAL

    @property
    def is_landed(self) -> bool:
        """What STANDBY in the heartbeat means here: disarmed."""
        return not self.motors.is_armed

    @is_landed.setter
    def is_landed(self, _: bool) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """It never is."""

    @property
    def guided(self) -> SubGuided:
        return self.mode_of(SubGuided)

    @property
    def auto(self) -> SubAuto:
        return self.mode_of(SubAuto)

    @property
    def base_mode(self) -> int:
        """Guided in the modes that know where they are."""
        base = int(_BASE)
        if self.mode.name in _GUIDED_MODES:
            base |= MavModeFlag.GUIDED_ENABLED
        return base | MavModeFlag.SAFETY_ARMED if self.motors.is_armed else base

    @property
    def is_at_rest(self) -> bool:
        return self.motion.is_still

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        """Why a mode is not entered."""
        if reason == "requires position":
            return f"Mode change failed: {mode.name} requires position"
        return f"Flight mode change failed {mode.name}"

    def own_commands(self) -> dict[int, CommandHandler]:
        """LAND is the surface, LOITER_UNLIM holds the place; there is no way home by command."""
        return {
            MavCmd.DO_CHANGE_SPEED: self._change_speed_at_any_time,
            MavCmd.NAV_LAND: lambda _: self.change_to(SubMode.SURFACE),
            MavCmd.NAV_LOITER_UNLIM: lambda _: self.change_to(SubMode.POSHOLD),
            MavCmd.CONDITION_YAW: self._turn,
        }

    def _change_speed_at_any_time(self, command: Command) -> int:
        """Also in modes that have no use for it."""
        if not command.param2 > 0 or command.param1 not in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED):
            return MavResult.DENIED
        if isinstance(self.mode, SubGuided | SubAuto):
            self.mode.speed = command.param2
        return MavResult.ACCEPTED

    def _turn(self, command: Command) -> int:
        angle, relative = command.param1, command.param4
        if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
            return MavResult.FAILED
        if self.mode is not self.guided:
            return MavResult.ACCEPTED
        heading = math.radians(angle)
        if relative:
            heading = self.motion.yaw + math.copysign(heading, command.param3 or 1.0)
        self.guided.face(heading)
        return MavResult.ACCEPTED
