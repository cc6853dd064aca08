"""State values and decoders: inertial and pressure sensors, odometry, ground truth, traffic, winch."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import AdsbAltitudeType, AdsbEmitterType, AdsbFlags, MavFrame, MavWinchStatusFlag
from aerokit.position import Position
from aerokit.vehicle.state.field import I16, Context, divided, enum_member, finite, known
from aerokit.vehicle.state.movement import valid_coordinates

if TYPE_CHECKING:
    from aerokit.mavlink import messages

__all__ = ["ActuatorControls", "AirPressure", "Aircraft", "Altitude", "Imu", "Odometry", "RawImu", "WinchStatus"]

# Conversion factors: thousandths of g to m/s², milligauss to microtesla, hectopascal to pascal, radians to degrees.
MG_M_S2, MGAUSS_UT, HPA_PA, RAD_DEG = 9.80665e-3, 0.1, 100.0, math.degrees(1)
# ALTITUDE.altitude_terrain is unknown if it is below NO_TERRAIN_M. A temperature of exactly 0 means "unknown".
NO_TERRAIN_M, UNKNOWN_TEMPERATURE = -1000.0, 0
MAX_AIRCRAFT = 64


class Imu(Snapshot):
    """One inertial sensor, in body axes: x forward, y right, z down.

    Accelerations are in m/s², rates in degrees per second, the magnetic field in microtesla (1 gauss is 100 µT),
    pressures in Pa and the pressure altitude in metres. A value that the message does not contain is None.
    """

    acceleration_m_s2: tuple[float, float, float]
    rate_deg_s: tuple[float, float, float]
    field_ut: tuple[float, float, float]
    temperature_c: float | None = None
    pressure_pa: float | None = None
    differential_pressure_pa: float | None = None
    pressure_altitude_m: float | None = None


class RawImu(Snapshot):
    """Raw readings of one inertial sensor along the body axes x, y, z, without a unit."""

    acceleration: tuple[int, int, int]
    rate: tuple[int, int, int]
    field: tuple[int, int, int]
    temperature_c: float | None = None


class Odometry(Snapshot):
    """Pose in ``frame`` and velocity in ``child_frame`` (MAV_FRAME), as the estimator reports them.

    Vectors are along x, y, z, in metres, m/s and degrees per second; ``quaternion`` is w, x, y, z. A covariance is the
    upper right triangle of a 6×6 matrix, row by row (x, y, z, roll, pitch, yaw), None if unknown. ``quality_percent``
    is None if not reported, −1 if the odometry has failed.
    """

    frame: int
    child_frame: int
    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    velocity_m_s: tuple[float, float, float]
    rate_deg_s: tuple[float, float, float]
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
    """Altitudes of PX4 in metres (ALTITUDE). An unknown altitude is None.

    ``monotonic_m`` never jumps, but its zero is arbitrary.
    """

    monotonic_m: float | None
    amsl_m: float | None
    local_m: float | None
    relative_m: float | None
    terrain_m: float | None
    bottom_clearance_m: float | None


class ActuatorControls(Snapshot):
    """Control outputs of one group before mixing, −1 to 1: roll, pitch, yaw, throttle and others."""

    group: int
    controls: tuple[float, ...]


class Aircraft(Snapshot):
    """Another aircraft that an ADS-B receiver on board has reported; unknown values are None.

    ``altitude_m`` is above mean sea level: geometric if ``altitude_is_geometric``, otherwise derived from pressure.
    ``course_deg`` is clockwise from north; ``climb_m_s`` is positive upwards. ``silent_for_s`` is the time between the
    aircraft's last transmission and this message. ``emitter`` is an ADSB_EMITTER_TYPE. ``squawk`` is read as four
    decimal digits.
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

    ``speed_m_s`` is positive while the line runs out. ArduCopter measures neither speed nor length: it reports the
    ordered speed, and a length calculated from this speed.
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


