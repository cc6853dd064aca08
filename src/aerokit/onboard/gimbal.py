"""``GimbalDriver``: base class for your program's gimbal, for which aerokit serves the gimbal protocol."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalDeviceCapFlags as DeviceCapFlags
from aerokit.mavlink.enums import GimbalManagerFlags as ManagerFlags
from aerokit.onboard.commands import overrides
from aerokit.position import Position
from aerokit.protocols.servers.gimbal import (
    ALL_CAPABILITIES,
    Angles,
    GimbalMount,
    Place,
    gimbal_builders,
    gimbal_commands,
    listen_for_gimbal,
)

if TYPE_CHECKING:
    from aerokit.onboard.commands import ComponentServices
    from aerokit.protocols.servers.host import ServerHost

STATUS_INTERVAL_S = 1.0
_FULL_TURN_DEG = (-180.0, 180.0)


class GimbalTarget(Snapshot):
    """Target of a gimbal: angles in degrees, or rates in degrees per second.

    Roll and pitch are relative to the horizon; yaw is relative to the vehicle's nose, or to north if ``yaw_locked``.
    One of ``angles`` and ``rates`` is None.
    """

    angles: tuple[float, float, float] | None
    rates: tuple[float, float, float] | None
    yaw_locked: bool
    is_retracted: bool = False


class GimbalDriver:
    """Base class for your program's gimbal; pass an instance to :meth:`OnboardComponent.add_gimbal`.

    Override :meth:`point` and :meth:`attitude`. Only the component in control (DO_GIMBAL_MANAGER_CONFIGURE) can point
    the gimbal; commands of all others are DENIED.

    Args:
        vendor: at most 32 bytes.
        model: at most 32 bytes.
        roll_deg: minimum and maximum roll angle.
        pitch_deg: minimum and maximum pitch angle.
        yaw_deg: minimum and maximum yaw angle.
        max_rate_deg_s: maximum rate. Full deflection in GIMBAL_MANAGER_SET_MANUAL_CONTROL commands this rate, or the
            minimum or maximum angle.
        attitude_hz: rate of GIMBAL_DEVICE_ATTITUDE_STATUS, 0 to 100.
    """

    def __init__(
        self,
        *,
        vendor: str = "aerokit",
        model: str = "gimbal",
        roll_deg: tuple[float, float] = (0.0, 0.0),
        pitch_deg: tuple[float, float] = (-90.0, 30.0),
        yaw_deg: tuple[float, float] = _FULL_TURN_DEG,
        max_rate_deg_s: float = 60.0,
        attitude_hz: float = 10.0,
    ) -> None:
        for name, (low, high) in (("roll_deg", roll_deg), ("pitch_deg", pitch_deg), ("yaw_deg", yaw_deg)):
            if not -360.0 <= low <= high <= 360.0:
                raise InvalidArgument(
                    f"{name} = ({low}, {high}) is not allowed: both must be −360 to 360, the lower first"
                )
        if not max_rate_deg_s > 0:
            raise InvalidArgument(f"max_rate_deg_s = {max_rate_deg_s} is not allowed: it must be above 0")
        check_range("attitude_hz", attitude_hz, 0, 100)
        self.vendor: str = vendor
        self.model: str = model
        self.limits_deg: tuple[tuple[float, float], ...] = (roll_deg, pitch_deg, yaw_deg)
        self.max_rate_deg_s: float = max_rate_deg_s
        self.attitude_hz: float = attitude_hz

    def point(self, target: GimbalTarget) -> None:
        """Start to turn to a target within the limits. Called on the event loop, so it must return at once.

        Rates last until the next target. When the component's block ends, aerokit calls this method with rates of zero.
        """
        raise NotImplementedError

    def attitude(self) -> tuple[float, float, float]:
        """Return the current roll and pitch (from the horizon) and yaw (from the vehicle's nose) in degrees."""
        raise NotImplementedError

    def heading(self) -> float:
        """Return the heading of the vehicle in degrees; 0 if unknown."""
        return 0.0

    def look_at(self, position: Position | None) -> None:
        """Start to point at a position; None means to point ahead again.

        If a subclass does not override this method, commands to point at a position are UNSUPPORTED.
        """
        raise NotImplementedError


class GimbalAdapter(GimbalMount):
    """Serves the gimbal protocol for a `GimbalDriver`."""

    def __init__(self, gimbal: GimbalDriver, services: ComponentServices) -> None:
        self.vendor: str = gimbal.vendor
        self.model: str = gimbal.model
        roll, pitch, yaw = gimbal.limits_deg
        self.limits: tuple[tuple[float, float], ...] = tuple(
            (math.radians(low), math.radians(high)) for low, high in (roll, pitch, yaw)
        )
        self.slew_rad_s: float = math.radians(gimbal.max_rate_deg_s)
        self.can_point_at_positions: bool = overrides(gimbal, GimbalDriver, "look_at")
        self.capabilities: int = ALL_CAPABILITIES
        for axis_flags, (low, high) in ((_ROLL_FLAGS, roll), (_PITCH_FLAGS, pitch), (_YAW_FLAGS, yaw)):
            if low == high:  # The gimbal does not turn about this axis.
                self.capabilities &= ~axis_flags
        if yaw == _FULL_TURN_DEG:
            self.capabilities |= DeviceCapFlags.SUPPORTS_INFINITE_YAW
        self.host: ServerHost = services.host
        self.device_id: int = services.host.component_id
        self._gimbal, self._stop_functions = gimbal, services.stop_functions
        self._is_yaw_locked = False
        self._followed_system_id = 0  # system at which the gimbal points; 0 if there is none

    @property
    def is_yaw_locked(self) -> bool:
        return self._is_yaw_locked

    def angles(self) -> Angles:
        roll, pitch, yaw = map(math.radians, self._gimbal.attitude())
        return (roll, pitch, yaw)

    def heading(self) -> float:
        return math.radians(self._gimbal.heading())

    def home_altitude_m(self) -> float:
        raise InvalidArgument("the altitude of home is unknown: send the altitude above sea level (MAV_FRAME_GLOBAL)")

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        roll, pitch, yaw = (max(low, min(high, angle)) for angle, (low, high) in zip(angles, self.limits, strict=True))
        if locked:  # A locked yaw is relative to north, but the yaw limits are relative to the nose.
            _, _, yaw = angles
        angles_deg = (math.degrees(roll), math.degrees(pitch), math.degrees(yaw))
        is_retracted = bool(flags & ManagerFlags.RETRACT)
        target = GimbalTarget(angles_deg, rates=None, yaw_locked=locked, is_retracted=is_retracted)
        self._apply(target, flags)

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        limit = self.slew_rad_s
        roll, pitch, yaw = (math.degrees(max(-limit, min(limit, rate))) for rate in rates)
        self._apply(GimbalTarget(angles=None, rates=(roll, pitch, yaw), yaw_locked=locked), flags)
        if any(rates):
            self._stop_functions["gimbal"] = self._stop

    async def _stop(self) -> None:  # A coroutine function, because plain functions may be called in a thread.
        self._gimbal.point(GimbalTarget(angles=None, rates=(0.0, 0.0, 0.0), yaw_locked=self._is_yaw_locked))

    def _apply(self, target: GimbalTarget, flags: int) -> None:
        self._gimbal.point(target)
        self._record(flags, is_yaw_locked=target.yaw_locked)

    def _record(self, flags: int, *, is_yaw_locked: bool) -> None:
        # Called after the program's method has returned. If the method raises, the gimbal may still turn, and the stop
        # function stays.
        self._stop_functions.pop("gimbal", None)
        self.flags: int = flags
        self._is_yaw_locked = is_yaw_locked
        self._followed_system_id = 0  # A new target ends the following of a system.

    def look_at(self, place: Place | None) -> None:
        position = None
        if place is not None:
            position = Position(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, altitude_amsl_m=place.altitude_m)
        self._gimbal.look_at(position)
        # While the gimbal looks at a position, turns of the vehicle do not turn the gimbal.
        self._record(0, is_yaw_locked=position is not None)

    def follow(self, system_id: int) -> None:
        self._followed_system_id = system_id

    def update_followed(self, system_id: int, place: Place) -> None:
        if system_id == self._followed_system_id:
            self.look_at(place)
            self._followed_system_id = system_id  # `look_at` has reset it.


_ROLL_FLAGS = DeviceCapFlags.HAS_ROLL_AXIS | DeviceCapFlags.HAS_ROLL_LOCK | DeviceCapFlags.HAS_ROLL_FOLLOW
_PITCH_FLAGS = DeviceCapFlags.HAS_PITCH_AXIS | DeviceCapFlags.HAS_PITCH_LOCK | DeviceCapFlags.HAS_PITCH_FOLLOW
_YAW_FLAGS = DeviceCapFlags.HAS_YAW_AXIS | DeviceCapFlags.HAS_YAW_LOCK | DeviceCapFlags.HAS_YAW_FOLLOW


def add_gimbal(services: ComponentServices, gimbal: GimbalDriver) -> None:
    streams = services.streams
    if m.GimbalManagerInformation.ID in streams.builders:
        raise InvalidArgument("this component already has a gimbal: open another component for the second one")
    adapter = GimbalAdapter(gimbal, services)
    streams.builders.update(gimbal_builders(adapter))
    services.commands.add_guarded(gimbal_commands(adapter))
    listen_for_gimbal(adapter)
    streams.stream(m.GimbalManagerStatus.ID, STATUS_INTERVAL_S)
    if gimbal.attitude_hz > 0:
        streams.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / gimbal.attitude_hz)
