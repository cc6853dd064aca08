"""State values and decoders: inertial and pressure sensors, odometry, ground truth, traffic, winch."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import AdsbAltitudeType, AdsbEmitterType, AdsbFlags, MavFrame, MavWinchStatusFlag
from aerokit.position import Position
from aerokit.vehicle.state.field import I16, Context, finite, member, unless

if TYPE_CHECKING:
    from aerokit.mavlink import messages

MG_M_S2, MGAUSS_UT, GAUSS_UT, HPA_PA = 9.80665e-3, 0.1, 100.0, 100.0
NO_TERRAIN_M = -1000.0
MAX_AIRCRAFT = 64
_F = AdsbFlags


class Imu(Snapshot):
    """One inertial sensor in body axes: x forward, y right, z down.

    Accelerations in m/s², rates in degrees per second, magnetic field in microtesla (1 gauss is 100 µT). Pressures in
    Pa and metres, None if the message has none.
    """

    acceleration_x_m_s2: float
    acceleration_y_m_s2: float
    acceleration_z_m_s2: float
    rate_x_deg_s: float
    rate_y_deg_s: float
    rate_z_deg_s: float
    field_x_ut: float
    field_y_ut: float
    field_z_ut: float
    temperature_c: float | None = None
    pressure_pa: float | None = None
    differential_pressure_pa: float | None = None
    pressure_altitude_m: float | None = None


class RawImu(Snapshot):
    """Readings of one inertial sensor without a unit, as its driver gives them: x, y, z of the body axes."""

    acceleration: tuple[int, int, int]
    rate: tuple[int, int, int]
    field: tuple[int, int, int]
    temperature_c: float | None = None


class Odometry(Snapshot):
    """Pose in ``frame`` and velocity in ``child_frame`` (MAV_FRAME), as the estimator reports them.

    Metres, m/s and degrees per second; ``quaternion`` is w, x, y, z. A covariance is the upper right triangle of a
    6×6 matrix, row by row (x, y, z, roll, pitch, yaw), None if unknown. ``quality_percent`` is None if not reported,
    −1 if the odometry has failed.
    """

    frame: int
    child_frame: int
    x_m: float
    y_m: float
    z_m: float
    quaternion: tuple[float, float, float, float]
    x_m_s: float
    y_m_s: float
    z_m_s: float
    roll_rate_deg_s: float
    pitch_rate_deg_s: float
    yaw_rate_deg_s: float
    pose_covariance: tuple[float, ...] | None = None
    velocity_covariance: tuple[float, ...] | None = None
    quality_percent: int | None = None


class AirPressure(Snapshot):
    """Pressures in Pa and temperatures in °C of the first barometer and the first air-speed sensor."""

    absolute_pa: float
    differential_pa: float
    temperature_c: float
    differential_temperature_c: float | None = None


class Altitude(Snapshot):
    """Altitudes of PX4 in metres; None if unknown. ``monotonic_m`` never jumps, but its zero is arbitrary."""

    monotonic_m: float | None
    amsl_m: float | None
    local_m: float | None
    relative_m: float | None
    terrain_m: float | None
    bottom_clearance_m: float | None


class ActuatorControls(Snapshot):
    """Control outputs of one group, −1 to 1: roll, pitch, yaw, throttle and others, before mixing."""

    group: int
    controls: tuple[float, ...]


class Aircraft(Snapshot):
    """Another aircraft that an ADS-B receiver on board has reported; unknown values are None.

    ``altitude_m`` is above mean sea level, geometric if ``altitude_is_geometric``, otherwise by pressure.
    ``course_deg`` is clockwise from north, ``climb_m_s`` up is positive. ``silent_for_s``: seconds between its last
    transmission and the message. ``emitter`` is an ADSB_EMITTER_TYPE. ``squawk`` is read as four decimal digits.
    """

    icao: int
    callsign: str
    latitude_deg: float | None
    longitude_deg: float | None
    altitude_m: float | None
    altitude_is_geometric: bool
    course_deg: float | None
    ground_speed_m_s: float | None
    climb_m_s: float | None
    squawk: int | None
    emitter: int
    silent_for_s: int


class WinchStatus(Snapshot):
    """Line and motor of a winch; unknown values are None. ``flags`` are MAV_WINCH_STATUS_FLAG bits.

    ``speed_m_s`` is positive while the line runs out. ArduCopter reports the ordered speed and the length that follows
    from it.
    """

    length_m: float | None
    speed_m_s: float | None
    tension_kg: float | None
    voltage_v: float | None
    current_a: float | None
    temperature_c: int | None
    flags: int

    @property
    def is_healthy(self) -> bool:
        """True if the winch reports no fault."""
        return bool(self.flags & MavWinchStatusFlag.HEALTHY)


def _deg_s(*rates_rad_s: float) -> tuple[float, ...]:
    return tuple(map(math.degrees, rates_rad_s))


def highres_imu(message: messages.HighresImu) -> Imu:
    """Decode HIGHRES_IMU."""
    return Imu(
        *(message.xacc, message.yacc, message.zacc),
        *_deg_s(message.xgyro, message.ygyro, message.zgyro),
        *(field * GAUSS_UT for field in (message.xmag, message.ymag, message.zmag)),
        temperature_c=finite(message.temperature),
        pressure_pa=message.abs_pressure * HPA_PA,
        differential_pressure_pa=message.diff_pressure * HPA_PA,
        pressure_altitude_m=finite(message.pressure_alt),
    )


def scaled_imu(message: messages.ScaledImu) -> Imu:
    """Decode SCALED_IMU: thousandths of g, rad/s and gauss."""
    return Imu(
        *(axis * MG_M_S2 for axis in (message.xacc, message.yacc, message.zacc)),
        *_deg_s(*(axis / 1000 for axis in (message.xgyro, message.ygyro, message.zgyro))),
        *(axis * MGAUSS_UT for axis in (message.xmag, message.ymag, message.zmag)),
        temperature_c=_centidegrees(message.temperature),
    )


def raw_imu(message: messages.RawImu) -> RawImu:
    """Decode RAW_IMU."""
    return RawImu(
        (message.xacc, message.yacc, message.zacc),
        (message.xgyro, message.ygyro, message.zgyro),
        (message.xmag, message.ymag, message.zmag),
        _centidegrees(message.temperature),
    )


def _centidegrees(value: int) -> float | None:
    return value / 100 if value else None


def odometry(message: messages.Odometry) -> Odometry:
    """Decode ODOMETRY."""
    return Odometry(
        member(MavFrame, message.frame_id),
        member(MavFrame, message.child_frame_id),
        *(message.x, message.y, message.z),
        tuple(message.q),
        *(message.vx, message.vy, message.vz),
        *_deg_s(message.rollspeed, message.pitchspeed, message.yawspeed),
        _covariance(message.pose_covariance),
        _covariance(message.velocity_covariance),
        message.quality or None,
    )


def _covariance(values: tuple[float, ...]) -> tuple[float, ...] | None:
    return None if math.isnan(values[0]) else tuple(values)


def air_pressure(message: messages.ScaledPressure) -> AirPressure:
    """Decode SCALED_PRESSURE."""
    return AirPressure(
        message.press_abs * HPA_PA,
        message.press_diff * HPA_PA,
        message.temperature / 100,
        _centidegrees(message.temperature_press_diff),
    )


def ground_truth(message: messages.HilStateQuaternion) -> Position:
    """Decode the position in HIL_STATE_QUATERNION, the truth of PX4's simulation."""
    return Position(message.lat * 1e-7, message.lon * 1e-7, altitude_amsl_m=message.alt / 1000)


