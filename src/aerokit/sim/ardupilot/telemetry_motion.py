"""Attitude, position, velocity and home, as simulated ArduPilot vehicles tell them."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import EkfStatusFlags, GpsFixType, PlaneMode
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.message import Message
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import GRAVITY_M_S2, quaternion_from_euler


def _attitude(vehicle: ArduPilotVehicle) -> m.Attitude:
    motion = vehicle.motion
    return m.Attitude(
        vehicle.time_boot_ms,
        motion.roll,
        motion.pitch,
        motion.yaw,
        motion.roll_rate,
        motion.pitch_rate,
        motion.yaw_rate,
    )


def _attitude_quaternion(vehicle: ArduPilotVehicle) -> m.AttitudeQuaternion | None:
    if not vehicle.navigation.has_attitude:
        return None
    motion = vehicle.motion
    q = quaternion_from_euler(motion.roll, motion.pitch, motion.yaw)
    return m.AttitudeQuaternion(
        vehicle.time_boot_ms, *q, motion.roll_rate, motion.pitch_rate, motion.yaw_rate
    )


def _attitude_target(vehicle: ArduPilotVehicle) -> m.AttitudeTarget:
    motion = vehicle.motion
    q = quaternion_from_euler(motion.roll, motion.pitch, motion.yaw)
    return m.AttitudeTarget(vehicle.time_boot_ms, 0, q, 0.0, 0.0, motion.yaw_rate, vehicle.motors.throttle)


def _ahrs(vehicle: ArduPilotVehicle) -> m.Ahrs:
    error = 0.01 if vehicle.navigation.has_attitude else 1.0
    return m.Ahrs(0.0, 0.0, 0.0, 0.0, 0.0, error, error)


def _ahrs2(vehicle: ArduPilotVehicle) -> m.Ahrs2:
    motion, place = vehicle.motion, vehicle.navigation.position
    lat, lon, alt = (
        (0, 0, 0.0) if place is None else (place.latitude_e7, place.longitude_e7, place.altitude_m)
    )
    return m.Ahrs2(motion.roll, motion.pitch, motion.yaw, alt, lat, lon)


def _simstate(vehicle: ArduPilotVehicle) -> m.Simstate:
    motion = vehicle.motion
    place = vehicle.navigation.frame.to_global(*motion.place)
    return m.Simstate(
        motion.roll,
        motion.pitch,
        motion.yaw,
        0.0,
        0.0,
        -GRAVITY_M_S2,
        motion.roll_rate,
        motion.pitch_rate,
        motion.yaw_rate,
        place.latitude_e7,
        place.longitude_e7,
    )


def _vfr_hud(vehicle: ArduPilotVehicle) -> m.VfrHud:
    motion, place = vehicle.motion, vehicle.navigation.position
    return m.VfrHud(
        motion.airspeed_m_s if vehicle.navigation.has_position else 0.0,
        motion.ground_speed_m_s,
        int(math.degrees(motion.yaw) % 360.0),
        round(vehicle.motors.throttle * 100),
        0.0 if place is None else place.altitude_m,
        -motion.velocity_down,
    )


Three = tuple[int, int, int]


def _acceleration(vehicle: ArduPilotVehicle) -> Three:
    """In mG."""
    motion = vehicle.motion
    lift = -GRAVITY_M_S2 + (0.0 if vehicle.is_landed else motion.acceleration_down)
    x, y = 1000 * math.sin(motion.pitch), -1000 * math.sin(motion.roll)
    return (_int16(x), _int16(y), _int16(lift / GRAVITY_M_S2 * 1000))


def _rates(vehicle: ArduPilotVehicle) -> Three:
    """In mrad/s."""
    motion = vehicle.motion
    return (
        _int16(motion.roll_rate * 1000),
        _int16(motion.pitch_rate * 1000),
        _int16(motion.yaw_rate * 1000),
    )


def _field(vehicle: ArduPilotVehicle) -> Three:
    """In mG (milligauss)."""
    yaw = vehicle.motion.yaw
    return (_int16(230 * math.cos(yaw)), _int16(-230 * math.sin(yaw)), -530)


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value)))


def _raw_imu(vehicle: ArduPilotVehicle) -> m.RawImu:
    return m.RawImu(
        vehicle.time_boot_us, *_acceleration(vehicle), *_rates(vehicle), *_field(vehicle), 0, 3500
    )


def _scaled(numbers: Three, factor: float) -> tuple[float, float, float]:
    x, y, z = numbers
    return (x * factor, y * factor, z * factor)


def _scaled_imu(vehicle: ArduPilotVehicle) -> m.ScaledImu:
    return m.ScaledImu(
        vehicle.time_boot_ms, *_acceleration(vehicle), *_rates(vehicle), *_field(vehicle), 3500
    )


def _highres_imu(vehicle: ArduPilotVehicle) -> m.HighresImu:
    pressure, motion = _pressure_hpa(vehicle), vehicle.motion
    return m.HighresImu(
        vehicle.time_boot_us,
        *_scaled(_acceleration(vehicle), GRAVITY_M_S2 / 1000.0),
        motion.roll_rate,
        motion.pitch_rate,
        motion.yaw_rate,
        *_scaled(_field(vehicle), 1000.0),
        pressure,
        0.0,
        vehicle.navigation.frame.origin.altitude_m - motion.down,
        28.0,
        8191,
    )


def _scaled_imu2(vehicle: ArduPilotVehicle) -> m.ScaledImu2:
    return m.ScaledImu2(
        vehicle.time_boot_ms, *_acceleration(vehicle), *_rates(vehicle), *_field(vehicle), 3500
    )


def _scaled_imu3(vehicle: ArduPilotVehicle) -> m.ScaledImu3:
    return m.ScaledImu3(vehicle.time_boot_ms, 0, 0, 0, 0, 0, 0, *_field(vehicle))


def _pressure_hpa(vehicle: ArduPilotVehicle) -> float:
    altitude = vehicle.navigation.frame.origin.altitude_m - vehicle.motion.down
    return float(1013.25 * (1 - 2.25577e-5 * altitude) ** 5.25588)


def _scaled_pressure(vehicle: ArduPilotVehicle) -> m.ScaledPressure:
    return m.ScaledPressure(vehicle.time_boot_ms, _pressure_hpa(vehicle), 0.0, 2800, 0)


def _scaled_pressure2(vehicle: ArduPilotVehicle) -> m.ScaledPressure2:
    return m.ScaledPressure2(vehicle.time_boot_ms, _pressure_hpa(vehicle), 0.0, 2800, 0)


def _wind(vehicle: ArduPilotVehicle) -> m.Wind | None:
    if not vehicle.navigation.has_position:
        return None
    wind = vehicle.motion.wind
    speed = math.hypot(wind.north_m_s, wind.east_m_s)
    comes_from = math.degrees(math.atan2(-wind.east_m_s, -wind.north_m_s))
    return m.Wind(comes_from, speed, 0.0)


ATTITUDE_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.Attitude.ID: _attitude,
    m.AttitudeQuaternion.ID: _attitude_quaternion,
    m.AttitudeTarget.ID: _attitude_target,
    m.Ahrs.ID: _ahrs,
    m.Ahrs2.ID: _ahrs2,
    m.Simstate.ID: _simstate,
    m.VfrHud.ID: _vfr_hud,
    m.RawImu.ID: _raw_imu,
    m.ScaledImu.ID: _scaled_imu,
    m.ScaledImu2.ID: _scaled_imu2,
    m.HighresImu.ID: _highres_imu,
    m.ScaledImu3.ID: _scaled_imu3,
    m.ScaledPressure.ID: _scaled_pressure,
    m.ScaledPressure2.ID: _scaled_pressure2,
    m.Wind.ID: _wind,
}
"""Message id → what to send now, or None."""


_NAN4 = (math.nan,) * 4
_POS_HORIZ_ABS = int(EkfStatusFlags.POS_HORIZ_ABS)
_POSITION_ONLY = (
    Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE | Mask.AX_IGNORE | Mask.AY_IGNORE | Mask.AZ_IGNORE
) | (Mask.YAW_IGNORE | Mask.YAW_RATE_IGNORE)


def _global_position(vehicle: ArduPilotVehicle) -> m.GlobalPositionInt:
    motion, nav = vehicle.motion, vehicle.navigation
    place = nav.position
    relative = round(nav.altitude_above_home * 1000)
    heading = round(math.degrees(motion.yaw) % 360.0 * 100) % 36000 if nav.has_attitude else 0
    if place is None:
        return m.GlobalPositionInt(vehicle.time_boot_ms, 0, 0, 0, relative, 0, 0, 0, heading)
    return m.GlobalPositionInt(
        vehicle.time_boot_ms,
        place.latitude_e7,
        place.longitude_e7,
        round(place.altitude_m * 1000),
        relative,
        round(motion.velocity_north * 100),
        round(motion.velocity_east * 100),
        round(motion.velocity_down * 100),
        heading,
    )


def _local_position(vehicle: ArduPilotVehicle) -> m.LocalPositionNed | None:
    motion, nav = vehicle.motion, vehicle.navigation
    if not nav.has_position:
        return None
    north, east, down = nav.local(motion.place)
    return m.LocalPositionNed(
        vehicle.time_boot_ms,
        north,
        east,
        down,
        motion.velocity_north,
        motion.velocity_east,
        motion.velocity_down,
    )


def _gps_raw(vehicle: ArduPilotVehicle) -> m.GpsRawInt:
    motion, nav = vehicle.motion, vehicle.navigation
    if not nav.is_gps_detected:
        return m.GpsRawInt(0, GpsFixType.NO_GPS, 0, 0, 0, 65535, 65535, 0, 0, 0)
    if nav.fix_type < GpsFixType.TYPE_3D_FIX:
        return m.GpsRawInt(0, GpsFixType.NO_FIX, 0, 0, 0, 9999, 9999, 0, 0, 3)
    place = nav.frame.to_global(*motion.place)
    altitude = round(place.altitude_m * 1000)
    course = (
        round(math.degrees(math.atan2(motion.velocity_east, motion.velocity_north)) % 360.0 * 100) % 36000
    )
    return m.GpsRawInt(
        vehicle.time_boot_us,
        nav.fix_type,
        place.latitude_e7,
        place.longitude_e7,
        altitude,
        121,
        200,
        round(motion.ground_speed_m_s * 100),
        course,
        10,
        altitude,
        300,
        300,
    )


def _ekf_status(vehicle: ArduPilotVehicle) -> m.EkfStatusReport | None:
    flags = vehicle.navigation.flags
    if flags is None:
        return None
    size = 0.02 if flags & _POS_HORIZ_ABS else 0.0
    return m.EkfStatusReport(flags, size, size, size / 2, size, 0.0, 0.0)


def home_position(vehicle: ArduPilotVehicle) -> m.HomePosition | None:
    """HOME_POSITION; None without a home. ArduPilot's quaternion is NaN."""
    home = vehicle.navigation.home
    if home is None:
        return None
    place = vehicle.navigation.frame.to_global(*home)
    local = vehicle.navigation.local(home)
    return m.HomePosition(
        place.latitude_e7,
        place.longitude_e7,
        round(place.altitude_m * 1000),
        *local,
        _NAN4,
        0.0,
        0.0,
        0.0,
        vehicle.time_boot_us,
    )


