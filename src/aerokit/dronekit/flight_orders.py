"""Orders that move a vehicle, maintenance orders, and checks of their arguments.

Flight modes have the names that DroneKit programs use: those of pymavlink, which are the autopilots' own names.
"""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio

from aerokit.autopilots import autopilot_for
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, Mode
from aerokit.dronekit.core import VehicleCore
from aerokit.dronekit.exceptions import APIException
from aerokit.errors import CommandRejected, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    MavAutopilot,
    MavCmd,
    MavDoRepositionFlags,
    MavFrame,
    MavResult,
    MissionState,
)
from aerokit.mavlink.messages import PlayTune
from aerokit.parameters import ParameterType
from aerokit.protocols.command import command_long
from aerokit.vehicle.commanding.arbiter import MODE_MAX_AGE_S
from aerokit.vehicle.commanding.sender import add_clause

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot, Purpose
    from aerokit.dronekit.core import Core
    from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative
    from aerokit.vehicle.commanding.order import Subject
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

POSITION_ONLY = 0x0DF8  # type_mask that ignores velocity, acceleration, yaw and yaw rate

ARMED_TIMEOUT_S = 10.0

MISSION_CURRENT_TIMEOUT_S = 1.5  # how long to wait for MISSION_CURRENT after MISSION_SET_CURRENT

MAX_SEQ = 0xFFFF

MAX_FLOAT = ParameterType.REAL32.maximum  # the largest number that a field of a command can hold

NO_MISSION = 0xFFFF  # MISSION_CURRENT.total of a vehicle without a mission


def mode_name(vehicle: AsyncVehicle, custom_mode: int) -> str:
    autopilot = _autopilot_with_mode_numbers(vehicle)
    return autopilot.mode(custom_mode, CUSTOM_MODE_ENABLED, vehicle.telemetry.mode_names).name


def find_mode(vehicle: AsyncVehicle, mode: str | int) -> Mode:
    """Return a mode by its name or, on ArduPilot, its number. Raise KeyError for an unknown name.

    The name must be in capitals, or spelled as the vehicle reports it.
    """
    autopilot = _autopilot_with_mode_numbers(vehicle)
    # Numbers are not checked, as in DroneKit.
    if isinstance(mode, int) and autopilot.modes_are_numbered:
        return Mode(mode_name(vehicle, mode), mode)
    try:
        known_mode = autopilot.find_mode(mode, vehicle.telemetry.mode_names)
    except InvalidArgument as error:
        raise KeyError(mode) from error  # The text of the cause lists the available modes.
    except (AttributeError, TypeError):  # `mode` is not a string
        raise KeyError(mode) from None
    if not isinstance(mode, str) or not (mode.isupper() or mode == known_mode.name):
        raise KeyError(mode)
    # PX4 gets the base_mode that pymavlink would send.
    return known_mode if autopilot.modes_are_numbered else known_mode.replace(base_mode=_px4_base_mode(known_mode.name))


def _px4_base_mode(name: str) -> int:
    # pymavlink sends these flags. PX4 evaluates only CUSTOM_MODE_ENABLED.
    from pymavlink.mavutil import px4_map

    base_mode, *_ = px4_map.get(name, (CUSTOM_MODE_ENABLED,))
    return int(base_mode)


def _autopilot_with_mode_numbers(vehicle: AsyncVehicle) -> Autopilot:
    """Return the vehicle's autopilot; ArduPilot for autopilots whose mode numbers are unknown."""
    if vehicle.autopilot.modes.numbers:
        return vehicle.autopilot
    # Like pymavlink, use ArduPilot's mode numbers for autopilots such as iNav.
    heartbeat = m.Heartbeat(
        vehicle.vehicle_type,
        MavAutopilot.ARDUPILOTMEGA,
        base_mode=0,
        custom_mode=0,
        system_status=0,
        mavlink_version=0,
    )
    return autopilot_for(heartbeat)


async def change_mode(vehicle: AsyncVehicle, mode: Mode) -> None:
    with vehicle.posted("mode", "motion", modes=(mode,)) as order:
        await order.set_mode(mode, component_id=0)