def simulation_state(message: messages.SimState) -> Position:
    """Decode the position in SIM_STATE, the truth of ArduPilot's simulation."""
    latitude, longitude = message.lat_int * 1e-7, message.lon_int * 1e-7
    if not (message.lat_int or message.lon_int):
        latitude, longitude = message.lat, message.lon
    return Position(latitude, longitude, altitude_amsl_m=message.alt)


def altitude(message: messages.Altitude) -> Altitude:
    """Decode ALTITUDE."""
    terrain, clearance = finite(message.altitude_terrain), finite(message.bottom_clearance)
    return Altitude(
        finite(message.altitude_monotonic),
        finite(message.altitude_amsl),
        finite(message.altitude_local),
        finite(message.altitude_relative),
        None if terrain is None or terrain < NO_TERRAIN_M else terrain,
        None if clearance is None or clearance < 0 else clearance,
    )


def actuator_controls(message: messages.ActuatorControlTarget) -> ActuatorControls:
    """Decode ACTUATOR_CONTROL_TARGET."""
    return ActuatorControls(message.group_mlx, tuple(message.controls))


def aircraft(message: messages.AdsbVehicle, context: Context) -> tuple[Aircraft, ...]:
    """Return the aircraft reported so far, at most 64, with this one last."""

    def if_valid(flag: AdsbFlags, value: float) -> float | None:
        return value if message.flags & flag else None

    others = [each for each in context.before or () if each.icao != message.ICAO_address]
    reported = Aircraft(
        message.ICAO_address,
        message.callsign.strip() if message.flags & _F.VALID_CALLSIGN else "",
        if_valid(_F.VALID_COORDS, message.lat * 1e-7),
        if_valid(_F.VALID_COORDS, message.lon * 1e-7),
        if_valid(_F.VALID_ALTITUDE, message.altitude / 1000),
        message.altitude_type == AdsbAltitudeType.GEOMETRIC,
        if_valid(_F.VALID_HEADING, message.heading / 100),
        if_valid(_F.VALID_VELOCITY, message.hor_velocity / 100),
        if_valid(_F.VALID_VELOCITY, message.ver_velocity / 100),
        message.squawk if message.flags & _F.VALID_SQUAWK else None,
        member(AdsbEmitterType, message.emitter_type),
        message.tslc,
    )
    return (*others[-(MAX_AIRCRAFT - 1) :], reported)


def winch(message: messages.WinchStatus) -> WinchStatus:
    """Decode WINCH_STATUS."""
    return WinchStatus(
        *map(finite, (message.line_length, message.speed, message.tension, message.voltage, message.current)),
        unless(message.temperature, I16),
        message.status,
    )
