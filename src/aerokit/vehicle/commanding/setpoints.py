"""Guided set-points as values, and their encoding as messages.

https://mavlink.io/en/services/offboard_control.html
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_finite, check_range
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
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S
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

# Bits of POSITION_TARGET_TYPEMASK.
IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCELERATION = 0x007, 0x038, 0x1C0
IGNORE_YAW, IGNORE_YAW_RATE = 0x400, 0x800
VECTORS = {
    IGNORE_POSITION: ("north_m", "east_m", "down_m"),
    IGNORE_VELOCITY: ("north_m_s", "east_m_s", "down_m_s"),
    IGNORE_ACCELERATION: ("north_m_s2", "east_m_s2", "down_m_s2"),
}
"""Maps type-mask bits of SET_POSITION_TARGET_LOCAL_NED to the fields that they make the vehicle ignore."""
ZERO = (0.0, 0.0, 0.0)
# Bits of ATTITUDE_TARGET_TYPEMASK.
IGNORE_BODY_RATES, IGNORE_ATTITUDE = 0x07, 0x80
ACTUATORS_PER_GROUP, MAX_BODY_RATE_DEG_S = 8, 3600.0
# A standstill is no stall if the set-point is slower than SLOW_M_S, or nearer than MAX_RESTING_RADII arrival radii.
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

    ArduCopter in GUIDED reads ``thrust`` as climb rate: 0.5 holds the altitude. With bit 3 of GUID_OPTIONS, it reads
    ``thrust`` as collective thrust, as PX4 always does.
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
    """Position in metres from the estimator's origin, with velocity (m/s) and acceleration (m/s²) at this position.

    Velocity and acceleration are feed-forward terms: with them, the vehicle follows a moving position without lag.
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


LocalSetpoint = VelocitySetpoint | AccelerationSetpoint | LocalPositionSetpoint | TrajectorySetpoint


def wants_motion(setpoint: object, context: VehicleContext) -> bool:
    """Return True if a vehicle that follows this set-point must move now; False if unknown.

    Of a trajectory, only the velocity is considered.
    """
    if isinstance(setpoint, (VelocitySetpoint, TrajectorySetpoint)):
        return math.hypot(setpoint.north_m_s, setpoint.east_m_s, setpoint.down_m_s) >= SLOW_M_S
    if isinstance(setpoint, BodyVelocitySetpoint):
        return math.hypot(setpoint.forward_m_s, setpoint.right_m_s, setpoint.down_m_s) >= SLOW_M_S
    max_resting_m = MAX_RESTING_RADII * context.session.autopilot.arrival_radius_m
    if isinstance(setpoint, PositionSetpoint):
        distance_m = context.vehicle_position.distance_to(setpoint.position)  # infinite if the position is unknown
        return max_resting_m < distance_m < math.inf
    # Reading `local_position` decodes a message, so it is read only for the set-points that need it: this function is
    # called up to 400 times a second.
    if not isinstance(setpoint, LocalPositionSetpoint):
        return False
    here = context.session.telemetry.local_position.latest
    if here is None:
        return False
    north_m, east_m = setpoint.north_m - here.north_m, setpoint.east_m - here.east_m
    return math.hypot(north_m, east_m, setpoint.down_m - here.down_m) > max_resting_m


