"""`SimulatedPlane`: an ArduPlane 4.7 with fixed wings without sockets, threads or a clock of its own."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar

from aerokit.mavlink.enums import MavModeFlag, MavSeverity, MavType, PlaneMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.plane.arming import PlaneArming
from aerokit.sim.ardupilot.plane.auto import Auto
from aerokit.sim.ardupilot.plane.commands import plane_commands
from aerokit.sim.ardupilot.plane.failsafes import PlaneFailsafes
from aerokit.sim.ardupilot.plane.fence import PlaneFence
from aerokit.sim.ardupilot.plane.guided import Guided, PlaneSetpoints
from aerokit.sim.ardupilot.plane.modes import (
    Autoland,
    Circle,
    Cruise,
    FlyByWireA,
    FlyByWireB,
    Loiter,
    Manual,
    PlaneModeBase,
    Rtl,
    Stabilize,
    TakeOff,
)
from aerokit.sim.ardupilot.plane.other_modes import (
    Acro,
    Autotune,
    AvoidAdsb,
    Initialising,
    Thermal,
    Training,
)
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.fixed_wing import FixedWing

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.sim.ardupilot.arming import Arming
    from aerokit.sim.ardupilot.failsafes import Failsafes
    from aerokit.sim.ardupilot.fence import Fence
    from aerokit.sim.ardupilot.mode import VehicleMode
    from aerokit.sim.ardupilot.parameter_tables import Kind
    from aerokit.sim.commands import CommandHandler
    from aerokit.sim.motion import Motion, Wind

__all__ = ["SimulatedPlane"]

_FULL_AMPERES = 25.0
_STANDS_S = 1.0
_LIFTING_MODES = range(PlaneMode.QSTABILIZE, PlaneMode.QACRO + 1)


class SimulatedPlane(ArduPilotVehicle):
    """Speaks and behaves as ArduPlane does where a client can see it; flies as `FixedWing` does.

    Its arguments are those of `ArduPilotVehicle`. It starts on a runway along its heading. Not simulated: lifting
    rotors, parachutes.
    """

    KIND: ClassVar[Kind] = "plane"
    FIRMWARE: ClassVar[str] = "ArduPlane"
    MAV_TYPE: ClassVar[int] = MavType.FIXED_WING
    HOME_NEEDS_ORIGIN: ClassVar[bool] = False
    CAPABILITIES: ClassVar[int] = 0xF36F
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = (
        Manual, Circle, Stabilize, Training, Acro, FlyByWireA, FlyByWireB, Cruise, Autotune, Auto, Rtl, Loiter,
        AvoidAdsb, Guided, Initialising, TakeOff, Thermal, Autoland,
    )  # fmt: skip
    ARMING: ClassVar[type[Arming]] = PlaneArming
    FAILSAFES: ClassVar[type[Failsafes]] = PlaneFailsafes
    FENCE: ClassVar[type[Fence]] = PlaneFence

    fence: PlaneFence  # pyright: ignore[reportIncompatibleVariableOverride]
    failsafes: PlaneFailsafes  # pyright: ignore[reportIncompatibleVariableOverride]

    def make_motion(self, wind: Wind | None) -> Motion:
        """An aeroplane within the limits of the parameters."""
        self.wing: FixedWing = FixedWing(self.rng, wind=wind)
        """What flies; the same as ``motion``."""
        self._read_limits()
        return self.wing

    def _read_limits(self) -> None:
        limits, parameters = self.wing.wing, self.parameters
        limits.airspeed_min_m_s = parameters["AIRSPEED_MIN"]
        limits.airspeed_max_m_s = parameters["AIRSPEED_MAX"]
        limits.climb_m_s = parameters["TECS_CLMB_MAX"]
        limits.sink_m_s = parameters["TECS_SINK_MAX"]
        limits.glide_sink_m_s = parameters["TECS_SINK_MIN"]
        limits.bank_rad = math.radians(parameters["ROLL_LIMIT_DEG"])

    def make_motors(self) -> Motors:
        """One engine."""
        return _Engine()

    def make_commands(self) -> dict[int, CommandHandler]:
        """See `plane_commands`."""
        return plane_commands(self)

    def hear_setpoints(self) -> None:
        """See `PlaneSetpoints`."""
        PlaneSetpoints(self)

    def reset_controllers(self) -> None:
        """Forget the take-off."""
        self.take_off_yaw: float | None = None
        """Where it has taken off to, in radians; None before."""
        self._rests_since = math.nan

    def unknown_mode(self, number: int) -> tuple[int, str]:
        """Those for lifting rotors need Q_ENABLE."""
        if number in _LIFTING_MODES:
            return MavSeverity.INFO, "Q_ENABLE 0"
        return super().unknown_mode(number)

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        """The same for every mode."""
        return "Flight mode change failed"

    @property
    def guided(self) -> Guided:
        """GUIDED."""
        return self.mode_of(Guided)

    @property
    def auto(self) -> Auto:
        """AUTO."""
        return self.mode_of(Auto)

    @property
    def base_mode(self) -> int:
        """As the mode has it; the radio is heard."""
        mode = self.mode
        flags = int(mode.flags) if isinstance(mode, PlaneModeBase) else 0
        armed = MavModeFlag.SAFETY_ARMED if self.motors.is_armed else 0
        return flags | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED | armed

    @property
    def cruise_m_s(self) -> float:
        """AIRSPEED_CRUISE."""
        return self.parameters["AIRSPEED_CRUISE"]

    def can_fly_at(self, airspeed: float) -> bool:
        """Whether an airspeed in m/s is between AIRSPEED_MIN and AIRSPEED_MAX."""
        return self.parameters["AIRSPEED_MIN"] <= airspeed <= self.parameters["AIRSPEED_MAX"]

    def lift_off(self) -> None:
        """The engine runs: from now on it moves, on the ground at first."""
        if self.is_landed:
            self._read_limits()
            self.is_landed, self._rests_since = False, math.nan
            self.take_off_yaw = self.wing.yaw

    def move(self, dt: float) -> None:
        """Motion, and whether it stands."""
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
        """What the battery gives."""
        return self.throttle * _FULL_AMPERES

    def update(self, now: float, dt: float, motion: Any, *, landed: bool) -> None:
        """Follow the motion."""
        self.throttle = motion.throttle if self.is_armed and not landed else 0.0
        self.spool = self.throttle
