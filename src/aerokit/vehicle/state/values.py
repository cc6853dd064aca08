"""What programs read of a vehicle: immutable values in SI units and degrees, the unit in the name.

A number that the standard marks as unknown (UINT16_MAX, −1, NaN …) is None here, never a number. Angles are
degrees, lengths metres, speeds metres per second; directions are clockwise from north; ``down`` is positive
downwards.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit import geo
from aerokit.autopilots.modes import Mode
from aerokit.autopilots.version import AutopilotVersion
from aerokit.position import Position
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "Attitude",
    "AutopilotVersion",
    "Battery",
    "EstimatorHealth",
    "GpsReceiver",
    "Home",
    "LocalPosition",
    "MissionProgress",
    "Mode",
    "Position",
    "RangeFinder",
    "RcChannels",
    "SensorHealth",
    "ServoOutputs",
    "Snapshot",
    "StatusText",
    "SystemTime",
    "Velocity",
    "Vibration",
    "Wind",
]

MAV_SEVERITY_ERROR = 3
GPS_FIX_TYPE_3D = 3
SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")


# --------------------------------------------------------------------------- where and how it moves


class Home(Snapshot):
    """Where the vehicle returns to (HOME_POSITION); ``north_m`` … are from the origin, None: not told."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float
    north_m: float | None = None
    east_m: float | None = None
    down_m: float | None = None

    @property
    def position(self) -> Position:
        """The place as a target without an altitude, so that going there keeps the present one."""
        return Position(self.latitude_deg, self.longitude_deg)


class LocalPosition(Snapshot):
    """Metres from the estimator's origin, and velocity in m/s (LOCAL_POSITION_NED)."""

    north_m: float
    east_m: float
    down_m: float
    north_m_s: float
    east_m_s: float
    down_m_s: float


class Velocity(Snapshot):
    """Velocity over ground in m/s."""

    north_m_s: float
    east_m_s: float
    down_m_s: float

    @property
    def ground_speed_m_s(self) -> float:
        """Horizontal speed."""
        return math.hypot(self.north_m_s, self.east_m_s)

    @property
    def course_deg(self) -> float:
        """Direction of the horizontal movement, 0 to 360."""
        return geo.wrap_360(math.degrees(math.atan2(self.east_m_s, self.north_m_s)))


class Attitude(Snapshot):
    """Attitude in degrees and turn rates about the body's axes in degrees per second.

    ``roll_deg`` right side down, ``pitch_deg`` nose up, ``yaw_deg`` −180 to 180 clockwise from north; a rate
    is None when it is not told.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    roll_rate_deg_s: float | None = None
    pitch_rate_deg_s: float | None = None
    yaw_rate_deg_s: float | None = None

    @classmethod
    def from_quaternion(
        cls,
        w: float,
        x: float,
        y: float,
        z: float,
        rates_deg_s: tuple[float | None, float | None, float | None],
    ) -> Self:
        """The attitude of a quaternion from earth (north, east, down) to body axes, w first."""
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return cls(math.degrees(roll), math.degrees(pitch), math.degrees(yaw), *rates_deg_s)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The same attitude as w, x, y, z."""
        halves = (math.radians(angle) / 2 for angle in (self.roll_deg, self.pitch_deg, self.yaw_deg))
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(half), math.sin(half)) for half in halves)
        return (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )


class Wind(Snapshot):
    """``direction_deg`` is where it comes from, 0 to 360; speeds in m/s, ``down_m_s`` None when not told."""

    speed_m_s: float
    direction_deg: float
    down_m_s: float | None = None


class RangeFinder(Snapshot):
    """One distance sensor. ``distance_m`` is None when the reading is invalid.

    ``orientation`` is a MAV_SENSOR_ORIENTATION, 25 looks down. ``quality_percent`` None: not told.
    """

    id: int
    distance_m: float | None
    orientation: int
    min_distance_m: float | None = None
    max_distance_m: float | None = None
    quality_percent: int | None = None


# ------------------------------------------------------------------------------- what it runs on


class GpsReceiver(Snapshot):
    """One satellite receiver: 0 is GPS_RAW_INT, 1 is GPS2_RAW.

    ``fix_type`` is a GPS_FIX_TYPE (0 no receiver, 1 no fix, 2 2D, 3 3D, 4 DGPS, 5 RTK float, 6 RTK fixed).
    The place is None before a fix. Accuracies are one standard deviation.
    """

    index: int
    fix_type: int
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_amsl_m: float | None = None
    ground_speed_m_s: float | None = None
    course_deg: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None
    speed_accuracy_m_s: float | None = None
    yaw_deg: float | None = None

    @property
    def has_3d_fix(self) -> bool:
        """Whether it has a fix in three dimensions, or a better one."""
        return GPS_FIX_TYPE_3D <= self.fix_type <= 8


