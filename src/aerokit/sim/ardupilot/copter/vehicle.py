"""`SimulatedCopter`: an ArduCopter 4.7 quadrotor without sockets, threads or a clock of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavDoRepositionFlags,
    MavFrame,
    MavModeFlag,
    MavResult,
    MavSeverity,
    MavType,
    MotorTestThrottleType,
    SpeedType,
)
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.commands import common_commands
from aerokit.sim.ardupilot.copter.auto import Auto
from aerokit.sim.ardupilot.copter.failsafes import CopterArming, CopterFailsafes, CopterFence
from aerokit.sim.ardupilot.copter.guided import Guided, Setpoints
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import AltHold, Follow, Holding, Loiter, Refusing, Stabilize, Throw
from aerokit.sim.ardupilot.copter.returning import Land, Rtl, SmartRtl
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.mode import VehicleMode, variant
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import Command, CommandHandler, whole

_MAX_S = 600.0
_PAUSE_SHARE = 0.5
"""Between two motors, of the time for each."""
_MIN_PWM, _MAX_PWM = 800, 2200


class MotorTest:
    """Only on the ground; HEARTBEAT says "armed" while a motor turns, and afterwards the vehicle is disarmed."""

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter
        self.is_running: bool = False
        self._number = 0

    def command(self, command: Command) -> int:
        """Begin, or go on with other motors; how it ends is told by a text."""
        if not self.is_running and (reason := self._refusal()):
            self._copter.send_text(MavSeverity.CRITICAL, f"Motor Test: {reason}")
            return MavResult.FAILED
        if not self.is_running:
            self._copter.info("starting motor test")
        self.is_running = True
        self._number += 1
        self._copter.call_later(self._duration_s(command), lambda number=self._number: self._stop(number))  # type: ignore[misc]
        return MavResult.ACCEPTED

    def _refusal(self) -> str:
        if not self._copter.is_initialised:
            return "Board initialising"
        return "" if self._copter.is_landed else "vehicle not landed"

    def _duration_s(self, command: Command) -> float:
        """A throttle that is none ends it at once."""
        kind, throttle = command.param2, command.param3
        is_valid = kind == MotorTestThrottleType.THROTTLE_PILOT or (
            throttle <= 100.0
            if kind in (MotorTestThrottleType.THROTTLE_PERCENT, MotorTestThrottleType.COMPASS_CAL)
            else kind == MotorTestThrottleType.THROTTLE_PWM and _MIN_PWM <= throttle <= _MAX_PWM
        )
        each, motors = max(0.0, min(command.param4, _MAX_S)), max(1, whole(command.x))
        return each * (motors + (motors - 1) * _PAUSE_SHARE) if is_valid else 0.0

    def _stop(self, number: int) -> None:
        if number == self._number:
            self.is_running = False
            self._copter.info("finished motor test")
            self._copter.motors.set_armed(False, self._copter.now)


def copter_commands(copter: SimulatedCopter) -> dict[int, CommandHandler]:
    flight = _Flight(copter)
    return {
        **common_commands(copter),
        MavCmd.NAV_TAKEOFF: flight.take_off,
        MavCmd.NAV_VTOL_TAKEOFF: flight.take_off,
        MavCmd.NAV_LAND: lambda _: copter.change_to(CopterMode.LAND),
        MavCmd.NAV_VTOL_LAND: lambda _: copter.change_to(CopterMode.LAND),
        MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: copter.change_to(CopterMode.RTL),
        MavCmd.NAV_LOITER_UNLIM: lambda _: copter.change_to(CopterMode.LOITER),
        MavCmd.MISSION_START: flight.start_mission,
        MavCmd.DO_REPOSITION: flight.reposition,
        MavCmd.DO_CHANGE_SPEED: flight.change_speed,
        MavCmd.CONDITION_YAW: flight.turn,
        MavCmd.DO_PAUSE_CONTINUE: flight.pause_or_continue,
        MavCmd.DO_MOTOR_TEST: lambda command: copter.motor_test.command(command),
    }


class _Flight:
    """Commands that move the vehicle."""

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter

    def take_off(self, command: Command) -> int:
        copter = self._copter
        if command.altitude_frame != MavFrame.GLOBAL_RELATIVE_ALT:
            return MavResult.DENIED
        upwards = command.z > copter.navigation.altitude_above_home
        if not (copter.motors.is_armed and copter.is_landed and upwards):
            return MavResult.FAILED
        done = copter.mode.take_off(command.z, must_navigate=command.param3 == 0.0)
        return MavResult.ACCEPTED if done else MavResult.FAILED

    def start_mission(self, command: Command) -> int:
        """From the present place in the mission; on the ground this is what lets a take-off begin."""
        if command.param1 or command.param2:
            return MavResult.DENIED
        result = self._copter.change_to(CopterMode.AUTO)
        if result == MavResult.ACCEPTED:
            self._copter.auto.may_lift_off = self._copter.is_armed
            if not self._copter.mission.is_running:
                self._copter.mission.start_or_resume()
        return result

    def reposition(self, command: Command) -> int:
        """Only as COMMAND_INT: ArduPilot knows no frame for it in COMMAND_LONG."""
        copter = self._copter
        if command.is_long:
            return MavResult.UNSUPPORTED
        may_change_mode = whole(command.param2) & MavDoRepositionFlags.CHANGE_MODE
        if copter.mode is not copter.guided and not may_change_mode:
            return MavResult.DENIED
        point = copter.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        if copter.mode is not copter.guided and not copter.set_mode(CopterMode.GUIDED):
            return MavResult.FAILED
        if not copter.fence.contains(point):
            return MavResult.FAILED
        copter.guided.go_to(point)
        copter.yaw.default()
        return MavResult.ACCEPTED

    def change_speed(self, command: Command) -> int:
        mode, speed = self._copter.mode, command.param2
        if not speed > 0:
            return MavResult.DENIED
        if not mode.can_change_speed:
            return MavResult.FAILED
        if command.param1 in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED):
            mode.speed = speed  # type: ignore[attr-defined]
            return MavResult.ACCEPTED
        if not isinstance(mode, Guided | Auto):
            return MavResult.FAILED
        if command.param1 == SpeedType.CLIMB_SPEED:
            mode.climb = speed
        elif command.param1 == SpeedType.DESCENT_SPEED:
            mode.descent = speed
        else:
            return MavResult.FAILED
        return MavResult.ACCEPTED

    def turn(self, command: Command) -> int:
        angle, rate, direction, relative = command.param1, command.param2, command.param3, command.param4
        if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
            return MavResult.FAILED
        heading = math.radians(angle)
        if relative:
            heading = self._copter.motion.yaw + math.copysign(heading, direction or 1.0)
        self._copter.yaw.fixed(heading, math.radians(rate), int(direction) if not relative else 0)
        return MavResult.ACCEPTED

    def pause_or_continue(self, command: Command) -> int:
        copter = self._copter
        if command.param1 not in (0.0, 1.0):
            return MavResult.DENIED
        pause = command.param1 == 0.0
        if copter.mode.pause() if pause else copter.mode.resume():
            return MavResult.ACCEPTED
        copter.info("Failed to pause" if pause else "Failed to resume")
        return MavResult.FAILED


_LAND_DETECTOR_S = 1.0
_BASE = int(
    MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED
)
_GUIDED, _ARMED = int(MavModeFlag.GUIDED_ENABLED), int(MavModeFlag.SAFETY_ARMED)
_GUIDED_MODES = frozenset((
    "GUIDED", "GUIDED_NOGPS", "LOITER", "POSHOLD", "CIRCLE", "BRAKE", "RTL", "SMARTRTL", "LAND", "AUTO", "FOLLOW",
    "AVOID_ADSB", "ZIGZAG",
))  # fmt: skip


_MODES: tuple[Callable[[Any], VehicleMode], ...] = (
    variant(
        Refusing, CopterMode.AUTO_RTL, "AUTO RTL", text="Unable to start landing sequence",
        refused_because="No return path or landing sequence found",
    ),
    Auto,
    variant(Stabilize, CopterMode.ACRO, "ACRO"),
    Stabilize,
    AltHold,
    # it pulls at its circle on the ground, and notices no landing
    variant(Loiter, CopterMode.CIRCLE, "CIRCLE", takes_off=False, can_arm=False, notices_landing=False),
    Loiter,
    Guided,
    Land,
    Rtl,
    variant(AltHold, CopterMode.DRIFT, "DRIFT", takes_off=False, needs_position=True),
    variant(Refusing, CopterMode.FLIP, "FLIP"),
    variant(Refusing, CopterMode.AUTOTUNE, "AUTOTUNE"),
    variant(Loiter, CopterMode.POSHOLD, "POSHOLD"),
    variant(Holding, CopterMode.BRAKE, "BRAKE", can_arm=False),
    Throw,
    variant(Holding, CopterMode.AVOID_ADSB, "AVOID_ADSB", can_arm=False),
    variant(Guided, CopterMode.GUIDED_NOGPS, "GUIDED_NOGPS", needs_position=False),
    SmartRtl,
    variant(Refusing, CopterMode.FLOWHOLD, "FLOWHOLD"),
    Follow,
    variant(Loiter, CopterMode.ZIGZAG, "ZIGZAG"),
    variant(Refusing, CopterMode.SYSTEMID, "SYSTEMID", text="No axis selected, SID_AXIS = 0"),
    variant(Refusing, CopterMode.TURTLE, "TURTLE"),
)  # fmt: skip
"""In the order in which they are listed; the rarer ones hold, fly by the sticks, or refuse."""


class SimulatedCopter(CopterHost):
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
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["copter"]
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = _MODES
    FAILSAFES: ClassVar[type[Failsafes]] = CopterFailsafes
    FENCE: ClassVar[type[Fence]] = CopterFence

    def make_arming(self) -> Arming:
        return CopterArming(self)

    def make_commands(self) -> dict[int, CommandHandler]:
        return copter_commands(self)

    def hear_setpoints(self) -> None:
        Setpoints(self)

    def reset_controllers(self) -> None:
        """The land detector and motor tests, too."""
        super().reset_controllers()
        self._still_since = math.nan
        self.motor_test: MotorTest = MotorTest(self)

    @property
    def guided(self) -> Guided:
        return self.mode_of(Guided)

    @property
    def auto(self) -> Auto:
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