async def arm_or_disarm(vehicle: AsyncVehicle, armed: bool) -> None:
    """Arm or disarm, and wait until HEARTBEAT reports the change."""
    if armed:
        if await vehicle._is_armed_already(ARMED_TIMEOUT_S, None):
            return
        await _leave_mode_starting_flight(vehicle)
    # Disarming ends orders that move the vehicle.
    topics: tuple[Subject, ...] = ("arm",) if armed else ("arm", "motion")
    try:
        with vehicle.posted(*topics, armed=armed) as order:
            await order.command(MavCmd.COMPONENT_ARM_DISARM, float(armed), component_id=0)
            await order.wait_confirmed(ARMED_TIMEOUT_S)
    except CommandRejected:  # The vehicle certainly does not execute the command.
        raise
    except (OperationRejected, OperationTimeout) as error:
        if getattr(error, "was_sent", True):
            add_clause(error, "the vehicle may still execute the command, which is not monitored any more")
        raise


async def _leave_mode_starting_flight(vehicle: AsyncVehicle) -> None:
    """Change the mode if arming in the present one would start a flight that the program has not ordered."""
    mode = vehicle._mode_instead_of_flight()
    if mode is None:
        return
    arm_commands_before = vehicle._arbiter.arm_commands_sent
    try:
        await change_mode(vehicle, mode)
    except OperationRejected:
        if vehicle._mode_instead_of_flight() is not None:  # The program has not ordered another mode meanwhile.
            raise
    if vehicle._arbiter.arm_commands_sent != arm_commands_before:
        raise OperationRejected("another arm or disarm command was given; the arm command was not sent")


async def take_off(vehicle: AsyncVehicle, modes: tuple[Mode, ...], command: int, *params: float) -> None:
    with vehicle.posted("motion", modes=modes) as order:
        await order.command(command, *params, component_id=0)


