"""``MeasurementEncoder``: encodes measurements as the messages that the autopilot reads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_finite, check_range
from aerokit.errors import InvalidArgument, ValueUnknownError
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GpsInputIgnoreFlags, MavFrame
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S
from aerokit.vehicle.external.values import Quaternion, RangeDirection, Vector
from aerokit.vehicle.state.movement import Attitude

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.external import values as v
    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["MeasurementEncoder"]

NAN = math.nan
UNKNOWN_VECTOR: Vector = (NAN, NAN, NAN)
# Indexes of the diagonal in the upper triangle of a 6x6 covariance matrix, row by row.
POSITION_DIAGONAL, ORIENTATION_DIAGONAL, TRIANGLE_SIZE = (0, 6, 11), (15, 18, 20), 21
MAX_SECTORS, UNKNOWN_DISTANCE = 72, 0xFFFF
MAX_CENTIMETRES = 0xFFFE
# GPS time began on 1980-01-06 and is 18 leap seconds ahead of UTC since 2017.
GPS_EPOCH_S, LEAP_SECONDS, SECONDS_PER_WEEK = 315_964_800, 18, 604_800
GPS_NUMBERS = ("hdop", "vdop", "horizontal_accuracy_m", "vertical_accuracy_m", "speed_accuracy_m_s", "yaw_deg")
# MAV_SENSOR_ORIENTATION.
ORIENTATIONS: dict[RangeDirection, int] = {"forward": 0, "right": 2, "back": 4, "left": 6, "up": 24, "down": 25}
# MAV_ESTIMATOR_TYPE, MAV_DISTANCE_SENSOR, and the covariance of DISTANCE_SENSOR that means "unknown".
VISION, LASER, NO_COVARIANCE = 2, 0, 255
# Rotations between the axes of ROS (east, north, up; forward, left, up) and those of MAVLink.
HALF = math.sqrt(0.5)
ENU_TO_NED: Quaternion = (0.0, HALF, HALF, 0.0)
FLU_TO_FRD: Quaternion = (0.0, 1.0, 0.0, 0.0)


class MeasurementEncoder:
    """Encodes measurements for one vehicle: each method returns the messages of one measurement.

    A measurement that is out of range raises InvalidArgument. Time stamps are those of the event loop's clock; by
    `TimesyncAnswers` PX4 can convert them to its own clock.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session

    def odometry(self, value: v.OdometryMeasurement) -> tuple[Message, ...]:
        """Return ODOMETRY in a frame that the autopilot reads."""
        check_range("quality", value.quality, -1, 100)
        given = value.orientation
        q = given.quaternion if isinstance(given, Attitude) else given
        position, velocity = value.position_m, value.velocity_m_s
        check_finite("position_m", *position)
        check_finite("orientation", *q)
        if velocity is not None:
            check_finite("velocity_m_s", *velocity)
        is_north = value.frame in ("ned", "enu")
        if value.frame in ("enu", "flu"):
            q = multiply(multiply(ENU_TO_NED if is_north else FLU_TO_FRD, q), FLU_TO_FRD)
            forward, left, up = position
            position = (left, forward, -up) if is_north else (forward, -left, -up)
            velocity = None if velocity is None else (velocity[0], -velocity[1], -velocity[2])
        frame = self._session.autopilot.external.ned_frame if is_north else MavFrame.LOCAL_FRD
        return (
            m.Odometry(
                self._time_us(value.measured_at),
                frame,
                MavFrame.BODY_FRD,
                *position,
                _normalized(q),
                *(UNKNOWN_VECTOR if velocity is None else velocity),
                *UNKNOWN_VECTOR,
                _triangle(value.position_variance_m2, value.orientation_variance_rad2),
                _triangle(value.velocity_variance_m2_s2, None),
                _reset_counter(value.reset_counter),
                VISION,
                value.quality,
            ),
        )

    def vision_position(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        """Return VISION_POSITION_ESTIMATE."""
        time, place, covariance = self._pose(value)
        attitude, count = value.attitude, _reset_counter(value.reset_counter)
        roll, pitch, yaw = map(math.radians, (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg))
        return (m.VisionPositionEstimate(time, *place, roll, pitch, yaw, covariance, count),)

    def motion_capture(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        """Return ATT_POS_MOCAP, or VISION_POSITION_ESTIMATE for an autopilot that does not read ATT_POS_MOCAP."""
        if not self._session.autopilot.external.has_mocap:
            return self.vision_position(value)
        time, place, covariance = self._pose(value)
        return (m.AttPosMocap(time, value.attitude.quaternion, *place, covariance),)

    def _pose(self, value: v.PoseMeasurement) -> tuple[int, Vector, list[float]]:
        """Check a pose; return its time stamp, place and covariance."""
        place = (value.north_m, value.east_m, value.down_m)
        check_finite("position", *place)
        check_finite("attitude", value.attitude.roll_deg, value.attitude.pitch_deg, value.attitude.yaw_deg)
        covariance = _triangle(value.position_variance_m2, value.orientation_variance_rad2)
        return self._time_us(value.measured_at), place, covariance

    def vision_speed(self, value: v.SpeedMeasurement) -> tuple[Message, ...]:
        """Return VISION_SPEED_ESTIMATE, or ODOMETRY without a pose for an autopilot that does not read it."""
        speeds = (value.north_m_s, value.east_m_s, value.down_m_s)
        check_finite("velocity", *speeds)
        time, count = self._time_us(value.measured_at), _reset_counter(value.reset_counter)
        variance = value.variance_m2_s2
        if self._session.autopilot.external.has_vision_speed:
            _check_variance(variance)
            covariance = [NAN] * 9 if variance is None else [variance, 0, 0, 0, variance, 0, 0, 0, variance]
            return (m.VisionSpeedEstimate(time, *speeds, covariance, count),)
        ned, unknown = MavFrame.LOCAL_NED, _triangle(None, None)
        pose = (*UNKNOWN_VECTOR, (NAN,) * 4)
        known = _triangle(variance, None)
        return (m.Odometry(time, ned, ned, *pose, *speeds, *UNKNOWN_VECTOR, unknown, known, count, VISION, 100),)

    def gps(self, value: v.GpsMeasurement) -> tuple[Message, ...]:
        """Return GPS_INPUT."""
        for name, limit in (("latitude_deg", 90), ("longitude_deg", 180)):
            check_range(name, getattr(value, name), -limit, limit)
        check_finite("altitude_amsl_m", value.altitude_amsl_m)
        for name in GPS_NUMBERS:
            check_finite(name, getattr(value, name) or 0.0)
        check_finite("velocity_m_s", *(value.velocity_m_s or ()))
        check_range("fix", value.fix, 0, 8)
        check_range("satellites", value.satellites, 0, 255)
        check_range("instance", value.instance, 0, 255)
        ignored = GpsInputIgnoreFlags
        optional = (
            (value.hdop, ignored.HDOP),
            (value.vdop, ignored.VDOP),
            (value.velocity_m_s, ignored.VEL_HORIZ | ignored.VEL_VERT),
            (value.speed_accuracy_m_s, ignored.SPEED_ACCURACY),
            (value.horizontal_accuracy_m, ignored.HORIZONTAL_ACCURACY),
            (value.vertical_accuracy_m, ignored.VERTICAL_ACCURACY),
        )
        flags = sum(flag for known, flag in optional if known is None)
        week, week_ms = _gps_time(value.unix_time_s)
        return (
            m.GpsInput(
                self._time_us(value.measured_at),
                value.instance,
                flags,
                week_ms,
                week,
                value.fix,
                round(value.latitude_deg * 1e7),
                round(value.longitude_deg * 1e7),
                value.altitude_amsl_m,
                value.hdop or 0.0,
                value.vdop or 0.0,
                *(value.velocity_m_s or (0.0, 0.0, 0.0)),
                value.speed_accuracy_m_s or 0.0,
                value.horizontal_accuracy_m or 0.0,
                value.vertical_accuracy_m or 0.0,
                value.satellites,
                0 if value.yaw_deg is None else round(value.yaw_deg % 360 * 100) or 36000,  # 0 is "no heading"
            ),
        )

    def obstacles(self, value: v.ObstacleSectors) -> tuple[Message, ...]:
        """Return OBSTACLE_DISTANCE with angles from the vehicle's nose."""
        check_range("step_deg", value.step_deg, 0, 360, above=True)
        check_range("first_deg", value.first_deg, -360, 360)
        count = len(value.distances_m)
        if not 1 <= count <= MAX_SECTORS:
            raise InvalidArgument(f"distances_m has {count} distances; allowed: 1 to {MAX_SECTORS}")
        low, high = _centimetres("min_m", value.min_m), _centimetres("max_m", value.max_m)
        distances = [UNKNOWN_DISTANCE] * MAX_SECTORS
        for index, distance in enumerate(value.distances_m):
            if distance is not None:
                is_free = distance > value.max_m
                distances[index] = high + 1 if is_free else _centimetres("distances_m", distance)
        time, step = self._time_us(value.measured_at), value.step_deg
        return (m.ObstacleDistance(time, LASER, distances, 0, low, high, step, value.first_deg, MavFrame.BODY_FRD),)

    def obstacle_points(self, value: v.ObstaclePoints) -> tuple[Message, ...]:
        """Return one OBSTACLE_DISTANCE_3D for each point, all with the same time stamp."""
        check_range("min_m", value.min_m, 0, 1e5)
        check_range("max_m", value.max_m, 0, 1e5, above=True)
        time = self._time_us(value.measured_at) // 1000 & 0xFFFFFFFF
        for point in value.points_m:
            check_finite("points_m", *point)
        return tuple(
            m.ObstacleDistance3d(time, LASER, MavFrame.BODY_FRD, UNKNOWN_DISTANCE, *point, value.min_m, value.max_m)
            for point in value.points_m
        )

    def range_finder(self, value: v.RangeMeasurement) -> tuple[Message, ...]:
        """Return DISTANCE_SENSOR."""
        if value.direction not in ORIENTATIONS:
            raise InvalidArgument(f"direction = {value.direction!r} is not allowed: one of {', '.join(ORIENTATIONS)}")
        if value.quality is not None:
            check_range("quality", value.quality, 1, 100)
        _check_variance(value.variance_m2)
        low, high = _centimetres("min_m", value.min_m), _centimetres("max_m", value.max_m)
        distance = _centimetres("distance_m", value.distance_m)
        variance = NO_COVARIANCE
        if value.variance_m2 is not None:
            variance = min(NO_COVARIANCE - 1, round(value.variance_m2 * 1e4))
        time = self._time_us(value.measured_at) // 1000 & 0xFFFFFFFF
        place = (ORIENTATIONS[value.direction], variance)
        return (m.DistanceSensor(time, low, high, distance, LASER, 0, *place, signal_quality=value.quality or 0),)

    def landing_target(self, value: v.TargetMeasurement) -> tuple[Message, ...]:
        """Return LANDING_TARGET relative to the vehicle, or converted to the local frame for PX4."""
        offset = (value.forward_m, value.right_m, value.down_m)
        check_finite("target", *offset)
        check_range("number", value.number, 0, 255)
        distance = math.hypot(*offset)
        if not distance > 0:
            raise InvalidArgument("the distance of the target is 0; it must be above 0")
        frame = MavFrame.LOCAL_FRD if value.is_level else MavFrame.BODY_FRD
        if self._session.autopilot.external.target_is_local:
            frame, offset = MavFrame.LOCAL_NED, self._in_local_frame(offset, is_level=value.is_level)
        time, no_size = self._time_us(value.measured_at), (0.0, 0.0)
        angles = (math.atan2(value.right_m, value.down_m), -math.atan2(value.forward_m, value.down_m))
        q = (1.0, 0.0, 0.0, 0.0)
        return (m.LandingTarget(time, value.number, frame, *angles, distance, *no_size, *offset, q, 2, 1),)

    def optical_flow(self, value: v.FlowMeasurement) -> tuple[Message, ...]:
        """Return OPTICAL_FLOW_RAD for PX4, or OPTICAL_FLOW scaled as ArduPilot reads it."""
        check_finite("flow", value.x_rad, value.y_rad, *(value.gyro_rad or ()))
        check_range("interval_s", value.interval_s, 0, 10, above=True)
        check_range("quality", value.quality, 0, 255)
        time = self._time_us(value.measured_at)
        distance = -1.0 if value.distance_m is None else value.distance_m
        check_finite("distance_m", distance)
        if self._session.autopilot.external.flow_in_radians:
            gyro = UNKNOWN_VECTOR if value.gyro_rad is None else value.gyro_rad
            interval_us = round(value.interval_s * 1e6)
            flow = (value.x_rad, value.y_rad, *gyro)
            return (m.OpticalFlowRad(time, 0, interval_us, *flow, 0, value.quality, 0, distance),)
        # ArduPilot multiplies flow_x by the interval between messages to get rad/s (AP_OpticalFlow_MAV.cpp).
        x, y = (round(angle / value.interval_s**2) for angle in (value.x_rad, value.y_rad))
        for name, count in (("x_rad", x), ("y_rad", y)):
            check_range(name, count, -0x8000, 0x7FFF)
        rates = (value.x_rad / value.interval_s, value.y_rad / value.interval_s)
        return (m.OpticalFlow(time, 0, x, y, 0.0, 0.0, value.quality, distance, *rates),)

    def _in_local_frame(self, offset: Vector, *, is_level: bool) -> Vector:
        telemetry = self._session.telemetry
        if max(telemetry.attitude.age, telemetry.local_position.age) > POSITION_MAX_AGE_S:
            raise ValueUnknownError("landing target: the vehicle's attitude or local position is unknown, or too old")
        attitude, here = telemetry.attitude.value, telemetry.local_position.value
        if is_level:
            attitude = Attitude(0.0, 0.0, attitude.yaw_deg)
        north, east, down = rotate(attitude.quaternion, offset)
        return (here.north_m + north, here.east_m + east, here.down_m + down)

    def _time_us(self, measured_at: float | None) -> int:
        now = self._session.connection.now()
        stamp = now if measured_at is None else measured_at
        check_range("measured_at", stamp, 0, now)
        return int(stamp * 1e6)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product of two quaternions (w, x, y, z)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(q: Quaternion, vector: Vector) -> Vector:
    """Return a vector rotated by a unit quaternion."""
    conjugate = (q[0], -q[1], -q[2], -q[3])
    _, x, y, z = multiply(multiply(q, (0.0, *vector)), conjugate)
    return (x, y, z)


def _normalized(q: Quaternion) -> Quaternion:
    size = math.hypot(*q)
    if not 0.9 < size < 1.1:
        raise InvalidArgument(f"orientation = {q!r} is not allowed: a quaternion (w, x, y, z) of length 1")
    sign = -1.0 if q[0] < 0 else 1.0
    return (sign * q[0] / size, sign * q[1] / size, sign * q[2] / size, sign * q[3] / size)


def _triangle(first: float | None, second: float | None) -> list[float]:
    """Return the upper triangle of a 6x6 covariance matrix with two variances, each three times on its diagonal.

    An unknown first variance is sent as NaN. An unknown second variance is sent as 0: both autopilots then use the
    minimum in their parameters, and ArduPilot does not accept NaN there.
    """
    _check_variance(first)
    _check_variance(second)
    values = [0.0] * TRIANGLE_SIZE
    for places, variance in ((POSITION_DIAGONAL, first), (ORIENTATION_DIAGONAL, second)):
        for place in places:
            values[place] = variance or 0.0
    if first is None:
        values[0] = NAN
    return values


def _check_variance(variance: float | None) -> None:
    if variance is not None:
        check_range("variance", variance, 0, 1e6)


def _reset_counter(count: int) -> int:
    check_range("reset_counter", count, 0, 255)
    return count


def _centimetres(name: str, metres: float) -> int:
    check_range(name, metres, 0, MAX_CENTIMETRES / 100)
    return round(metres * 100)


def _gps_time(unix_time_s: float | None) -> tuple[int, int]:
    if unix_time_s is None:
        return 0, 0
    check_range("unix_time_s", unix_time_s, GPS_EPOCH_S, GPS_EPOCH_S + 65535 * SECONDS_PER_WEEK)
    week, seconds = divmod(unix_time_s - GPS_EPOCH_S + LEAP_SECONDS, SECONDS_PER_WEEK)
    return int(week), int(seconds * 1000)
