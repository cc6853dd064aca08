"""What a simulated ArduPilot says of its attitude, speed and inertial sensors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.sim.motion import GRAVITY_M_S2
from aerokit.sim.rotations import quaternion_from_euler

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["ATTITUDE_BUILDERS"]


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
    place = vehicle.navigation.frame.to_global(motion.north, motion.east, motion.down)
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
