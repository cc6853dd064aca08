"""`SimulatedPlane`: an ArduPlane 4.7 with fixed wings that uses no sockets, threads or system clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from aerokit.mavlink.enums import (
    MavCmd,
    MavDoRepositionFlags,
    MavModeFlag,
    MavResult,
    MavSeverity,
    MavType,
    PlaneMode,
    SpeedType,
)
from aerokit.sim.ardupilot import plane_modes as modes
from aerokit.sim.ardupilot.commands import common_commands
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes
from aerokit.sim.ardupilot.fence import ArduPilotFence
from aerokit.sim.ardupilot.host import ArduPilotMode, ArduPilotMotors, variant
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.plane_auto import PlaneAuto, PlaneGuided
from aerokit.sim.ardupilot.plane_failsafes import PlaneFailsafes, PlaneFence
from aerokit.sim.ardupilot.plane_modes import PlaneHost, PlaneModeBase, PlaneNavigatingMode
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler, ReceivedCommand, to_int

_SHORT_DISABLED = 3
_MIN_ANGLE_DEG, _MIN_AIRSPEED_M_S = 3.0, 5


class PlaneArming(ArduPilotArming[PlaneHost]):
    """ArduPlane's arming checks: GPS in every mode; plausible angle limits, airspeed and time-outs; an armable mode."""

    def own_reasons(self) -> list[str]:
        parameters, mode = self.vehicle.parameters, self.vehicle.mode
        max_roll = parameters["ROLL_LIMIT_DEG"]
        max_pitch, min_pitch = parameters["PTCH_LIM_MAX_DEG"], parameters["PTCH_LIM_MIN_DEG"]
        airspeed = int(parameters["AIRSPEED_MIN"])
        # The long failsafe follows the short failsafe, so FS_LONG_TIMEOUT must not be shorter than FS_SHORT_TIMEOUT.
        is_long_shorter = parameters["FS_LONG_TIMEOUT"] < parameters["FS_SHORT_TIMEOUT"]
        checks = (
            (is_long_shorter and parameters["FS_SHORT_ACTN"] != _SHORT_DISABLED, "FS_LONG_TIMEOUT < FS_SHORT_TIMEOUT"),
            (max_roll < _MIN_ANGLE_DEG, f"ROLL_LIMIT_DEG too small ({max_roll:.1f})"),
            (max_pitch < _MIN_ANGLE_DEG, f"PTCH_LIM_MAX_DEG too small ({max_pitch:.1f})"),
            (min_pitch > -_MIN_ANGLE_DEG, f"PTCH_LIM_MIN_DEG too large ({min_pitch:.1f})"),
            (airspeed < _MIN_AIRSPEED_M_S, f"AIRSPEED_MIN too low ({airspeed} < {_MIN_AIRSPEED_M_S})"),
            (not mode.can_arm, f"{mode.name} mode not armable"),
        )
        return [text for failed, text in checks if failed]


class PlaneEngine(ArduPilotMotors):
    """The engine of a plane, whose throttle is that of the motion model."""

    ELECTRONICS_A: ClassVar[float] = 0.0
    AMPERES_AT_FULL: ClassVar[float] = 25.0

    def update(self, dt: float, *, landed: bool) -> None:
        self.throttle: float = self.vehicle.motion.throttle if self.is_armed and not landed else 0.0
        self.spool: float = self.throttle


_MIN_REST_S = 1.0
_LIFTING_MODES = range(PlaneMode.QSTABILIZE, PlaneMode.QACRO + 1)

# Modes in the order of AVAILABLE_MODES. With Q_ENABLE 0, the firmware has no modes for lifting rotors.
_MODES: tuple[Callable[[Any], ArduPilotMode], ...] = (
    variant(
        modes.PlanePilotedMode, PlaneMode.MANUAL, "MANUAL",
        flags=MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.STABILIZE_ENABLED,
    ),
    variant(modes.PlaneCircle, PlaneMode.CIRCLE, "CIRCLE"),
    variant(modes.PlanePilotedMode, PlaneMode.STABILIZE, "STABILIZE"),
    variant(modes.PlanePilotedMode, PlaneMode.TRAINING, "TRAINING"),
    variant(modes.PlanePilotedMode, PlaneMode.ACRO, "ACRO"),
    variant(modes.PlanePilotedMode, PlaneMode.FLY_BY_WIRE_A, "FLY_BY_WIRE_A"),
    variant(modes.PlaneAltitudeMode, PlaneMode.FLY_BY_WIRE_B, "FLY_BY_WIRE_B"),
    variant(modes.PlaneCruise, PlaneMode.CRUISE, "CRUISE"),
    variant(
        modes.PlanePilotedMode, PlaneMode.AUTOTUNE, "AUTOTUNE",
        entry_texts=("Started autotune", "Autotuning roll pitch yaw"),
    ),
    PlaneAuto,
    variant(modes.PlaneRtl, PlaneMode.RTL, "RTL"),
    variant(PlaneNavigatingMode, PlaneMode.LOITER, "LOITER"),
    variant(PlaneNavigatingMode, PlaneMode.AVOID_ADSB, "AVOID_ADSB"),
    PlaneGuided,
    variant(modes.PlaneModeBase, PlaneMode.INITIALIZING, "INITIALISING", is_available=False, can_arm=False),
    variant(modes.PlaneTakeOff, PlaneMode.TAKEOFF, "TAKEOFF"),
    variant(modes.PlaneModeBase, PlaneMode.THERMAL, "THERMAL", is_available=False, can_arm=False),
    variant(modes.PlaneAutoland, PlaneMode.AUTOLAND, "AUTOLAND"),
)  # fmt: skip


