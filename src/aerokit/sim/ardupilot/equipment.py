"""Commands to what an ArduPilot drives besides its motors: outputs, relays, battery, grippers.

Outputs move nothing here: what is simulated is the answer of a vehicle on the ground that has no such equipment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavResult

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["equipment_commands"]

_ANSWERS: dict[int, tuple[int, ...]] = {
    MavResult.ACCEPTED: (
        MavCmd.DO_SET_SERVO, MavCmd.DO_REPEAT_SERVO, MavCmd.DO_SET_RELAY, MavCmd.DO_REPEAT_RELAY,
        MavCmd.SET_EKF_SOURCE_SET, MavCmd.EXTERNAL_WIND_ESTIMATE, MavCmd.START_RX_PAIR,
        MavCmd.DO_SET_SAFETY_SWITCH_STATE,
    ),
    MavResult.FAILED: (MavCmd.DO_GRIPPER, MavCmd.STORAGE_FORMAT, MavCmd.DO_SPRAYER, MavCmd.DO_AUX_FUNCTION,
                       MavCmd.DO_MOTOR_TEST),
    MavResult.DENIED: (MavCmd.PREFLIGHT_STORAGE, MavCmd.DEBUG_TRAP, MavCmd.SCRIPTING),
}  # fmt: skip
"""MAV_RESULT → MAV_CMDs that each kind answers so."""
_ANSWERS_OF_KIND: dict[str, dict[int, tuple[int, ...]]] = {
    "copter": {
        MavResult.ACCEPTED: (
            MavCmd.DO_MOTOR_TEST, MavCmd.DO_PARACHUTE, MavCmd.DO_SPRAYER, MavCmd.DO_AUX_FUNCTION,
        ),
        MavResult.FAILED: (MavCmd.DO_WINCH, MavCmd.DO_LAND_START),
        MavResult.DENIED: (MavCmd.DO_FOLLOW,),
    },
    "plane": {
        MavResult.ACCEPTED: (MavCmd.DO_PARACHUTE, MavCmd.DO_AUTOTUNE_ENABLE, MavCmd.SET_HAGL),
        MavResult.FAILED: (MavCmd.DO_LAND_START, MavCmd.DO_GO_AROUND, MavCmd.DO_VTOL_TRANSITION),
        MavResult.DENIED: (MavCmd.DO_FOLLOW,),
    },
    "rover": {
        MavResult.ACCEPTED: (MavCmd.DO_SET_REVERSE, MavCmd.DO_SPRAYER, MavCmd.DO_AUX_FUNCTION),
        MavResult.DENIED: (MavCmd.DO_FOLLOW,),
    },
    "sub": {},
}  # fmt: skip
"""What one kind answers otherwise, or alone knows."""
_FIRST_BATTERY = 1


def equipment_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    tables = (_ANSWERS, _ANSWERS_OF_KIND[vehicle.KIND])
    handlers = {command: _always(result) for table in tables for result in table for command in table[result]}
    return {**handlers, MavCmd.BATTERY_RESET: lambda command: _reset_battery(vehicle, command)}


def _always(result: int) -> CommandHandler:
    return lambda _: result


def _reset_battery(vehicle: ArduPilotVehicle, command: Command) -> int:
    """Param 1 is a mask of batteries, of which the first is there; param 2 what is left, in percent."""
    if not int(command.param1) & _FIRST_BATTERY:
        return MavResult.FAILED
    vehicle.battery.percent = max(0.0, min(100.0, command.param2))
    return MavResult.ACCEPTED
