"""Guided set-points as values, and their encoding as messages.

https://mavlink.io/en/services/offboard_control.html
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.messages import (
    SetActuatorControlTarget,
    SetAttitudeTarget,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.position import Position
from aerokit.vehicle.state.movement import Attitude

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = [
    "AccelerationSetpoint",
    "ActuatorSetpoint",
    "AttitudeRateSetpoint",
    "AttitudeSetpoint",
    "BodyVelocitySetpoint",
    "LocalPositionSetpoint",
    "PositionSetpoint",
    "SetpointEncoder",
    "TrajectorySetpoint",
    "VelocitySetpoint",
    "wants_motion",
]

IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCELERATION = 0x007, 0x038, 0x1C0
IGNORE_YAW, IGNORE_YAW_RATE = 0x400, 0x800
IGNORE_BODY_RATES, IGNORE_ATTITUDE = 0x07, 0x80
ACTUATORS_PER_GROUP, MAX_BODY_RATE_DEG_S = 8, 3600.0
# Below this speed, or within this many arrival radii, a vehicle that obeys may stand still.
SLOW_M_S, MAX_RESTING_RADII = 0.3, 2.0


class VelocitySetpoint(Snapshot):
    """Velocity over ground in m/s (north, east, down), with a heading (degrees) or a turn rate (degrees/s)."""

    north_m_s: float = 0.0
    east_m_s: float = 0.0
    down_m_s: float = 0.0
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


class BodyVelocitySetpoint(Snapshot):
    """Velocity in m/s in the body frame (forward, right, down), with a heading from north or a turn rate."""

    forward_m_s: float = 0.0
    right_m_s: float = 0.0
    down_m_s: float = 0.0
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


class AccelerationSetpoint(Snapshot):
    """Acceleration in m/s² (north, east, down), with a heading or a turn rate."""

    north_m_s2: float = 0.0
    east_m_s2: float = 0.0
    down_m_s2: float = 0.0
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


class LocalPositionSetpoint(Snapshot):
    """Position in metres north, east and down of the estimator's origin (``vehicle.origin``)."""

    north_m: float
    east_m: float
    down_m: float
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


class PositionSetpoint(Snapshot):
    """Global position; ``position`` has ``altitude_relative_m`` or ``altitude_amsl_m``."""

    position: Position
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


class AttitudeSetpoint(Snapshot):
    """Attitude in degrees and ``thrust`` from 0 to 1.

    ArduCopter reads ``thrust`` as climb rate in GUIDED unless GUID_OPTIONS selects thrust: 0.5 holds the altitude.
    PX4 reads it as collective thrust.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    thrust: float


class AttitudeRateSetpoint(Snapshot):
    """Body rates in degrees/s, at most 3600 in either direction, and ``thrust`` from 0 to 1.

    Positive rates roll to the right, pitch up and turn clockwise. ``thrust`` is as in :class:`AttitudeSetpoint`.
    """

    roll_deg_s: float = 0.0
    pitch_deg_s: float = 0.0
    yaw_deg_s: float = 0.0
    thrust: float = 0.5


class ActuatorSetpoint(Snapshot):
    """Eight normalized controls, −1 to 1, of one actuator control group (0 to 3) of PX4's old mixers."""

    controls: tuple[float, ...]
    group: int = 0


class TrajectorySetpoint(Snapshot):
    """Position in metres from the estimator's origin, with the velocity (m/s) and the acceleration (m/s²) there.

    Velocity and acceleration are feed-forward: with them the vehicle follows a moving position without lag.
    """

    north_m: float
    east_m: float
    down_m: float
    north_m_s: float = 0.0
    east_m_s: float = 0.0
    down_m_s: float = 0.0
    north_m_s2: float = 0.0
    east_m_s2: float = 0.0
    down_m_s2: float = 0.0
    yaw_deg: float | None = None
    yaw_rate_deg_s: float | None = None


