"""`SimulatedPlane`: an ArduPlane 4.7 with fixed wings without sockets, threads or a clock of its own."""

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
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.commands import common_commands
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.mode import VehicleMode, variant
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.plane.auto import Auto
from aerokit.sim.ardupilot.plane.failsafes import PlaneFailsafes, PlaneFence
from aerokit.sim.ardupilot.plane.guided import Guided, PlaneSetpoints, guided_commands
from aerokit.sim.ardupilot.plane.host import PlaneHost
from aerokit.sim.ardupilot.plane.modes import (
    Autoland,
    Autotune,
    Circle,
    Cruise,
    FlyByWireB,
    NavigatingMode,
    Piloted,
    PlaneModeBase,
    Refusing,
    Rtl,
    TakeOff,
)
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import Command, CommandHandler, whole

_SHORT_DISABLED = 3
_SMALLEST_ANGLE_DEG, _SLOWEST_M_S = 3.0, 5


class PlaneArming(Arming):
    """GPS in every mode, limits that make sense, and a mode that starts on the ground."""

    def __init__(self, plane: SimulatedPlane) -> None:
        super().__init__(plane)
        self._plane = plane

    def own_reasons(self) -> list[str]:
        mode = self._plane.mode
        return self._bad_limits() + ([] if mode.can_arm else [f"{mode.name} mode not armable"])

    def _bad_limits(self) -> list[str]:
        parameters = self._plane.parameters
        roll, up, down = (
            parameters[name] for name in ("ROLL_LIMIT_DEG", "PTCH_LIM_MAX_DEG", "PTCH_LIM_MIN_DEG")
        )
        slowest = int(parameters["AIRSPEED_MIN"])
        too_short = parameters["FS_LONG_TIMEOUT"] < parameters["FS_SHORT_TIMEOUT"]
        checks = (
            (
                too_short and parameters["FS_SHORT_ACTN"] != _SHORT_DISABLED,
                "FS_LONG_TIMEOUT < FS_SHORT_TIMEOUT",
            ),
            (roll < _SMALLEST_ANGLE_DEG, f"ROLL_LIMIT_DEG too small ({roll:.1f})"),
            (up < _SMALLEST_ANGLE_DEG, f"PTCH_LIM_MAX_DEG too small ({up:.1f})"),
            (down > -_SMALLEST_ANGLE_DEG, f"PTCH_LIM_MIN_DEG too large ({down:.1f})"),
            (slowest < _SLOWEST_M_S, f"AIRSPEED_MIN too low ({slowest} < {_SLOWEST_M_S})"),
        )
        return [text for failed, text in checks if failed]


def plane_commands(plane: SimulatedPlane) -> dict[int, CommandHandler]:
    """MAV_CMD → handler. NAV_TAKEOFF is for aeroplanes with lifting rotors; there is no command to land."""
    flight = _Flight(plane)
    return {
        **common_commands(plane),
        MavCmd.NAV_TAKEOFF: lambda _: MavResult.FAILED,
        MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: plane.change_to(PlaneMode.RTL),
        MavCmd.NAV_LOITER_UNLIM: lambda _: plane.change_to(PlaneMode.LOITER),
        MavCmd.MISSION_START: flight.start_mission,
        MavCmd.DO_REPOSITION: flight.reposition,
        MavCmd.DO_CHANGE_SPEED: flight.change_speed,
        **guided_commands(plane),
        MavCmd.DO_FLIGHTTERMINATION: flight.terminate,
    }


class _Flight:
    """Commands that move the aeroplane."""

    def __init__(self, plane: SimulatedPlane) -> None:
        self._plane = plane

    def terminate(self, command: Command) -> int:
        """Only with the advanced failsafe, which is not simulated."""
        if command.param1 > 0.5:
            self._plane.failsafes.refuse_termination()
        return MavResult.FAILED

    def start_mission(self, command: Command) -> int:
        if command.param1 or command.param2:
            return MavResult.DENIED
        return self._plane.change_to(PlaneMode.AUTO)

    def reposition(self, command: Command) -> int:
        """Only as COMMAND_INT; param 3 is the radius of the circle, param 4 not 0 is anticlockwise."""
        plane = self._plane
        if command.is_long:
            return MavResult.UNSUPPORTED
        point = plane.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        if plane.mode is not plane.guided and not whole(command.param2) & MavDoRepositionFlags.CHANGE_MODE:
            return MavResult.FAILED
        if not plane.set_mode(PlaneMode.GUIDED):
            return MavResult.FAILED
        plane.guided.go_to(point)
        if command.param3 > 0:
            anticlockwise = command.param4 == command.param4 and command.param4 != 0
            plane.guided.radius = -command.param3 if anticlockwise else command.param3
        return MavResult.ACCEPTED

    def change_speed(self, command: Command) -> int:
        """Airspeed between AIRSPEED_MIN and AIRSPEED_MAX, in GUIDED and AUTO."""
        mode, plane = self._plane.mode, self._plane
        if not isinstance(mode, NavigatingMode) or not mode.can_change_speed:
            return MavResult.FAILED
        if command.param1 == SpeedType.AIRSPEED and plane.can_fly_at(command.param2):
            mode.speed = command.param2
            return MavResult.ACCEPTED
        if command.param1 == SpeedType.GROUNDSPEED:
            return MavResult.ACCEPTED  # sets the lowest speed over the ground, which is not simulated
        return MavResult.FAILED


