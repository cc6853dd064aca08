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
# Indexes of the diagonal elements in the upper triangle of a 6x6 matrix, row by row, and the number of its elements.
POSITION_DIAGONAL, ORIENTATION_DIAGONAL, TRIANGLE_SIZE = (0, 6, 11), (15, 18, 20), 21
MAX_SECTORS, UNKNOWN_DISTANCE, UNKNOWN_OBSTACLE_ID = 72, 0xFFFF, 0xFFFF
MAX_CENTIMETRES = 0xFFFE
# GPS time began on 1980-01-06 and is 18 leap seconds ahead of UTC since 2017.
GPS_EPOCH_S, LEAP_SECONDS, SECONDS_PER_WEEK = 315_964_800, 18, 604_800
GPS_NUMBERS = ("hdop", "vdop", "horizontal_accuracy_m", "vertical_accuracy_m", "speed_accuracy_m_s", "yaw_deg")
# Maps each direction to its MAV_SENSOR_ORIENTATION.
ORIENTATIONS: dict[RangeDirection, int] = {"forward": 0, "right": 2, "back": 4, "left": 6, "up": 24, "down": 25}
# The MAV_ESTIMATOR_TYPE of vision, the MAV_DISTANCE_SENSOR of a laser, and the covariance in DISTANCE_SENSOR that means
# "unknown".
VISION, LASER, UNKNOWN_COVARIANCE = 2, 0, 255
LANDING_TARGET_TYPE_VISION_FIDUCIAL = 2
# Rotations between the axes of ROS (east, north, up; forward, left, up) and the axes of MAVLink.
SQRT_HALF = math.sqrt(0.5)
ENU_TO_NED: Quaternion = (0.0, SQRT_HALF, SQRT_HALF, 0.0)
FLU_TO_FRD: Quaternion = (0.0, 1.0, 0.0, 0.0)


