"""Measurements that a program supplies to a vehicle, in SI units and degrees.

``measured_at`` is the time of the measurement on the clock of the event loop (``vehicle.connection.now()``); None means
the time of the call of ``send``. ``variance`` fields are squared standard deviations. If a variance is None, the
autopilot uses its parameters instead (VISO_POS_M_NSE …, EKF2_EVP_NOISE …).
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

from aerokit._internal.values import Snapshot
from aerokit.vehicle.state.movement import Attitude

__all__ = [
    "FlowMeasurement",
    "GpsMeasurement",
    "LocalFrame",
    "ObstaclePoints",
    "ObstacleSectors",
    "OdometryMeasurement",
    "PoseMeasurement",
    "Quaternion",
    "RangeDirection",
    "RangeMeasurement",
    "SpeedMeasurement",
    "TargetMeasurement",
    "Vector",
]

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
LocalFrame: TypeAlias = Literal["ned", "frd", "enu", "flu"]
"""Axes of a local frame.

``ned``: north, east, down. ``frd``: forward, right, down of the vehicle at its start. ``enu``: east, north, up.
``flu``: forward, left, up. ROS uses the last two (REP 103). With either of them, the body axes are ``flu``, too.
"""
RangeDirection: TypeAlias = Literal["down", "up", "forward", "back", "left", "right"]


class OdometryMeasurement(Snapshot):
    """Pose and velocity of the vehicle (ODOMETRY).

    ``position_m`` and ``orientation`` are in ``frame``. ``orientation`` is the rotation from the body axes to the
    frame, as a quaternion (w, x, y, z) or an :class:`Attitude`. ``velocity_m_s`` is along the body axes. ``quality`` is
    from 0 to 100 percent, or −1 for a failed measurement. Increase ``reset_counter`` (0 to 255) when the estimate
    jumps.
    """

    position_m: Vector
    orientation: Quaternion | Attitude
    velocity_m_s: Vector | None = None
    frame: LocalFrame = "frd"
    position_variance_m2: float | None = None
    orientation_variance_rad2: float | None = None
    velocity_variance_m2_s2: float | None = None
    quality: int = 100
    reset_counter: int = 0
    measured_at: float | None = None


class PoseMeasurement(Snapshot):
    """Pose of the vehicle from vision or motion capture: metres north, east and down of the origin, and attitude."""

    north_m: float
    east_m: float
    down_m: float
    attitude: Attitude
    position_variance_m2: float | None = None
    orientation_variance_rad2: float | None = None
    reset_counter: int = 0
    measured_at: float | None = None


class SpeedMeasurement(Snapshot):
    """Velocity of the vehicle from vision, in m/s north, east and down."""

    north_m_s: float
    east_m_s: float
    down_m_s: float
    variance_m2_s2: float | None = None
    reset_counter: int = 0
    measured_at: float | None = None


class GpsMeasurement(Snapshot):
    """Position of a satellite receiver (GPS_INPUT).

    ``velocity_m_s`` is north, east, down. ``fix`` is a GPS_FIX_TYPE (3 is a 3D fix). ``yaw_deg`` is the heading from a
    receiver with two antennas. ``unix_time_s`` is the time of the fix in seconds since 1970 (UTC). ``instance`` is the
    number of the receiver, from 0.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float
    velocity_m_s: Vector | None = None
    fix: int = 3
    satellites: int = 10
    hdop: float | None = None
    vdop: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None
    speed_accuracy_m_s: float | None = None
    yaw_deg: float | None = None
    unix_time_s: float | None = None
    instance: int = 0
    measured_at: float | None = None


class ObstacleSectors(Snapshot):
    """Distances in metres to obstacles around the vehicle, in at most 72 sectors (OBSTACLE_DISTANCE).

    The first sector is centered on ``first_deg`` clockwise from the nose, each following sector ``step_deg`` further
    clockwise. None means that the distance is unknown; infinity means that there is no obstacle within ``max_m``.
    """

    distances_m: tuple[float | None, ...]
    min_m: float
    max_m: float
    first_deg: float = 0.0
    step_deg: float = 5.0
    measured_at: float | None = None


class ObstaclePoints(Snapshot):
    """Positions of obstacles in metres forward, right and down of the vehicle (OBSTACLE_DISTANCE_3D).

    Each point is sent as one message. If there are no points, nothing is sent, and the vehicle keeps the earlier
    obstacles.
    """

    points_m: tuple[Vector, ...]
    min_m: float
    max_m: float
    measured_at: float | None = None


class RangeMeasurement(Snapshot):
    """Distance measured by a range finder, in metres (DISTANCE_SENSOR). ``quality`` is from 1 to 100 percent."""

    distance_m: float
    min_m: float
    max_m: float
    direction: RangeDirection = "down"
    variance_m2: float | None = None
    quality: int | None = None
    measured_at: float | None = None


class TargetMeasurement(Snapshot):
    """Position of a landing target relative to the vehicle in metres forward, right and down.

    The axes are body axes, which tilt with the vehicle. With ``is_level`` the axes stay level, as for a stabilised
    camera.
    """

    forward_m: float
    right_m: float
    down_m: float
    is_level: bool = False
    number: int = 0
    measured_at: float | None = None

    @classmethod
    def from_angles(
        cls, forward_deg: float, right_deg: float, height_m: float, *, is_level: bool = False
    ) -> TargetMeasurement:
        """Return a target that a camera sees at these angles from straight down.

        ``height_m`` is the height of the camera above the target.
        """
        forward, right = (math.tan(math.radians(angle)) * height_m for angle in (forward_deg, right_deg))
        return cls(forward, right, height_m, is_level)

    @property
    def horizontal_m(self) -> float:
        """Horizontal distance in metres, if the axes are level."""
        return math.hypot(self.forward_m, self.right_m)


class FlowMeasurement(Snapshot):
    """Optical flow of a camera that looks down (OPTICAL_FLOW, OPTICAL_FLOW_RAD).

    ``x_rad`` and ``y_rad`` are the movement of the picture within ``interval_s``, as angles about the body's forward
    and right axes. They include the rotation of the body: do not subtract ``gyro_rad``, which is this rotation about
    all three axes. ``quality`` is from 0 to 255. Send every measurement without gaps: ArduPilot uses the time between
    two messages as ``interval_s``.
    """

    x_rad: float
    y_rad: float
    interval_s: float
    gyro_rad: Vector | None = None
    quality: int = 255
    distance_m: float | None = None
    measured_at: float | None = None