class Target(NamedTuple):
    """Latitude and longitude in degrees times 1e7, and an altitude in metres."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float


async def go_to(vehicle: AsyncVehicle, target: Target) -> None:
    """Send DO_REPOSITION or, if it is unsupported, SET_POSITION_TARGET_GLOBAL_INT.

    The altitude is above sea level on PX4, otherwise above home.
    """
    is_amsl = vehicle.autopilot.repositions_amsl
    flags = MavDoRepositionFlags.CHANGE_MODE if is_amsl else 0
    with vehicle.posted("motion", modes=reposition_modes(vehicle)[:1]) as order:
        try:
            await order.command_int(
                MavCmd.DO_REPOSITION,
                -1,  # default speed
                flags,
                0,  # default radius
                math.nan,  # unchanged yaw
                frame=MavFrame.GLOBAL_INT if is_amsl else MavFrame.GLOBAL_RELATIVE_ALT_INT,
                x=target.latitude_e7,
                y=target.longitude_e7,
                z=target.altitude_m,
                component_id=0,
            )
        except CommandRejected as error:
            is_unsupported = error.result == MavResult.UNSUPPORTED and not is_amsl
            is_overruled = bool(order.end)  # True if a newer order or a mode change has ended the order
            is_silent = vehicle.heartbeat_age > MODE_MAX_AGE_S
            if not is_unsupported or is_overruled or is_silent:
                raise
            set_point = m.SetPositionTargetGlobalInt(
                time_boot_ms=0, target_system=vehicle.system_id, target_component=0,
                coordinate_frame=MavFrame.GLOBAL_RELATIVE_ALT_INT, type_mask=POSITION_ONLY,
                lat_int=target.latitude_e7, lon_int=target.longitude_e7, alt=target.altitude_m,
                vx=0.0, vy=0.0, vz=0.0, afx=0.0, afy=0.0, afz=0.0, yaw=0.0, yaw_rate=0.0,
            )  # fmt: skip
            vehicle.send(set_point)


def reposition_modes(aio: AsyncVehicle) -> tuple[Mode, ...]:
    """Return the modes in which DO_REPOSITION may be sent to PX4, which then changes to the first of them.

    The result is empty for other autopilots, which refuse the command in unsuitable modes, and do not change the mode.
    """
    if not aio.autopilot.repositions_amsl:  # not PX4
        return ()
    purposes: tuple[Purpose, ...] = (aio.autopilot.reposition_purpose, "take_off")
    modes = map(aio.autopilot.mode_for, purposes)
    return tuple(mode for mode in modes if mode is not None)


async def reject(reason: str) -> None:
    """Raise APIException with a reason, which is then logged like a rejection by the vehicle."""
    raise APIException(reason)


def checked_location(location: LocationGlobal | LocationGlobalRelative) -> Target:
    for name, limit in (("lat", 90.0), ("lon", 180.0), ("alt", MAX_FLOAT)):
        value = getattr(location, name)
        try:
            is_good = abs(value) <= limit
        except TypeError:
            is_good = False
        if not is_good:
            allowed = "a finite number" if limit == MAX_FLOAT else f"-{limit:g} to {limit:g} degrees"
            raise InvalidArgument(f"location.{name} = {value!r} is not allowed: it must be {allowed}")
    return Target(round(location.lat * 1e7), round(location.lon * 1e7), float(location.alt))


def check_speed(name: str, speed: float | None) -> None:
    if speed is not None and not abs(speed) <= MAX_FLOAT:
        raise InvalidArgument(f"{name} = {speed!r} is not allowed: it must be a finite number of m/s")


class CurrentCommand:
    """Reads and sets the current command of a mission (MISSION_CURRENT, MISSION_SET_CURRENT).

    The numbers are ArduPilot's for all autopilots: home is 0, the first item is 1. ArduPilot reports 0 before it flies
    a mission. PX4 counts the first item as 0, so its numbers are converted; they become 0 while no mission is active.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        # Index of the item that the program has set on PX4; None once PX4 reports another item.
        self._requested_index: int | None = None
        self._latest = core.on(m.MissionCurrent, self._on_current)

    @property
    def seq(self) -> int:
        """``seq`` of the current command; 0 if it is unknown or, on PX4, if no mission is active."""
        message = self._latest.message
        if message is None:
            return 0
        if self._core.aio.autopilot.home_is_item_0:
            return int(message.seq)
        # An item that the program has just set is returned even if the mission is not active yet.
        is_requested = message.seq == self._requested_index
        if message.total == NO_MISSION or (self._is_mission_inactive(message) and not is_requested):
            return 0
        return int(message.seq) + 1

    def set_next(self, seq: int) -> None:
        """Set the next command without waiting."""
        if not 0 <= operator.index(seq) <= MAX_SEQ:
            raise InvalidArgument(f"next = {seq!r} is not allowed: it must be 0 to {MAX_SEQ}")
        self._core.order("commands.next", self._set_current, operator.index(seq))

    def _on_current(self, message: m.MissionCurrent) -> None:
        if message.seq != self._requested_index:
            self._requested_index = None

    def _is_mission_inactive(self, message: m.MissionCurrent) -> bool:
        is_at_start_or_end = message.seq == 0 or message.mission_state == MissionState.COMPLETE
        return is_at_start_or_end and not self._core.aio.is_armed

    async def _set_current(self, seq: int) -> None:
        aio = self._core.aio
        if not aio.autopilot.home_is_item_0:
            await aio.mission.set_current(max(seq - 1, 0))
            self._requested_index = seq - 1  # -1 is not the index of an item.
            return
        aio.send(m.MissionSetCurrent(aio.system_id, aio.component_id, seq))  # once, as in DroneKit
        current, sent_at = aio.telemetry.mission_current, aio.connection.now()
        with anyio.move_on_after(MISSION_CURRENT_TIMEOUT_S):
            # A report from before MISSION_SET_CURRENT does not confirm the command, even if it has this number.
            await current.wait_until(lambda progress: progress.current == seq and current.updated_at > sent_at)
            return
        # MISSION_SET_CURRENT was not confirmed in time, so send a command instead, which the vehicle acknowledges.
        if aio.heartbeat_age > MODE_MAX_AGE_S:
            raise APIException(f"the vehicle is silent; it may or may not have set the next command to {seq}")
        if seq == 0:  # `mission.set_current` cannot select home. Its index 0 is the first item after home.
            await aio.command(MavCmd.DO_SET_MISSION_CURRENT, 0)
        else:
            await aio.mission.set_current(seq - 1)


# ArduPilot answers when the calibration is done, or after half a minute if the vehicle moves.
CALIBRATION_TIMEOUT_S = 35.0

