"""`SimulatedCopter`: an ArduCopter 4.7 quadrotor without sockets, threads or a clock of its own."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavModeFlag, MavType
from aerokit.sim.ardupilot.copter.arming import CopterArming
from aerokit.sim.ardupilot.copter.auto import Auto
from aerokit.sim.ardupilot.copter.commands import copter_commands
from aerokit.sim.ardupilot.copter.failsafes import CopterFailsafes
from aerokit.sim.ardupilot.copter.fence import CopterFence
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.copter.modes import AltHold, Brake, Circle, Loiter, PosHold, Stabilize
from aerokit.sim.ardupilot.copter.motor_test import MotorTest
from aerokit.sim.ardupilot.copter.other_modes import (
    Acro,
    AutoRtl,
    Autotune,
    AvoidAdsb,
    Drift,
    Flip,
    FlowHold,
    Follow,
    GuidedNoGps,
    SystemId,
    Throw,
    Turtle,
    ZigZag,
)
from aerokit.sim.ardupilot.copter.returning import Land, Rtl, SmartRtl
from aerokit.sim.ardupilot.copter.setpoints import Setpoints
from aerokit.sim.ardupilot.copter.yaw import AutoYaw
from aerokit.sim.ardupilot.smart_path import SmartPath
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from aerokit.sim.ardupilot.arming import Arming
    from aerokit.sim.ardupilot.failsafes import Failsafes
    from aerokit.sim.ardupilot.fence import Fence
    from aerokit.sim.ardupilot.mode import VehicleMode
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.parameter_tables import Kind
    from aerokit.sim.commands import CommandHandler

__all__ = ["SimulatedCopter"]

_LAND_DETECTOR_S = 1.0
_BASE = int(
    MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED
)
_GUIDED, _ARMED = int(MavModeFlag.GUIDED_ENABLED), int(MavModeFlag.SAFETY_ARMED)
_GUIDED_MODES = frozenset((
    "GUIDED", "GUIDED_NOGPS", "LOITER", "POSHOLD", "CIRCLE", "BRAKE", "RTL", "SMARTRTL", "LAND", "AUTO", "FOLLOW",
    "AVOID_ADSB", "ZIGZAG",
))  # fmt: skip


class SimulatedCopter(ArduPilotVehicle):
    """Speaks and behaves as ArduCopter does where a client can see it; flies as `Motion` does.

    Its arguments are those of `ArduPilotVehicle`. It has 1,349 parameters; MNT1_TYPE 1 fits a gimbal with three
    axes.

    Not simulated yet: slowing down before a fence, terrain failsafe.
    """

    KIND: ClassVar[Kind] = "copter"
    FIRMWARE: ClassVar[str] = "ArduCopter"
    FRAME: ClassVar[str | None] = "Frame: QUAD/PLUS"
    MAV_TYPE: ClassVar[int] = MavType.QUADROTOR
    CAPABILITIES: ClassVar[int] = 0xFBEF
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = (
        AutoRtl, Auto, Acro, Stabilize, AltHold, Circle, Loiter, Guided, Land, Rtl, Drift, Flip, Autotune, PosHold,
        Brake, Throw, AvoidAdsb, GuidedNoGps, SmartRtl, FlowHold, Follow, ZigZag, SystemId, Turtle,
    )  # fmt: skip
    ARMING: ClassVar[type[Arming]] = CopterArming
    FAILSAFES: ClassVar[type[Failsafes]] = CopterFailsafes
    FENCE: ClassVar[type[Fence]] = CopterFence

    def make_commands(self) -> dict[int, CommandHandler]:
        """See `copter_commands`."""
        return copter_commands(self)

    def hear_setpoints(self) -> None:
        """See `Setpoints`."""
        Setpoints(self)

    def reset_controllers(self) -> None:
        """Where it points its nose, the land detector, and the way back of SMART_RTL."""
        self.yaw: AutoYaw = AutoYaw(self)
        self._still_since = math.nan
        self.path: SmartPath = SmartPath(self, only_armed=True)
        self.motor_test: MotorTest = MotorTest(self)

    def _become_ready(self) -> None:
        super()._become_ready()
        self.path.start()

    def look_at(self, place: Ned | None) -> None:
        """See `AutoYaw.region_of_interest`."""
        self.yaw.region_of_interest(place)

    @property
    def guided(self) -> Guided:
        """GUIDED."""
        return self.mode_of(Guided)

    @property
    def auto(self) -> Auto:
        """AUTO."""
        return self.mode_of(Auto)

    @property
    def is_armed(self) -> bool:
        """Whether the motors are armed, for a test of them, too."""
        return self.motors.is_armed or self.motor_test.is_running

    @property
    def base_mode(self) -> int:
        """Guided in the modes that know where they are, in RTL when armed only."""
        base, name = _BASE, self.mode.name
        if not self.has_left_boot:
            return base | _GUIDED
        if name in _GUIDED_MODES and (self.motors.is_armed or name != "RTL"):
            base |= _GUIDED
        return base | _ARMED if self.is_armed else base

    def move(self, dt: float) -> None:
        """Motion and land detector."""
        motion = self.motion
        was_on_ground = motion.is_on_ground
        motion.step(dt, powered=self.motors.is_armed and not self.faults.motor_failed)
        is_on_ground = motion.is_on_ground
        if is_on_ground and not was_on_ground:
            self.info(f"SIM Hit ground at {motion.impact_speed_m_s:f} m/s")
        keeps_flying = self.mode.is_taking_off or not self.mode.notices_landing
        if not is_on_ground or (self.motors.is_armed and keeps_flying):
            self._still_since = math.nan
        elif math.isnan(self._still_since):
            self._still_since = self.now
        elif self.now - self._still_since >= _LAND_DETECTOR_S or not self.motors.is_armed:
            self.is_landed: bool = True
            self._still_since = math.nan
            motion.settle()