def global_origin(vehicle: ArduPilotVehicle) -> m.GpsGlobalOrigin | None:
    """GPS_GLOBAL_ORIGIN; None before the estimator has one."""
    origin = vehicle.navigation.origin
    if origin is None:
        return None
    place = vehicle.navigation.frame.to_global(*origin)
    return m.GpsGlobalOrigin(
        place.latitude_e7, place.longitude_e7, round(place.altitude_m * 1000), vehicle.time_boot_us
    )


def _target_global(vehicle: ArduPilotVehicle) -> m.PositionTargetGlobalInt | None:
    target = vehicle.mode.destination
    if target is None or not vehicle.motors.is_armed:
        return None
    place = vehicle.navigation.frame.to_global(*target)
    return m.PositionTargetGlobalInt(
        vehicle.time_boot_ms,
        0,
        _POSITION_ONLY | 0xF000,
        place.latitude_e7,
        place.longitude_e7,
        place.altitude_m,
        *(0.0,) * 8,
    )


def _target_local(vehicle: ArduPilotVehicle) -> m.PositionTargetLocalNed | None:
    guided = vehicle.mode
    if not isinstance(guided, Guided):
        return None
    target = guided.destination
    if target is None:
        mask = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE | Mask.YAW_IGNORE | Mask.YAW_RATE_IGNORE
        velocity, acceleration = guided.velocity, guided.acceleration
        return m.PositionTargetLocalNed(
            vehicle.time_boot_ms, 1, mask, 0.0, 0.0, 0.0, *velocity, *acceleration, 0.0, 0.0
        )
    local = vehicle.navigation.local(target)
    return m.PositionTargetLocalNed(vehicle.time_boot_ms, 1, _POSITION_ONLY, *local, *(0.0,) * 8)