REBOOT_TIMEOUT_S = 3.0

TUNE_SIZE, TUNE2_SIZE = 30, 200  # characters in the fields `tune` and `tune2` of PLAY_TUNE


class Maintenance(VehicleCore):
    """Orders for a vehicle on the ground. They return immediately; a rejection is logged as a warning."""

    # -------------------------------------------------------------------------- calibrations

    # PREFLIGHT_CALIBRATION has one parameter each for gyroscopes, compasses, pressure, radio and accelerometers. The
    # last one is 1 for six poses, 2 for the level attitude, and 4 for the level pose only.

    def send_calibrate_gyro(self) -> None:
        """Calibrate the gyroscopes: keep the vehicle still."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 1)

    def send_calibrate_magnetometer(self) -> None:
        """Calibrate the compasses: turn the vehicle around all axes until it reports success."""
        if self._dk.check_link().autopilot.calibrates_compasses_by_command:
            self._dk_calibrate(MavCmd.DO_START_MAG_CAL, 0, 1, 1)  # parameters: all compasses, retry, save the result
        else:
            self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 1)

    def send_calibrate_vehicle_level(self) -> None:
        """Store the current attitude as level."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 2)

    def send_calibrate_barometer(self) -> None:
        """Store the current air pressure as the pressure at altitude 0."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 1)

    def send_calibrate_accelerometer(self, simple: bool = False) -> None:
        """Calibrate the accelerometers in six poses, which STATUSTEXT messages request.

        With ``simple``, calibrate them in the level pose only.
        """
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 4 if simple else 1)

    def _dk_calibrate(self, command: int, *params: float) -> None:
        self._dk.command(
            "calibration",
            command,
            *params,
            attempt_timeout=CALIBRATION_TIMEOUT_S,
            progress_timeout=CALIBRATION_TIMEOUT_S,
        )

    # ------------------------------------------------------------------ tunes and rebooting

    def play_tune(self, tune: str | bytes) -> None:
        """Play a tune on the vehicle's buzzer, such as ``"AAAA"``, in the format of the autopilot (PLAY_TUNE).

        At most 230 ASCII characters (else ValueError); ArduPilot plays the first 99. Raises APIException if the link is
        down, or if the vehicle uses MAVLink 1, which has no such message.
        """
        text = _tune_text(tune)
        if self._dk.check_link().connection.mavlink_version == 1:
            raise APIException("play_tune needs MAVLink 2, and this vehicle uses MAVLink 1")
        self._dk.send(PlayTune(self._dk.target_system, 0, text[:TUNE_SIZE], text[TUNE_SIZE:]))

    def reboot(self) -> None:
        """Reboot the autopilot, which then does not answer for some seconds. An armed vehicle refuses.

        The command is sent once. If it is not answered, a warning is logged; the vehicle may have rebooted.
        """
        shutdown = MavCmd.PREFLIGHT_REBOOT_SHUTDOWN
        self._dk.command("reboot", shutdown, 1, attempt_timeout=REBOOT_TIMEOUT_S)

    def send_capabilities_request(self, vehicle: Any, name: str, m: Any) -> None:
        """Send one request for AUTOPILOT_VERSION. The arguments are ignored; they are those of a message listener."""
        self._dk.check_link()
        self._dk.send(command_long(self._dk.target_system, 0, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, (1,)))

    def send_capabilties_request(self, vehicle: Any, name: str, m: Any) -> None:
        """Misspelled alias of :meth:`send_capabilities_request`, from early DroneKit versions."""
        self.send_capabilities_request(vehicle, name, m)


def _tune_text(tune: str | bytes) -> str:
    try:
        data = tune.encode() if isinstance(tune, str) else tune
        text = data.rstrip(b"\0").decode("ascii")
    except (UnicodeError, AttributeError):
        raise InvalidArgument(f"tune = {tune!r} is not allowed: it must be ASCII text") from None
    max_size = TUNE_SIZE + TUNE2_SIZE
    if "\0" in text or len(text) > max_size:
        raise InvalidArgument(
            f"tune of {len(text)} characters is not allowed: at most {max_size} characters, none of them NUL"
        )
    return text
