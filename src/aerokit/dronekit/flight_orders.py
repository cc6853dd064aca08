"""What is sent to make a vehicle move, and what is refused before anything is sent.

Flight modes have the names that DroneKit programs know: pymavlink's, which are the autopilots' own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit.autopilots import autopilot_for
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, Mode
from aerokit.dronekit.exceptions import APIException
from aerokit.errors import CommandRejected, LocalProtocolError, OperationTimeout
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavDoRepositionFlags, MavFrame, MavResult
from aerokit.mavlink.messages import Heartbeat, SetMode, SetPositionTargetGlobalInt

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot, Purpose
    from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative
    from aerokit.vehicle.orders.order import Subject
    from aerokit.vehicle.orders.posting import PostedOrder
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = [
    "change_armed",
    "change_mode",
    "check_speed",
    "checked_place",
    "flies_to_places_in",
    "go_to",
    "mode_name",
    "mode_named",
    "refuse",
    "take_off",
]

POSITION_ONLY = 0x0DF8
ARMED_IS_TOLD_S = 10.0
MODE_IS_TOLD_S = 5.0
ATTEMPTS, ASK_AGAIN_S = 4, 0.5


def mode_name(vehicle: AsyncVehicle, custom_mode: int) -> str:
    """The name of a mode in HEARTBEAT: pymavlink's and the autopilot's are the same."""
    return _as_known(vehicle).mode(custom_mode, CUSTOM_MODE_ENABLED, vehicle.telemetry.mode_names).name


def mode_named(vehicle: AsyncVehicle, mode: str | int) -> Mode:
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


def _as_known(vehicle: AsyncVehicle) -> Autopilot:
    """An autopilot of which nothing is known (iNav is one) has ArduPilot's numbers, as with pymavlink."""
    if vehicle.autopilot.modes.numbers:
        return vehicle.autopilot
    return autopilot_for(Heartbeat(vehicle.vehicle_type, MavAutopilot.ARDUPILOTMEGA, 0, 0, 0, 0))


async def change_mode(vehicle: AsyncVehicle, wanted: Mode) -> None:
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


async def _request(vehicle: AsyncVehicle, wanted: Mode, order: PostedOrder) -> None:
    params = (wanted.base_mode, *vehicle.autopilot.mode_order(wanted).params[1:])
    try:
        await order.command(MavCmd.DO_SET_MODE, *params, component_id=0)
    except CommandRejected as error:
        if error.result != MavResult.UNSUPPORTED or (order.end and not vehicle.telemetry.is_in(wanted)):
            raise
        if not order.end:
            vehicle.connection.send(SetMode(vehicle.system_id, wanted.base_mode, wanted.custom_mode))


async def change_armed(vehicle: AsyncVehicle, value: bool) -> None:
    """Arm or disarm, and wait until HEARTBEAT says so. To disarm ends what was ordered about motion."""
    subjects: tuple[Subject, ...] = ("arm",) if value else ("arm", "motion")
    try:
        with vehicle.posted(*subjects, armed=value) as order:
            await order.command(MavCmd.COMPONENT_ARM_DISARM, float(value), component_id=0)
            await order.until_told(ARMED_IS_TOLD_S)
    except OperationTimeout as error:
        error.args = (f"{error}; it may still be carried out, and nobody watches for that",)
        raise


async def take_off(vehicle: AsyncVehicle, modes: tuple[Mode, ...], command: int, *params: float) -> None:
    """Send the command to take off, which brings about these modes."""
    with vehicle.posted("motion", modes=modes) as order:
        await order.command(command, *params, component_id=0)


async def go_to(vehicle: AsyncVehicle, latitude: int, longitude: int, altitude: float) -> None:
    """DO_REPOSITION, which is answered; and the message for a vehicle that does not know it.

    The altitude is above home, or above the sea where the autopilot repositions so (PX4).
    """
    is_amsl = vehicle.autopilot.repositions_amsl
    with vehicle.posted("motion", modes=flies_to_places_in(vehicle)[:1]) as order:
        try:
            await order.command_int(
                MavCmd.DO_REPOSITION,
                *(-1, MavDoRepositionFlags.CHANGE_MODE if is_amsl else 0, 0, math.nan),
                frame=MavFrame.GLOBAL_INT if is_amsl else MavFrame.GLOBAL_RELATIVE_ALT_INT,
                x=latitude,
                y=longitude,
                z=altitude,
                component_id=0,
            )
        except CommandRejected as error:
            if is_amsl or error.result != MavResult.UNSUPPORTED or order.end:
                raise
            target = (vehicle.system_id, 0, MavFrame.GLOBAL_RELATIVE_ALT_INT, POSITION_ONLY)
            vehicle.send(SetPositionTargetGlobalInt(0, *target, latitude, longitude, altitude, *(0.0,) * 8))


def flies_to_places_in(aio: AsyncVehicle) -> tuple[Mode, ...]:
    """Where the order to fly to a place changes the mode itself: those in which the program meant it to; the first is
    the one that the order brings about. Empty where the mode stays what it is, and the vehicle refuses in a wrong one.
    """
    if not aio.autopilot.repositions_amsl:
        return ()
    purposes: tuple[Purpose, ...] = (aio.autopilot.reposition_purpose, "take_off")
    modes = map(aio.autopilot.mode_for, purposes)
    return tuple(mode for mode in modes if mode is not None)


async def refuse(reason: str) -> None:
    """An order that is not sent: the reason is logged as a refusal of the vehicle would be."""
    raise APIException(reason)


def checked_place(location: LocationGlobal | LocationGlobalRelative) -> tuple[int, int, float]:
    """Latitude and longitude in 1e-7 degrees, altitude in metres.

    Raises:
        LocalProtocolError: a ValueError, which names the number that is missing or wrong.
    """
    for name, limit in (("lat", 90.0), ("lon", 180.0), ("alt", math.inf)):
        value = getattr(location, name)
        try:
            is_good = math.isfinite(value) and abs(value) <= limit
        except TypeError:
            is_good = False
        if not is_good:
            allowed = "a number of metres" if limit == math.inf else f"-{limit:g} to {limit:g} degrees"
            raise LocalProtocolError(f"location.{name} = {value!r} is not allowed: {allowed}")
    return round(location.lat * 1e7), round(location.lon * 1e7), float(location.alt)


def check_speed(name: str, speed: float | None) -> None:
    """LocalProtocolError, a ValueError, unless it is a number of m/s or None."""
    if speed is not None and not math.isfinite(speed):
        raise LocalProtocolError(f"{name} = {speed!r} is not allowed: a number of m/s")