def _is_led(vehicle: ArduPilotVehicle) -> bool:
    """Whether there is somewhere to go; a plane has that in every mode but MANUAL, a rover in few."""
    if vehicle.KIND == "plane":
        return vehicle.mode.number != PlaneMode.MANUAL
    mode = vehicle.mode
    return vehicle.KIND != "rover" or (mode.needs_position and not mode.has_manual_throttle)


def _nav_controller(vehicle: ArduPilotVehicle) -> m.NavControllerOutput | None:
    if not _is_led(vehicle):
        return None
    motion, target = vehicle.motion, vehicle.mode.destination
    roll, pitch, yaw = (math.degrees(angle) for angle in (motion.roll, motion.pitch, motion.yaw))
    bearing, distance, altitude_error = _to_target(vehicle, target)
    return m.NavControllerOutput(roll, pitch, round(yaw), bearing, distance, altitude_error, 0.0, 0.0)


def _to_target(vehicle: ArduPilotVehicle, target: Ned | None) -> tuple[int, int, float]:
    if target is None:
        return 0, 0, 0.0
    motion = vehicle.motion
    north, east = target[0] - motion.north, target[1] - motion.east
    bearing = round(math.degrees(math.atan2(east, north)) % 360.0) % 360
    return bearing, min(65535, int(math.hypot(north, east))), motion.down - target[2]