def wants_motion(setpoint: object, context: VehicleContext) -> bool:
    """Return True if a vehicle that obeys this set-point must move now; False if unknown."""
    if isinstance(setpoint, (VelocitySetpoint, TrajectorySetpoint)):
        return math.hypot(setpoint.north_m_s, setpoint.east_m_s, setpoint.down_m_s) >= SLOW_M_S
    if isinstance(setpoint, BodyVelocitySetpoint):
        return math.hypot(setpoint.forward_m_s, setpoint.right_m_s, setpoint.down_m_s) >= SLOW_M_S
    far_m = MAX_RESTING_RADII * context.session.autopilot.arrival_radius_m
    if isinstance(setpoint, PositionSetpoint):
        return far_m < context.vehicle_position.distance_to(setpoint.position) < math.inf
    here = context.session.telemetry.local_position.latest
    if isinstance(setpoint, LocalPositionSetpoint) and here is not None:
        to_go = (
            setpoint.north_m - here.north_m,
            setpoint.east_m - here.east_m,
            setpoint.down_m - here.down_m,
        )
        return math.hypot(*to_go) > far_m
    return False


class SetpointEncoder:
    """Encodes set-points for one vehicle; raises InvalidArgument for invalid ones."""

    def __init__(self, context: VehicleContext) -> None:
        self._session, self._position = context.session, context.vehicle_position

    def velocity(self, s: VelocitySetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with a velocity in MAV_FRAME_LOCAL_NED."""
        vector = (s.north_m_s, s.east_m_s, s.down_m_s)
        return self._local(MavFrame.LOCAL_NED, IGNORE_VELOCITY, vector, s.yaw_deg, s.yaw_rate_deg_s)

    def body_velocity(self, s: BodyVelocitySetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with a velocity in MAV_FRAME_BODY_NED.

        With a heading for ArduPilot it is converted to MAV_FRAME_LOCAL_NED by the present heading: in
        MAV_FRAME_BODY_NED ArduPilot adds each yaw to the previous target, and correcting that by telemetry
        oscillates.
        """
        vector = (s.forward_m_s, s.right_m_s, s.down_m_s)
        if s.yaw_deg is None or not self._session.autopilot.setpoints.body_yaw_is_relative:
            return self._local(MavFrame.BODY_NED, IGNORE_VELOCITY, vector, s.yaw_deg, s.yaw_rate_deg_s)
        heading = math.radians(self._session.telemetry.heading_deg.value)
        north = s.forward_m_s * math.cos(heading) - s.right_m_s * math.sin(heading)
        east = s.forward_m_s * math.sin(heading) + s.right_m_s * math.cos(heading)
        vector = (north, east, s.down_m_s)
        return self._local(MavFrame.LOCAL_NED, IGNORE_VELOCITY, vector, s.yaw_deg, s.yaw_rate_deg_s)

    def acceleration(self, s: AccelerationSetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with an acceleration in MAV_FRAME_LOCAL_NED."""
        vector = (s.north_m_s2, s.east_m_s2, s.down_m_s2)
        return self._local(MavFrame.LOCAL_NED, IGNORE_ACCELERATION, vector, s.yaw_deg, s.yaw_rate_deg_s)

    def local_position(self, s: LocalPositionSetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with a position in MAV_FRAME_LOCAL_NED."""
        vector = (s.north_m, s.east_m, s.down_m)
        return self._local(MavFrame.LOCAL_NED, IGNORE_POSITION, vector, s.yaw_deg, s.yaw_rate_deg_s)

    def trajectory(self, s: TrajectorySetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with position, velocity and acceleration in MAV_FRAME_LOCAL_NED."""
        vectors = (
            *(s.north_m, s.east_m, s.down_m),
            *(s.north_m_s, s.east_m_s, s.down_m_s),
            *(s.north_m_s2, s.east_m_s2, s.down_m_s2),
        )
        _check_finite("set-point", *vectors)
        mask, yaw, yaw_rate = _yaw(s.yaw_deg, s.yaw_rate_deg_s)
        address = (self._session.system_id, self._session.component_id)
        return SetPositionTargetLocalNed(self._time_ms(), *address, MavFrame.LOCAL_NED, mask, *vectors, yaw, yaw_rate)

    def _local(
        self,
        frame: int,
        group: int,
        vector: tuple[float, float, float],
        yaw_deg: float | None,
        yaw_rate_deg_s: float | None,
    ) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED whose only vector is the one of ``group``."""
        _check_finite("set-point", *vector)
        everything = IGNORE_POSITION | IGNORE_VELOCITY | IGNORE_ACCELERATION
        mask, yaw, yaw_rate = _yaw(yaw_deg, yaw_rate_deg_s)
        none = (0.0, 0.0, 0.0)
        vectors = [vector if group == name else none for name in _GROUPS]
        return SetPositionTargetLocalNed(
            self._time_ms(),
            self._session.system_id,
            self._session.component_id,
            frame,
            (everything & ~group) | mask,
            *vectors[0],
            *vectors[1],
            *vectors[2],
            yaw,
            yaw_rate,
        )

    def position(self, s: PositionSetpoint) -> Message:
        """Return SET_POSITION_TARGET_GLOBAL_INT, relative to home or above mean sea level."""
        mask, yaw, yaw_rate = _yaw(s.yaw_deg, s.yaw_rate_deg_s)
        latitude, longitude, altitude, is_relative = self._position.global_target(s.position)
        return SetPositionTargetGlobalInt(
            self._time_ms(),
            self._session.system_id,
            self._session.component_id,
            MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT,
            IGNORE_VELOCITY | IGNORE_ACCELERATION | mask,
            latitude,
            longitude,
            altitude,
            *(0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0),
            yaw,
            yaw_rate,
        )

    def attitude(self, s: AttitudeSetpoint) -> Message:
        """Return SET_ATTITUDE_TARGET with attitude and thrust."""
        _check_finite("attitude", s.roll_deg, s.pitch_deg, s.yaw_deg, s.thrust)
        check_range("thrust", s.thrust, 0, 1)
        return SetAttitudeTarget(
            self._time_ms(),
            self._session.system_id,
            self._session.component_id,
            IGNORE_BODY_RATES,
            Attitude(s.roll_deg, s.pitch_deg, s.yaw_deg).quaternion,
            0.0,
            0.0,
            0.0,
            s.thrust,
        )

    def attitude_rate(self, s: AttitudeRateSetpoint) -> Message:
        """Return SET_ATTITUDE_TARGET with body rates and thrust."""
        rates = (s.roll_deg_s, s.pitch_deg_s, s.yaw_deg_s)
        for name, rate in zip(("roll_deg_s", "pitch_deg_s", "yaw_deg_s"), rates, strict=True):
            check_range(name, rate, -MAX_BODY_RATE_DEG_S, MAX_BODY_RATE_DEG_S)
        check_range("thrust", s.thrust, 0, 1)
        return SetAttitudeTarget(
            self._time_ms(),
            self._session.system_id,
            self._session.component_id,
            IGNORE_ATTITUDE,
            (1.0, 0.0, 0.0, 0.0),
            math.radians(s.roll_deg_s),
            math.radians(s.pitch_deg_s),
            math.radians(s.yaw_deg_s),
            s.thrust,
        )

    def actuators(self, s: ActuatorSetpoint) -> Message:
        """Return SET_ACTUATOR_CONTROL_TARGET."""
        check_range("group", s.group, 0, 3)
        if len(s.controls) != ACTUATORS_PER_GROUP:
            raise InvalidArgument(f"controls = {s.controls!r} is not allowed: {ACTUATORS_PER_GROUP} numbers")
        for control in s.controls:
            check_range("controls", control, -1, 1)
        return SetActuatorControlTarget(
            self._time_ms() * 1000, s.group, self._session.system_id, self._session.component_id, s.controls
        )

    def _time_ms(self) -> int:
        return int(self._session.connection.now() * 1000) & 0xFFFFFFFF


_GROUPS = (IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCELERATION)


def _yaw(yaw_deg: float | None, yaw_rate_deg_s: float | None) -> tuple[int, float, float]:
    """Return type-mask bits, yaw in radians and yaw rate in radians per second."""
    if yaw_deg is not None and yaw_rate_deg_s is not None:
        raise InvalidArgument(f"yaw_deg = {yaw_deg} and yaw_rate_deg_s = {yaw_rate_deg_s} are not allowed together")
    _check_finite("yaw", yaw_deg or 0.0, yaw_rate_deg_s or 0.0)
    mask = (IGNORE_YAW if yaw_deg is None else 0) | (IGNORE_YAW_RATE if yaw_rate_deg_s is None else 0)
    return mask, math.radians(yaw_deg or 0.0), math.radians(yaw_rate_deg_s or 0.0)


def _check_finite(what: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value):
            raise InvalidArgument(f"{what}: {value!r} is not a finite number")
