"""What a simulated ArduCopter says of itself: one function per message, in the units and with the gaps of the real one.

Values that are unknown look as they do on the real vehicle: latitude and longitude 0 before the first fix, no
LOCAL_POSITION_NED and no WIND before the estimator uses GPS, no HOME_POSITION without a home.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    EkfStatusFlags,
    GpsFixType,
    MavAutopilot,
    MavBatteryChargeState,
    MavLandedState,
    MavModeFlag,
    MavState,
    MavType,
    MissionState,
)
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.sim.ardupilot.sensor_status import sensor_status
from aerokit.sim.motion import GRAVITY_M_S2

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.copter import SimulatedCopter
    from aerokit.sim.ardupilot.navigation import Ned

__all__ = ["BUILDERS", "global_origin", "heartbeat", "home_position"]

_NAN4 = (math.nan,) * 4
_UNKNOWN_CELL = 0xFFFF
_POSITION_ONLY = (
    Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE | Mask.AX_IGNORE | Mask.AY_IGNORE | Mask.AZ_IGNORE
) | (Mask.YAW_IGNORE | Mask.YAW_RATE_IGNORE)
_GUIDED_MODES = frozenset(
    {"GUIDED", "LOITER", "POSHOLD", "CIRCLE", "BRAKE", "RTL", "SMARTRTL", "LAND", "AUTO"}
)


# ----------------------------------------------------------------------------------------- state


def heartbeat(copter: SimulatedCopter) -> m.Heartbeat:
    """HEARTBEAT; BOOT until half a second after the vehicle is initialised."""
    base = MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED
    if not copter.has_left_boot:
        return m.Heartbeat(
            MavType.QUADROTOR,
            MavAutopilot.ARDUPILOTMEGA,
            base | MavModeFlag.GUIDED_ENABLED,
            copter.mode.number,
            MavState.BOOT,
            3,
        )
    if copter.mode.name in _GUIDED_MODES and (copter.motors.is_armed or copter.mode.name == "GUIDED"):
        base |= MavModeFlag.GUIDED_ENABLED
    if copter.motors.is_armed:
        base |= MavModeFlag.SAFETY_ARMED
    return m.Heartbeat(
        MavType.QUADROTOR, MavAutopilot.ARDUPILOTMEGA, base, copter.mode.number, _state(copter), 3
    )


def _state(copter: SimulatedCopter) -> int:
    if copter.failsafes.is_any_active:
        return MavState.CRITICAL
    return MavState.STANDBY if copter.is_landed else MavState.ACTIVE


def _sys_status(copter: SimulatedCopter) -> m.SysStatus:
    present, enabled, health = sensor_status(copter)
    battery = copter.battery
    return m.SysStatus(
        present,
        enabled,
        health,
        0,
        round(battery.voltage_v * 1000),
        round(battery.current_a * 100),
        int(battery.percent),
        0,
        0,
        0,
        0,
        0,
        0,
    )


def _extended_sys_state(copter: SimulatedCopter) -> m.ExtendedSysState:
    state = MavLandedState.IN_AIR
    if copter.is_landed:
        state = MavLandedState.ON_GROUND
    elif copter.mode.is_landing:
        state = MavLandedState.LANDING
    elif copter.mode.is_taking_off:
        state = MavLandedState.TAKEOFF
    return m.ExtendedSysState(0, state)


def _battery_status(copter: SimulatedCopter) -> m.BatteryStatus:
    battery = copter.battery
    voltages = (round(battery.voltage_v * 1000), *(_UNKNOWN_CELL,) * 9)
    low = copter.failsafes.battery_is_low
    return m.BatteryStatus(
        0,
        0,
        0,
        32767,
        voltages,
        round(battery.current_a * 100),
        round(battery.consumed_mah),
        round(battery.consumed_wh * 36),
        int(battery.percent),
        0,
        MavBatteryChargeState.LOW if low else MavBatteryChargeState.OK,
    )


def _power_status(copter: SimulatedCopter) -> m.PowerStatus:
    return m.PowerStatus(5000, 0, 0)


def _meminfo(copter: SimulatedCopter) -> m.Meminfo:
    return m.Meminfo(0, 65535, 524288)


def _system_time(copter: SimulatedCopter) -> m.SystemTime:
    unix = round(copter.unix_time * 1e6) if copter.navigation.fix_type >= GpsFixType.TYPE_3D_FIX else 0
    return m.SystemTime(unix, copter.time_boot_ms)


def _mission_current(copter: SimulatedCopter) -> m.MissionCurrent:
    return m.MissionCurrent(0, 0, MissionState.NO_MISSION, 0)


def _rc_channels(copter: SimulatedCopter) -> m.RcChannels:
    return m.RcChannels(copter.time_boot_ms, len(copter.rc), *copter.rc, *(0,) * (18 - len(copter.rc)), 255)


def _servo_output(copter: SimulatedCopter) -> m.ServoOutputRaw:
    pwm = copter.motors.pwm
    return m.ServoOutputRaw(_micros(copter), 0, pwm, pwm, pwm, pwm, 0, 0, 0, 0)


def _vibration(copter: SimulatedCopter) -> m.Vibration:
    size = 0.003 + 0.3 * copter.motors.throttle
    x, y, z = (abs(copter.rng.gauss(0.0, size)) for _ in range(3))
    return m.Vibration(_micros(copter), x, y, z, 0, 0, 0)


def _esc_telemetry(copter: SimulatedCopter) -> m.EscTelemetry1To4:
    current = round(copter.battery.current_a * 25)
    rpm = round(copter.motors.throttle * 15000)
    count = int(copter.uptime * 100) & 0xFFFF
    voltage = round(copter.battery.voltage_v * 100)
    return m.EscTelemetry1To4(
        bytes([32] * 4), (voltage,) * 4, (current,) * 4, (0,) * 4, (rpm,) * 4, (count,) * 4
    )


def _autopilot_version(copter: SimulatedCopter) -> m.AutopilotVersion:
    return m.AutopilotVersion(
        copter.CAPABILITIES,
        copter.version_number,
        0,
        0,
        0,
        copter.GIT_HASH,
        bytes(8),
        bytes(8),
        0,
        0,
        0,
        copter.uid,
    )


# ------------------------------------------------------------------------------ attitude and speed


def _attitude(copter: SimulatedCopter) -> m.Attitude:
    motion = copter.motion
    return m.Attitude(
        copter.time_boot_ms,
        motion.roll,
        motion.pitch,
        motion.yaw,
        motion.roll_rate,
        motion.pitch_rate,
        motion.yaw_rate,
    )


def _attitude_quaternion(copter: SimulatedCopter) -> m.AttitudeQuaternion | None:
    if not copter.navigation.has_attitude:
        return None
    motion = copter.motion
    q = quaternion(motion.roll, motion.pitch, motion.yaw)
    return m.AttitudeQuaternion(copter.time_boot_ms, *q, motion.roll_rate, motion.pitch_rate, motion.yaw_rate)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Euler angles as w, x, y, z."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _attitude_target(copter: SimulatedCopter) -> m.AttitudeTarget:
    motion = copter.motion
    q = quaternion(motion.roll, motion.pitch, motion.yaw)
    return m.AttitudeTarget(copter.time_boot_ms, 0, q, 0.0, 0.0, motion.yaw_rate, copter.motors.throttle)


def _ahrs(copter: SimulatedCopter) -> m.Ahrs:
    error = 0.01 if copter.navigation.has_attitude else 1.0
    return m.Ahrs(0.0, 0.0, 0.0, 0.0, 0.0, error, error)


def _ahrs2(copter: SimulatedCopter) -> m.Ahrs2:
    motion, place = copter.motion, copter.navigation.position
    lat, lon, alt = (
        (0, 0, 0.0) if place is None else (place.latitude_e7, place.longitude_e7, place.altitude_m)
    )
    return m.Ahrs2(motion.roll, motion.pitch, motion.yaw, alt, lat, lon)


def _simstate(copter: SimulatedCopter) -> m.Simstate:
    motion = copter.motion
    place = copter.navigation.frame.to_global(motion.north, motion.east, motion.down)
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


def _vfr_hud(copter: SimulatedCopter) -> m.VfrHud:
    motion, place = copter.motion, copter.navigation.position
    return m.VfrHud(
        motion.airspeed_m_s if copter.navigation.has_position else 0.0,
        motion.ground_speed_m_s,
        int(math.degrees(motion.yaw) % 360.0),
        round(copter.motors.throttle * 100),
        0.0 if place is None else place.altitude_m,
        -motion.velocity_down,
    )


def _imu_values(copter: SimulatedCopter) -> tuple[int, ...]:
    motion = copter.motion
    lift = -GRAVITY_M_S2 + (motion.acceleration_down if not copter.is_landed else 0.0)
    accel = (1000 * math.sin(motion.pitch), -1000 * math.sin(motion.roll), lift / GRAVITY_M_S2 * 1000)
    gyro = (motion.roll_rate * 1000, motion.pitch_rate * 1000, motion.yaw_rate * 1000)
    field = (230 * math.cos(motion.yaw), -230 * math.sin(motion.yaw), -530.0)
    return tuple(max(-32768, min(32767, round(value))) for value in (*accel, *gyro, *field))


def _raw_imu(copter: SimulatedCopter) -> m.RawImu:
    return m.RawImu(_micros(copter), *_imu_values(copter), 0, 3500)


def _scaled_imu2(copter: SimulatedCopter) -> m.ScaledImu2:
    return m.ScaledImu2(copter.time_boot_ms, *_imu_values(copter), 3500)


def _scaled_imu3(copter: SimulatedCopter) -> m.ScaledImu3:
    return m.ScaledImu3(copter.time_boot_ms, 0, 0, 0, 0, 0, 0, *_imu_values(copter)[6:], 0)


def _pressure_hpa(copter: SimulatedCopter) -> float:
    altitude = copter.navigation.frame.origin.altitude_m - copter.motion.down
    return float(1013.25 * (1 - 2.25577e-5 * altitude) ** 5.25588)


def _scaled_pressure(copter: SimulatedCopter) -> m.ScaledPressure:
    return m.ScaledPressure(copter.time_boot_ms, _pressure_hpa(copter), 0.0, 2800, 0)


def _scaled_pressure2(copter: SimulatedCopter) -> m.ScaledPressure2:
    return m.ScaledPressure2(copter.time_boot_ms, _pressure_hpa(copter), 0.0, 2800, 0)


def _wind(copter: SimulatedCopter) -> m.Wind | None:
    if not copter.navigation.has_position:
        return None
    wind = copter.motion.wind
    speed = math.hypot(wind.north_m_s, wind.east_m_s)
    comes_from = math.degrees(math.atan2(-wind.east_m_s, -wind.north_m_s))
    return m.Wind(comes_from, speed, 0.0)


# ----------------------------------------------------------------------------------------- position


def _global_position(copter: SimulatedCopter) -> m.GlobalPositionInt:
    motion, nav = copter.motion, copter.navigation
    place = nav.position
    relative = round(nav.altitude_above_home * 1000)
    heading = round(math.degrees(motion.yaw) % 360.0 * 100) % 36000 if nav.has_attitude else 0
    if place is None:
        return m.GlobalPositionInt(copter.time_boot_ms, 0, 0, 0, relative, 0, 0, 0, heading)
    return m.GlobalPositionInt(
        copter.time_boot_ms,
        place.latitude_e7,
        place.longitude_e7,
        round(place.altitude_m * 1000),
        relative,
        round(motion.velocity_north * 100),
        round(motion.velocity_east * 100),
        round(motion.velocity_down * 100),
        heading,
    )


def _local_position(copter: SimulatedCopter) -> m.LocalPositionNed | None:
    motion, nav = copter.motion, copter.navigation
    if not nav.has_position:
        return None
    north, east, down = nav.local((motion.north, motion.east, motion.down))
    return m.LocalPositionNed(
        copter.time_boot_ms,
        north,
        east,
        down,
        motion.velocity_north,
        motion.velocity_east,
        motion.velocity_down,
    )


def _gps_raw(copter: SimulatedCopter) -> m.GpsRawInt:
    motion, nav = copter.motion, copter.navigation
    if not nav.is_gps_detected:
        return m.GpsRawInt(0, GpsFixType.NO_GPS, 0, 0, 0, 65535, 65535, 0, 0, 0)
    if nav.fix_type < GpsFixType.TYPE_3D_FIX:
        return m.GpsRawInt(0, GpsFixType.NO_FIX, 0, 0, 0, 9999, 9999, 0, 0, 3)
    place = nav.frame.to_global(motion.north, motion.east, motion.down)
    altitude = round(place.altitude_m * 1000)
    course = (
        round(math.degrees(math.atan2(motion.velocity_east, motion.velocity_north)) % 360.0 * 100) % 36000
    )
    return m.GpsRawInt(
        _micros(copter),
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


def _ekf_status(copter: SimulatedCopter) -> m.EkfStatusReport | None:
    flags = copter.navigation.flags
    if flags is None:
        return None
    size = 0.02 if flags & EkfStatusFlags.POS_HORIZ_ABS else 0.0
    return m.EkfStatusReport(flags, size, size, size / 2, size, 0.0, 0.0)


def home_position(copter: SimulatedCopter) -> m.HomePosition | None:
    """HOME_POSITION; None without a home. ArduPilot's quaternion is NaN."""
    home = copter.navigation.home
    if home is None:
        return None
    place = copter.navigation.frame.to_global(*home)
    local = copter.navigation.local(home)
    return m.HomePosition(
        place.latitude_e7,
        place.longitude_e7,
        round(place.altitude_m * 1000),
        *local,
        _NAN4,
        0.0,
        0.0,
        0.0,
        _micros(copter),
    )