class SetpointEncoder:
    """Encodes set-points for one vehicle; raises InvalidArgument for invalid ones."""

    def __init__(self, context: VehicleContext) -> None:
        self._session, self._position = context.session, context.vehicle_position
        self._address = (self._session.system_id, self._session.component_id)

    def local(self, setpoint: LocalSetpoint, frame: int = MavFrame.LOCAL_NED) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with the vectors that the set-point has."""
        mask, yaw, yaw_rate = _encode_yaw(setpoint.yaw_deg, setpoint.yaw_rate_deg_s)
        vectors: list[tuple[float, float, float]] = []
        for ignore_bits, (north, east, down) in VECTORS.items():
            if hasattr(setpoint, north):
                vectors.append((getattr(setpoint, north), getattr(setpoint, east), getattr(setpoint, down)))
            else:  # The set-point does not have this vector, so the vehicle must ignore it.
                vectors.append(ZERO)
                mask |= ignore_bits
        position, velocity, acceleration = vectors
        vector_fields = (*position, *velocity, *acceleration)
        check_finite("set-point", *vector_fields)
        return SetPositionTargetLocalNed(self._time_ms(), *self._address, frame, mask, *vector_fields, yaw, yaw_rate)

    def body_velocity(self, setpoint: BodyVelocitySetpoint) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED with a velocity in MAV_FRAME_BODY_NED.

        In MAV_FRAME_BODY_NED, ArduPilot treats yaw as a turn from the previous target heading (ArduCopter) or from the
        present heading (Rover). A set-point with a heading is therefore converted to MAV_FRAME_LOCAL_NED by the
        reported heading. Raises StaleValueError if the reported heading is old, because the vehicle would then move in
        a wrong direction.
        """
        forward, right, frame = setpoint.forward_m_s, setpoint.right_m_s, MavFrame.BODY_NED
        if setpoint.yaw_deg is not None and self._session.autopilot.setpoints.body_yaw_is_relative:
            frame = MavFrame.LOCAL_NED
            heading = math.radians(self._session.telemetry.heading_deg.fresh(POSITION_MAX_AGE_S))
            forward, right = (
                forward * math.cos(heading) - right * math.sin(heading),
                forward * math.sin(heading) + right * math.cos(heading),
            )
        return self.local(
            VelocitySetpoint(forward, right, setpoint.down_m_s, setpoint.yaw_deg, setpoint.yaw_rate_deg_s), frame
        )

    def position(self, setpoint: PositionSetpoint, velocity: tuple[float, float, float] | None = None) -> Message:
        """Return SET_POSITION_TARGET_GLOBAL_INT, relative to home or above mean sea level.

        ``velocity`` is the velocity of a moving target position, in m/s north, east, down.
        """
        mask, yaw, yaw_rate = _encode_yaw(setpoint.yaw_deg, setpoint.yaw_rate_deg_s)
        mask |= IGNORE_ACCELERATION
        if velocity is None:
            mask |= IGNORE_VELOCITY
        latitude, longitude, altitude, frame = self._position.global_target(setpoint.position, "position")
        vectors = (*(velocity or ZERO), *ZERO)  # velocity and acceleration
        return SetPositionTargetGlobalInt(
            self._time_ms(), *self._address, frame, mask, latitude, longitude, altitude, *vectors, yaw, yaw_rate
        )

    def attitude(self, setpoint: AttitudeSetpoint) -> Message:
        """Return SET_ATTITUDE_TARGET with attitude and thrust."""
        check_finite("attitude", setpoint.roll_deg, setpoint.pitch_deg, setpoint.yaw_deg, setpoint.thrust)
        check_range("thrust", setpoint.thrust, 0, 1)
        quaternion = Attitude(setpoint.roll_deg, setpoint.pitch_deg, setpoint.yaw_deg).quaternion
        return SetAttitudeTarget(self._time_ms(), *self._address, IGNORE_BODY_RATES, quaternion, *ZERO, setpoint.thrust)

    def attitude_rate(self, setpoint: AttitudeRateSetpoint) -> Message:
        """Return SET_ATTITUDE_TARGET with body rates and thrust."""
        for name in ("roll_deg_s", "pitch_deg_s", "yaw_deg_s"):
            check_range(name, getattr(setpoint, name), -MAX_BODY_RATE_DEG_S, MAX_BODY_RATE_DEG_S)
        check_range("thrust", setpoint.thrust, 0, 1)
        no_rotation = (1.0, 0.0, 0.0, 0.0)  # The vehicle ignores the attitude.
        roll, pitch, yaw = map(math.radians, (setpoint.roll_deg_s, setpoint.pitch_deg_s, setpoint.yaw_deg_s))
        return SetAttitudeTarget(
            self._time_ms(), *self._address, IGNORE_ATTITUDE, no_rotation, roll, pitch, yaw, setpoint.thrust
        )

    def actuators(self, setpoint: ActuatorSetpoint) -> Message:
        """Return SET_ACTUATOR_CONTROL_TARGET."""
        check_range("group", setpoint.group, 0, 3)
        if len(setpoint.controls) != ACTUATORS_PER_GROUP:
            raise InvalidArgument(
                f"controls = {setpoint.controls!r} is not allowed: it must be {ACTUATORS_PER_GROUP} numbers"
            )
        for control in setpoint.controls:
            check_range("controls", control, -1, 1)
        return SetActuatorControlTarget(self._time_ms() * 1000, setpoint.group, *self._address, setpoint.controls)

    def _time_ms(self) -> int:
        return int(self._session.connection.now() * 1000) & 0xFFFFFFFF  # The field has 32 bits.


def _encode_yaw(yaw_deg: float | None, yaw_rate_deg_s: float | None) -> tuple[int, float, float]:
    """Return type-mask bits, yaw in radians and yaw rate in radians per second."""
    if yaw_deg is not None and yaw_rate_deg_s is not None:
        raise InvalidArgument(f"yaw_deg = {yaw_deg} and yaw_rate_deg_s = {yaw_rate_deg_s} are not allowed together")
    check_finite("yaw", yaw_deg or 0.0, yaw_rate_deg_s or 0.0)
    mask = 0
    if yaw_deg is None:
        mask |= IGNORE_YAW
    if yaw_rate_deg_s is None:
        mask |= IGNORE_YAW_RATE
    return mask, math.radians(yaw_deg or 0.0), math.radians(yaw_rate_deg_s or 0.0)
