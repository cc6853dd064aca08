"""``Gimbal``: where the camera points, and orders to it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.flight_orders import checked_place
from aerokit.dronekit.gimbal_attitude import from_device, from_orientation, from_status
from aerokit.dronekit.privates import GimbalPrivates
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative
from aerokit.errors import CommandRejected, CommandTimeout, LocalProtocolError
from aerokit.mavlink.messages import (
    CommandAck,
    GimbalDeviceAttitudeStatus,
    MountConfigure,
    MountControl,
    MountOrientation,
    MountStatus,
)
from aerokit.protocols.command import command_long

if TYPE_CHECKING:
    from aerokit.dronekit.gimbal_attitude import Angles
    from aerokit.dronekit.vehicle import Vehicle
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["Gimbal"]

DO_GIMBAL_MANAGER_PITCHYAW, DO_GIMBAL_MANAGER_CONFIGURE, DO_MOUNT_CONTROL = 1000, 1001, 205
DO_SET_ROI_LOCATION, DO_SET_ROI_NONE, DO_SET_ROI = 195, 197, 201
ORDERS = frozenset({DO_GIMBAL_MANAGER_PITCHYAW, DO_MOUNT_CONTROL, DO_SET_ROI_LOCATION})
LOCKED = 4 | 8 | 16
"""GIMBAL_MANAGER_FLAGS: roll and pitch from the horizon, yaw from north."""
MAVLINK_TARGETING, RC_TARGETING = 2, 3
RELEASE = -3
DENIED, UNSUPPORTED, LONG_ONLY = 2, 3, 7
GLOBAL_INT, GLOBAL_RELATIVE_ALT_INT = 5, 6
AUTOPILOT = 1
HOME_TIMEOUT_S = 10.0


class Gimbal(GimbalPrivates):
    """The first gimbal: where it points, and orders to it.

    :attr:`pitch`, :attr:`roll` and :attr:`yaw` are None until the vehicle has told of a gimbal. Orders return at once;
    a newer one replaces one that is not answered yet, and a refusal becomes a warning of the logger ``dronekit``.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._angles: Angles = (None, None, None)
        self._source: tuple[int, int] | None = None
        self._unknown: set[int] = set()
        self._must_claim = self._has_claimed = False
        vehicle._dk_on(CommandAck, self._on_ack)
        vehicle._dk_on_any_component(GimbalDeviceAttitudeStatus, self._on_device)
        vehicle._dk_on_any_component(MountStatus, self._on_status)
        vehicle._dk_on_any_component(MountOrientation, self._on_orientation)

    @property
    def pitch(self) -> float | None:
        """Degrees from the horizon: 0 is level, -90 straight down."""
        return self._angles[0]

    @property
    def roll(self) -> float | None:
        """Degrees from the horizon, positive to the right."""
        return self._angles[1]

    @property
    def yaw(self) -> float | None:
        """Degrees clockwise from north, 0 to 360.

        Of firmware that tells MOUNT_STATUS (ArduPilot before 4.3) it is that number, whatever it counts from.
        """
        return self._angles[2]

    @property
    def mount_status(self) -> list[float | None]:
        """``[pitch, yaw, roll]`` in degrees."""
        pitch, roll, yaw = self._angles
        return [pitch, yaw, roll]

    def __str__(self) -> str:
        pitch, roll, yaw = self._angles
        return f"Gimbal: pitch={pitch}, roll={roll}, yaw={yaw}"

    __repr__ = __str__

    def rotate(self, pitch: float, roll: float, yaw: float) -> None:
        """Turn the gimbal and keep it there, however the vehicle moves; returns at once.

        Args:
            pitch: degrees from the horizon: 0 is level, -90 straight down.
            roll: degrees from the horizon. If it is not 0, the order can only be given by a command that turns the
                camera with the vehicle: ``yaw`` is right at the moment of the order.
            yaw: degrees clockwise from north.

        Raises:
            ValueError: one of them is not a finite number. Nothing was sent.
            APIException: the link is down.
        """
        angles = [_checked(name, value) for name, value in (("pitch", pitch), ("roll", roll), ("yaw", yaw))]
        aio = self._vehicle._dk_check_link()
        self._vehicle._dk_order("gimbal", self._rotate, aio, *angles)

    def target_location(self, roi: LocationGlobalRelative | LocationGlobal) -> None:
        """Keep the camera on a place; a copter without a gimbal that turns does so itself. Returns at once.

        Latitude, longitude and altitude 0 give it up.

        Raises:
            ValueError: it is no such location, or one of its numbers is missing or wrong. Nothing was sent.
            APIException: the link is down.
        """
        if not isinstance(roi, (LocationGlobal, LocationGlobalRelative)):
            raise LocalProtocolError("Expecting roi to be LocationGlobal or LocationGlobalRelative.")
        place = checked_place(roi)
        aio = self._vehicle._dk_check_link()
        if any(place):
            self._vehicle._dk_order("gimbal", self._look_at, aio, isinstance(roi, LocationGlobal), *place)
        else:
            self._vehicle._dk_order("gimbal", _look_nowhere, aio)

    def release(self) -> None:
        """Give the gimbal back to the pilot's sticks; returns at once.

        Raises:
            APIException: the link is down.
        """
        self._vehicle._dk_order("gimbal", self._release, self._vehicle._dk_check_link())

    # ----------------------------------------------------------------------------- receiving

    def _on_device(self, message: GimbalDeviceAttitudeStatus) -> None:
        frame = message.received_frame
        source = (0 if frame is None else frame.component_id, message.gimbal_device_id)
        if self._source is None or source <= self._source:  # of several gimbals, the first
            self._source = source
            self._angles = from_device(message, self._heading())
            self._tell(is_mount_status=True)

    def _on_status(self, message: MountStatus) -> None:
        self._angles = from_status(message)
        self._tell(is_mount_status=True)

    def _on_orientation(self, message: MountOrientation) -> None:
        if self._source is None:
            self._angles = from_orientation(message, self._heading())
            self._tell(is_mount_status=False)

    def _tell(self, *, is_mount_status: bool) -> None:
        if is_mount_status:
            self._vehicle._dk_tell("mount", self.mount_status)
        self._vehicle._dk_tell("gimbal", self)

    def _heading(self) -> float | None:
        """Degrees clockwise from north in which the vehicle's nose points."""
        attitude = self._vehicle._dk_attitude
        return None if attitude is None else math.degrees(attitude.yaw)

    # -------------------------------------------------------------------------------- orders

    def _on_ack(self, ack: CommandAck) -> None:
        """Of orders that replace each other quickly none may live to see its answer: what it says is kept here."""
        if ack.command in ORDERS:
            if ack.result in (UNSUPPORTED, LONG_ONLY):
                self._unknown.add(ack.command)
            else:
                self._unknown.discard(ack.command)
        if ack.command == DO_GIMBAL_MANAGER_PITCHYAW:
            self._must_claim = ack.result == DENIED

    async def _rotate(self, aio: AsyncVehicle, pitch: float, roll: float, yaw: float) -> None:
        if roll or DO_GIMBAL_MANAGER_PITCHYAW in self._unknown:  # the gimbal manager's command has no roll
            await self._control_mount(aio, pitch, roll, yaw)
            return
        self._claim(aio)
        params = (pitch, yaw, math.nan, math.nan, LOCKED)
        try:
            await aio.command(DO_GIMBAL_MANAGER_PITCHYAW, *params)
        except CommandRejected as error:
            if error.result == UNSUPPORTED:
                await self._control_mount(aio, pitch, roll, yaw)
            elif error.result == DENIED and self._claim(aio):
                await aio.command(DO_GIMBAL_MANAGER_PITCHYAW, *params)
            else:
                raise

    def _claim(self, aio: AsyncVehicle) -> bool:
        """Say that we are in control, if the gimbal manager has denied us something; whether that was so."""
        if not self._must_claim:
            return False
        self._must_claim, self._has_claimed = False, True
        own = (aio.connection.source_system, aio.connection.source_component)
        aio.send(command_long(aio.system_id, AUTOPILOT, DO_GIMBAL_MANAGER_CONFIGURE, own))
        return True

    async def _control_mount(self, aio: AsyncVehicle, pitch: float, roll: float, yaw: float) -> None:
        relative = math.remainder(yaw - (self._heading() or 0.0), 360.0)
        if not await self._command_mount(aio, pitch, roll, relative, 0, 0, 0, MAVLINK_TARGETING):
            a, b, c = (round(angle * 100) for angle in (pitch, roll, yaw))
            aio.send(MountControl(aio.system_id, AUTOPILOT, a, b, c, 0))

    async def _command_mount(self, aio: AsyncVehicle, *params: float) -> bool:
        """DO_MOUNT_CONTROL; False for firmware that is older, and was told the mode by a message without an answer."""
        if DO_MOUNT_CONTROL not in self._unknown:
            try:
                await aio.command(DO_MOUNT_CONTROL, *params)
            except CommandRejected as error:
                if error.result != UNSUPPORTED:
                    raise
            else:
                return True
        aio.send(MountConfigure(aio.system_id, AUTOPILOT, int(params[-1]), 1, 1, 1))
        return False

    async def _look_at(
        self, aio: AsyncVehicle, is_absolute: bool, latitude: int, longitude: int, altitude: float
    ) -> None:
        frame = GLOBAL_INT if is_absolute else GLOBAL_RELATIVE_ALT_INT
        if aio.autopilot.roi_altitude_is_amsl and not is_absolute:
            frame, altitude = GLOBAL_INT, altitude + await _home_altitude(aio)
        if DO_SET_ROI_LOCATION not in self._unknown:
            try:
                await aio.command_int(DO_SET_ROI_LOCATION, frame=frame, x=latitude, y=longitude, z=altitude)
            except CommandTimeout:
                pass  # very old firmware knows no COMMAND_INT, and says nothing
            except CommandRejected as error:
                if error.result not in (UNSUPPORTED, LONG_ONLY):
                    raise
            else:
                return
        if frame == GLOBAL_INT:
            altitude -= await _home_altitude(aio)
        await aio.command(DO_SET_ROI, 0, 0, 0, 0, latitude * 1e-7, longitude * 1e-7, altitude)

    async def _release(self, aio: AsyncVehicle) -> None:
        await self._command_mount(aio, 0, 0, 0, 0, 0, 0, RC_TARGETING)
        if self._has_claimed:
            self._has_claimed = False
            await aio.command(DO_GIMBAL_MANAGER_CONFIGURE, RELEASE, RELEASE)


async def _look_nowhere(aio: AsyncVehicle) -> None:
    try:
        await aio.command(DO_SET_ROI_NONE)
    except CommandRejected as error:
        if error.result != UNSUPPORTED:
            raise
        await aio.command(DO_SET_ROI)


async def _home_altitude(aio: AsyncVehicle) -> float:
    home = aio.telemetry.home
    if not home.is_known:
        await home.wait_until(lambda _: True, timeout=HOME_TIMEOUT_S, description="home")
    altitude = home.value.altitude_amsl_m
    if altitude is None:
        raise APIException("the vehicle does not know its home yet: it is set with the first good position")
    return altitude


def _checked(name: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise LocalProtocolError(f"{name} = {value!r} is not allowed: a finite number of degrees")
    return number
