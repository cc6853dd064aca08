"""What simulated rovers and submarines have in common: no take-off, no landing, targets and missions on the level."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags, MavResult, SpeedType
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.ardupilot.vehicle_commands import common_commands
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.mode import VehicleMode
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["LevelVehicle"]

_STICK_MIDDLE = 1500


class LevelVehicle(ArduPilotVehicle):
    """Its arguments are those of `ArduPilotVehicle`."""

    # ----------------------------------------------------------------------------- what a kind says

    def own_commands(self) -> dict[int, CommandHandler]:
        """Commands beside those of every ArduPilot."""
        return {}

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing moves while it is disarmed."""
        raise NotImplementedError

    # -------------------------------------------------------------------------------------- vehicle

    def reset_controllers(self) -> None:
        """The throttle stick rests in the middle."""
        self.rc[2] = _STICK_MIDDLE

    def tick(self, dt: float) -> None:
        """Mode, motors, motion, battery."""
        if self.motors.is_armed:
            self.mode.update(dt)
        self.motors.update(self.now, dt, self.motion, landed=False)
        self.move(dt)
        self.battery.drain(self.motors.current_a, dt)
        if not self.motors.is_armed and self.is_at_rest:
            self.set_ticking(False)

    def move(self, dt: float) -> None:
        """Motion."""
        self.motion.step(dt, powered=self.motors.is_armed and not self.faults.motor_failed)

    # ------------------------------------------------------------------------------------- commands

    def make_commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler."""
        return {
            **common_commands(self),
            MavCmd.MISSION_START: self._start_mission,
            MavCmd.DO_REPOSITION: self._reposition,
            MavCmd.DO_CHANGE_SPEED: self._change_speed,
            **self.own_commands(),
        }

    def _start_mission(self, command: Command) -> int:
        if command.param1 or command.param2:
            return MavResult.DENIED
        result = self.change_to(cast("VehicleMode", self.auto).number)
        if result == MavResult.ACCEPTED and not self.mission.is_running:
            self.mission.start_or_resume()
        return result

    def _reposition(self, command: Command) -> int:
        """Only as COMMAND_INT: ArduPilot knows no frame for it in COMMAND_LONG."""
        if command.is_long:
            return MavResult.UNSUPPORTED
        guided = self.guided
        if self.mode is not guided and not whole(command.param2) & MavDoRepositionFlags.CHANGE_MODE:
            return MavResult.DENIED
        point = self.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        if not self.set_mode(guided.number):
            return MavResult.FAILED
        self.guided.go_to(point)
        return MavResult.ACCEPTED

    def _change_speed(self, command: Command) -> int:
        if command.param1 in (SpeedType.CLIMB_SPEED, SpeedType.DESCENT_SPEED):
            return MavResult.DENIED
        kinds = (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED)
        if not self.mode.can_change_speed or command.param1 not in kinds or not command.param2 > 0:
            return MavResult.FAILED
        cast("Any", self.mode).speed = command.param2
        return MavResult.ACCEPTED
