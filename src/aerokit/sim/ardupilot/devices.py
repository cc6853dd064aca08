"""Servos, relays, gripper, landing gear, parachute and winch of a simulated ArduPilot."""

from __future__ import annotations

from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GripperActions, MavCmd, MavSeverity, ParachuteAction, WinchActions
from aerokit.mavlink.enums import MavResult as Result
from aerokit.sim.ardupilot.failsafes import ArduPilotArming
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.commands import ReceivedCommand, constrained, to_int

_GRIP_DURATION_S = 0.7
_WINCH_RATE_M_S, _WINCH_INTERVAL_S = 1.0, 0.1
_MIN_CHUTE_ALTITUDE_M = 10.0
_SERVOS = 32
_RELAYS = {"rover": 2}
_FUNCTIONS = 320
_SAVE_WAYPOINT = 7
# Numbers of the auxiliary functions that each firmware refused in SITL.
_REFUSED_FUNCTIONS: dict[Kind, tuple[int, ...]] = {
    "copter": (0,),
    "plane": (0, _SAVE_WAYPOINT),
    "rover": (),
    "sub": (0, _SAVE_WAYPOINT),
}
# Values of SERVOn_FUNCTION for a free output: 0 (no function), and those that pass an RC channel through.
_FREE_FUNCTIONS = frozenset({0, 1, *range(51, 67)})
_AUX_POSITIONS = (0.0, 1.0, 2.0)


