"""Flight modes by the names that DroneKit programs know: pymavlink's, which are the autopilots' own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.autopilots import autopilot_for
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, Mode
from aerokit.errors import CommandRejected, LocalProtocolError
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult
from aerokit.mavlink.messages import Heartbeat, SetMode

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.vehicle.orders.posting import PostedOrder
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["change_mode", "mode_name", "mode_named"]

MODE_IS_TOLD_S = 5.0
ATTEMPTS, ASK_AGAIN_S = 4, 0.5


def mode_name(vehicle: Vehicle, custom_mode: int) -> str:
    """The name of a mode in HEARTBEAT: pymavlink's and the autopilot's are the same."""
    return _as_known(vehicle).mode(custom_mode, CUSTOM_MODE_ENABLED, vehicle.telemetry.mode_names).name


def mode_named(vehicle: Vehicle, mode: str | int) -> Mode:
    """The mode of a name in capitals, of one that the vehicle itself has told, or on ArduPilot of a number.

    Raises:
        KeyError: the vehicle has no such mode.
    """
    autopilot = _as_known(vehicle)
    if isinstance(mode, int) and autopilot.modes_are_numbered:
        return Mode(mode_name(vehicle, mode), mode)
    try:
        found = autopilot.find_mode(mode, vehicle.telemetry.mode_names)
    except (LocalProtocolError, AttributeError, TypeError) as error:  # the first lists the modes there are
        raise KeyError(mode) from (error if isinstance(error, LocalProtocolError) else None)
    if not isinstance(mode, str) or not (mode.isupper() or mode == found.name):
        raise KeyError(mode)
    return found if autopilot.modes_are_numbered else found.replace(base_mode=_px4_flags(found.name))


def _px4_flags(name: str) -> int:
    """MAV_MODE_FLAG as pymavlink sends them; PX4 looks at the one for custom modes only."""
    from pymavlink.mavutil import px4_map

    return int(px4_map.get(name, (CUSTOM_MODE_ENABLED,))[0])


def _as_known(vehicle: Vehicle) -> Autopilot:
    """An autopilot of which nothing is known (iNav is one) has ArduPilot's numbers, as with pymavlink."""
    if vehicle.autopilot.modes.numbers:
        return vehicle.autopilot
    return autopilot_for(Heartbeat(vehicle.vehicle_type, MavAutopilot.ARDUPILOTMEGA, 0, 0, 0, 0))


async def change_mode(vehicle: Vehicle, wanted: Mode) -> None:
    """Send MAV_CMD_DO_SET_MODE, or SET_MODE to a vehicle that does not know it, and wait until HEARTBEAT tells it.

    Asked again where the vehicle says that it is too early, as PX4 does while it checks a mission just uploaded, and as
    long as the order stands.

    Raises:
        CommandRejected: the vehicle refused.
        OperationTimeout: it did not answer, or it accepted and stays in another mode.
    """
    with vehicle.posted("mode", "motion", modes=(wanted,)) as order:
        for attempts_left in reversed(range(ATTEMPTS)):
            try:
                await _request(vehicle, wanted, order)
                await order.until_told(MODE_IS_TOLD_S)
            except CommandRejected as error:
                if error.result != MavResult.TEMPORARILY_REJECTED or not attempts_left:
                    raise
                await anyio.sleep(ASK_AGAIN_S)
                if order.end:
                    raise
            else:
                return


async def _request(vehicle: Vehicle, wanted: Mode, order: PostedOrder) -> None:
    params = (wanted.base_mode, *vehicle.autopilot.mode_order(wanted).params[1:])
    try:
        await order.command(MavCmd.DO_SET_MODE, *params, component_id=0)
    except CommandRejected as error:
        if error.result != MavResult.UNSUPPORTED or (order.end and not vehicle.telemetry.is_in(wanted)):
            raise
        if not order.end:
            vehicle.connection.send(SetMode(vehicle.system_id, wanted.base_mode, wanted.custom_mode))