class MeasurementEncoder:
    """Encodes measurements for one vehicle: each method returns the messages of one measurement.

    A measurement that is out of range raises InvalidArgument. Time stamps are on the event loop's clock. PX4 converts
    them to its own clock by the answers of `TimesyncAnswers`.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session

    def odometry(self, value: v.OdometryMeasurement) -> tuple[Message, ...]:
        """Return ODOMETRY, converted from the axes of ROS to those of MAVLink if necessary."""
        check_range("quality", value.quality, -1, 100)
        orientation = value.orientation
        quaternion = orientation.quaternion if isinstance(orientation, Attitude) else orientation
        position, velocity = value.position_m, value.velocity_m_s
        check_finite("position_m", *position)
        check_finite("orientation", *quaternion)
        if velocity is not None:
            check_finite("velocity_m_s", *velocity)
        is_earth_frame = value.frame in ("ned", "enu")
        if value.frame in ("enu", "flu"):  # the axes of ROS
            # The axes of the frame and the axes of the body are both converted.
            to_mavlink = ENU_TO_NED if is_earth_frame else FLU_TO_FRD
            quaternion = multiply(multiply(to_mavlink, quaternion), FLU_TO_FRD)
            x, y, up = position  # x and y are east and north in "enu", forward and left in "flu".
            position = (y, x, -up) if is_earth_frame else (x, -y, -up)
            if velocity is not None:  # The velocity is along the axes of the body in every frame.
                forward, left, upward = velocity
                velocity = (forward, -left, -upward)
        frame = self._session.autopilot.external.ned_frame if is_earth_frame else MavFrame.LOCAL_FRD
        return (
            m.Odometry(
                self._time_us(value.measured_at),
                frame,
                MavFrame.BODY_FRD,
                *position,
                _normalized(quaternion),
                *(UNKNOWN_VECTOR if velocity is None else velocity),
                *UNKNOWN_VECTOR,  # turn rates
                _triangle(value.position_variance_m2, value.orientation_variance_rad2),
                _triangle(value.velocity_variance_m2_s2, None),
                _reset_counter(value.reset_counter),
                VISION,
                value.quality,
            ),
        )

    def vision_position(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        """Return VISION_POSITION_ESTIMATE."""
        time_us, position, covariance = self._pose(value)
        attitude, reset_count = value.attitude, _reset_counter(value.reset_counter)
        roll, pitch, yaw = map(math.radians, (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg))
        return (m.VisionPositionEstimate(time_us, *position, roll, pitch, yaw, covariance, reset_count),)

    def motion_capture(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        """Return ATT_POS_MOCAP, or VISION_POSITION_ESTIMATE for an autopilot that does not read ATT_POS_MOCAP."""
        if not self._session.autopilot.external.has_mocap:
            return self.vision_position(value)
        time_us, position, covariance = self._pose(value)
        return (m.AttPosMocap(time_us, value.attitude.quaternion, *position, covariance),)

    def _pose(self, value: v.PoseMeasurement) -> tuple[int, Vector, list[float]]:
        """Check a pose; return its time stamp, its position and its covariance."""
        position = (value.north_m, value.east_m, value.down_m)
        check_finite("position", *position)
        check_finite("attitude", value.attitude.roll_deg, value.attitude.pitch_deg, value.attitude.yaw_deg)
        covariance = _triangle(value.position_variance_m2, value.orientation_variance_rad2)
        return self._time_us(value.measured_at), position, covariance

    def vision_speed(self, value: v.SpeedMeasurement) -> tuple[Message, ...]:
        """Return VISION_SPEED_ESTIMATE, or ODOMETRY without a pose if the autopilot reads only ODOMETRY."""
        speeds = (value.north_m_s, value.east_m_s, value.down_m_s)
        check_finite("velocity", *speeds)
        time_us, reset_count = self._time_us(value.measured_at), _reset_counter(value.reset_counter)
        variance = value.variance_m2_s2
        if self._session.autopilot.external.has_vision_speed:
            _check_variance(variance)
            covariance = [NAN] * 9 if variance is None else [variance, 0, 0, 0, variance, 0, 0, 0, variance]
            return (m.VisionSpeedEstimate(time_us, *speeds, covariance, reset_count),)
        frames = (MavFrame.LOCAL_NED, MavFrame.LOCAL_NED)
        unknown_quaternion = (NAN,) * 4
        covariances = (_triangle(None, None), _triangle(variance, None))
        last_fields = (reset_count, VISION, 100)  # 100 is the quality in percent
        return (
            m.Odometry(
                time_us,
                *frames,
                *UNKNOWN_VECTOR,  # position
                unknown_quaternion,
                *speeds,
                *UNKNOWN_VECTOR,  # turn rates
                *covariances,
                *last_fields,
            ),
        )

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
        ignore = GpsInputIgnoreFlags
        optional_fields = (
            (value.hdop, ignore.HDOP),
            (value.vdop, ignore.VDOP),
            (value.velocity_m_s, ignore.VEL_HORIZ | ignore.VEL_VERT),
            (value.speed_accuracy_m_s, ignore.SPEED_ACCURACY),
            (value.horizontal_accuracy_m, ignore.HORIZONTAL_ACCURACY),
            (value.vertical_accuracy_m, ignore.VERTICAL_ACCURACY),
        )
        ignore_flags = sum(flag for field, flag in optional_fields if field is None)
        week, week_ms = _gps_time(value.unix_time_s)
        yaw_cdeg = 0  # 0 means that the yaw is unknown, so north is sent as 36000.
        if value.yaw_deg is not None:
            yaw_cdeg = round(value.yaw_deg % 360 * 100) or 36000
        return (
            m.GpsInput(
                self._time_us(value.measured_at),
                value.instance,
                ignore_flags,
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
                yaw_cdeg,
            ),
        )

    def obstacles(self, value: v.ObstacleSectors) -> tuple[Message, ...]:
        """Return OBSTACLE_DISTANCE with angles from the vehicle's nose."""
        check_range("step_deg", value.step_deg, 0, 360, above=True)
        check_range("first_deg", value.first_deg, -360, 360)
        count = len(value.distances_m)
        if not 1 <= count <= MAX_SECTORS:
            raise InvalidArgument(f"distances_m has {count} distances, but must have 1 to {MAX_SECTORS}")
        min_cm, max_cm = _centimetres("min_m", value.min_m), _centimetres("max_m", value.max_m)
        distances = [UNKNOWN_DISTANCE] * MAX_SECTORS
        for index, distance_m in enumerate(value.distances_m):
            if distance_m is None:
                continue
            is_free = distance_m > value.max_m  # A sector without an obstacle is sent as max_distance + 1.
            distances[index] = max_cm + 1 if is_free else _centimetres("distances_m", distance_m)
        time_us = self._time_us(value.measured_at)
        # The fields increment_f, which the autopilots read instead of the integer field increment, and angle_offset.
        angles = (value.step_deg, value.first_deg)
        return (m.ObstacleDistance(time_us, LASER, distances, 0, min_cm, max_cm, *angles, MavFrame.BODY_FRD),)

    def obstacle_points(self, value: v.ObstaclePoints) -> tuple[Message, ...]:
        """Return one OBSTACLE_DISTANCE_3D for each point, all with the same time stamp."""
        check_range("min_m", value.min_m, 0, 1e5)
        check_range("max_m", value.max_m, 0, 1e5, above=True)
        time_ms = (self._time_us(value.measured_at) // 1000) & 0xFFFFFFFF  # The field has 32 bits.
        limits_m = (value.min_m, value.max_m)
        for point in value.points_m:
            check_finite("points_m", *point)
        return tuple(
            m.ObstacleDistance3d(time_ms, LASER, MavFrame.BODY_FRD, UNKNOWN_OBSTACLE_ID, *point, *limits_m)
            for point in value.points_m
        )

    def range_finder(self, value: v.RangeMeasurement) -> tuple[Message, ...]:
        """Return DISTANCE_SENSOR."""
        if value.direction not in ORIENTATIONS:
            directions = ", ".join(ORIENTATIONS)
            raise InvalidArgument(f"direction = {value.direction!r} is not allowed: it must be one of {directions}")
        if value.quality is not None:
            check_range("quality", value.quality, 1, 100)
        _check_variance(value.variance_m2)
        limits_cm = (_centimetres("min_m", value.min_m), _centimetres("max_m", value.max_m))
        distance_cm = _centimetres("distance_m", value.distance_m)
        covariance_cm2 = UNKNOWN_COVARIANCE
        if value.variance_m2 is not None:
            covariance_cm2 = min(UNKNOWN_COVARIANCE - 1, round(value.variance_m2 * 1e4))
        time_ms = (self._time_us(value.measured_at) // 1000) & 0xFFFFFFFF  # The field has 32 bits.
        sensor = (LASER, 0, ORIENTATIONS[value.direction])  # type, id, orientation
        quality = value.quality or 0  # 0 means "unknown"
        return (m.DistanceSensor(time_ms, *limits_cm, distance_cm, *sensor, covariance_cm2, signal_quality=quality),)

    def landing_target(self, value: v.TargetMeasurement) -> tuple[Message, ...]:
        """Return LANDING_TARGET relative to the vehicle, or converted to the local frame for PX4."""
        offset = (value.forward_m, value.right_m, value.down_m)
        check_finite("target", *offset)
        check_range("number", value.number, 0, 255)
        distance = math.hypot(*offset)
        if not distance > 0:
            raise InvalidArgument(
                "forward_m = right_m = down_m = 0 is not allowed: the target cannot be at the vehicle's own position"
            )
        frame = MavFrame.LOCAL_FRD if value.is_level else MavFrame.BODY_FRD
        if self._session.autopilot.external.target_is_local:
            frame, offset = MavFrame.LOCAL_NED, self._in_local_frame(offset, is_level=value.is_level)
        time_us, unknown_size = self._time_us(value.measured_at), (0.0, 0.0)
        # Angular offsets of the target from the centre of the picture, for a camera that looks straight down.
        angles = (math.atan2(value.right_m, value.down_m), -math.atan2(value.forward_m, value.down_m))
        no_rotation = (1.0, 0.0, 0.0, 0.0)
        last_fields = (LANDING_TARGET_TYPE_VISION_FIDUCIAL, 1)  # 1: the position is valid
        return (
            m.LandingTarget(
                time_us, value.number, frame, *angles, distance, *unknown_size, *offset, no_rotation, *last_fields
            ),
        )

    def optical_flow(self, value: v.FlowMeasurement) -> tuple[Message, ...]:
        """Return OPTICAL_FLOW_RAD for PX4, or OPTICAL_FLOW scaled as ArduPilot reads it."""
        check_finite("flow", value.x_rad, value.y_rad, *(value.gyro_rad or ()))
        check_range("interval_s", value.interval_s, 0, 10, above=True)
        check_range("quality", value.quality, 0, 255)
        time_us = self._time_us(value.measured_at)
        distance_m = -1.0 if value.distance_m is None else value.distance_m  # A negative distance means "unknown".
        check_finite("distance_m", distance_m)
        if self._session.autopilot.external.flow_in_radians:
            gyro = UNKNOWN_VECTOR if value.gyro_rad is None else value.gyro_rad
            interval_us = round(value.interval_s * 1e6)
            flow = (value.x_rad, value.y_rad, *gyro)
            return (m.OpticalFlowRad(time_us, 0, interval_us, *flow, 0, value.quality, 0, distance_m),)
        # ArduPilot takes flow_x times the interval between messages as the rate in rad/s (AP_OpticalFlow_MAV.cpp). The
        # angle is therefore divided by the interval twice. The result must fit into 16 bits.
        unit_rad = value.interval_s**2
        for name, angle in (("x_rad", value.x_rad), ("y_rad", value.y_rad)):
            check_range(name, angle, -0x8000 * unit_rad, 0x7FFF * unit_rad)
        flow_x, flow_y = round(value.x_rad / unit_rad), round(value.y_rad / unit_rad)
        rates = (value.x_rad / value.interval_s, value.y_rad / value.interval_s)
        return (m.OpticalFlow(time_us, 0, flow_x, flow_y, 0.0, 0.0, value.quality, distance_m, *rates),)

    def _in_local_frame(self, offset: Vector, *, is_level: bool) -> Vector:
        """Return a position in the local frame; ``offset`` is relative to the vehicle, along its body axes."""
        telemetry = self._session.telemetry
        if max(telemetry.attitude.age, telemetry.local_position.age) > POSITION_MAX_AGE_S:
            raise ValueUnknownError(
                "the landing target was not sent: the vehicle's attitude or local position is unknown or too old"
            )
        attitude, own_position = telemetry.attitude.value, telemetry.local_position.value
        if is_level:  # The axes of the offset turn with the vehicle, but do not tilt.
            attitude = Attitude(0.0, 0.0, attitude.yaw_deg)
        north, east, down = rotate(attitude.quaternion, offset)
        return (own_position.north_m + north, own_position.east_m + east, own_position.down_m + down)

    def _time_us(self, measured_at: float | None) -> int:
        """Return a time on the event loop's clock as a time stamp in microseconds. None means the present time."""
        now = self._session.connection.now()
        seconds = now if measured_at is None else measured_at
        check_range("measured_at", seconds, 0, now)
        return int(seconds * 1e6)


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the product of two quaternions (w, x, y, z)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = left, right
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """Return a vector rotated by a unit quaternion."""
    w, x, y, z = quaternion
    conjugate = (w, -x, -y, -z)
    _, x, y, z = multiply(multiply(quaternion, (0.0, *vector)), conjugate)
    return (x, y, z)


def _normalized(quaternion: Quaternion) -> Quaternion:
    """Return the quaternion of the same rotation that has length 1 and a w that is not negative."""
    length = math.hypot(*quaternion)
    if not 0.9 < length < 1.1:
        raise InvalidArgument(f"orientation = {quaternion!r} is not allowed: its length must be 1")
    w, x, y, z = quaternion
    sign = -1.0 if w < 0 else 1.0
    return (sign * w / length, sign * x / length, sign * y / length, sign * z / length)


def _triangle(linear_variance: float | None, angular_variance: float | None) -> list[float]:
    """Return the upper triangle of a 6x6 covariance matrix with three linear and three angular variances.

    Only the diagonal is not 0. An unknown linear variance is sent as NaN in the first element. An unknown angular
    variance is sent as 0: both autopilots then use the minimum in their parameters, and ArduPilot does not accept NaN
    there.
    """
    _check_variance(linear_variance)
    _check_variance(angular_variance)
    triangle = [0.0] * TRIANGLE_SIZE
    for indexes, variance in ((POSITION_DIAGONAL, linear_variance), (ORIENTATION_DIAGONAL, angular_variance)):
        for index in indexes:
            triangle[index] = variance or 0.0
    if linear_variance is None:
        triangle[0] = NAN
    return triangle


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
    """Return the number of the GPS week, and the milliseconds since this week began; zeros if the time is unknown."""
    if unix_time_s is None:
        return 0, 0
    check_range("unix_time_s", unix_time_s, GPS_EPOCH_S, GPS_EPOCH_S + 65535 * SECONDS_PER_WEEK)
    week, seconds = divmod(unix_time_s - GPS_EPOCH_S + LEAP_SECONDS, SECONDS_PER_WEEK)
    return int(week), int(seconds * 1000)
