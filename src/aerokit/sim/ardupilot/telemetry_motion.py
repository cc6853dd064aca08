"""Builders of messages about attitude, position, velocity, targets and terrain of a simulated ArduPilot."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    EkfStatusFlags,
    GpsFixType,
    MavDistanceSensor,
    MavFrame,
    MavSensorOrientation,
    PlaneMode,
)
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.message import Message
from aerokit.sim.ardupilot.copter_guided import CopterGuided
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.motion import GRAVITY_M_S2, GlobalPoint, centidegrees, quaternion_from_euler

Three = tuple[int, int, int]
_UNKNOWN_PLACE = GlobalPoint(0, 0, 0.0)  # As in the firmware, position fields are 0 before the first position.


def _attitude_quaternion(vehicle: ArduPilotVehicle) -> m.AttitudeQuaternion | None:
    if not vehicle.navigation.has_attitude:
        return None
    quaternion = quaternion_from_euler(*vehicle.motion.angles)
    return m.AttitudeQuaternion(vehicle.time_boot_ms, *quaternion, *vehicle.motion.angular_rates)


def _attitude_target(vehicle: ArduPilotVehicle) -> m.AttitudeTarget:
    motion = vehicle.motion
    quaternion = quaternion_from_euler(*motion.angles)
    return m.AttitudeTarget(
        time_boot_ms=vehicle.time_boot_ms, type_mask=0, q=quaternion, body_roll_rate=0.0, body_pitch_rate=0.0,
        body_yaw_rate=motion.yaw_rate, thrust=vehicle.motors.throttle,
    )  # fmt: skip


def _ahrs(vehicle: ArduPilotVehicle) -> m.Ahrs:
    error = 0.01 if vehicle.navigation.has_attitude else 1.0
    return m.Ahrs(
        omegaIx=0.0, omegaIy=0.0, omegaIz=0.0, accel_weight=0.0, renorm_val=0.0, error_rp=error, error_yaw=error
    )


def _ahrs2(vehicle: ArduPilotVehicle) -> m.Ahrs2:
    place = vehicle.navigation.position or _UNKNOWN_PLACE
    return m.Ahrs2(*vehicle.motion.angles, place.altitude_m, place.latitude_e7, place.longitude_e7)


def _simstate(vehicle: ArduPilotVehicle) -> m.Simstate:
    motion = vehicle.motion
    place = vehicle.navigation.frame.to_global(*motion.place)
    gravity = (0.0, 0.0, -GRAVITY_M_S2)
    position = (place.latitude_e7, place.longitude_e7)
    return m.Simstate(*motion.angles, *gravity, *motion.angular_rates, *position)


def _vfr_hud(vehicle: ArduPilotVehicle) -> m.VfrHud:
    motion, place = vehicle.motion, vehicle.navigation.position or _UNKNOWN_PLACE
    # ArduRover sends no airspeed and no climb rate. Its throttle is positive even in reverse.
    is_rover = vehicle.KIND == "rover"
    has_airspeed = vehicle.navigation.has_position and not is_rover
    return m.VfrHud(
        airspeed=motion.airspeed_m_s if has_airspeed else 0.0, groundspeed=motion.ground_speed_m_s,
        heading=int(math.degrees(motion.yaw) % 360.0), throttle=round(abs(vehicle.motors.throttle) * 100),
        alt=place.altitude_m, climb=0.0 if is_rover else -motion.velocity_down,
    )  # fmt: skip


def _acceleration(vehicle: ArduPilotVehicle) -> Three:
    """Return the measured acceleration in milli-g."""
    motion = vehicle.motion
    acceleration_down = 0.0 if vehicle.is_landed else motion.acceleration_down
    x = 1000 * math.sin(motion.pitch)
    y = -1000 * math.sin(motion.roll)
    return (_int16(x), _int16(y), _int16((-GRAVITY_M_S2 + acceleration_down) / GRAVITY_M_S2 * 1000))


def _magnetic_field(vehicle: ArduPilotVehicle) -> Three:
    """Return the field in milligauss."""
    yaw = vehicle.motion.yaw
    return (_int16(230 * math.cos(yaw)), _int16(-230 * math.sin(yaw)), -530)


def _imu(vehicle: ArduPilotVehicle) -> tuple[int, int, int, int, int, int, int, int, int]:
    """Return acceleration (milli-g), turn rates (mrad/s) and magnetic field (milligauss)."""
    roll, pitch, yaw = (_int16(rate * 1000) for rate in vehicle.motion.angular_rates)
    return (*_acceleration(vehicle), roll, pitch, yaw, *_magnetic_field(vehicle))


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value)))


def _highres_imu(vehicle: ArduPilotVehicle) -> m.HighresImu:
    motion = vehicle.motion
    x, y, z = (value * (GRAVITY_M_S2 / 1000.0) for value in _acceleration(vehicle))
    # The firmware multiplies milligauss by 1000, although the fields are in gauss (GCS_Common.cpp).
    north, east, down = (value * 1000.0 for value in _magnetic_field(vehicle))
    altitude = vehicle.navigation.frame.origin.altitude_m - motion.down
    sensors = (x, y, z, *motion.angular_rates, north, east, down, _pressure_hpa(vehicle))
    all_fields = 8191
    return m.HighresImu(
        vehicle.time_boot_us, *sensors, diff_pressure=0.0, pressure_alt=altitude, temperature=28.0,
        fields_updated=all_fields,
    )  # fmt: skip


def _pressure_hpa(vehicle: ArduPilotVehicle) -> float:
    """Return the pressure of the standard atmosphere at the altitude of the vehicle."""
    altitude = vehicle.navigation.frame.origin.altitude_m - vehicle.motion.down
    return float(1013.25 * (1 - 2.25577e-5 * altitude) ** 5.25588)


def _wind(vehicle: ArduPilotVehicle) -> m.Wind | None:
    if not vehicle.navigation.has_position:
        return None
    wind = vehicle.motion.wind
    speed = math.hypot(wind.north_m_s, wind.east_m_s)
    comes_from = math.degrees(math.atan2(-wind.east_m_s, -wind.north_m_s))
    return m.Wind(comes_from, speed, 0.0)


_POS_HORIZ_ABS = int(EkfStatusFlags.POS_HORIZ_ABS)
_NO_YAW = Mask.YAW_IGNORE | Mask.YAW_RATE_IGNORE
_WITHOUT_POSITION = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE | _NO_YAW
_POSITION_ONLY = (
    Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE | Mask.AX_IGNORE | Mask.AY_IGNORE | Mask.AZ_IGNORE | _NO_YAW
)  # fmt: skip
# Four undefined bits of the type mask, which ArduPilot sets in POSITION_TARGET_GLOBAL_INT, but not in
# POSITION_TARGET_LOCAL_NED (GCS_MAVLink_Copter.cpp).
_UNDEFINED_BITS = 0xF000
# Spacing of the terrain grid in metres, and the offset in degrees from the vehicle to the corner of its terrain block.
_GRID_M, _GRID_CORNER = 100, (0.0115, 0.0104)
_GRIDS_PER_BLOCK = 56  # The mask of TERRAIN_REQUEST has one bit for each grid of a block.
_REQUESTED_BLOCKS = 9  # The firmware requests the vehicle's block and its neighbours (AP_Terrain.cpp).
_RANGEFINDER_HEIGHT_M = 0.2  # Height of the sensor above the ground on which the vehicle stands.


def _global_position(vehicle: ArduPilotVehicle) -> m.GlobalPositionInt:
    motion, nav = vehicle.motion, vehicle.navigation
    place = nav.position or _UNKNOWN_PLACE
    relative = round(nav.altitude_above_home * 1000)
    heading = centidegrees(motion.yaw) if nav.has_attitude else 0
    altitude = round(place.altitude_m * 1000)
    is_known = place is not _UNKNOWN_PLACE
    north, east, down = (round(speed * 100) if is_known else 0 for speed in motion.velocity)
    return m.GlobalPositionInt(
        vehicle.time_boot_ms, lat=place.latitude_e7, lon=place.longitude_e7, alt=altitude, relative_alt=relative,
        vx=north, vy=east, vz=down, hdg=heading,
    )  # fmt: skip


def _local_position(vehicle: ArduPilotVehicle) -> m.LocalPositionNed | None:
    motion, nav = vehicle.motion, vehicle.navigation
    if not nav.has_position:
        return None
    return m.LocalPositionNed(vehicle.time_boot_ms, *nav.local(motion.place), *motion.velocity)


def _gps_raw(vehicle: ArduPilotVehicle) -> m.GpsRawInt:
    motion, nav = vehicle.motion, vehicle.navigation
    if not nav.is_gps_detected:
        return _gps_without_fix(GpsFixType.NO_GPS, dilution=65535, satellites=0)  # 65535 means unknown.
    if nav.fix_type < GpsFixType.TYPE_3D_FIX:
        return _gps_without_fix(GpsFixType.NO_FIX, dilution=9999, satellites=3)
    place = nav.frame.to_global(*motion.place)
    altitude = round(place.altitude_m * 1000)
    return m.GpsRawInt(
        time_usec=vehicle.time_boot_us, fix_type=nav.fix_type, lat=place.latitude_e7, lon=place.longitude_e7,
        alt=altitude, eph=121, epv=200, vel=round(motion.ground_speed_m_s * 100),
        cog=centidegrees(motion.course), satellites_visible=10,
        alt_ellipsoid=altitude, h_acc=300, v_acc=300,
    )  # fmt: skip


def _gps_without_fix(fix_type: int, *, dilution: int, satellites: int) -> m.GpsRawInt:
    return m.GpsRawInt(
        time_usec=0, fix_type=fix_type, lat=0, lon=0, alt=0, eph=dilution, epv=dilution, vel=0, cog=0,
        satellites_visible=satellites,
    )  # fmt: skip


def _ekf_status(vehicle: ArduPilotVehicle) -> m.EkfStatusReport | None:
    flags = vehicle.navigation.flags
    if flags is None:
        return None
    variance = 0.02 if flags & _POS_HORIZ_ABS else 0.0
    return m.EkfStatusReport(
        flags=flags, velocity_variance=variance, pos_horiz_variance=variance, pos_vert_variance=variance / 2,
        compass_variance=variance, terrain_alt_variance=0.0, airspeed_variance=0.0,
    )  # fmt: skip


def _home_position(vehicle: ArduPilotVehicle) -> m.HomePosition | None:
    home = vehicle.navigation.home
    if home is None:
        return None
    place = vehicle.navigation.frame.to_global(*home)
    x, y, z = vehicle.navigation.local(home)
    quaternion = (math.nan,) * 4  # ArduPilot sends NaN, too.
    return m.HomePosition(
        latitude=place.latitude_e7, longitude=place.longitude_e7, altitude=round(place.altitude_m * 1000),
        x=x, y=y, z=z, q=quaternion, approach_x=0.0, approach_y=0.0, approach_z=0.0, time_usec=vehicle.time_boot_us,
    )  # fmt: skip


def _global_origin(vehicle: ArduPilotVehicle) -> m.GpsGlobalOrigin | None:
    origin = vehicle.navigation.origin
    if origin is None:
        return None
    place = vehicle.navigation.frame.to_global(*origin)
    altitude = round(place.altitude_m * 1000)
    return m.GpsGlobalOrigin(place.latitude_e7, place.longitude_e7, altitude, vehicle.time_boot_us)


def _target_global(vehicle: ArduPilotVehicle) -> m.PositionTargetGlobalInt | None:
    target = vehicle.mode.destination
    if target is None or not vehicle.motors.is_armed:
        return None
    place = vehicle.navigation.frame.to_global(*target)
    position = (place.latitude_e7, place.longitude_e7, place.altitude_m)
    mask = _POSITION_ONLY | _UNDEFINED_BITS
    return m.PositionTargetGlobalInt(vehicle.time_boot_ms, MavFrame.GLOBAL, mask, *position, *(0.0,) * 8)


def _target_local(vehicle: ArduPilotVehicle) -> m.PositionTargetLocalNed | None:
    guided, time = vehicle.mode, vehicle.time_boot_ms
    if not isinstance(guided, CopterGuided):
        return None
    target = guided.destination
    if target is None:  # The submode follows a velocity, not a position.
        vectors = (0.0, 0.0, 0.0, *guided.velocity, *guided.acceleration)
        return m.PositionTargetLocalNed(time, MavFrame.LOCAL_NED, _WITHOUT_POSITION, *vectors, yaw=0.0, yaw_rate=0.0)
    local = vehicle.navigation.local(target)
    return m.PositionTargetLocalNed(time, MavFrame.LOCAL_NED, _POSITION_ONLY, *local, *(0.0,) * 8)


def _is_navigating(vehicle: ArduPilotVehicle) -> bool:
    """Return True if the firmware sends NAV_CONTROLLER_OUTPUT in the present mode."""
    mode = vehicle.mode
    if vehicle.KIND == "plane":
        return mode.number != PlaneMode.MANUAL
    return vehicle.KIND != "rover" or (mode.needs_position and not mode.has_manual_throttle)


def _nav_controller(vehicle: ArduPilotVehicle) -> m.NavControllerOutput | None:
    if not _is_navigating(vehicle):
        return None
    motion, target = vehicle.motion, vehicle.mode.destination
    roll, pitch, yaw = map(math.degrees, motion.angles)
    bearing, distance, altitude_error = 0, 0, 0.0
    if target is not None:
        _, _, target_down = target
        bearing = round(math.degrees(motion.bearing_to(target)) % 360.0) % 360  # Rounding may give 360, which is 0.
        distance = min(65535, int(motion.distance_to(target)))
        altitude_error = motion.down - target_down
    return m.NavControllerOutput(
        nav_roll=roll, nav_pitch=pitch, nav_bearing=round(yaw), target_bearing=bearing, wp_dist=distance,
        alt_error=altitude_error, aspd_error=0.0, xtrack_error=0.0,
    )  # fmt: skip


def _terrain_report(vehicle: ArduPilotVehicle) -> m.TerrainReport:
    place = vehicle.navigation.position
    if place is None:
        return m.TerrainReport(
            lat=0, lon=0, spacing=_GRID_M, terrain_height=0.0, current_height=0.0, pending=_GRIDS_PER_BLOCK, loaded=0
        )
    pending = 0 if vehicle.KIND == "sub" else _REQUESTED_BLOCKS * _GRIDS_PER_BLOCK
    # A spacing of 0 means that no terrain data is available for this place.
    return m.TerrainReport(
        lat=place.latitude_e7, lon=place.longitude_e7, spacing=0, terrain_height=0.0, current_height=place.altitude_m,
        pending=pending, loaded=0,
    )  # fmt: skip


def _terrain_request(vehicle: ArduPilotVehicle) -> m.TerrainRequest | None:
    place = vehicle.navigation.position
    if place is None:
        return None
    south_offset_e7, west_offset_e7 = (round(1e7 * degrees) for degrees in _GRID_CORNER)
    # All grids are requested, because the vehicle stores no terrain data.
    all_grids = (1 << _GRIDS_PER_BLOCK) - 1
    return m.TerrainRequest(
        place.latitude_e7 - south_offset_e7, place.longitude_e7 - west_offset_e7, _GRID_M, all_grids
    )


def _rangefinder(vehicle: ArduPilotVehicle) -> m.Rangefinder | None:
    distance = _height_above_ground(vehicle)
    return None if distance is None else m.Rangefinder(distance, 0.0)


def _distance_sensor(vehicle: ArduPilotVehicle) -> m.DistanceSensor | None:
    distance = _height_above_ground(vehicle)
    if distance is None:
        return None
    reach_cm = round(vehicle.rangefinder_reach_m * 100)
    return m.DistanceSensor(
        time_boot_ms=vehicle.time_boot_ms, min_distance=20, max_distance=reach_cm,
        current_distance=min(reach_cm + 10, round(distance * 100)), type=MavDistanceSensor.LASER, id=0,
        orientation=MavSensorOrientation.PITCH_270, covariance=0, signal_quality=100,
    )  # fmt: skip


def _height_above_ground(vehicle: ArduPilotVehicle) -> float | None:
    if vehicle.rangefinder_reach_m <= 0.0:
        return None
    return vehicle.motion.ground_down - vehicle.motion.down + _RANGEFINDER_HEIGHT_M


MOTION_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.Attitude.ID: lambda v: m.Attitude(v.time_boot_ms, *v.motion.angles, *v.motion.angular_rates),
    m.AttitudeQuaternion.ID: _attitude_quaternion,
    m.AttitudeTarget.ID: _attitude_target,
    m.Ahrs.ID: _ahrs,
    m.Ahrs2.ID: _ahrs2,
    m.Simstate.ID: _simstate,
    m.VfrHud.ID: _vfr_hud,
    m.RawImu.ID: lambda v: m.RawImu(v.time_boot_us, *_imu(v), id=0, temperature=3500),
    m.ScaledImu.ID: lambda v: m.ScaledImu(v.time_boot_ms, *_imu(v), temperature=3500),
    m.ScaledImu2.ID: lambda v: m.ScaledImu2(v.time_boot_ms, *_imu(v), temperature=3500),
    # The third compass has no accelerometers and no gyroscopes, so their six values are 0.
    m.ScaledImu3.ID: lambda v: m.ScaledImu3(v.time_boot_ms, 0, 0, 0, 0, 0, 0, *_magnetic_field(v)),
    m.HighresImu.ID: _highres_imu,
    m.ScaledPressure.ID: lambda v: m.ScaledPressure(
        v.time_boot_ms, _pressure_hpa(v), press_diff=0.0, temperature=2800, temperature_press_diff=0
    ),
    m.ScaledPressure2.ID: lambda v: m.ScaledPressure2(
        v.time_boot_ms, _pressure_hpa(v), press_diff=0.0, temperature=2800, temperature_press_diff=0
    ),
    m.Wind.ID: _wind,
    m.GlobalPositionInt.ID: _global_position,
    m.LocalPositionNed.ID: _local_position,
    m.GpsRawInt.ID: _gps_raw,
    m.EkfStatusReport.ID: _ekf_status,
    m.HomePosition.ID: _home_position,
    m.GpsGlobalOrigin.ID: _global_origin,
    m.PositionTargetGlobalInt.ID: _target_global,
    m.PositionTargetLocalNed.ID: _target_local,
    m.NavControllerOutput.ID: _nav_controller,
    m.TerrainReport.ID: _terrain_report,
    m.TerrainRequest.ID: _terrain_request,
    m.Rangefinder.ID: _rangefinder,
    m.DistanceSensor.ID: _distance_sensor,
}
"""Functions that build messages, by message id. A function returns None if there is nothing to send."""
