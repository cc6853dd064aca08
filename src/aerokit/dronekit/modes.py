"""Flight modes by the names that DroneKit scripts know: pymavlink's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio
from pymavlink import mavutil

from aerokit.autopilots.px4 import Px4
from aerokit.dronekit.standing import send_while_standing
from aerokit.errors import CommandRejected, LocalProtocolError, OperationTimeout
from aerokit.mavlink.messages import SetMode
from aerokit.protocols.command import result_name

if TYPE_CHECKING:
    from aerokit.dronekit.standing import Standing
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["change_mode", "mode_name", "mode_order", "told_as"]

DO_SET_MODE = 176
RESULT_UNSUPPORTED = 3
RESULT_TEMPORARILY_REJECTED = 1
MODE_IS_TOLD_S = 5.0
LOOK_S = 0.05
ATTEMPTS, ASK_AGAIN_S = 4, 0.5
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
        if not isinstance(mode, str):
            raise KeyError(mode)
        known = mavutil.px4_map.get(mode)
        if known is not None:
            return int(known[0]), int(known[1]), int(known[2])
        custom_mode = _custom_mode(vehicle, mode)
        return CUSTOM_MODE_ENABLED, custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if isinstance(mode, int):
        return CUSTOM_MODE_ENABLED, mode, 0
    names = mavutil.mode_mapping_byname(vehicle.vehicle_type) or {}
    return CUSTOM_MODE_ENABLED, names[mode] if mode in names else _custom_mode(vehicle, mode), 0


def _custom_mode(vehicle: Vehicle, mode: str) -> int:
    try:
        return vehicle.autopilot.find_mode(mode, vehicle.telemetry.mode_names).custom_mode
    except LocalProtocolError as error:  # it lists the modes there are
        raise KeyError(mode) from error
    except (AttributeError, TypeError):
        raise KeyError(mode) from None


def told_as(vehicle: Vehicle, order: Order) -> int:
    """HEARTBEAT.custom_mode of what is asked for."""
    _, main_mode, sub_mode = order
    return main_mode << 16 | sub_mode << 24 if isinstance(vehicle.autopilot, Px4) else main_mode


async def change_mode(vehicle: Vehicle, order: Order, standing: Standing) -> None:
    """Send MAV_CMD_DO_SET_MODE, or SET_MODE to a vehicle that does not know it, and wait until HEARTBEAT tells it.

    Asked again where the vehicle says that it is too early, as PX4 does while it checks a mission just uploaded, and as
    long as the order stands.

    Raises:
        CommandRejected: the vehicle refused.
        OperationTimeout: it did not answer, or it accepted and stays in another mode.
    """
    with standing.watching(vehicle):
        for attempts_left in reversed(range(ATTEMPTS)):
            try:
                await _change_mode(vehicle, order, standing)
            except CommandRejected as error:
                if error.result != RESULT_TEMPORARILY_REJECTED or not attempts_left:
                    raise
                await anyio.sleep(ASK_AGAIN_S)
                if not standing.holds():
                    raise
            else:
                return


async def _change_mode(vehicle: Vehicle, order: Order, standing: Standing) -> None:
    """PX4 acks twice: the first ack is always ACCEPTED, the second one may take it back."""
    base_mode, custom_mode = order[0], told_as(vehicle, order)
    started = vehicle.connection.now()
    with vehicle._talk.refusals_of(DO_SET_MODE) as refusals:
        await _request(vehicle, order, standing)
        with anyio.move_on_after(MODE_IS_TOLD_S):
            while not (standing.is_done or _is_in(vehicle, custom_mode)):
                if refusals:
                    raise _refused(vehicle, refusals[-1].result, started)
                await anyio.sleep(LOOK_S)
            return
    raise OperationTimeout(
        f"{mode_name(vehicle, base_mode, custom_mode)} was accepted, and the vehicle stays in {vehicle.mode.latest}"
    )


async def _request(vehicle: Vehicle, order: Order, standing: Standing) -> None:
    try:
        await send_while_standing(vehicle, standing, vehicle._talk.commands.send_long, DO_SET_MODE, *order)
    except CommandRejected as error:
        if error.result != RESULT_UNSUPPORTED:
            raise
        vehicle.send(SetMode(vehicle.system_id, order[0], told_as(vehicle, order)))


def _is_in(vehicle: Vehicle, custom_mode: int) -> bool:
    mode = vehicle.telemetry.mode.latest
    return mode is not None and mode.custom_mode == custom_mode


def _refused(vehicle: Vehicle, result: int, since: float) -> CommandRejected:
    return CommandRejected(
        f"MAV_CMD_DO_SET_MODE was refused: {result_name(result)}",
        command=DO_SET_MODE,
        result=result,
        reasons=vehicle.texts_since(since),
    )