class ArduPilotDevices:
    """State of the attached devices, which a reboot resets. Parameters select which ones the vehicle has.

    DO_SET_SERVO and DO_SET_RELAY set servos and relays. DO_AUX_FUNCTION is answered, but has no effect.
    """

    def __init__(self, vehicle: ArduPilotHost, arming: ArduPilotArming[Any]) -> None:
        self._vehicle, self._arming = vehicle, arming
        self.servos: dict[int, int] = {}  # Pulses in microseconds by output number, which counts from 1.
        self.relays: int = 0  # Bit mask of the relays that are on.
        self.is_gripped: bool = False
        self.gear_is_up: bool = False
        self.chute_is_released: bool = False
        self.line_m: float = 0.0  # Length of the winch's line.
        self.line_rate_m_s: float = 0.0  # Above 0 while the winch lets out line.
        self._goal_m: float | None = None  # Length at which the winch stops; None if it stops only on command.
        self._is_step_scheduled = False  # True while `_move_line` is scheduled

    def _is_set(self, name: str) -> bool:
        return bool(self._vehicle.parameters.get(name, 0))

    def grip(self, command: ReceivedCommand) -> int:
        is_known = command.param2 in (GripperActions.GRAB, GripperActions.RELEASE)
        if not self._is_set("GRIP_ENABLE") or not is_known:
            return Result.FAILED
        is_grab = command.param2 == GripperActions.GRAB
        has_to_move = is_grab is not self.is_gripped
        if has_to_move:
            self._vehicle.info(f"Gripper load {'grabbing' if is_grab else 'releasing'}")

        def finish() -> None:
            self._vehicle.info(f"Gripper load {'grabbed' if is_grab else 'released'}")

        # The command is acknowledged at once. A text reports the end of the movement (AP_Gripper_Servo.cpp).
        self._vehicle.call_later(_GRIP_DURATION_S if has_to_move else 0.0, finish)
        self.is_gripped = is_grab
        return Result.ACCEPTED

    def move_gear(self, command: ReceivedCommand) -> int:
        # As in the firmware, the command is accepted even without a landing gear.
        is_retraction = command.param2 == 1
        if self._is_set("LGR_ENABLE") and is_retraction is not self.gear_is_up:
            self.gear_is_up = is_retraction
            self._vehicle.info(f"LandingGear: {'RETRACT' if is_retraction else 'DEPLOY'}")
        return Result.ACCEPTED

    def handle_chute(self, command: ReceivedCommand) -> int:
        vehicle = self._vehicle
        # Like the firmware, accept even a release that has no effect.
        if command.param1 in (ParachuteAction.DISABLE, ParachuteAction.ENABLE):
            if "CHUTE_ENABLED" in vehicle.parameters:
                vehicle.parameters["CHUTE_ENABLED"] = command.param1
        elif command.param1 != ParachuteAction.RELEASE:
            return Result.FAILED
        elif self._is_set("CHUTE_ENABLED"):
            if vehicle.is_landed:
                vehicle.info("Parachute: Landed")
            elif vehicle.altitude_m < _MIN_CHUTE_ALTITUDE_M:
                vehicle.send_text(MavSeverity.ALERT, "Parachute: Too low")
            else:
                self.chute_is_released = True
                vehicle.info("Parachute: Released")
                self._arming.disarm()
        return Result.ACCEPTED

    def move_winch(self, command: ReceivedCommand) -> int:
        action, length_m, rate_m_s = to_int(command.param2), command.param3, command.param4
        if not self._is_set("WINCH_TYPE") or action > WinchActions.RATE_CONTROL:
            return Result.FAILED
        self._goal_m = None
        self.line_rate_m_s = 0.0  # The action RELAXED only stops the winch.
        if action == WinchActions.RATE_CONTROL:
            self.line_rate_m_s = constrained(rate_m_s, -_WINCH_RATE_M_S, _WINCH_RATE_M_S)
        elif action == WinchActions.RELATIVE_LENGTH_CONTROL:
            direction = (length_m > 0) - (length_m < 0)  # 1, 0 or -1; 0 for NaN
            self._goal_m = self.line_m + length_m
            self.line_rate_m_s = _WINCH_RATE_M_S * direction
        self._schedule_step()
        return Result.ACCEPTED

    def _schedule_step(self) -> None:
        if self.line_rate_m_s and not self._is_step_scheduled:
            self._is_step_scheduled = True
            self._vehicle.call_later(_WINCH_INTERVAL_S, self._move_line)

    def _move_line(self) -> None:
        self._is_step_scheduled = False
        self.line_m += self.line_rate_m_s * _WINCH_INTERVAL_S
        # Once the line has passed the goal, the remaining length and the rate have opposite signs.
        if self._goal_m is not None and (self._goal_m - self.line_m) * self.line_rate_m_s <= 0:
            self.line_m, self.line_rate_m_s = self._goal_m, 0.0
        self._schedule_step()

    def winch_status(self) -> m.WinchStatus | None:
        if not self._is_set("WINCH_TYPE"):
            return None
        unknown, unknown_temperature, healthy = float("nan"), 0x7FFF, 1
        electrical = (unknown, unknown, unknown, unknown_temperature)  # tension, voltage, current, temperature
        return m.WinchStatus(self._vehicle.time_boot_us, self.line_m, self.line_rate_m_s, *electrical, healthy)

    @property
    def relay_count(self) -> int:
        return _RELAYS.get(self._vehicle.KIND, 1)

    def set_servo(self, command: ReceivedCommand) -> int:
        output = to_int(command.param1)
        if not 1 <= output <= _SERVOS:
            return Result.FAILED
        if self._vehicle.parameters.get(f"SERVO{output}_FUNCTION", 0) not in _FREE_FUNCTIONS:
            self._vehicle.info(f"ServoRelayEvent: Channel {output} is already in use")
            return Result.FAILED
        self.servos[output] = to_int(command.param2)
        return Result.ACCEPTED

    def set_relay(self, command: ReceivedCommand) -> int:
        if not 0 <= command.param1 < self.relay_count:
            return Result.FAILED
        if command.command == MavCmd.DO_SET_RELAY:  # After DO_REPEAT_RELAY, the relay has its previous state again.
            bit = 1 << to_int(command.param1)
            self.relays = self.relays | bit if command.param2 else self.relays & ~bit
        return Result.ACCEPTED

    def switch(self, command: ReceivedCommand) -> int:
        function = to_int(command.param1)
        if command.param2 not in _AUX_POSITIONS:
            return Result.DENIED
        if not 0 <= function < _FUNCTIONS or function in _REFUSED_FUNCTIONS[self._vehicle.KIND]:
            self._vehicle.info(f"Invalid channel option ({function})")
            return Result.FAILED
        return Result.ACCEPTED