def global_origin(copter: SimulatedCopter) -> m.GpsGlobalOrigin | None:
    """GPS_GLOBAL_ORIGIN; None before the estimator has one."""
    origin = copter.navigation.origin
    if origin is None:
        return None
    place = copter.navigation.frame.to_global(*origin)
    return m.GpsGlobalOrigin(
        place.latitude_e7, place.longitude_e7, round(place.altitude_m * 1000), _micros(copter)
    )


def _target_global(copter: SimulatedCopter) -> m.PositionTargetGlobalInt | None:
    target = copter.mode.destination
    if target is None or not copter.motors.is_armed:
        return None
    place = copter.navigation.frame.to_global(*target)
    return m.PositionTargetGlobalInt(
        copter.time_boot_ms,
        0,
        _POSITION_ONLY | 0xF000,
        place.latitude_e7,
        place.longitude_e7,
        place.altitude_m,
        *(0.0,) * 8,
    )


def _target_local(copter: SimulatedCopter) -> m.PositionTargetLocalNed | None:
    if copter.mode is not copter.guided:
        return None
    target = copter.guided.destination
    if target is None:
        mask = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE | Mask.YAW_IGNORE | Mask.YAW_RATE_IGNORE
        velocity, acceleration = copter.guided.velocity, copter.guided.acceleration
        return m.PositionTargetLocalNed(
            copter.time_boot_ms, 1, mask, 0.0, 0.0, 0.0, *velocity, *acceleration, 0.0, 0.0
        )
    local = copter.navigation.local(target)
    return m.PositionTargetLocalNed(copter.time_boot_ms, 1, _POSITION_ONLY, *local, *(0.0,) * 8)


