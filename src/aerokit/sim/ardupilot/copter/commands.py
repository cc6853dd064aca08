"""The commands (MAV_CMD) that a simulated ArduCopter knows, with the real one's conditions and results."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavDoRepositionFlags,
    MavFrame,
    MavResult,
    SpeedType,
)
from aerokit.sim.ardupilot.copter.auto import Auto
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.vehicle_commands import common_commands
from aerokit.sim.commands import Command, CommandHandler, whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter.vehicle import SimulatedCopter

__all__ = ["copter_commands"]


def copter_commands(copter: SimulatedCopter) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
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