_FULL_AMPERES = 25.0
_STANDS_S = 1.0
_LIFTING_MODES = range(PlaneMode.QSTABILIZE, PlaneMode.QACRO + 1)


_MODES: tuple[Callable[[Any], VehicleMode], ...] = (
    variant(
        Piloted, PlaneMode.MANUAL, "MANUAL",
        flags=MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.STABILIZE_ENABLED,
    ),
    Circle,
    variant(Piloted, PlaneMode.STABILIZE, "STABILIZE"),
    variant(Piloted, PlaneMode.TRAINING, "TRAINING"),
    variant(Piloted, PlaneMode.ACRO, "ACRO"),
    variant(Piloted, PlaneMode.FLY_BY_WIRE_A, "FLY_BY_WIRE_A"),
    FlyByWireB,
    Cruise,
    Autotune,
    Auto,
    Rtl,
    variant(NavigatingMode, PlaneMode.LOITER, "LOITER"),
    variant(NavigatingMode, PlaneMode.AVOID_ADSB, "AVOID_ADSB"),
    Guided,
    variant(Refusing, PlaneMode.INITIALIZING, "INITIALISING"),
    TakeOff,
    variant(Refusing, PlaneMode.THERMAL, "THERMAL"),
    Autoland,
)  # fmt: skip
"""In the order in which they are listed; the rarer ones fly by the sticks, circle, or refuse."""


class SimulatedPlane(PlaneHost):
    """Speaks and behaves as ArduPlane does where a client can see it; flies as `FixedWing` does.

    Its arguments are those of `ArduPilotVehicle`. It starts on a runway along its heading. Not simulated: lifting
    rotors, parachutes.
    """

    KIND: ClassVar[Kind] = "plane"
    FIRMWARE: ClassVar[str] = "ArduPlane"
    MAV_TYPE: ClassVar[int] = MavType.FIXED_WING
    HOME_NEEDS_ORIGIN: ClassVar[bool] = False
    CAPABILITIES: ClassVar[int] = 0xF36F
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["plane"]
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = _MODES
    FAILSAFES: ClassVar[type[Failsafes]] = PlaneFailsafes
    FENCE: ClassVar[type[Fence]] = PlaneFence

    fence: PlaneFence  # pyright: ignore[reportIncompatibleVariableOverride]
    failsafes: PlaneFailsafes  # pyright: ignore[reportIncompatibleVariableOverride]

    def make_motors(self) -> Motors:
        return _Engine()

    def make_arming(self) -> Arming:
        return PlaneArming(self)

    def make_commands(self) -> dict[int, CommandHandler]:
        return plane_commands(self)

    def hear_setpoints(self) -> None:
        PlaneSetpoints(self)

    def unknown_mode(self, number: int) -> tuple[int, str]:
        if number in _LIFTING_MODES:
            return MavSeverity.INFO, "Q_ENABLE 0"
        return super().unknown_mode(number)

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        return "Flight mode change failed"

    @property
    def guided(self) -> Guided:
        return self.mode_of(Guided)

    @property
    def auto(self) -> Auto:
        return self.mode_of(Auto)

    @property
    def base_mode(self) -> int:
        """As the mode has it; the radio is heard."""
        mode = self.mode
        flags = int(mode.flags) if isinstance(mode, PlaneModeBase) else 0
        armed = MavModeFlag.SAFETY_ARMED if self.motors.is_armed else 0
        return flags | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED | armed

    def move(self, dt: float) -> None:
        wing = self.wing
        was_on_ground = wing.is_on_ground
        wing.step(dt, powered=self.motors.is_armed and not self.faults.motor_failed)
        if wing.is_on_ground and not was_on_ground:
            self.info(f"SIM Hit ground at {wing.impact_speed_m_s:f} m/s")
        if not wing.is_at_rest or wing.throttle > 0:
            self._rests_since = math.nan
        elif math.isnan(self._rests_since):
            self._rests_since = self.now
        elif self.now - self._rests_since >= _STANDS_S:
            self.is_landed: bool = True
            wing.settle()


class _Engine(Motors):
    """Its throttle is what the aeroplane needs."""

    @property
    def current_a(self) -> float:
        return self.throttle * _FULL_AMPERES

    def update(self, now: float, dt: float, motion: Any, *, landed: bool) -> None:
        self.throttle = motion.throttle if self.is_armed and not landed else 0.0
        self.spool = self.throttle