def _nav_controller(copter: SimulatedCopter) -> m.NavControllerOutput:
    motion, target = copter.motion, copter.mode.destination
    roll, pitch, yaw = (math.degrees(angle) for angle in (motion.roll, motion.pitch, motion.yaw))
    bearing, distance, altitude_error = _to_target(copter, target)
    return m.NavControllerOutput(roll, pitch, round(yaw), bearing, distance, altitude_error, 0.0, 0.0)


def _to_target(copter: SimulatedCopter, target: Ned | None) -> tuple[int, int, float]:
    if target is None:
        return 0, 0, 0.0
    motion = copter.motion
    north, east = target[0] - motion.north, target[1] - motion.east
    bearing = round(math.degrees(math.atan2(east, north)) % 360.0) % 360
    return bearing, min(65535, int(math.hypot(north, east))), motion.down - target[2]


def _terrain_report(copter: SimulatedCopter) -> m.TerrainReport:
    place = copter.navigation.position
    if place is None:
        return m.TerrainReport(0, 0, 100, 0.0, 0.0, 56, 0)
    return m.TerrainReport(place.latitude_e7, place.longitude_e7, 0, 0.0, place.altitude_m, 504, 0)


def _rangefinder(copter: SimulatedCopter) -> m.Rangefinder | None:
    distance = _height_below(copter)
    return None if distance is None else m.Rangefinder(distance, 0.0)


