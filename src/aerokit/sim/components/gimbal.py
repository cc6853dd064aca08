"""`SimulatedGimbal`: a gimbal component that implements the MAVLink gimbal protocol v2.

https://mavlink.io/en/services/gimbal_v2.html
"""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.mavlink.enums import MavType
from aerokit.protocols.servers.commands import CommandHandler
from aerokit.protocols.servers.gimbal import (
    Angles,
    GimbalMount,
    Place,
    gimbal_builders,
    gimbal_commands,
    listen_for_gimbal,
)
from aerokit.protocols.servers.host import ComponentIds, ServerHost
from aerokit.protocols.servers.intervals import Builder
from aerokit.sim.components.component import SimulatedComponent, pose_of
from aerokit.sim.motion import GlobalPoint

_STATUS_INTERVAL_S = 1.0
_ZERO: Angles = (0.0, 0.0, 0.0)


class SimulatedGimbal(SimulatedComponent, GimbalMount):
    """A gimbal device and its gimbal manager. The gimbal turns at a limited rate and can point at positions.

    Only the component in control can command the gimbal. Initially, no component is in control. Take control with
    MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE. The gimbal denies commands of other components and ignores their messages.

    - ``component_id``: MAVLink reserves 154 and 171 to 175 for gimbals; ``system_id``: None uses that of the vehicle
    - ``roll_deg``, ``pitch_deg``, ``yaw_deg``: minimum and maximum angle. Roll and pitch are relative to the horizon at
      any attitude of the vehicle
    - ``slew_deg_s``: turn rate
    - ``attitude_rate_hz``: rate of GIMBAL_DEVICE_ATTITUDE_STATUS

    Not simulated: motor failures, a second manager.
    """

    TYPE: ClassVar[int] = MavType.GIMBAL
    model = "Simulated gimbal"

    def __init__(
        self,
        component_id: int = 154,
        *,
        system_id: int | None = None,
        roll_deg: tuple[float, float] = (-30.0, 30.0),
        pitch_deg: tuple[float, float] = (-90.0, 25.0),
        yaw_deg: tuple[float, float] = (-180.0, 180.0),
        slew_deg_s: float = 60.0,
        attitude_rate_hz: float = 5.0,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.host: ServerHost = self
        self.device_id: int = component_id
        self.limits: tuple[tuple[float, float], ...] = tuple(
            (math.radians(low), math.radians(high)) for low, high in (roll_deg, pitch_deg, yaw_deg)
        )
        """Minimum and maximum of roll, pitch and yaw in radians."""
        self.slew_rad_s: float = math.radians(slew_deg_s)
        self._attitude_rate_hz = attitude_rate_hz
        self._reset()

    def _reset(self) -> None:
        self.primary: ComponentIds = ComponentIds()
        self.secondary: ComponentIds = ComponentIds()
        self.flags: int = 0
        self.region: GlobalPoint | None = None
        """Position to point at; None without a region of interest."""
        self.followed: int = 0
        """System id of the followed vehicle; 0 if none."""
        # At the time `_start_at`, the gimbal had the angles `_start_angles`. From then on, the gimbal turns towards
        # `_target`, and `_target` turns at `_rates`.
        self._start_angles: Angles = _ZERO
        self._start_at = 0.0
        self._target: Angles = _ZERO
        self._rates: Angles = _ZERO
        self._is_locked = False

    def start(self) -> None:
        """Called at power-on: reset control and direction, and start the streams."""
        self._reset()
        self._start_at = self.now
        self.stream(m.GimbalManagerStatus.ID, _STATUS_INTERVAL_S)
        if self._attitude_rate_hz > 0:
            self.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / self._attitude_rate_hz)

    def commands(self) -> dict[int, CommandHandler]:
        return gimbal_commands(self)

    def builders(self) -> dict[int, Builder]:
        return gimbal_builders(self)

    def listen(self) -> None:
        listen_for_gimbal(self)

    def home_altitude_m(self) -> float:
        pose = pose_of(self.vehicle)
        return 0.0 if pose is None else pose.place.altitude_m - pose.height_m

    @property
    def is_yaw_locked(self) -> bool:
        """True if the yaw is fixed relative to north."""
        return self._is_locked or self.region is not None

    def angles(self) -> Angles:
        """Return roll and pitch (from the horizon) and yaw (from the vehicle's nose) in radians."""
        max_change = self.slew_rad_s * (self.now - self._start_at)
        roll, pitch, yaw = (
            start + max(-max_change, min(max_change, target - start))
            for start, target in zip(self._start_angles, self._wanted_angles(), strict=True)
        )
        return (roll, pitch, yaw)

    def heading(self) -> float:
        """Return the heading of the vehicle in radians; 0 if unknown."""
        pose = pose_of(self.vehicle)
        return 0.0 if pose is None else pose.yaw

    def _wanted_angles(self) -> Angles:
        """Return the angles towards which the gimbal turns now, with yaw from the nose."""
        target = self._target if self.region is None else self._angles_to(self.region)
        seconds = self.now - self._start_at
        roll, pitch, yaw = (angle + rate * seconds for angle, rate in zip(target, self._rates, strict=True))
        if self.is_yaw_locked:  # The target is relative to north, the result to the nose.
            yaw = math.remainder(yaw - self.heading(), math.tau)
        roll_limits, pitch_limits, yaw_limits = self.limits
        return (_clamped(roll, roll_limits), _clamped(pitch, pitch_limits), _clamped(yaw, yaw_limits))

    def _angles_to(self, region: GlobalPoint) -> Angles:
        """Return the angles to a position, with yaw from north."""
        pose = pose_of(self.vehicle)
        if pose is None:
            return self._target
        frame = self.vehicle.frame  # type: ignore[attr-defined]
        region_north, region_east = frame.to_local(region.latitude_e7, region.longitude_e7)
        vehicle_north, vehicle_east = frame.to_local(pose.place.latitude_e7, pose.place.longitude_e7)
        north, east = region_north - vehicle_north, region_east - vehicle_east
        pitch = math.atan2(region.altitude_m - pose.place.altitude_m, math.hypot(north, east))
        return (0.0, pitch, math.atan2(east, north))

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        """Turn to angles in radians. Yaw is relative to north if ``locked``, otherwise to the vehicle's nose."""
        self._begin(flags)
        self._target = angles
        self._is_locked = locked

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        """Turn at these rates in radians per second. The slew rate limits them."""
        current = self.angles_from_north() if locked else self.angles()
        self._begin(flags)
        limit = self.slew_rad_s
        roll, pitch, yaw = (max(-limit, min(limit, rate)) for rate in rates)
        self._target = current
        self._rates = (roll, pitch, yaw)
        self._is_locked = locked

    def look_at(self, place: Place | None) -> None:
        """Point at a position. None points ahead again."""
        self._begin(0)
        self.region = None if place is None else GlobalPoint(*place)

    def follow(self, system_id: int) -> None:
        """Point at another vehicle as soon as its position is received. Until then, keep the direction."""
        current = self.angles_from_north()
        self.point(current, Flags.YAW_LOCK, locked=True)
        self.followed = system_id

    def update_followed(self, system_id: int, place: Place) -> None:
        """Turn to the new position of a vehicle if it is the followed vehicle."""
        if system_id == self.followed:
            self._start_angles = self.angles()
            self._start_at = self.now
            self.region = GlobalPoint(*place)

    def _begin(self, flags: int) -> None:
        """Start a movement at the present angles, without a target."""
        self._start_angles = self.angles()
        self._start_at = self.now
        self._target = _ZERO
        self._rates = _ZERO
        self.region = None
        self.followed = 0
        self.flags = flags
        self._is_locked = False


def _clamped(angle: float, limits: tuple[float, float]) -> float:
    low, high = limits
    return max(low, min(high, angle))