def _scaled(factor: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (x * factor, y * factor, z * factor)


def highres_imu(message: messages.HighresImu, context: Context) -> Imu:
    return Imu(
        acceleration_m_s2=(message.xacc, message.yacc, message.zacc),
        rate_deg_s=_scaled(RAD_DEG, message.xgyro, message.ygyro, message.zgyro),
        field_ut=_scaled(context.autopilot.highres_imu_field_ut, message.xmag, message.ymag, message.zmag),
        temperature_c=finite(message.temperature),
        pressure_pa=message.abs_pressure * HPA_PA,
        differential_pressure_pa=message.diff_pressure * HPA_PA,
        pressure_altitude_m=finite(message.pressure_alt),
    )


def scaled_imu(message: messages.ScaledImu) -> Imu:
    # The units of SCALED_IMU are thousandths of g, of rad/s and of gauss.
    return Imu(
        acceleration_m_s2=_scaled(MG_M_S2, message.xacc, message.yacc, message.zacc),
        rate_deg_s=_scaled(RAD_DEG / 1000, message.xgyro, message.ygyro, message.zgyro),
        field_ut=_scaled(MGAUSS_UT, message.xmag, message.ymag, message.zmag),
        temperature_c=divided(message.temperature, 100, unknown=UNKNOWN_TEMPERATURE),
    )


def raw_imu(message: messages.RawImu) -> RawImu:
    # Only the temperature in RAW_IMU has a unit.
    return RawImu(
        acceleration=(message.xacc, message.yacc, message.zacc),
        rate=(message.xgyro, message.ygyro, message.zgyro),
        field=(message.xmag, message.ymag, message.zmag),
        temperature_c=divided(message.temperature, 100, unknown=UNKNOWN_TEMPERATURE),
    )


def odometry(message: messages.Odometry) -> Odometry:
    w, x, y, z = message.q
    return Odometry(
        frame=enum_member(MavFrame, message.frame_id),
        child_frame=enum_member(MavFrame, message.child_frame_id),
        position_m=(message.x, message.y, message.z),
        quaternion=(w, x, y, z),
        velocity_m_s=(message.vx, message.vy, message.vz),
        rate_deg_s=_scaled(RAD_DEG, message.rollspeed, message.pitchspeed, message.yawspeed),
        pose_covariance=_covariance(message.pose_covariance),
        velocity_covariance=_covariance(message.velocity_covariance),
        quality_percent=message.quality or None,  # 0 means "unknown"
    )


def _covariance(values: tuple[float, ...]) -> tuple[float, ...] | None:
    # NaN in the first element means that the whole matrix is unknown.
    return None if math.isnan(values[0]) else tuple(values)


def air_pressure(message: messages.ScaledPressure) -> AirPressure:
    return AirPressure(
        absolute_pa=message.press_abs * HPA_PA,
        differential_pa=message.press_diff * HPA_PA,
        temperature_c=message.temperature / 100,
        differential_temperature_c=divided(message.temperature_press_diff, 100, unknown=UNKNOWN_TEMPERATURE),
    )


def ground_truth(message: messages.HilStateQuaternion) -> Position | None:
    """Return the true position in PX4's simulation (HIL_STATE_QUATERNION)."""
    coordinates = valid_coordinates(message.lat, message.lon)
    return None if coordinates is None else Position(*coordinates, message.alt / 1000)


def simulation_state(message: messages.SimState) -> Position | None:
    """Return the true position in ArduPilot's simulation (SIM_STATE)."""
    latitude, longitude = message.lat_int, message.lon_int
    # Firmware that does not send the extension fields lat_int and lon_int sends only lat and lon, which are less exact.
    is_in_range = abs(message.lat) <= 90 and abs(message.lon) <= 180
    if latitude == longitude == 0 and is_in_range:
        latitude, longitude = round(message.lat * 1e7), round(message.lon * 1e7)
    coordinates, altitude_m = valid_coordinates(latitude, longitude), finite(message.alt)
    return None if coordinates is None or altitude_m is None else Position(*coordinates, altitude_m)


def altitude(message: messages.Altitude) -> Altitude:
    terrain, clearance = finite(message.altitude_terrain), finite(message.bottom_clearance)
    return Altitude(
        monotonic_m=finite(message.altitude_monotonic),
        amsl_m=finite(message.altitude_amsl),
        local_m=finite(message.altitude_local),
        relative_m=finite(message.altitude_relative),
        terrain_m=None if terrain is None or terrain < NO_TERRAIN_M else terrain,
        # A negative value means "not measured".
        bottom_clearance_m=None if clearance is None or clearance < 0 else clearance,
    )


def actuator_controls(message: messages.ActuatorControlTarget) -> ActuatorControls:
    return ActuatorControls(message.group_mlx, tuple(message.controls))


def aircraft(message: messages.AdsbVehicle, context: Context) -> tuple[Aircraft, ...]:
    """Return the last 64 aircraft reported, with the aircraft of this message last."""

    def if_valid(flag: AdsbFlags, value: float) -> float | None:
        return value if message.flags & flag else None

    earlier = [entry for entry in context.previous_value or () if entry.icao != message.ICAO_address]
    reported = Aircraft(
        icao=message.ICAO_address,
        callsign=message.callsign.strip() if message.flags & AdsbFlags.VALID_CALLSIGN else "",
        latitude_deg=if_valid(AdsbFlags.VALID_COORDS, message.lat * 1e-7),
        longitude_deg=if_valid(AdsbFlags.VALID_COORDS, message.lon * 1e-7),
        altitude_m=if_valid(AdsbFlags.VALID_ALTITUDE, message.altitude / 1000),
        altitude_is_geometric=message.altitude_type == AdsbAltitudeType.GEOMETRIC,
        course_deg=if_valid(AdsbFlags.VALID_HEADING, message.heading / 100),
        ground_speed_m_s=if_valid(AdsbFlags.VALID_VELOCITY, message.hor_velocity / 100),
        climb_m_s=if_valid(AdsbFlags.VALID_VELOCITY, message.ver_velocity / 100),
        squawk=message.squawk if message.flags & AdsbFlags.VALID_SQUAWK else None,
        emitter=enum_member(AdsbEmitterType, message.emitter_type),
        silent_for_s=message.tslc,
    )
    return (*earlier[-(MAX_AIRCRAFT - 1) :], reported)


def winch(message: messages.WinchStatus) -> WinchStatus:
    return WinchStatus(
        length_m=finite(message.line_length),
        speed_m_s=finite(message.speed),
        tension_kg=finite(message.tension),
        voltage_v=finite(message.voltage),
        current_a=finite(message.current),
        temperature_c=known(message.temperature, unknown=I16),
        flags=message.status,
    )
