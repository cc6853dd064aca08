"""What is sent to make a vehicle move, and what is refused before anything is sent.

Flight modes have the names that DroneKit programs know: pymavlink's, which are the autopilots' own.
"""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any

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
from aerokit.protocols.command import command_long
from aerokit.vehicle.commanding.arbiter import KNOWN_S

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot, Purpose
    from aerokit.dronekit.core import Core
    from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative
    from aerokit.vehicle.commanding.order import Subject
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

POSITION_ONLY = 0x0DF8

ARMED_IS_TOLD_S = 10.0

CONFIRMED_S = 1.5
"""So long MISSION_CURRENT is waited for before it is ordered by command."""

MOST = 0xFFFF

NO_MISSION = 0xFFFF


def mode_name(vehicle: AsyncVehicle, custom_mode: int) -> str:
    """The name of a mode in HEARTBEAT: pymavlink's and the autopilot's are the same."""
    return _as_known(vehicle).mode(custom_mode, CUSTOM_MODE_ENABLED, vehicle.telemetry.mode_names).name


def mode_named(vehicle: AsyncVehicle, mode: str | int) -> Mode:
    """The mode of a name in capitals or as the vehicle told it, or on ArduPilot of a number; KeyError: none such."""
    autopilot = _as_known(vehicle)
    if isinstance(mode, int) and autopilot.modes_are_numbered:
        return Mode(mode_name(vehicle, mode), mode)
    try:
        found = autopilot.find_mode(mode, vehicle.telemetry.mode_names)
    except (InvalidArgument, AttributeError, TypeError) as error:  # the first lists the modes there are
        raise KeyError(mode) from (error if isinstance(error, InvalidArgument) else None)
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
    return autopilot_for(m.Heartbeat(vehicle.vehicle_type, MavAutopilot.ARDUPILOTMEGA, 0, 0, 0, 0))


async def change_mode(vehicle: AsyncVehicle, wanted: Mode) -> None:
    """Order a mode, and wait until HEARTBEAT tells it."""
    with vehicle.posted("mode", "motion", modes=(wanted,)) as order:
        await order.set_mode(wanted, component_id=0)


async def change_armed(vehicle: AsyncVehicle, value: bool) -> None:
    """Arm or disarm, and wait until HEARTBEAT says so. To disarm ends what was ordered about motion."""
    subjects: tuple[Subject, ...] = ("arm",) if value else ("arm", "motion")
    try:
        with vehicle.posted(*subjects, armed=value) as order:
            await order.command(MavCmd.COMPONENT_ARM_DISARM, float(value), component_id=0)
            await order.until_told(ARMED_IS_TOLD_S)
    except CommandRejected:
        raise
    except (OperationRejected, OperationTimeout) as error:
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
            if (
                is_amsl
                or error.result != MavResult.UNSUPPORTED
                or order.end
                or vehicle.heartbeat_age > KNOWN_S
            ):
                raise
            target = (vehicle.system_id, 0, MavFrame.GLOBAL_RELATIVE_ALT_INT, POSITION_ONLY)
            vehicle.send(m.SetPositionTargetGlobalInt(0, *target, latitude, longitude, altitude, *(0.0,) * 8))


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
    """Latitude and longitude in 1e-7 degrees, altitude in metres; InvalidArgument names what is missing or wrong."""
    for name, limit in (("lat", 90.0), ("lon", 180.0), ("alt", math.inf)):
        value = getattr(location, name)
        try:
            is_good = math.isfinite(value) and abs(value) <= limit
        except TypeError:
            is_good = False
        if not is_good:
            allowed = "a number of metres" if limit == math.inf else f"-{limit:g} to {limit:g} degrees"
            raise InvalidArgument(f"location.{name} = {value!r} is not allowed: {allowed}")
    return round(location.lat * 1e7), round(location.lon * 1e7), float(location.alt)


def check_speed(name: str, speed: float | None) -> None:
    """InvalidArgument, a ValueError, unless it is a number of m/s or None."""
    if speed is not None and not math.isfinite(speed):
        raise InvalidArgument(f"{name} = {speed!r} is not allowed: a number of m/s")