def _distance_sensor(copter: SimulatedCopter) -> m.DistanceSensor | None:
    distance = _height_below(copter)
    if distance is None:
        return None
    reach = round(copter.rangefinder_reach_m * 100)
    return m.DistanceSensor(
        copter.time_boot_ms,
        20,
        reach,
        min(reach + 10, round(distance * 100)),
        0,
        0,
        25,
        0,
        signal_quality=100,
    )


def _height_below(copter: SimulatedCopter) -> float | None:
    if copter.rangefinder_reach_m <= 0.0:
        return None
    return copter.motion.ground_down - copter.motion.down + 0.2


def _micros(copter: SimulatedCopter) -> int:
    return int(copter.uptime * 1e6)


BUILDERS: dict[int, Callable[[SimulatedCopter], Message | None]] = {
    m.Heartbeat.ID: heartbeat,
    m.SysStatus.ID: _sys_status,
    m.ExtendedSysState.ID: _extended_sys_state,
    m.BatteryStatus.ID: _battery_status,
    m.PowerStatus.ID: _power_status,
    m.Meminfo.ID: _meminfo,
    m.SystemTime.ID: _system_time,
    m.MissionCurrent.ID: _mission_current,
    m.RcChannels.ID: _rc_channels,
    m.ServoOutputRaw.ID: _servo_output,
    m.Vibration.ID: _vibration,
    m.EscTelemetry1To4.ID: _esc_telemetry,
    m.AutopilotVersion.ID: _autopilot_version,
    m.Attitude.ID: _attitude,
    m.AttitudeQuaternion.ID: _attitude_quaternion,
    m.AttitudeTarget.ID: _attitude_target,
    m.Ahrs.ID: _ahrs,
    m.Ahrs2.ID: _ahrs2,
    m.Simstate.ID: _simstate,
    m.VfrHud.ID: _vfr_hud,
    m.RawImu.ID: _raw_imu,
    m.ScaledImu2.ID: _scaled_imu2,
    m.ScaledImu3.ID: _scaled_imu3,
    m.ScaledPressure.ID: _scaled_pressure,
    m.ScaledPressure2.ID: _scaled_pressure2,
    m.Wind.ID: _wind,
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
