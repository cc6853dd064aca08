"""``Gimbal``: the classic API of the first gimbal, on top of ``vehicle.aio.gimbal``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.dronekit.classic_connection import weak_callback
from aerokit.dronekit.core import core_of
from aerokit.dronekit.flight_orders import checked_location
from aerokit.dronekit.privates import GimbalPrivates
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative
from aerokit.errors import InvalidArgument
from aerokit.position import Position
from aerokit.vehicle.state.equipment import GimbalAttitude

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

HOME_TIMEOUT_S = 10.0
MAX_ANGLE_DEG = 360.0  # vehicle.aio.gimbal refuses larger angles
UNKNOWN_ATTITUDE = GimbalAttitude(None, None, None)


class Gimbal(GimbalPrivates):
    """The first gimbal of a vehicle: its attitude, and orders to turn it.

    :attr:`pitch`, :attr:`roll` and :attr:`yaw` are None until the vehicle reports a gimbal. Orders return immediately.
    A newer order replaces an unanswered order. A rejection is logged as a warning of the logger ``dronekit``. Orders
    raise ValueError for invalid numbers and locations, and APIException while the link is down.
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        self._core = core_of(vehicle)
        self._attitude = UNKNOWN_ATTITUDE
        self._core.on_connected.append(self._observe_attitude)

    @property
    def pitch(self) -> float | None:
        """Pitch in degrees from the horizon: 0 is level, -90 straight down."""
        return self._attitude.pitch_deg

    @property
    def roll(self) -> float | None:
        """Roll in degrees from the horizon, positive to the right."""
        return self._attitude.roll_deg

    @property
    def yaw(self) -> float | None:
        """Yaw in degrees clockwise from north, 0 to 360. May be None while the vehicle's heading is unknown.

        With ArduPilot before 4.3, the angle is that of MOUNT_STATUS. Its reference depends on the firmware.
        """
        return self._attitude.yaw_deg

    @property
    def mount_status(self) -> list[float | None]:
        """``[pitch, yaw, roll]`` in degrees."""
        attitude = self._attitude
        return [attitude.pitch_deg, attitude.yaw_deg, attitude.roll_deg]

    def __str__(self) -> str:
        attitude = self._attitude
        return f"Gimbal: pitch={attitude.pitch_deg}, roll={attitude.roll_deg}, yaw={attitude.yaw_deg}"

    __repr__ = __str__

    def rotate(self, pitch: float, roll: float, yaw: float) -> None:
        """Turn the gimbal to a direction, which it keeps while the vehicle moves.

        With a roll other than 0, or for a vehicle without a gimbal manager, DO_MOUNT_CONTROL is sent. The camera then
        points at ``yaw`` only at first, and afterwards turns with the vehicle.

        Args:
            pitch: degrees from the horizon: 0 is level, -90 straight down.
            roll: degrees from the horizon.
            yaw: degrees clockwise from north.
        """
        pitch = _checked("pitch", pitch)
        yaw = _checked("yaw", yaw)
        roll = _checked("roll", roll)
        gimbal = self._core.check_link().gimbal
        self._core.order("gimbal", gimbal.point, pitch, yaw, roll_deg=roll, wait=False)

    def target_location(self, roi: LocationGlobalRelative | LocationGlobal) -> None:
        """Point the camera, or a copter without a gimbal, at a location. A location of zeros ends this order."""
        if not isinstance(roi, (LocationGlobal, LocationGlobalRelative)):
            raise InvalidArgument("Expecting roi to be LocationGlobal or LocationGlobalRelative.")
        is_all_zeros = not any(checked_location(roi))
        aio = self._core.check_link()
        if is_all_zeros:
            self._core.order("gimbal", aio.stop_looking)
        elif isinstance(roi, LocationGlobal):
            self._core.order("gimbal", aio.look_at, Position(roi.lat, roi.lon, altitude_amsl_m=roi.alt))
        else:
            target = Position(roi.lat, roi.lon, altitude_relative_m=roi.alt)
            self._core.order("gimbal", _point_above_home, aio, target)

    def release(self) -> None:
        """Return control of the gimbal to the pilot's sticks."""
        self._core.order("gimbal", self._core.check_link().gimbal.release)

    def _observe_attitude(self) -> None:
        self._core.aio.gimbal.attitude.observe(weak_callback(self._on_attitude), every_arrival=True)

    def _on_attitude(self, _: GimbalAttitude | None, attitude: GimbalAttitude) -> None:
        self._attitude = attitude
        core = self._core
        source = core.aio.gimbal.attitude.source
        # As in DroneKit, MOUNT_ORIENTATION does not notify the listeners of ``mount``.
        if source is not None and source.message != "MOUNT_ORIENTATION":
            core.listeners.notify("mount", self.mount_status)
        core.listeners.notify("gimbal", self)


async def _point_above_home(aio: AsyncVehicle, target: Position) -> None:
    # PX4 takes altitudes above sea level. Home, which the conversion needs, may be unknown right after connecting.
    if aio.autopilot.repositions_amsl:
        await aio.home.wait_until(lambda _: True, timeout=HOME_TIMEOUT_S, description="home")
    await aio.look_at(target)


def _checked(name: str, value: float) -> float:
    """Return the angle. If it is beyond ±`MAX_ANGLE_DEG`, it is wrapped to ±180 degrees."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be a finite number of degrees")
    return number if abs(number) <= MAX_ANGLE_DEG else math.remainder(number, 360.0)
