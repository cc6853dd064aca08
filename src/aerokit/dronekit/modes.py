"""Flight modes by the names that DroneKit scripts know: pymavlink's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pymavlink import mavutil

from aerokit.autopilots.px4 import Px4
from aerokit.errors import CommandRejected, LocalProtocolError
from aerokit.mavlink.messages import SetMode

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["change_mode", "mode_name", "mode_order"]

DO_SET_MODE = 176
RESULT_UNSUPPORTED = 3
MODE_IS_TOLD_S = 5.0
CUSTOM_MODE_ENABLED = 1

Order = tuple[int, int, int]
"""param1 to param3 of MAV_CMD_DO_SET_MODE."""


def mode_name(vehicle: Vehicle, base_mode: int, custom_mode: int) -> str:
    """The name of a mode in HEARTBEAT; of one that pymavlink does not know, the autopilot's own name for it."""
    name = None
    if isinstance(vehicle.autopilot, Px4):
        name = mavutil.interpret_px4_mode(base_mode, custom_mode)
    else:
        numbers = mavutil.mode_mapping_bynumber(vehicle.vehicle_type)
        name = (numbers or {}).get(custom_mode)
    if name is None or name == "UNKNOWN":
        return vehicle.autopilot.mode(custom_mode, base_mode, vehicle.telemetry.mode_names).name
    return str(name)


def mode_order(vehicle: Vehicle, mode: str | int) -> Order:
    """How to ask for a mode by pymavlink's name, by the autopilot's own, or on ArduPilot by its number.

    Raises:
        KeyError: the vehicle has no such mode.
    """
    if isinstance(vehicle.autopilot, Px4):
        known = mavutil.px4_map.get(mode)
        if known is not None:
            return int(known[0]), int(known[1]), int(known[2])
        if not isinstance(mode, str):
            raise KeyError(mode)
        custom_mode = _custom_mode(vehicle, mode)
        return CUSTOM_MODE_ENABLED, custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if isinstance(mode, int):
        return CUSTOM_MODE_ENABLED, mode, 0
    names = mavutil.mode_mapping_byname(vehicle.vehicle_type) or {}
    return CUSTOM_MODE_ENABLED, names[mode] if mode in names else _custom_mode(vehicle, mode), 0


def _custom_mode(vehicle: Vehicle, mode: str) -> int:
    try:
        return vehicle.autopilot.find_mode(mode, vehicle.telemetry.mode_names).custom_mode
    except (LocalProtocolError, AttributeError, TypeError):
        raise KeyError(mode) from None


async def change_mode(vehicle: Vehicle, order: Order) -> None:
    """Send MAV_CMD_DO_SET_MODE, or SET_MODE to a vehicle that does not know it, and wait until HEARTBEAT tells it.

    Raises:
        CommandRejected: the vehicle refused.
        OperationTimeout: it accepted and stays in another mode.
    """
    base_mode, main_mode, sub_mode = order
    is_px4 = isinstance(vehicle.autopilot, Px4)
    custom_mode = main_mode << 16 | sub_mode << 24 if is_px4 else main_mode
    try:
        await vehicle.command(DO_SET_MODE, *order, component_id=0)
    except CommandRejected as error:
        if error.result != RESULT_UNSUPPORTED:
            raise
        vehicle.send(SetMode(vehicle.system_id, base_mode, custom_mode))
    await vehicle.telemetry.mode.wait_until(
        lambda mode: mode.custom_mode == custom_mode,
        timeout=MODE_IS_TOLD_S,
        description=f"mode {mode_name(vehicle, base_mode, custom_mode)}",
    )
