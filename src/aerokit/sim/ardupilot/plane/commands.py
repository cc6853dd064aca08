"""The commands (MAV_CMD) that a simulated ArduPlane knows besides those of every ArduPilot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags, MavResult, PlaneMode, SpeedType
from aerokit.sim.ardupilot.plane.guided import guided_commands
from aerokit.sim.ardupilot.plane.modes import NavigatingMode
from aerokit.sim.ardupilot.vehicle_commands import common_commands
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["plane_commands"]


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