def _terrain_report(vehicle: ArduPilotVehicle) -> m.TerrainReport:
    place = vehicle.navigation.position
    if place is None:
        return m.TerrainReport(0, 0, 100, 0.0, 0.0, 56, 0)
    missing = 0 if vehicle.KIND == "sub" else 504
    return m.TerrainReport(place.latitude_e7, place.longitude_e7, 0, 0.0, place.altitude_m, missing, 0)


def _rangefinder(vehicle: ArduPilotVehicle) -> m.Rangefinder | None:
    distance = _height_below(vehicle)
    return None if distance is None else m.Rangefinder(distance, 0.0)


def _distance_sensor(vehicle: ArduPilotVehicle) -> m.DistanceSensor | None:
    distance = _height_below(vehicle)
    if distance is None:
        return None
    reach = round(vehicle.rangefinder_reach_m * 100)
    return m.DistanceSensor(
        vehicle.time_boot_ms,
        20,
        reach,
        min(reach + 10, round(distance * 100)),
        0,
        0,
        25,
        0,
        signal_quality=100,
    )


def _height_below(vehicle: ArduPilotVehicle) -> float | None:
    if vehicle.rangefinder_reach_m <= 0.0:
        return None
    return vehicle.motion.ground_down - vehicle.motion.down + 0.2


POSITION_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.GlobalPositionInt.ID: _global_position,
    m.LocalPositionNed.ID: _local_position,
    m.GpsRawInt.ID: _gps_raw,
    m.EkfStatusReport.ID: _ekf_status,
    m.HomePosition.ID: home_position,
    m.GpsGlobalOrigin.ID: global_origin,
    m.PositionTargetGlobalInt.ID: _target_global,
    m.PositionTargetLocalNed.ID: _target_local,
    m.NavControllerOutput.ID: _nav_controller,
    m.TerrainReport.ID: _terrain_report,
    m.Rangefinder.ID: _rangefinder,
    m.DistanceSensor.ID: _distance_sensor,
}
"""Message id → what to send now, or None."""
