"""The three bit masks of SYS_STATUS as ArduCopter fills them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavSysStatusSensor as Sensor

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["sensor_status"]

_FENCE = Sensor.MAV_SYS_STATUS_GEOFENCE
_PREARM = Sensor.MAV_SYS_STATUS_PREARM_CHECK
_AHRS = Sensor.MAV_SYS_STATUS_AHRS
_LOGGING = Sensor.MAV_SYS_STATUS_LOGGING
_ALWAYS = (
    Sensor.SENSOR_3D_GYRO
    | Sensor.SENSOR_3D_ACCEL
    | Sensor.SENSOR_3D_MAG
    | Sensor.ABSOLUTE_PRESSURE
    | Sensor.ANGULAR_RATE_CONTROL
    | Sensor.ATTITUDE_STABILIZATION
    | Sensor.YAW_POSITION
    | Sensor.MOTOR_OUTPUTS
    | Sensor.RC_RECEIVER
    | Sensor.MAV_SYS_STATUS_TERRAIN
    | Sensor.BATTERY
    | Sensor.PROPULSION
)
_CONTROL = Sensor.Z_ALTITUDE_CONTROL | Sensor.XY_POSITION_CONTROL
_PRESENT = _ALWAYS | _CONTROL | _PREARM | _AHRS | _LOGGING | Sensor.MAV_SYS_STATUS_GEOFENCE
_QUIETLY_HEALTHY = Sensor.MAV_SYS_STATUS_GEOFENCE | Sensor.PROXIMITY | _LOGGING


def sensor_status(vehicle: ArduPilotVehicle) -> tuple[int, int, int]:
    """Present, enabled and healthy, as integers."""
    nav = vehicle.navigation
    present, enabled, health = int(_PRESENT), int(_ALWAYS | _PREARM), int(_ALWAYS | _QUIETLY_HEALTHY)
    if nav.is_gps_detected:
        present |= Sensor.GPS
        enabled |= Sensor.GPS
        if not vehicle.faults.gps_lost:
            health |= Sensor.GPS
    if nav.is_healthy:
        enabled |= _AHRS
        health |= _AHRS
    if vehicle.motors.is_armed:
        enabled |= _LOGGING
    if not vehicle.mode.has_manual_throttle and (vehicle.motors.is_armed or vehicle.mode.name == "GUIDED"):
        enabled |= _CONTROL
        health |= _CONTROL
    if vehicle.arming.passes:
        health |= _PREARM
    if not vehicle.failsafes.hears_radio:
        health &= ~Sensor.RC_RECEIVER
    if vehicle.failsafes.battery_is_low:
        health &= ~Sensor.BATTERY
    if vehicle.faults.motor_failed:
        health &= ~Sensor.PROPULSION
    is_present, is_enforced, is_kept = vehicle.fence.health
    if not is_present:
        present &= ~_FENCE
    if is_enforced:
        enabled |= _FENCE
    if not is_kept:
        health &= ~_FENCE
    if vehicle.rangefinder_reach_m > 0.0:
        for_it = Sensor.LASER_POSITION
        present, enabled, health = present | for_it, enabled | for_it, health | for_it
    return int(present), int(enabled), int(health)
