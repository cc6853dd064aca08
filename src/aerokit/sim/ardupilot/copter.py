"""`SimulatedCopter`: an ArduCopter 4.7 quadrotor that uses no sockets, threads or system clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavFrame,
    MavModeFlag,
    MavResult,
    MavSeverity,
    MavType,
    MotorTestThrottleType,
    SpeedType,
)
from aerokit.sim.ardupilot import copter_modes as modes
from aerokit.sim.ardupilot.commands import commanded_heading, common_commands
from aerokit.sim.ardupilot.copter_auto import CopterAuto
from aerokit.sim.ardupilot.copter_failsafes import CopterArming, CopterFailsafes, CopterFence
from aerokit.sim.ardupilot.copter_guided import CopterGuided
from aerokit.sim.ardupilot.copter_modes import CopterHost, CopterModeBase
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes
from aerokit.sim.ardupilot.fence import ArduPilotFence
from aerokit.sim.ardupilot.host import ArduPilotMode, ConditionTimer, variant
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.sim.motion import Ned

_MAX_MOTOR_TIME_S = 600.0
# The pause between the tests of two motors, divided by the test time of one motor.
_PAUSE_SHARE = 0.5
_MIN_PWM, _MAX_PWM = 800, 2200


class MotorTest:
    """Motor test on the ground. HEARTBEAT reports an armed vehicle during the test."""

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter
        self.is_running: bool = False
        self._test_number = 0  # number of this test; the timer of an earlier test does nothing

    def command(self, command: ReceivedCommand) -> int:
        if not self.is_running:
            reason = self._reason_not_to_start()
            if reason is not None:
                self._copter.send_text(MavSeverity.CRITICAL, f"Motor Test: {reason}")
                return MavResult.FAILED
            self._copter.info("starting motor test")
        self.is_running = True
        self._test_number += 1
        # `_stop` compares the number, so that the end of this test does not stop a newer test.
        self._copter.call_later(self._duration_s(command), partial(self._stop, self._test_number))
        return MavResult.ACCEPTED

    def _reason_not_to_start(self) -> str | None:
        if not self._copter.is_initialised:
            return "Board initialising"
        return None if self._copter.is_landed else "vehicle not landed"

    def _duration_s(self, command: ReceivedCommand) -> float:
        throttle_type, throttle = command.param2, command.param3
        if throttle_type == MotorTestThrottleType.THROTTLE_PILOT:
            is_valid = True
        elif throttle_type == MotorTestThrottleType.THROTTLE_PWM:
            is_valid = _MIN_PWM <= throttle <= _MAX_PWM
        else:
            # COMPASS_CAL also calibrates the compass, and its throttle is in percent (motor_test.cpp).
            in_percent = (MotorTestThrottleType.THROTTLE_PERCENT, MotorTestThrottleType.COMPASS_CAL)
            is_valid = throttle_type in in_percent and throttle <= 100.0
        if not is_valid:
            return 0.0  # ends the test at once
        seconds_per_motor = max(0.0, min(command.param4, _MAX_MOTOR_TIME_S))
        motor_count = max(1, to_int(command.x))
        return seconds_per_motor * (motor_count + (motor_count - 1) * _PAUSE_SHARE)

    def _stop(self, number: int) -> None:
        if number == self._test_number:
            self.is_running = False
            self._copter.info("finished motor test")
            self._copter.motors.set_armed(armed=False)


class CopterHold(CopterModeBase):
    """Mode that holds the position."""

    def update(self, dt: float) -> None:
        self.vehicle.hold_position()


class CopterThrow(CopterHold):
    """THROW: reports once after arming that the copter waits for the throw. The throw itself is not simulated."""

    _reported_at = -math.inf

    def update(self, dt: float) -> None:
        if self._reported_at < self.vehicle.motors.armed_at:
            self._reported_at = self.vehicle.now
            self.vehicle.info("waiting for throw")
        super().update(dt)


class CopterFollow(CopterHold):
    """FOLLOW: holds the position, as the firmware does without a vehicle to follow. FOLL_ENABLE enables the mode."""

    def enter(self, *, force: bool) -> bool:
        if self.vehicle.parameters["FOLL_ENABLE"]:
            return True
        self.vehicle.send_text(MavSeverity.WARNING, "Set FOLL_ENABLE = 1")
        return False


_LAND_DETECTOR_S = 1.0
_BASE = int(MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED)
_GUIDED = int(MavModeFlag.GUIDED_ENABLED)
_GUIDED_MODES = frozenset((
    "GUIDED", "GUIDED_NOGPS", "LOITER", "POSHOLD", "CIRCLE", "BRAKE", "RTL", "SMARTRTL", "LAND", "AUTO", "FOLLOW",
    "AVOID_ADSB", "ZIGZAG",
))  # fmt: skip

_refusing = partial(
    variant, CopterHold, is_available=False, needs_position=False, can_arm=False, entry_severity=MavSeverity.WARNING
)

# Modes in the order of AVAILABLE_MODES. The firmware for quadrotors has neither SPORT nor AUTOROTATE.
_MODES: tuple[Callable[[Any], ArduPilotMode], ...] = (
    _refusing(
        CopterMode.AUTO_RTL, "AUTO RTL", entry_texts=("Unable to start landing sequence",),
        refused_because="No return path or landing sequence found",
    ),
    CopterAuto,
    variant(modes.CopterStabilize, CopterMode.ACRO, "ACRO"),
    variant(modes.CopterStabilize, CopterMode.STABILIZE, "STABILIZE"),
    variant(modes.CopterPilotedMode, CopterMode.ALT_HOLD, "ALT_HOLD", needs_position=False),
    # CIRCLE moves towards its circle even on the ground, so the firmware does not detect a landing.
    variant(
        modes.CopterLoiter, CopterMode.CIRCLE, "CIRCLE", takes_off=False, can_arm=False, notices_landing=False
    ),
    variant(modes.CopterLoiter, CopterMode.LOITER, "LOITER"),
    CopterGuided,
    variant(modes.CopterLand, CopterMode.LAND, "LAND"),
    variant(modes.CopterRtl, CopterMode.RTL, "RTL"),
    variant(modes.CopterPilotedMode, CopterMode.DRIFT, "DRIFT", takes_off=False),
    _refusing(CopterMode.FLIP, "FLIP"),
    _refusing(CopterMode.AUTOTUNE, "AUTOTUNE"),
    variant(modes.CopterLoiter, CopterMode.POSHOLD, "POSHOLD"),
    variant(CopterHold, CopterMode.BRAKE, "BRAKE", can_arm=False),
    variant(CopterThrow, CopterMode.THROW, "THROW"),
    variant(CopterHold, CopterMode.AVOID_ADSB, "AVOID_ADSB", can_arm=False),
    variant(CopterGuided, CopterMode.GUIDED_NOGPS, "GUIDED_NOGPS", needs_position=False),
    variant(modes.CopterSmartRtl, CopterMode.SMART_RTL, "SMARTRTL"),
    _refusing(CopterMode.FLOWHOLD, "FLOWHOLD"),
    variant(CopterFollow, CopterMode.FOLLOW, "FOLLOW", can_arm=False),
    variant(modes.CopterLoiter, CopterMode.ZIGZAG, "ZIGZAG"),
    _refusing(CopterMode.SYSTEMID, "SYSTEMID", entry_texts=("No axis selected, SID_AXIS = 0",)),
    _refusing(CopterMode.TURTLE, "TURTLE"),
)  # fmt: skip


class SimulatedCopter(CopterHost):
    """ArduCopter, as far as a client can observe it. `Motion` is the motion model.

    Takes the arguments of `ArduPilotVehicle`. The copter has 1,349 parameters. MNT1_TYPE = 1 adds a 3-axis gimbal.

    Not simulated: braking before a fence, the terrain failsafe.
    """

    guided: CopterGuided  # pyright: ignore[reportIncompatibleVariableOverride]

    KIND: ClassVar[Kind] = "copter"
    FIRMWARE: ClassVar[str] = "ArduCopter"
    FRAME: ClassVar[str | None] = "Frame: QUAD/PLUS"
    MAV_TYPE: ClassVar[int] = MavType.QUADROTOR
    BASE_FLAGS: ClassVar[int] = _BASE
    GUIDED_MODES: ClassVar[frozenset[str]] = _GUIDED_MODES
    CAPABILITIES: ClassVar[int] = 0xFBEF
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["copter"]
    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]] = _MODES
    ARMING: ClassVar[type[ArduPilotArming[Any]]] = CopterArming
    FAILSAFES: ClassVar[type[ArduPilotFailsafes[Any]]] = CopterFailsafes
    FENCE: ClassVar[type[ArduPilotFence[Any]]] = CopterFence

    def make_commands(self) -> dict[int, CommandHandler]:
        """Return the handlers of the commands that ArduCopter knows."""
        return {
            **common_commands(self),
            MavCmd.NAV_TAKEOFF: self._take_off,
            MavCmd.NAV_VTOL_TAKEOFF: self._take_off,
            MavCmd.NAV_LAND: lambda _: self.change_to(CopterMode.LAND),
            MavCmd.NAV_VTOL_LAND: lambda _: self.change_to(CopterMode.LAND),
            MavCmd.NAV_RETURN_TO_LAUNCH: lambda _: self.change_to(CopterMode.RTL),
            MavCmd.NAV_LOITER_UNLIM: lambda _: self.change_to(CopterMode.LOITER),
            MavCmd.DO_CHANGE_SPEED: self._change_speed,
            MavCmd.CONDITION_YAW: self._turn,
            MavCmd.DO_PAUSE_CONTINUE: self._pause_or_continue,
            MavCmd.DO_MOTOR_TEST: lambda command: self.motor_test.command(command),
        }

    def reset_controllers(self) -> None:
        super().reset_controllers()
        self._on_ground_timer = ConditionTimer()
        self.motor_test: MotorTest = MotorTest(self)

    def refusal_text(self, mode: ArduPilotMode, reason: str) -> str:
        return f"Mode change to {mode.name} failed: {reason}"

    @property
    def is_armed(self) -> bool:
        """True while the motors are armed or tested."""
        return self.motors.is_armed or self.motor_test.is_running

    @property
    def base_mode(self) -> int:
        if not self.has_left_boot:  # During the boot, GUIDED_ENABLED is set in every mode.
            return self.BASE_FLAGS | _GUIDED
        is_disarmed_return = self.mode.name == "RTL" and not self.motors.is_armed
        return super().base_mode & ~_GUIDED if is_disarmed_return else super().base_mode

    def move(self, dt: float) -> None:
        """Move for ``dt`` seconds, and detect the landing."""
        super().move(dt)
        keeps_flying = self.motors.is_armed and (self.mode.is_taking_off or not self.mode.notices_landing)
        on_ground_for = self._on_ground_timer.seconds(self.motion.is_on_ground and not keeps_flying, self.now)
        # An armed copter counts as landed `_LAND_DETECTOR_S` after the touchdown, a disarmed copter at once.
        if on_ground_for >= _LAND_DETECTOR_S or (on_ground_for > 0.0 and not self.motors.is_armed):
            self.is_landed: bool = True
            self._on_ground_timer.reset()
            self.motion.settle()

    def _take_off(self, command: ReceivedCommand) -> int:
        if command.altitude_frame != MavFrame.GLOBAL_RELATIVE_ALT:
            return MavResult.DENIED
        is_upwards = command.z > self.navigation.altitude_above_home
        if not (self.motors.is_armed and self.is_landed and is_upwards):
            return MavResult.FAILED
        must_navigate = command.param3 == 0.0  # Param 3 is 1 if the pilot may control the horizontal position.
        is_accepted = self.mode.take_off(command.z, must_navigate=must_navigate)
        return MavResult.ACCEPTED if is_accepted else MavResult.FAILED

    def accept_reposition(self, place: Ned) -> bool:
        if not self.fence.contains(place):
            return False
        self.yaw.apply_default()  # A new target position ends a commanded heading.
        return True

    def _change_speed(self, command: ReceivedCommand) -> int:
        mode = self.mode
        speed = command.param2
        if not speed > 0:  # also refuses NaN
            return MavResult.DENIED
        if not mode.can_change_speed:
            return MavResult.FAILED
        if command.param1 in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED):
            mode.speed = speed
            return MavResult.ACCEPTED
        is_vertical = command.param1 in (SpeedType.CLIMB_SPEED, SpeedType.DESCENT_SPEED)
        if not isinstance(mode, CopterGuided | CopterAuto) or not is_vertical:
            return MavResult.FAILED
        if command.param1 == SpeedType.CLIMB_SPEED:
            mode.climb = speed
        else:
            mode.descent = speed
        return MavResult.ACCEPTED

    def _turn(self, command: ReceivedCommand) -> int:
        heading = commanded_heading(command, self.motion.yaw)
        if heading is None:
            return MavResult.FAILED
        direction = to_int(command.param3)
        # In a relative turn, the direction 0 means clockwise, even beyond 180 degrees (autoyaw.cpp).
        if command.param4 == 1.0:
            direction = direction or 1
        self.yaw.turn_to(heading, math.radians(command.param2), direction)
        return MavResult.ACCEPTED

    def _pause_or_continue(self, command: ReceivedCommand) -> int:
        if command.param1 not in (0.0, 1.0):
            return MavResult.DENIED
        is_pause = command.param1 == 0.0
        is_done = self.mode.pause() if is_pause else self.mode.resume()
        if not is_done:
            self.info("Failed to pause" if is_pause else "Failed to resume")
        return MavResult.ACCEPTED if is_done else MavResult.FAILED