class Battery(Snapshot):
    """One battery. ``cell_voltages_v`` is empty when cells are not measured one by one.

    ``charge_state`` is a MAV_BATTERY_CHARGE_STATE (1 OK, 2 low, 3 critical …), 0 when it is not told.
    """

    id: int
    voltage_v: float | None = None
    current_a: float | None = None
    remaining_percent: int | None = None
    cell_voltages_v: tuple[float, ...] = ()
    temperature_c: float | None = None
    consumed_mah: int | None = None
    consumed_wh: float | None = None
    time_remaining_s: int | None = None
    charge_state: int = 0


class RcChannels(Snapshot):
    """Pulse widths from the remote control in µs, None: channel unused; ``rssi`` 0 to 254, None: unknown."""

    channels_us: tuple[int | None, ...]
    rssi: int | None = None


class ServoOutputs(Snapshot):
    """Pulse widths to motors and servos in µs; ``outputs_us[0]`` is output 1, 0 means no pulses."""

    outputs_us: tuple[int, ...]


class Vibration(Snapshot):
    """Vibration levels in m/s² and how often each accelerometer reached its limit since boot."""

    x_m_s2: float
    y_m_s2: float
    z_m_s2: float
    clippings: tuple[int, int, int]


class SystemTime(Snapshot):
    """``unix_s`` is UTC in seconds since 1970, None while the vehicle does not know it."""

    unix_s: float | None
    since_boot_s: float


# ---------------------------------------------------------------------------------- how it fares


class SensorHealth(Snapshot):
    """SYS_STATUS (https://mavlink.io/en/messages/common.html#SYS_STATUS).

    ``present``, ``enabled`` and ``healthy`` are MAV_SYS_STATUS_SENSOR bits. ``failing`` names what should
    work and does not. ``prearm_checks_pass`` is None where the vehicle does not say. ``load_percent`` is the
    processor's.
    """

    present: int
    enabled: int
    healthy: int
    failing: tuple[str, ...]
    prearm_checks_pass: bool | None
    load_percent: float

    @property
    def blocks_arming(self) -> tuple[str, ...]:
        """What is failing, unless the checks pass all the same: then the vehicle does not mind."""
        return () if self.prearm_checks_pass else self.failing


class EstimatorHealth(Snapshot):
    """What the state estimator says of itself: EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (PX4).

    ``message`` is the name of the message, ``flags`` its flags, ``missing`` what a flight by position still
    needs, in words. Ratios are innovations by their limits: below 1 is good. Accuracies are in metres, one
    standard deviation.
    """

    message: str
    flags: int
    missing: tuple[str, ...]
    velocity_ratio: float | None = None
    horizontal_position_ratio: float | None = None
    vertical_position_ratio: float | None = None
    compass_ratio: float | None = None
    terrain_ratio: float | None = None
    airspeed_ratio: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None

    @property
    def has_attitude(self) -> bool:
        """Whether the attitude is good."""
        return bool(self.flags & 1)

    @property
    def has_horizontal_velocity(self) -> bool:
        """Whether the horizontal velocity is good."""
        return bool(self.flags & 2)

    @property
    def has_relative_position(self) -> bool:
        """Whether the position relative to where it began is good."""
        return bool(self.flags & 8)

    @property
    def has_absolute_position(self) -> bool:
        """Whether the position on the globe is good."""
        return bool(self.flags & 16)

    @property
    def has_altitude(self) -> bool:
        """Whether the altitude is good."""
        return bool(self.flags & 32)


class MissionProgress(Snapshot):
    """The current mission item, counted from 0, and how many there are; None: not told, or no mission.

    ``state`` is a MISSION_STATE (1 no mission, 2 not started, 3 active, 4 paused, 5 complete), 0 unknown.
    """

    current: int | None
    total: int | None = None
    state: int = 0


class StatusText(Snapshot):
    """What the vehicle said; ``severity`` is a MAV_SEVERITY, 0 emergency to 7 debug. "…" is a lost part."""

    severity: int
    text: str
    at: float = 0.0
    """When it was complete, in seconds on the event loop's clock."""

    @property
    def is_error(self) -> bool:
        """Whether it is an error or worse."""
        return self.severity <= MAV_SEVERITY_ERROR

    def __str__(self) -> str:
        name = SEVERITIES[self.severity] if self.severity < len(SEVERITIES) else str(self.severity)
        return f"{name}: {self.text}"