class SimulatedPlane(PlaneHost):
    """ArduPlane, as far as a client can observe it. `FixedWing` is the motion model.

    Takes the arguments of `ArduPilotVehicle`. The plane starts on a runway, facing along it. Not simulated: lifting
    rotors, parachutes.
    """

    guided: PlaneGuided  # pyright: ignore[reportIncompatibleVariableOverride]

    KIND: ClassVar[Kind] = "plane"
    FIRMWARE: ClassVar[str] = "ArduPlane"
    MAV_TYPE: ClassVar[int] = MavType.FIXED_WING
    HOME_NEEDS_ORIGIN: ClassVar[bool] = False
    BASE_FLAGS: ClassVar[int] = MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED
    CAPABILITIES: ClassVar[int] = 0xF36F
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["plane"]
    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]] = _MODES
    ARMING: ClassVar[type[ArduPilotArming[Any]]] = PlaneArming
    FAILSAFES: ClassVar[type[ArduPilotFailsafes[Any]]] = PlaneFailsafes
    FENCE: ClassVar[type[ArduPilotFence[Any]]] = PlaneFence
    MOTORS: ClassVar[type[ArduPilotMotors]] = PlaneEngine

    fence: PlaneFence  # pyright: ignore[reportIncompatibleVariableOverride]
    failsafes: PlaneFailsafes  # pyright: ignore[reportIncompatibleVariableOverride]

    def make_commands(self) -> dict[int, CommandHandler]:
        """Return the handlers of the commands that ArduPlane knows."""
        # NAV_TAKEOFF fails, because it needs the lifting rotors of a QuadPlane. ArduPlane has no command to land.
        return {
            **common_commands(self),
            MavCmd.NAV_TAKEOFF: lambda _: MavResult.FAILED,
            MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: self.change_to(PlaneMode.RTL),
            MavCmd.NAV_LOITER_UNLIM: lambda _: self.change_to(PlaneMode.LOITER),
            MavCmd.MISSION_START: self._start_mission,
            MavCmd.DO_REPOSITION: self._reposition,
            MavCmd.DO_CHANGE_SPEED: self._change_speed,
            **dict.fromkeys(
                (MavCmd.GUIDED_CHANGE_SPEED, MavCmd.GUIDED_CHANGE_ALTITUDE, MavCmd.GUIDED_CHANGE_HEADING),
                lambda command: self.guided.on_guided_command(command),
            ),
            MavCmd.DO_CHANGE_ALTITUDE: lambda command: self.guided.change_target_altitude(command),
            MavCmd.DO_FLIGHTTERMINATION: self._terminate,
        }

    def text_for_unknown_mode(self, number: int) -> tuple[int, str]:
        if number in _LIFTING_MODES:
            return MavSeverity.INFO, "Q_ENABLE 0"
        return super().text_for_unknown_mode(number)

    @property
    def base_mode(self) -> int:
        flags = int(self.mode.flags) if isinstance(self.mode, PlaneModeBase) else 0
        return super().base_mode | flags

    def move(self, dt: float) -> None:
        """Move for ``dt`` seconds. A plane that rests for a while counts as landed."""
        super().move(dt)
        is_resting = self.wing.is_at_rest and self.wing.throttle <= 0
        rested_for_s = self.rest_timer.seconds(is_resting, self.now)
        if rested_for_s >= _MIN_REST_S:
            self.is_landed: bool = True
            self.wing.settle()  # stops the motion model

    def _terminate(self, command: ReceivedCommand) -> int:
        # Termination is refused, because it needs the advanced failsafe, which is not simulated.
        if command.param1 > 0.5:
            self.failsafes.refuse_termination()
        return MavResult.FAILED

    def _start_mission(self, command: ReceivedCommand) -> int:
        if command.param1 or command.param2:  # The firmware refuses a first and a last item.
            return MavResult.DENIED
        return self.change_to(PlaneMode.AUTO)

    def _reposition(self, command: ReceivedCommand) -> int:
        if command.is_long:  # ArduPilot requires the altitude frame of a COMMAND_INT.
            return MavResult.UNSUPPORTED
        point = self.world_point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        may_change_mode = bool(to_int(command.param2) & MavDoRepositionFlags.CHANGE_MODE)
        if self.mode is not self.guided and not may_change_mode:
            return MavResult.FAILED
        if not self.set_mode(PlaneMode.GUIDED):
            return MavResult.FAILED
        self.guided.go_to(point)
        radius = command.param3
        if radius > 0:  # Without a positive radius, WP_LOITER_RAD applies.
            is_anticlockwise = not math.isnan(command.param4) and command.param4 != 0
            self.guided.radius = -radius if is_anticlockwise else radius
        return MavResult.ACCEPTED

    def _change_speed(self, command: ReceivedCommand) -> int:
        mode = self.mode
        if not isinstance(mode, PlaneNavigatingMode) or not mode.can_change_speed:
            return MavResult.FAILED
        if command.param1 == SpeedType.AIRSPEED and self.is_valid_airspeed(command.param2):
            mode.speed = command.param2
            return MavResult.ACCEPTED
        # A ground speed is accepted, but has no effect.
        is_ground_speed = command.param1 == SpeedType.GROUNDSPEED
        return MavResult.ACCEPTED if is_ground_speed else MavResult.FAILED  # An invalid airspeed fails, too.
