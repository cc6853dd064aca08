"""Commands to what an ArduPilot drives besides its motors, most of which is not there.

The results are those of a vehicle as the simulation starts it: no gripper, no winch, no lifting rotors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity
from aerokit.sim.ardupilot.accessories import Accessories
from aerokit.sim.commands import whole

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.parameter_tables import Kind
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["equipment_commands"]

_C, _R = MavCmd, MavResult
_ALL: tuple[Kind, ...] = ("copter", "plane", "rover", "sub")
_NOTICE, _WARNING, _INFO = MavSeverity.NOTICE, MavSeverity.WARNING, MavSeverity.INFO
_SOURCE_SETS = (1.0, 2.0, 3.0)

_ANSWERS: tuple[tuple[int, int, tuple[Kind, ...]], ...] = (
    (_C.DO_RETURN_PATH_START, _R.FAILED, ("copter", "plane")),
    (_C.DO_LAND_START, _R.FAILED, ("copter", "plane")),
    (_C.DO_GO_AROUND, _R.FAILED, ("plane",)),
    (_C.DO_SET_REVERSE, _R.ACCEPTED, ("rover",)),
    (_C.DO_PARACHUTE, _R.ACCEPTED, ("copter", "plane")),
    (_C.DO_MOTOR_TEST, _R.ACCEPTED, ("rover",)),
    (_C.DO_MOTOR_TEST, _R.FAILED, ("plane", "sub")),
    (_C.DO_GRIPPER, _R.FAILED, _ALL),
    (_C.DO_SPRAYER, _R.ACCEPTED, ("copter", "rover")),
    (_C.DO_SPRAYER, _R.FAILED, ("plane", "sub")),
    (_C.DO_ENGINE_CONTROL, _R.FAILED, ("plane",)),
    (_C.PREFLIGHT_STORAGE, _R.DENIED, _ALL),
    (_C.START_RX_PAIR, _R.ACCEPTED, _ALL),
    (_C.DO_SET_SAFETY_SWITCH_STATE, _R.ACCEPTED, _ALL),
    (_C.DO_JUMP_TAG, _R.FAILED, _ALL),
    (_C.AIRFRAME_CONFIGURATION, _R.ACCEPTED, ("copter", "plane")),
    (_C.DO_VTOL_TRANSITION, _R.FAILED, ("plane",)),
    (_C.DO_ADSB_OUT_IDENT, _R.FAILED, _ALL),
    (_C.SOLO_BTN_FLY_CLICK, _R.ACCEPTED, ("copter",)),
    (_C.SOLO_BTN_FLY_HOLD, _R.ACCEPTED, ("copter",)),
    (_C.SOLO_BTN_PAUSE_CLICK, _R.ACCEPTED, ("copter",)),
    (_C.FIXED_MAG_CAL_YAW, _R.ACCEPTED, _ALL),
    (_C.DO_WINCH, _R.FAILED, ("copter",)),
    (_C.DEBUG_TRAP, _R.DENIED, _ALL),
    (_C.EXTERNAL_WIND_ESTIMATE, _R.ACCEPTED, _ALL),
    (_C.SET_HAGL, _R.ACCEPTED, ("plane",)),
)
"""Command, result, and by whom."""

_TEXTS: dict[tuple[int, Kind], tuple[tuple[int, str], ...]] = {
    (_C.DO_LAND_START, "plane"): ((_WARNING, "Unable to start landing sequence"),),
    (_C.DO_LAND_START, "copter"): (
        (_WARNING, "Unable to start landing sequence"),
        (_WARNING, "Mode change to AUTO RTL failed: No landing sequence found"),
    ),
    (_C.DO_RETURN_PATH_START, "copter"): (
        (_WARNING, "Mode change to AUTO RTL failed: No return path found"),
    ),
    (_C.DO_VTOL_TRANSITION, "plane"): ((_NOTICE, "VTOL not available"),),
}
"""What is said besides."""


def equipment_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler; whoever simulates a command really replaces it."""
    kind, gear = vehicle.KIND, _Equipment(vehicle)
    handlers: dict[int, CommandHandler] = {
        command: gear.answers(result, _TEXTS.get((command, kind), ()))
        for command, result, kinds in _ANSWERS
        if kind in kinds
    }
    if kind != "sub":
        handlers[_C.DO_FOLLOW] = lambda c: _R.ACCEPTED if 0 < c.param1 <= 255 else _R.DENIED
    handlers |= {
        _C.DO_SET_SERVO: gear.accessory(Accessories.set_servo),
        _C.DO_REPEAT_SERVO: gear.accessory(Accessories.set_servo),
        _C.DO_SET_RELAY: gear.accessory(Accessories.set_relay),
        _C.DO_REPEAT_RELAY: gear.accessory(Accessories.repeat_relay),
        _C.DO_AUX_FUNCTION: gear.accessory(Accessories.switch),
        _C.BATTERY_RESET: gear.reset_battery,
        _C.CONTROL_HIGH_LATENCY: gear.high_latency,
        _C.SET_EKF_SOURCE_SET: lambda c: _R.ACCEPTED if c.param1 in _SOURCE_SETS else _R.DENIED,
        _C.CAN_FORWARD: lambda c: _R.FAILED if c.param1 else _R.ACCEPTED,
        _C.STORAGE_FORMAT: lambda c: _R.FAILED if c.param1 == c.param2 == 1.0 else _R.UNSUPPORTED,
        _C.SCRIPTING: lambda c: _R.DENIED if 0 <= c.param1 <= 3 else _R.UNSUPPORTED,
        _C.EXTERNAL_POSITION_ESTIMATE: lambda c: _R.UNSUPPORTED if c.is_long else _R.DENIED,
    }
    if kind == "plane":
        handlers[_C.DO_AUTOTUNE_ENABLE] = gear.tune
    return handlers


class _Equipment:
    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self._tunes = False

    def answers(self, result: int, texts: tuple[tuple[int, str], ...]) -> CommandHandler:
        def handle(_: Command) -> int:
            for severity, text in texts:
                self._vehicle.send_text(severity, text)
            return result

        return handle

    def accessory(self, do: Callable[[Accessories, Command], int]) -> CommandHandler:
        return lambda command: do(self._vehicle.accessories, command)

    def reset_battery(self, command: Command) -> int:
        """The first battery's charge in percent, when the mask in param 1 has it."""
        if whole(command.param1) & 1:
            self._vehicle.battery.percent = max(0.0, min(100.0, command.param2))
        return MavResult.ACCEPTED

    def high_latency(self, command: Command) -> int:
        """No port speaks it; to stop it is no error."""
        if command.param1:
            return MavResult.FAILED
        self._vehicle.send_text(MavSeverity.NOTICE, "High Latency disabled")
        return MavResult.ACCEPTED

    def tune(self, command: Command) -> int:
        """Said only: there are no gains to tune."""
        wanted = bool(command.param1)
        if wanted:
            self._vehicle.info("Started autotune")
            self._vehicle.info("Autotuning roll pitch yaw")
        elif self._tunes:
            self._vehicle.info("Stopped autotune")
        self._tunes = wanted
        return MavResult.ACCEPTED