class CurrentCommand:
    """MISSION_CURRENT and MISSION_SET_CURRENT of one vehicle.

    ArduPilot counts home as 0, and is at 0 before it flies its mission. PX4 counts the first item as 0: that is 1
    here, and 0 as long as it does not fly.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._chosen: int | None = None
        """What PX4 was told to fly next and has not gone past."""
        self._latest = core.on(m.MissionCurrent, self._on_current)

    @property
    def seq(self) -> int:
        """The command that the vehicle flies or will fly next; 0 before its first MISSION_CURRENT."""
        message = self._latest.message
        if message is None:
            return 0
        if self._core.aio.autopilot.home_is_item_0:
            return int(message.seq)
        if message.total == NO_MISSION or (self._is_over(message) and message.seq != self._chosen):
            return 0
        return int(message.seq) + 1

    def choose(self, seq: int) -> None:
        """Have the vehicle fly this one next; does not wait. InvalidArgument: it is not from 0 to 65,535."""
        if not 0 <= operator.index(seq) <= MOST:
            raise InvalidArgument(f"next = {seq!r} is not allowed, but 0 to {MOST}")
        self._core.order("commands.next", self._choose, operator.index(seq))

    def _on_current(self, message: m.MissionCurrent) -> None:
        if message.seq != self._chosen:
            self._chosen = None

    def _is_over(self, message: m.MissionCurrent) -> bool:
        is_at_an_end = message.seq == 0 or message.mission_state == MissionState.COMPLETE
        return is_at_an_end and not self._core.aio.is_armed

    async def _choose(self, seq: int) -> None:
        """By the message that DroneKit sends, once; what is not heard is ordered by the rules of all orders."""
        aio = self._core.aio
        if not aio.autopilot.home_is_item_0:
            await aio.mission.set_current(max(seq - 1, 0))
            self._chosen = seq - 1
            return
        aio.send(m.MissionSetCurrent(aio.system_id, aio.component_id, seq))
        with anyio.move_on_after(CONFIRMED_S):
            await aio.telemetry.mission_current.wait_until(lambda progress: progress.current == seq)
            return
        if aio.heartbeat_age > KNOWN_S:
            raise APIException(
                f"next = {seq} is not confirmed, and the vehicle is not heard: it may have been set"
            )
        if seq == 0:
            await aio.command(MavCmd.DO_SET_MISSION_CURRENT, 0)
        else:
            await aio.mission.set_current(seq - 1)


CALIBRATION_S = 35.0
"""ArduPilot answers when it is done, after half a minute if the vehicle is not held still."""

REBOOT_S = 3.0

TUNE_SIZES = (30, 200)


class Maintenance(VehicleCore):
    """Orders for a vehicle on the ground. They return at once; a refusal is a warning of the logger ``dronekit``."""

    # -------------------------------------------------------------------------- calibrations

    def send_calibrate_gyro(self) -> None:
        """Calibrate the gyroscopes: keep the vehicle still."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 1)

    def send_calibrate_magnetometer(self) -> None:
        """Calibrate the compasses: turn the vehicle about all axes until it says that it is done."""
        if self._dk.check_link().autopilot.calibrates_compasses_by_command:
            self._dk_calibrate(MavCmd.DO_START_MAG_CAL, 0, 1, 1)  # all compasses; retry; save by itself
        else:
            self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 1)

    def send_calibrate_vehicle_level(self) -> None:
        """Take the attitude of this moment for level."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 2)

    def send_calibrate_barometer(self) -> None:
        """Take the pressure of this moment for altitude 0."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 1)

    def send_calibrate_accelerometer(self, simple: bool = False) -> None:
        """Calibrate the accelerometers: in the six attitudes it asks for by texts, or, ``simple``, standing level."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 4 if simple else 1)

    def _dk_calibrate(self, command: int, *params: float) -> None:
        self._dk.command(
            "calibration",
            command,
            *params,
            attempt_timeout=CALIBRATION_S,
            progress_timeout=CALIBRATION_S,
        )

    # --------------------------------------------------------------------------------- rest

    def play_tune(self, tune: str | bytes) -> None:
        """Play a tune on the vehicle's buzzer: notes as ``"AAAA"``, in the format of the autopilot (PLAY_TUNE).

        At most 230 characters of ASCII (else ValueError); ArduPilot plays the first 99. APIException: the link is down,
        or the vehicle speaks MAVLink 1, which has no such message.
        """
        text = _tune_text(tune)
        if self._dk.check_link().connection.mavlink_version == 1:
            raise APIException("play_tune needs MAVLink 2, which this vehicle does not speak")
        first = TUNE_SIZES[0]
        self._dk.send(PlayTune(self._dk.target_system, 0, text[:first], text[first:]))

    def reboot(self) -> None:
        """Reboot the autopilot. It is away for some seconds, and then boots anew. Refused while it is armed.

        Sent once: a lost answer is a warning, and the vehicle may have rebooted.
        """
        shutdown = MavCmd.PREFLIGHT_REBOOT_SHUTDOWN
        self._dk.command("reboot", shutdown, 1, attempt_timeout=REBOOT_S)

    def send_capabilities_request(self, vehicle: Any, name: str, m: Any) -> None:
        """Ask for AUTOPILOT_VERSION once. Has the arguments of a message listener, and uses none of them."""
        self._dk.check_link()
        self._dk.send(command_long(self._dk.target_system, 0, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, (1,)))

    def send_capabilties_request(self, vehicle: Any, name: str, m: Any) -> None:
        """As :meth:`send_capabilities_request`; this spelling was the first."""
        self.send_capabilities_request(vehicle, name, m)


def _tune_text(tune: str | bytes) -> str:
    try:
        text = tune.encode() if isinstance(tune, str) else tune
        notes = text.rstrip(b"\0").decode("ascii")
    except (UnicodeError, AttributeError):
        raise InvalidArgument(f"tune = {tune!r} is not allowed: a text of ASCII characters") from None
    if "\0" in notes or len(notes) > sum(TUNE_SIZES):
        raise InvalidArgument(
            f"tune of {len(notes)} characters is not allowed: at most {sum(TUNE_SIZES)}, none of them NUL"
        )
    return notes
