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
# The upper triangle of a 6x6 covariance matrix, row by row: indexes of the variances, and the number of all elements.
POSITION_DIAGONAL, ORIENTATION_DIAGONAL, TRIANGLE_SIZE = (0, 6, 11), (15, 18, 20), 21
MAX_SECTORS, UNKNOWN_DISTANCE, UNKNOWN_OBSTACLE_ID = 72, 0xFFFF, 0xFFFF
MAX_CENTIMETRES = 0xFFFE
# GPS time began on 1980-01-06 and has been 18 leap seconds ahead of UTC since 2017.
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

    A measurement that is out of range raises InvalidArgument. Time stamps are on the event loop's clock, with which PX4
    synchronizes by TIMESYNC.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session

    def odometry(self, value: v.OdometryMeasurement) -> tuple[Message, ...]:
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
        x, y, z = position
        vx, vy, vz = UNKNOWN_VECTOR if velocity is None else velocity
        return (
            m.Odometry(
                time_usec=self._time_us(value.measured_at),
                frame_id=self._session.autopilot.external.ned_frame if is_earth_frame else MavFrame.LOCAL_FRD,
                child_frame_id=MavFrame.BODY_FRD,
                x=x,
                y=y,
                z=z,
                q=_normalized(quaternion),
                vx=vx,
                vy=vy,
                vz=vz,
                **dict.fromkeys(("rollspeed", "pitchspeed", "yawspeed"), NAN),
                pose_covariance=_triangle(value.position_variance_m2, value.orientation_variance_rad2),
                velocity_covariance=_triangle(value.velocity_variance_m2_s2, angular_variance=None),
                reset_counter=_reset_counter(value.reset_counter),
                estimator_type=VISION,
                quality=value.quality,
            ),
        )

    def vision_position(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        time_us, position, covariance = self._pose(value)
        attitude, reset_count = value.attitude, _reset_counter(value.reset_counter)
        roll, pitch, yaw = map(math.radians, (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg))
        return (m.VisionPositionEstimate(time_us, *position, roll, pitch, yaw, covariance, reset_count),)

    def motion_capture(self, value: v.PoseMeasurement) -> tuple[Message, ...]:
        if not self._session.autopilot.external.has_mocap:
            return self.vision_position(value)
        time_us, position, covariance = self._pose(value)
        return (m.AttPosMocap(time_us, value.attitude.quaternion, *position, covariance),)

    def _pose(self, value: v.PoseMeasurement) -> tuple[int, Vector, list[float]]:
        """Return the time stamp in microseconds, the position and the covariance of a pose."""
        position = (value.north_m, value.east_m, value.down_m)
        check_finite("position", *position)
        check_finite("attitude", value.attitude.roll_deg, value.attitude.pitch_deg, value.attitude.yaw_deg)
        covariance = _triangle(value.position_variance_m2, value.orientation_variance_rad2)
        return self._time_us(value.measured_at), position, covariance

    def vision_speed(self, value: v.SpeedMeasurement) -> tuple[Message, ...]:
        speeds = (value.north_m_s, value.east_m_s, value.down_m_s)
        check_finite("velocity", *speeds)
        time_us, reset_count = self._time_us(value.measured_at), _reset_counter(value.reset_counter)
        variance = value.variance_m2_s2
        if self._session.autopilot.external.has_vision_speed:
            _check_variance(variance)
            covariance = [NAN] * 9 if variance is None else [variance, 0, 0, 0, variance, 0, 0, 0, variance]
            return (m.VisionSpeedEstimate(time_us, *speeds, covariance, reset_count),)
        return (
            m.Odometry(
                time_usec=time_us,
                frame_id=MavFrame.LOCAL_NED,
                child_frame_id=MavFrame.LOCAL_NED,
                **dict.fromkeys(("x", "y", "z", "rollspeed", "pitchspeed", "yawspeed"), NAN),
                q=(NAN,) * 4,
                vx=value.north_m_s,
                vy=value.east_m_s,
                vz=value.down_m_s,
                pose_covariance=_triangle(linear_variance=None, angular_variance=None),
                velocity_covariance=_triangle(variance, angular_variance=None),
                reset_counter=reset_count,
                estimator_type=VISION,
                quality=100,
            ),
        )

    def gps(self, value: v.GpsMeasurement) -> tuple[Message, ...]:
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
        north_m_s, east_m_s, down_m_s = value.velocity_m_s or (0.0, 0.0, 0.0)
        return (
            m.GpsInput(
                time_usec=self._time_us(value.measured_at),
                gps_id=value.instance,
                ignore_flags=ignore_flags,
                time_week_ms=week_ms,
                time_week=week,
                fix_type=value.fix,
                lat=round(value.latitude_deg * 1e7),
                lon=round(value.longitude_deg * 1e7),
                alt=value.altitude_amsl_m,
                hdop=value.hdop or 0.0,
                vdop=value.vdop or 0.0,
                vn=north_m_s,
                ve=east_m_s,
                vd=down_m_s,
                speed_accuracy=value.speed_accuracy_m_s or 0.0,
                horiz_accuracy=value.horizontal_accuracy_m or 0.0,
                vert_accuracy=value.vertical_accuracy_m or 0.0,
                satellites_visible=value.satellites,
                yaw=yaw_cdeg,
            ),
        )

    def obstacles(self, value: v.ObstacleSectors) -> tuple[Message, ...]:
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
        return (
            m.ObstacleDistance(
                time_usec=self._time_us(value.measured_at),
                sensor_type=LASER,
                distances=distances,
                increment=0,  # The autopilots read increment_f instead of this integer field.
                min_distance=min_cm,
                max_distance=max_cm,
                increment_f=value.step_deg,
                angle_offset=value.first_deg,
                frame=MavFrame.BODY_FRD,
            ),
        )

    def obstacle_points(self, value: v.ObstaclePoints) -> tuple[Message, ...]:
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
        if value.direction not in ORIENTATIONS:
            directions = ", ".join(ORIENTATIONS)
            raise InvalidArgument(f"direction = {value.direction!r} is not allowed: it must be one of {directions}")
        if value.quality is not None:
            check_range("quality", value.quality, 1, 100)
        _check_variance(value.variance_m2)
        min_cm, max_cm = _centimetres("min_m", value.min_m), _centimetres("max_m", value.max_m)
        distance_cm = _centimetres("distance_m", value.distance_m)
        covariance_cm2 = UNKNOWN_COVARIANCE
        if value.variance_m2 is not None:
            covariance_cm2 = min(UNKNOWN_COVARIANCE - 1, round(value.variance_m2 * 1e4))
        time_ms = (self._time_us(value.measured_at) // 1000) & 0xFFFFFFFF  # The field has 32 bits.
        return (
            m.DistanceSensor(
                time_boot_ms=time_ms,
                min_distance=min_cm,
                max_distance=max_cm,
                current_distance=distance_cm,
                type=LASER,
                id=0,
                orientation=ORIENTATIONS[value.direction],
                covariance=covariance_cm2,
                signal_quality=value.quality or 0,  # 0 means "unknown"
            ),
        )

    def landing_target(self, value: v.TargetMeasurement) -> tuple[Message, ...]:
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
            frame = MavFrame.LOCAL_NED
            offset = self._in_local_frame(offset, is_level=value.is_level)
        x, y, z = offset
        return (
            m.LandingTarget(
                time_usec=self._time_us(value.measured_at),
                target_num=value.number,
                frame=frame,
                # Angles of the target from the center of the picture, for a camera that looks straight down.
                angle_x=math.atan2(value.right_m, value.down_m),
                angle_y=-math.atan2(value.forward_m, value.down_m),
                distance=distance,
                size_x=0.0,  # unknown
                size_y=0.0,
                x=x,
                y=y,
                z=z,
                q=(1.0, 0.0, 0.0, 0.0),  # no rotation
                type=LANDING_TARGET_TYPE_VISION_FIDUCIAL,
                position_valid=1,
            ),
        )

    def optical_flow(self, value: v.FlowMeasurement) -> tuple[Message, ...]:
        check_finite("flow", value.x_rad, value.y_rad, *(value.gyro_rad or ()))
        check_range("interval_s", value.interval_s, 0, 10, above=True)
        check_range("quality", value.quality, 0, 255)
        time_us = self._time_us(value.measured_at)
        distance_m = -1.0 if value.distance_m is None else value.distance_m  # A negative distance means "unknown".
        check_finite("distance_m", distance_m)
        if self._session.autopilot.external.flow_in_radians:
            gyro_x, gyro_y, gyro_z = UNKNOWN_VECTOR if value.gyro_rad is None else value.gyro_rad
            return (
                m.OpticalFlowRad(
                    time_usec=time_us,
                    sensor_id=0,
                    integration_time_us=round(value.interval_s * 1e6),
                    integrated_x=value.x_rad,
                    integrated_y=value.y_rad,
                    integrated_xgyro=gyro_x,
                    integrated_ygyro=gyro_y,
                    integrated_zgyro=gyro_z,
                    temperature=0,
                    quality=value.quality,
                    time_delta_distance_us=0,
                    distance=distance_m,
                ),
            )
        # ArduPilot takes flow_x times the interval between messages as the rate in rad/s (AP_OpticalFlow_MAV.cpp). The
        # angle is therefore divided by the interval twice. The result must fit into 16 bits.
        unit_rad = value.interval_s**2
        for name, angle in (("x_rad", value.x_rad), ("y_rad", value.y_rad)):
            check_range(name, angle, -0x8000 * unit_rad, 0x7FFF * unit_rad)
        return (
            m.OpticalFlow(
                time_usec=time_us,
                sensor_id=0,
                flow_x=round(value.x_rad / unit_rad),
                flow_y=round(value.y_rad / unit_rad),
                flow_comp_m_x=0.0,
                flow_comp_m_y=0.0,
                quality=value.quality,
                ground_distance=distance_m,
                flow_rate_x=value.x_rad / value.interval_s,
                flow_rate_y=value.y_rad / value.interval_s,
            ),
        )

    def _in_local_frame(self, offset: Vector, *, is_level: bool) -> Vector:
        """Convert an offset from the vehicle, along its body axes, to a position in the local frame."""
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
        """Convert a time of the event loop to microseconds. None is the present."""
        now = self._session.connection.now()
        seconds = now if measured_at is None else measured_at
        check_range("measured_at", seconds, 0, now)
        return int(seconds * 1e6)


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
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
    """Return the same rotation as a quaternion with length 1 and w ≥ 0."""
    length = math.hypot(*quaternion)
    if not 0.9 < length < 1.1:
        raise InvalidArgument(f"orientation = {quaternion!r} is not allowed: its length must be 1")
    w, x, y, z = quaternion
    sign = -1.0 if w < 0 else 1.0
    return (sign * w / length, sign * x / length, sign * y / length, sign * z / length)


def _triangle(linear_variance: float | None, angular_variance: float | None) -> list[float]:
    """Return the upper triangle of a 6x6 covariance matrix with these variances on its diagonal."""
    _check_variance(linear_variance)
    _check_variance(angular_variance)
    triangle = [0.0] * TRIANGLE_SIZE
    for indexes, variance in ((POSITION_DIAGONAL, linear_variance), (ORIENTATION_DIAGONAL, angular_variance)):
        for index in indexes:
            # For a variance of 0, ArduPilot and PX4 use the minimum in their parameters. So 0 is sent for an unknown
            # angular variance, for which ArduPilot does not accept NaN.
            triangle[index] = variance or 0.0
    if linear_variance is None:
        triangle[0] = NAN  # The linear variance is unknown.
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
    """Return the GPS week and the milliseconds since its start, or zeros if the time is unknown."""
    if unix_time_s is None:
        return 0, 0
    check_range("unix_time_s", unix_time_s, GPS_EPOCH_S, GPS_EPOCH_S + 65535 * SECONDS_PER_WEEK)
    week, seconds = divmod(unix_time_s - GPS_EPOCH_S + LEAP_SECONDS, SECONDS_PER_WEEK)
    return int(week), int(seconds * 1000)
