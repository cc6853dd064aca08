"""The gimbal of a simulated PX4 on its AUX outputs (MNT_MODE_OUT 0), with its manager; MNT_MODE_IN 0 or 4 fits it.

Servos tell nothing: what the vehicle tells is the set-point, at once. It obeys only who is in control, but a region of
interest whoever orders it; it knows no secondary control, no retracted position, and no GIMBAL_MANAGER_SET_PITCHYAW. On
the way home it takes control itself for a moment and turns to neutral.
"""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalDeviceFlags, GimbalManagerCapFlags
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.sim.channel import Channel
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.modes import RTL
from aerokit.sim.vehicle import sender_of

_FITTED_BY = frozenset({0, 4})
"""MNT_MODE_IN: the radio and MAVLink, MAVLink alone."""
_DEVICE_ID = 1
_LIMITS = ((-45.0, 45.0), (-45.0, 45.0), (-180.0, 180.0))
_TAU_S, _STEP_S = 0.3, 0.0187
_SLOWED = _STEP_S / (_TAU_S + _STEP_S)
"""It filters the angle that it integrates, and so turns slower than it is told."""
_RATES_END_S = 2.0
_LOOKS_S = 0.25
_Can = GimbalManagerCapFlags
_CAPABILITIES = (
    _Can.HAS_NEUTRAL | _Can.HAS_ROLL_LOCK | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_LOCK | _Can.CAN_POINT_LOCATION_GLOBAL
)  # fmt: skip
Angles = tuple[float, float, float]
_AHEAD: Angles = (0.0, 0.0, 0.0)


class Gimbal:
    """Set-point, and who is in control."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.in_control: tuple[int, int] = (0, 0)
        """System and component id; zeros are nobody."""
        self._target, self._rates, self._since = _AHEAD, _AHEAD, 0.0
        self._flags = 0
        self._place: tuple[int, int, float] | None = None
        self._was_going_home = False
        self.is_fitted: bool = False
        """Whether there is one, as MNT_MODE_IN said when it was switched on."""
        px4.on(m.GimbalManagerSetAttitude, self._on_attitude)

    def start(self) -> None:
        """The power comes on: it looks ahead, and nobody is in control."""
        parameters = self._px4.parameters
        self.is_fitted = "MNT_MODE_IN" in parameters and parameters["MNT_MODE_IN"] in _FITTED_BY
        self.rest()
        self.in_control = (0, 0)
        if self.is_fitted:
            self._px4.every(_LOOKS_S, self._look_home)

    @property
    def own_ids(self) -> tuple[int, int]:
        """System and component id of the vehicle."""
        return self._px4.system_id, self._px4.component_id

    @property
    def is_from_north(self) -> bool:
        return self._place is not None or bool(self._flags & Flags.YAW_LOCK)

    @property
    def flags(self) -> int:
        """GIMBAL_DEVICE_FLAGS."""
        locks = self._flags & (Flags.ROLL_LOCK | Flags.PITCH_LOCK)
        return locks | (
            GimbalDeviceFlags.YAW_LOCK if self.is_from_north else GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME
        )

    def angles(self) -> Angles:
        """Roll, pitch and yaw of the set-point in radians."""
        if self._place is not None:
            return self._towards(self._place)
        seconds = min(self._px4.now - self._since, _RATES_END_S) * _SLOWED
        moved = [angle + rate * seconds for angle, rate in zip(self._target, self._rates, strict=True)]
        limited = [
            max(math.radians(low), min(math.radians(high), angle))
            for angle, (low, high) in zip(moved, _LIMITS, strict=True)
        ]
        return (limited[0], limited[1], limited[2])

    def _towards(self, place: tuple[int, int, float]) -> Angles:
        north, east = self._px4.frame.to_local(place[0], place[1])
        motion = self._px4.motion
        north, east = north - motion.north, east - motion.east
        here = self._px4.frame.to_global(*motion.place)
        pitch = math.atan2(place[2] - here.altitude_m, math.hypot(north, east))
        return (0.0, max(math.radians(_LIMITS[1][0]), pitch), math.atan2(east, north))

    def obey(self, flags: int, angles: Angles, rates: Angles) -> None:
        """Angles if there are any, and rates besides; an order to retract is taken, and nothing done."""
        if flags & Flags.RETRACT:
            return
        here = self.angles()
        if flags & Flags.NEUTRAL:
            self.rest()
            return
        self._place, self._flags, self._since = None, flags, self._px4.now
        self._target = here if any(map(math.isnan, angles)) else angles
        roll, pitch, yaw = (0.0 if math.isnan(rate) else rate for rate in rates)
        self._rates = (roll, pitch, yaw)

    def rest(self) -> None:
        self._place, self._flags, self._target, self._rates = None, 0, _AHEAD, _AHEAD

    def look_at(self, latitude_e7: int, longitude_e7: int, altitude_m: float) -> None:
        """Keep pointing at a place, above the sea."""
        self._place = (latitude_e7, longitude_e7, altitude_m)

    def _look_home(self) -> None:
        is_going_home = self._px4.mode == RTL
        if is_going_home and not self._was_going_home:
            self.rest()
            self.in_control = (0, 0)  # it was PX4's own for a moment
        self._was_going_home = is_going_home

    def _on_attitude(self, order: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if not self.is_fitted or sender_of(order) != self.in_control:
            return
        has_angles = not any(map(math.isnan, order.q))
        angles = euler_from_quaternion(*order.q) if has_angles else (math.nan,) * 3
        rates = (order.angular_velocity_x, order.angular_velocity_y, order.angular_velocity_z)
        self.obey(order.flags, (angles[0], angles[1], angles[2]), rates)

    def attitude_status(self) -> m.GimbalDeviceAttitudeStatus | None:
        if not self.is_fitted:
            return None
        q = quaternion_from_euler(*self.angles())
        return m.GimbalDeviceAttitudeStatus(
            0, 0, self._px4.time_boot_ms, self.flags, q, 0.0, 0.0, 0.0, 0, 0.0, 0.0, _DEVICE_ID
        )

    def manager_information(self) -> m.GimbalManagerInformation | None:
        if not self.is_fitted:
            return None
        limits = [math.radians(end) for axis in _LIMITS for end in axis]
        return m.GimbalManagerInformation(self._px4.time_boot_ms, _CAPABILITIES, _DEVICE_ID, *limits)

    def manager_status(self) -> m.GimbalManagerStatus | None:
        if not self.is_fitted:
            return None
        return m.GimbalManagerStatus(self._px4.time_boot_ms, self.flags, _DEVICE_ID, *self.in_control, 0, 0)
